"""Every file of shared/data/cases, as other programs wrote it, is read whole and as the right values say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for package in ("nibabel", "nrrd"):
    pytest.importorskip(package, reason="the extra mesh is absent")

from softtwin.app.register import find_clouds
from softtwin.meshes.body import Surface
from softtwin.meshes.checks import put_in_order
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import FileError, Volume, read_cloud, read_mesh
from softtwin.meshes.io.common import SMALLEST, in_metres, unit_advice
from softtwin.meshes.metrics import cell_volumes
from softtwin.meshes.segmentation import find, organ_surface, read_segmentation, voxels_of
from softtwin.registration.pose import read_landmarks, read_matrix

CASES = Path(__file__).parents[3] / "shared" / "data" / "cases"
if not CASES.is_dir():
    pytest.skip("../shared/data/cases is not there", allow_module_level=True)
EXPECTED: list[dict[str, Any]] = json.loads((CASES / "expected.json").read_text())
_VOLUME, _VOXELS = 0.02, 0.05  # as README.md beside the files says


def of_kind(*kinds: str) -> list[Any]:
    return [pytest.param(row, id=row["file"]) for row in EXPECTED if row["kind"] in kinds]


def test_every_row_is_of_a_kind_that_is_tested_here() -> None:
    kinds = {"volume", "surface", "labels", "folder", "cloud", "landmarks", "transform"}
    assert {row["kind"] for row in EXPECTED} <= kinds and len(EXPECTED) >= 36


@pytest.mark.parametrize("row", of_kind("volume"))
def test_a_volume_mesh(row: dict[str, Any]) -> None:
    volume, expect = read_mesh(CASES / row["file"], "mm"), row["expect"]
    assert isinstance(volume, Volume)
    kind = volume.cells.shape[1]
    linear = volume.cells[:, : 4 if kind in (4, 10) else 8]
    assert len(volume.points) == expect.get("nodes", len(volume.points))
    wanted = expect.get("linear_volume_ml", expect["volume_ml"])
    assert 1e6 * cell_volumes(volume.points, linear).sum() == pytest.approx(wanted, rel=1e-4)
    assert len(volume.cells) == expect.get("tetrahedra", len(volume.cells))
    if "dropped_nodes" in expect:
        assert any(f"{expect['dropped_nodes']} of" in line for line in volume.said)


@pytest.mark.parametrize("row", of_kind("surface"))
def test_a_surface(row: dict[str, Any]) -> None:
    surface, expect = read_mesh(CASES / row["file"], "mm"), row["expect"]
    assert isinstance(surface, Surface)
    ordered, defects = put_in_order(surface)
    assert 1e6 * ordered.volume == pytest.approx(expect["volume_ml"], rel=1e-3)
    assert defects.open_edges == 0
    assert [1e6 * volume for volume in defects.cavities] == pytest.approx(
        [expect["cavity_ml"]] if "cavity_ml" in expect else [], rel=_VOLUME
    )
    assert defects.misleading == ("both_out" in row["file"])


@pytest.mark.parametrize("row", of_kind("labels"))
def test_labels(row: dict[str, Any]) -> None:
    expect, path = row["expect"], CASES / row["file"]
    unit = expect.get("given", {}).get("unit")
    segmentation = read_segmentation(path, None, unit)
    organ = str(expect.get("label", expect.get("organ", 1)))
    if "volume_ml" in expect:
        surface, notes = organ_surface(segmentation, organ)
        assert 1e6 * surface.volume == pytest.approx(expect["volume_ml"], rel=_VOXELS)
        if "cavity_ml" in expect:
            assert any(f"{expect['cavity_ml']:g} ml stay open" in note for note in notes)
    if unit:
        size = float(np.ptp(organ_surface(read_segmentation(path), organ)[0].points, axis=0).max())
        assert size == pytest.approx(112, rel=0.02)
        assert expect["without"]["refused_naming"] in unit_advice(size, "m")
        assert f"{unit} was taken" in notes[0]


def test_parts_of_structures_that_leave_the_organ() -> None:
    expect = next(row["expect"] for row in EXPECTED if row["file"].startswith("tumour_surface"))
    segmentation = read_segmentation(CASES / "tumour_surface" / "seg.nii.gz")
    joined, notes = organ_surface(segmentation, "1", inner=["3"], join=["2"])
    assert 1e6 * joined.volume == pytest.approx(expect["joined_volume_ml"], rel=0.003)
    assert any(note.startswith("segmentation: 3 lies inside by 7") for note in notes)  # 79 %, and a lid that is flat
    outline, notes = organ_surface(segmentation, "1", inner=["2", "3"])
    assert any(note.startswith("segmentation: 2 lies inside by 48 %") for note in notes)  # a flat lid: 60 are right
    assert any(note.startswith("segmentation: 3 lies inside by 77 %") for note in notes)  # 79 are right
    assert 1e6 * outline.volume == pytest.approx(expect["outline_ml"], rel=0.006)
    every, _ = organ_surface(segmentation, "1", join=["2", "3"])
    assert 1e6 * every.volume == pytest.approx(expect["all_labels_ml"], rel=0.002)
    for name in ("tumour", "vessel"):
        voxels = voxels_of(segmentation, find(segmentation, str(expect["inner"][name])))
        assert 1e6 * voxels.volume == pytest.approx(expect[f"{name}_ml"], rel=0.005)


def test_a_component_by_size_by_side_and_by_the_tumour() -> None:
    expect = next(row["expect"] for row in EXPECTED if row["file"].startswith("kidneys"))
    segmentation = read_segmentation(CASES / "kidneys" / "seg.nii.gz")
    large, small = expect["components_ml"]

    def volume(component: str, **more: Any) -> float:
        return 1e6 * organ_surface(segmentation, "1", component=component, **more)[0].volume

    for component, wanted in (("largest", large), ("1", large), ("2", small), ("near:2", small)):
        assert volume(component) == pytest.approx(wanted, rel=0.002)
    assert {round(volume("left")), round(volume("right"))} == {round(large), round(small)}
    assert volume("near:2", join=["2"]) == pytest.approx(expect["component_with_tumour_ml"], rel=0.002)
    assert volume("near:2", inner=["2"]) == pytest.approx(expect["component_with_tumour_ml"], rel=0.002)
    warning = organ_surface(segmentation, "1")[1][1]
    assert warning.startswith("warning: component: largest, 122.7 ml, was kept; 105 ml") and "--component" in warning


def test_two_segments_of_one_name() -> None:
    segmentation = read_segmentation(CASES / "nrrd_twice" / "a.seg.nrrd")
    for asked in ("tumor", "tumour", "Tumor"):
        with pytest.raises(FileError, match=r"one segment called 'tumor', it has 2: .*tumor \(1\).*tumor \(2\)"):
            find(segmentation, asked)
    assert find(segmentation, "tumor (1)")[0].value == 2
    assert find(segmentation, "2")[0].value == 2


@pytest.mark.parametrize("row", of_kind("folder"))
def test_a_folder(row: dict[str, Any]) -> None:
    folder, expect = (CASES / row["file"]).parent, row["expect"]
    if "points" in expect:
        clouds = find_clouds([folder], Coordinates("mm", "lps"))
        assert [len(cloud.read()) for cloud in clouds] == [expect["points"]]
    else:
        surface, _ = organ_surface(read_segmentation(folder), "liver")
        assert 1e6 * surface.volume == pytest.approx(expect["volume_ml"], rel=_VOXELS)


@pytest.mark.parametrize("row", of_kind("cloud"))
def test_a_cloud(row: dict[str, Any]) -> None:
    cloud, expect = read_cloud(CASES / row["file"], "mm"), row["expect"]
    assert len(cloud) == expect["points"]
    assert 1e3 * cloud.mean(axis=0) == pytest.approx(expect["centroid_mm"], abs=0.01)


@pytest.mark.parametrize("row", of_kind("landmarks"))
def test_landmarks(row: dict[str, Any]) -> None:
    path = CASES / row["file"]
    body = read_landmarks(path, "mm", "lps")
    assert sorted(body) == ["corner", "ligament", "notch", "tip"] and len(body) == row["expect"]["landmarks"]
    assert body["tip"] == pytest.approx(in_metres([98.4322, -111.2878, 297.9998], "mm"))
    other = read_landmarks(path.with_name("body_lps.csv"), "mm", "lps")
    assert all(body[name] == pytest.approx(other[name], abs=1e-9) for name in body)
    assert len(read_landmarks(path.with_name("camera.csv"), "m", "lps")) == 4  # a table of Slicer is in millimetres
    assert np.ptp(list(body.values()), axis=0).max() > SMALLEST


@pytest.mark.parametrize("row", of_kind("transform"))
def test_a_transform(row: dict[str, Any]) -> None:
    found, same = (read_matrix(CASES / name) for name in (row["file"], row["expect"]["same_as"]))
    assert found.matrix == pytest.approx(same.matrix, abs=1e-9)


def test_larger_balls_find_no_more_of_a_structure_within(monkeypatch: pytest.MonkeyPatch) -> None:
    segmentation = read_segmentation(CASES / "tumour_surface" / "seg.nii.gz")
    shares = {}
    for radii in (1.0, 2.0, 4.0, 8.0):
        monkeypatch.setattr("softtwin.meshes.voxels._LID", radii)
        notes = organ_surface(segmentation, "1", inner=["2", "3"])[1]
        shares[radii] = [any(f"segmentation: {label} lies inside by {share} %" in note for note in notes)
                         for label, share in (("2", 48), ("3", 77))]  # fmt: skip
    assert shares[4.0] == shares[8.0] == [True, True] and not shares[1.0][0] and not shares[2.0][0]
