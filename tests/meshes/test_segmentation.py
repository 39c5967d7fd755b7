"""Segmentations become closed, smooth surfaces at the right place, whatever file and grid they come in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

nibabel = pytest.importorskip("nibabel", reason="the extra mesh is absent")
pytest.importorskip("nrrd", reason="the extra mesh is absent")

from labels import Grid, ellipsoid, write_nifti, write_nrrd

from softtwin.meshes.body import Surface
from softtwin.meshes.checks import put_in_order
from softtwin.meshes.io import FileError, is_segmentation
from softtwin.meshes.io.labels import read_labelmap
from softtwin.meshes.segmentation import (
    distances_to,
    find,
    inner_surface,
    organ_surface,
    read_segmentation,
    the_organ,
)

MIDDLE, RADII = (14.0, -28.0, 218.0), (34.0, 22.0, 27.0)
ORGAN = ellipsoid(MIDDLE, RADII)
TUMOUR = ellipsoid((24.0, -30.0, 222.0), (9.0, 8.0, 8.0))
VOLUME = 4e-9 / 3 * np.pi * float(np.prod(RADII))
CAVA = ellipsoid((14.0, 6.0, 218.0), (8.0, 12.0, 30.0))  # touches the organ's back


def surface_of(path: Path, name: str = "") -> Surface:
    segmentation = read_segmentation(path)
    return organ_surface(segmentation, name or the_organ(segmentation))[0]


def check_place(surface: Surface, grid: Grid) -> None:
    """Nowhere farther from the truth than half a voxel's diagonal, and not off to one side."""
    away = ORGAN(1e3 * surface.points)
    coarsest = max(grid.spacing)
    assert np.abs(away).max() < 0.5 * np.linalg.norm(grid.spacing)
    assert np.abs(away).mean() < 0.15 * coarsest
    a, b, c = (surface.points[surface.triangles[:, i]] for i in range(3))
    six = np.einsum("ti,ti->t", a, np.cross(b, c))
    centroid = 1e3 * ((a + b + c) / 4 * six[:, None]).sum(axis=0) / six.sum()
    assert np.linalg.norm(centroid - MIDDLE) < 0.1 * coarsest  # half a voxel off would be 0.5 and more
    assert surface.volume == pytest.approx(VOLUME, rel=0.01)


@pytest.mark.parametrize("grid", [Grid(), Grid(turn=20.0, flips=(0,)), Grid((1.0, 1.0, 4.0), 20.0, (0, 1, 2))])
@pytest.mark.parametrize("kind", ["nifti", "lps", "ras"])
def test_an_organ_is_where_it_is_in_every_kind_of_file(tmp_path: Path, grid: Grid, kind: str) -> None:
    labels = grid.label(ORGAN)
    if kind == "nifti":
        path = write_nifti(tmp_path / "liver.nii.gz", grid, labels)
    else:
        path = write_nrrd(tmp_path / "liver.seg.nrrd", grid, labels, {"liver": (0, 1)}, kind)
    check_place(surface_of(path), grid)


