"""An organ out of a segmentation: labels in words, attachment where another label touches, units and axes as stated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

for package in ("nibabel", "nrrd", "pytetwild"):
    pytest.importorskip(package, reason="the extra mesh is absent")

import nibabel
from labels import Grid, ellipsoid, write_nifti, write_nrrd

from softtwin.app import chain
from softtwin.app.cli import main
from softtwin.app.config import Config, ConfigError, parse_config
from softtwin.app.organ import Organ, make_organ
from softtwin.app.scan import framed
from softtwin.app.twin import coordinates_of
from softtwin.meshes.attachment import RegionError
from softtwin.meshes.body import Body
from softtwin.meshes.io import FileError, read_volume
from softtwin.meshes.segmentation import find, read_segmentation, voxels_of

ORGAN = ellipsoid((14.0, -28.0, 218.0), (34.0, 22.0, 27.0))
TUMOUR = ellipsoid((24.0, -30.0, 222.0), (9.0, 8.0, 8.0))
CAVA = ellipsoid((14.0, 6.0, 218.0), (8.0, 13.0, 16.0))
FAR = ellipsoid((-30.0, -62.0, 185.0), (6.0, 6.0, 6.0))
NAMES = {1: "liver", 2: "liver_tumor", 3: "inferior_vena_cava", 4: "gallbladder"}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, grid = tmp_path_factory.mktemp("scan"), Grid()
    labels = grid.label(ORGAN, TUMOUR, CAVA, FAR)
    write_nifti(folder / "total.nii.gz", grid, labels, NAMES)
    write_nrrd(folder / "total.seg.nrrd", grid, labels, {name: (0, value) for value, name in NAMES.items()})
    write_nrrd(folder / "placeless.nrrd", grid, labels, axes="")
    return folder


def made(files: Path, **entries: Any) -> Organ:
    base = {"source": "total.nii.gz:ras", "unit": "mm", "cell_size": 0.014, "fixed": "touching:vena_cava"}
    return make_organ(parse_config({"body": base | entries}).body, files)


def built(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> Config:
    """The configuration that `softtwin build` makes of its arguments."""
    seen: list[Config] = []
    monkeypatch.setattr(chain, "build_twin", lambda config, *_: seen.append(config))
    main(["build", *map(str, arguments)])
    return seen[0]


def test_build_makes_an_organ_of_labels_held_where_another_touches(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["--organ", "liver", "--inner", "tumour", "--fixed", "touching:inferior_vena_cava:6mm", "--nodes", 400]
    config = built(monkeypatch, files / "total.nii.gz", *words)
    assert coordinates_of(config).unit == "mm" and coordinates_of(config).axes == "ras"
    organ = make_organ(config.body, Path("/"))
    volume = 4e-9 / 3 * np.pi * 34 * 22 * 27
    assert organ.body.volume == pytest.approx(volume, rel=0.05)
    assert np.abs(ORGAN(1e3 * organ.body.points[organ.body.boundary_nodes])).max() < 4.0
    held = 1e3 * organ.body.points[organ.body.fixed]
    assert len(held) >= 3 and CAVA(held).max() < 6.0 + 1.8  # a voxel's half diagonal more
    assert np.abs(TUMOUR(1e3 * organ.body.inner["tumour"].points)).mean() < 0.4
    assert any("tumour lies inside liver" in note for note in organ.notes)


def test_a_picked_point_and_a_box_are_in_the_units_and_axes_of_the_file(files: Path) -> None:
    ras = "ball:-14,50,218:12"  # the organ's front is at y = -50 mm in LPS
    held = [1e3 * organ.body.points[organ.body.fixed] for organ in (
        made(files, fixed=ras),
        made(files, fixed="box:-30,40,200:0,60,236"),
        made(files, fixed="ball:14,-50,218mm:12mm", source="total.seg.nrrd:lps"),
    )]  # fmt: skip
    assert all(len(nodes) >= 3 and nodes[:, 1].max() < -38.0 for nodes in held)


@pytest.mark.parametrize("words", ["touching:gallbladder", "touching:gallbladder:2mm"])
def test_what_does_not_touch_is_refused_with_its_distance_before_a_mesh_is_made(
    files: Path, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.setattr("softtwin.app.organ.solidify", lambda *_, **__: pytest.fail("a mesh was made"))
    with pytest.raises(RegionError, match=r"touching gallbladder: expected it within .* of liver, it is .* mm away"):
        made(files, fixed=words)


def test_words_that_cannot_be_are_refused_before_a_mesh_is_made(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softtwin.app.organ.solidify", lambda *_, **__: pytest.fail("a mesh was made"))
    listed = "liver, liver_tumor, inferior_vena_cava, gallbladder"
    for entries in ({"organ": "kidney"}, {"inner": {"cyst": "cyst"}}, {"fixed": "touching:diaphragm"}):
        with pytest.raises(FileError, match=f"it has {listed}"):
            made(files, **entries)
    with pytest.raises(ConfigError, match='write unit = "mm"'):
        made(files, unit="m")
    with pytest.raises(ConfigError, match=r"expected source = .*total.nii.gz:ras"):
        made(files, source="total.nii.gz")
    with pytest.raises(ConfigError, match="expected a segmentation as source"):
        make_organ(parse_config({"body": {"fixed": "touching:spleen"}}).body, files)


def test_the_unit_that_is_said_wins_over_the_file_and_both_are_named(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["build", str(files / "total.nii.gz"), "--fixed", "touching:vena_cava", "--unit", "m"])
    assert "got 68.4 m across when read in m; say --unit mm, in which it is 68.4 mm" in capsys.readouterr().err
    shrunk = files / "shrunk.nii.gz"
    image = nibabel.load(files / "total.nii.gz")
    image.header.set_xyzt_units("micron")
    nibabel.save(image, shrunk)
    assert framed(str(shrunk), None, None) == (f"{shrunk}:ras", "mm", "ras")
    assert framed(str(shrunk), "mm", None) == (f"{shrunk}:mm:ras", "mm", "ras")
    segmentation = read_segmentation(shrunk, None, "mm")
    assert "says that it is in micrometres; mm was taken" in segmentation.notes[0]
    whole = read_segmentation(files / "total.nii.gz")
    volumes = [voxels_of(one, find(one, "liver")).volume for one in (segmentation, whole)]
    assert volumes[0] == pytest.approx(volumes[1])


@pytest.mark.parametrize(
    ("name", "words", "said"),
    [
        ("total.nii.gz", ["--frame", "lps"], "--frame: expected ras"),
        ("total.seg.nrrd", ["--frame", "ras"], "--frame: expected lps"),
        ("placeless.nrrd", [], "--frame: expected lps or ras"),
        ("none.nii.gz", [], "no such file"),
    ],
)
def test_a_frame_that_contradicts_the_file_is_refused(
    files: Path, capsys: pytest.CaptureFixture[str], name: str, words: list[str], said: str
) -> None:
    with pytest.raises(SystemExit):
        main(["build", str(files / name), "--fixed", "touching:vena_cava", *words])
    assert said in capsys.readouterr().err


def test_a_file_that_says_no_frame_takes_the_users(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = built(monkeypatch, files / "placeless.nrrd", "--frame", "ras", "--organ", "1", "--fixed", "touching:3")
    assert coordinates_of(config).axes == "ras" and config.body.organ == "1"


@pytest.mark.liver
def test_the_real_liver_comes_back_from_flat_voxels(liver_folder: Path, tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    points, cells = read_volume(liver_folder / "mesh-default" / "liver.msh")
    fixed = np.load(liver_folder / "mesh-default" / "dirichlet-vertices.npy")
    truth = Body(points, cells, {"fixed": fixed})
    surface = pyvista.PolyData.from_regular_faces(1e3 * points, truth.boundary_surface.triangles).clean()
    low, high = np.reshape(surface.bounds, (3, 2)).T
    grid = Grid((0.9, 0.9, 2.5), half=tuple((high - low) / 2 + 8), middle=tuple((low + high) / 2))
    image = pyvista.ImageData(dimensions=grid.shape, spacing=grid.spacing, origin=grid.origin)
    mask = surface.voxelize_binary_mask(reference_volume=image)["mask"].reshape(grid.shape, order="F")
    write_nifti(tmp_path / "liver.nii.gz", grid, mask.astype(np.uint8), {1: "liver"})
    picked = points[fixed[0]]
    held = f"ball:{','.join(f'{1e3 * x:.2f}' for x in picked * (-1, -1, 1))}:20mm"
    section = {"source": "liver.nii.gz:ras", "unit": "mm", "cell_size": 0.0153, "fixed": held}
    worst = []
    for _ in range(3):  # fTetWild meshes differently each time: where one node is too far off, two more have to be near
        body = make_organ(parse_config({"body": section}).body, tmp_path).body
        assert body.volume == pytest.approx(truth.volume, rel=0.02)  # flat faces between nodes cost a little
        made = pyvista.PolyData(1e3 * body.points[body.boundary_nodes])
        away = np.abs(made.compute_implicit_distance(surface)["implicit_distance"])
        assert away.mean() < 0.5 and np.quantile(away, 0.99) < 1.6
        worst.append(away.max())
        if worst[0] < 2.5:
            break
    assert np.median(worst) < 2.5
    assert len(body.fixed) > 5 and np.linalg.norm(body.points[body.fixed] - picked, axis=1).max() < 0.02