@pytest.mark.parametrize("spacing", [(1.5, 1.5, 1.5), (0.8, 0.8, 5.0), (3.0, 3.0, 3.0)])
def test_surfaces_are_closed_outward_and_without_steps(tmp_path: Path, spacing: tuple[float, float, float]) -> None:
    grid = Grid(spacing, half=(45.0, 34.0, 42.0))
    surface = surface_of(write_nifti(tmp_path / "liver.nii", grid, grid.label(ORGAN)))
    _, defects = put_in_order(surface)
    assert surface.volume > 0 and defects.pieces == 1 and not defects.winds_inward
    assert defects.open_edges == defects.crowded_edges == defects.clashing_edges == 0
    a, b, c = (surface.points[surface.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    truth = (1e3 * (a + b + c) / 3 - MIDDLE) / np.square(RADII)
    cosines = np.einsum("ti,ti->t", normals, truth) / np.linalg.norm(normals, axis=1) / np.linalg.norm(truth, axis=1)
    leaning = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert np.sqrt((leaning**2).mean()) < 12.0  # the faces of voxels lean by 40 degrees and more


def test_voxels_finer_than_the_surface_are_taken_together_at_the_same_place(tmp_path: Path) -> None:
    grid = Grid((0.15, 0.15, 2.0), half=(37.0, 25.0, 31.0))
    surface = surface_of(write_nifti(tmp_path / "liver.nii", grid, grid.label(ORGAN)))
    away = ORGAN(1e3 * surface.points)
    assert np.abs(away).mean() < 0.15 and abs(away.mean()) < 0.05
    assert surface.volume == pytest.approx(VOLUME, rel=0.01)
    assert len(surface.triangles) < 200_000  # 0.15 mm would make 1.3 millions


def test_names_of_totalsegmentator_are_understood(tmp_path: Path) -> None:
    grid = Grid()
    names = {1: "liver", 2: "liver_tumor", 3: "inferior_vena_cava", 4: "spleen"}
    segmentation = read_segmentation(
        write_nifti(tmp_path / "total.nii.gz", grid, grid.label(ORGAN, TUMOUR, CAVA), names)
    )
    assert [s.name for s in segmentation.structures] == ["liver", "liver_tumor", "inferior_vena_cava"]  # no spleen
    assert the_organ(segmentation) == "liver"
    assert [s.value for word in ("Tumour", "LIVER", "vena cava", "3") for s in find(segmentation, word)] == [2, 1, 3, 3]
    with pytest.raises(FileError, match=r"'spleen', it has liver, liver_tumor, inferior_vena_cava"):
        find(segmentation, "spleen")


def test_a_tumour_with_a_label_of_its_own_belongs_to_the_organ_around_it(tmp_path: Path) -> None:
    grid = Grid()
    names = {1: "liver", 2: "liver_tumor", 3: "inferior_vena_cava"}
    path = write_nifti(tmp_path / "total.nii.gz", grid, grid.label(ORGAN, TUMOUR, CAVA), names)
    segmentation = read_segmentation(path)
    surface, notes = organ_surface(segmentation, "liver", ["tumour", "vena_cava"])
    assert "tumour lies inside liver" in " ".join(notes) and "vena_cava lies" not in " ".join(notes)
    beside = ORGAN(1e3 * surface.points)[1e3 * surface.points[:, 1] < -25.0]  # away from the vein
    assert np.abs(beside).max() < 2.0
    tumour, _ = inner_surface(segmentation, "tumour")
    assert np.abs(TUMOUR(1e3 * tumour.points)).mean() < 0.4


def test_a_folder_of_files_is_a_segmentation_and_segments_make_a_liver(tmp_path: Path) -> None:
    grid = Grid()
    for number, side in ((1, 1), (2, -1)):
        half = grid.label(lambda x, side=side: np.maximum(ORGAN(x), side * (x[..., 0] - MIDDLE[0])))
        write_nifti(tmp_path / f"liver_segment_{number}.nii.gz", grid, half)
    write_nifti(tmp_path / "portal_vein_and_splenic_vein.nii.gz", grid, grid.label(CAVA))
    for companion in ("._liver.nii.gz", ".liver.nii.gz", "~$liver.nii.gz"):
        (tmp_path / companion).write_bytes(b"Mac OS X        ")  # beside the files of a folder that was copied
    assert is_segmentation(tmp_path)
    segmentation = read_segmentation(tmp_path)
    surface, notes = organ_surface(segmentation, the_organ(segmentation))
    check_place(surface, grid)
    assert "liver_segment_1 + liver_segment_2" in notes[0]
    assert [s.name for s in find(segmentation, "liver_segment_2")] == ["liver_segment_2"]
    assert [s.name for s in find(segmentation, "portal_vein")] == ["portal_vein_and_splenic_vein"]
    write_nifti(tmp_path / "liver_segment_3.nii.gz", Grid(turn=5.0), grid.label(CAVA))
    with pytest.raises(FileError, match="expected the same voxels"):
        organ_surface(read_segmentation(tmp_path), "liver")


def test_layers_of_slicer_overlap(tmp_path: Path) -> None:
    grid = Grid()
    layers = np.stack([grid.label(ORGAN), 3 * grid.label(TUMOUR)])
    path = write_nrrd(tmp_path / "a.seg.nrrd", grid, layers, {"Liver": (0, 1), "Tumor 1": (1, 3)}, "ras")
    segmentation = read_segmentation(path)
    check_place(organ_surface(segmentation, "liver")[0], grid)
    assert np.abs(TUMOUR(1e3 * inner_surface(segmentation, "tumour")[0].points)).mean() < 0.4


def test_labels_without_names_go_by_number(tmp_path: Path) -> None:
    grid = Grid()
    segmentation = read_segmentation(write_nifti(tmp_path / "a.nii.gz", grid, grid.label(ORGAN, TUMOUR)))
    assert find(segmentation, "2")[0].value == 2
    with pytest.raises(FileError, match=r"it has 1, 2\..*by number"):
        find(segmentation, "liver")
    with pytest.raises(FileError, match=r"expected --organ .*it has 1, 2"):
        the_organ(segmentation)


def test_labels_stored_as_floats_are_read_as_what_they_are(tmp_path: Path) -> None:
    grid = Grid()
    labels = grid.label(ORGAN)
    volume = read_labelmap(write_nifti(tmp_path / "a.nii.gz", grid, labels.astype(np.float64)))
    assert volume.labels.dtype == np.uint8 and np.array_equal(volume.labels[0], labels)


@pytest.mark.parametrize("kind", ["probabilities", "image", "series", "plain", "empty", "truncated", "no space"])
def test_what_is_no_segmentation_is_refused_with_the_reason(tmp_path: Path, kind: str) -> None:
    grid = Grid()
    labels = grid.label(ORGAN)
    wrong = {
        "probabilities": (0.7 * labels, "whole number"),
        "image": (np.where(labels, 60, -1000).astype(np.int16), "is it the image itself"),
        "series": (np.stack([labels, labels], axis=-1), "three axes"),
        "empty": (0 * labels, "all are 0"),
        "plain": (labels, "suffix '.dcm'"),
        "truncated": (labels, "truncated or damaged"),
        "no space": (labels, "--frame lps or --frame ras"),
    }
    content, said = wrong[kind]
    path = tmp_path / ("a.nrrd" if kind == "no space" else "a.nii.gz")
    if kind == "no space":
        write_nrrd(path, grid, content, axes="")
        assert read_segmentation(path, "ras").axes == "ras"
    else:
        write_nifti(path, grid, content)
    if kind == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    if kind == "plain":
        path = path.rename(tmp_path / "a.dcm")
    with pytest.raises(FileError, match=said):
        read_segmentation(path)


def test_one_voxel_thick_is_refused_as_a_surface_and_good_enough_to_touch(tmp_path: Path) -> None:
    grid = Grid()
    labels = grid.label(ORGAN)
    sheet = np.zeros_like(labels)
    sheet[:, 20, :] = 1
    segmentation = read_segmentation(write_nifti(tmp_path / "sheet.nii.gz", grid, sheet))
    with pytest.raises(FileError, match="more than one voxel thick"):
        organ_surface(segmentation, "sheet")
    middle = 1e-3 * (grid.axes @ [25, 20, 25] + grid.origin)
    beside = middle + 1e-3 * np.array([[0.0, 0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 5.0, 0.0]])  # half a voxel is 1 mm
    assert distances_to(segmentation, "sheet", beside) == pytest.approx(
        [0.0, 0.0, 0.004], abs=1e-7
    )  # NIfTI holds places in single precision


def test_crumbs_and_cavities_go_and_are_said(tmp_path: Path) -> None:
    grid = Grid()
    labels = grid.label(ORGAN)
    labels[2:5, 2:5, 2:5] = 1
    labels[24:27, 19:22, 22:25] = 0
    surface, notes = organ_surface(read_segmentation(write_nifti(tmp_path / "liver.nii", grid, labels)), "liver")
    check_place(surface, grid)
    assert "0.216 ml in others left out" in " ".join(notes) and "cavities of 0.216 ml filled" in " ".join(notes)


def test_an_organ_that_is_cut_off_is_closed_and_said(tmp_path: Path) -> None:
    grid = Grid(half=(50.0, 40.0, 20.0))
    surface, notes = organ_surface(
        read_segmentation(write_nifti(tmp_path / "liver.nii", grid, grid.label(ORGAN))), "liver"
    )
    assert any(note.startswith("warning: liver reaches the edge") for note in notes)
    assert put_in_order(surface)[1].open_edges == 0
