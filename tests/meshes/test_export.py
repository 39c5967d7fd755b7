"""Surfaces, points and series written: what a reader finds is what was given, in the unit and on the axes asked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista
from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader
from vtkmodules.vtkIOPLY import vtkPLYReader
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.export import SURFACE_FORMATS, Coordinates, write_points, write_series, write_surface
from softtwin.meshes.io import (
    FileError,
    read_cloud,
    read_surface,
    read_volume,
    stated_axes,
    stated_unit,
    write_deformed,
)

SINGLE = 1e-7  # relative rounding of a number in single precision, which STL and PLY have


@pytest.fixture
def surface(tetrahedral_beam: Body) -> Surface:
    return tetrahedral_beam.boundary_surface


@pytest.mark.parametrize("kind", SURFACE_FORMATS)
@pytest.mark.parametrize("place", [Coordinates(), Coordinates("mm"), Coordinates("cm", "ras")])
def test_a_surface_comes_back(tmp_path: Path, surface: Surface, kind: str, place: Coordinates) -> None:
    path = tmp_path / f"organ.{kind}"
    write_surface(path, Surface(place.lengths(surface.points), surface.triangles))
    back = read_surface(path, place.unit, place.axes)
    assert len(back.triangles) == len(surface.triangles)
    assert back.volume == pytest.approx(surface.volume, rel=1e-5)  # and its sign: it winds outward still
    for corner in (surface.points.min(axis=0), surface.points.max(axis=0)):
        assert np.abs(back.points - corner).max(axis=1).min() <= SINGLE
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("kind", SURFACE_FORMATS)
def test_vertices_that_no_triangle_uses_are_left_out(tmp_path: Path, kind: str) -> None:
    points = np.vstack([np.full((1, 3), 9.0), 0.1 * np.eye(3)])
    write_surface(tmp_path / f"a.{kind}", Surface(points, np.array([[1, 2, 3]])), {"height": np.arange(4.0)})
    written = pyvista.read(tmp_path / f"a.{kind}")
    assert written.n_points == 3 and np.abs(written.points).max() < 1.0
    if kind == "vtp":
        assert np.array_equal(written.point_data["height"], [1.0, 2.0, 3.0])


@pytest.mark.parametrize("kind", ["ply", "vtp"])
def test_points_come_back(tmp_path: Path, rng, kind: str) -> None:
    cloud = rng.random((40, 3))
    write_points(tmp_path / f"cloud.{kind}", cloud, {"weight": np.ones(40)})
    assert np.abs(read_cloud(tmp_path / f"cloud.{kind}") - cloud).max() <= SINGLE


def test_what_cannot_be_written_is_said_with_its_name(tmp_path: Path, surface: Surface) -> None:
    with pytest.raises(FileError, match=r"organ\.off: expected the suffix \.stl, \.ply, \.obj, \.vtp"):
        write_surface(tmp_path / "organ.off", surface)
    with pytest.raises(FileError, match="triangles alone"):
        write_points(tmp_path / "cloud.stl", surface.points)
    with pytest.raises(FileError, match=r"organ\.vtp: could not be written"):
        write_surface(tmp_path / "nowhere" / "organ.vtp", surface)


def test_coordinates_lead_out_and_back(rng) -> None:
    points, place = rng.standard_normal((5, 3)), Coordinates("mm", "ras")
    assert np.array_equal(place.lengths([[1.0, 2.0, 3.0]]), [[-1000.0, -2000.0, 3000.0]])
    np.testing.assert_allclose(place.metres(place.lengths(points)), points, rtol=1e-15)
    matrix = rng.standard_normal((4, 4))
    assert np.array_equal(place.motion(place.motion(matrix)), matrix)
    with pytest.raises(ValueError, match="got 'inch' and 'lps'"):
        Coordinates("inch")


def test_paraview_reads_a_series(tmp_path: Path, surface: Surface) -> None:
    """Two parts over three times, one of them with a name that XML would take for its own."""
    pieces = []
    for time in range(3):
        for name in ("organ", 'a "b" & <c>'):
            file = f"part{len(pieces)}.vtp"
            write_surface(tmp_path / file, surface)
            pieces.append((float(time), name, file))
    write_series(tmp_path / "frames.pvd", pieces)
    reader = pyvista.get_reader(tmp_path / "frames.pvd")
    assert list(reader.time_values) == [0.0, 1.0, 2.0]
    reader.set_active_time_value(2.0)
    assert [(data.path, data.part) for data in reader.active_datasets] == [("part4.vtp", 0), ("part5.vtp", 1)]
    assert reader.read().n_blocks == 2


# --- What a file states about itself.

FRAMES = [Coordinates("mm"), Coordinates("mm", "ras"), Coordinates("m"), Coordinates("m", "ras")]
CLOSE = 1e-6  # metres: the thousandth of a millimetre that was promised, hundreds of times single precision's rounding


@pytest.fixture
def lump(rng) -> Surface:
    """A surface of an organ's size, far from the origin, without any symmetry that a wrong axis would hide behind."""
    points = np.array([0.11, -0.23, 0.41]) + 0.1 * rng.standard_normal((60, 3))
    return Surface(points, np.array([[i, (i + 1) % 60, (i + 17) % 60] for i in range(60)]))


def in_order(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(np.round(points, 6).T)]


@pytest.mark.parametrize("kind", SURFACE_FORMATS)
@pytest.mark.parametrize("place", FRAMES, ids=str)
def test_a_surface_is_read_back_without_being_told_how(
    tmp_path: Path, lump: Surface, kind: str, place: Coordinates
) -> None:
    path = tmp_path / f"Gefäß 1.{kind}"
    write_surface(path, Surface(place.lengths(lump.points), lump.triangles), place=place)
    assert (stated_axes(path), stated_unit(path)) == (place.axes, place.unit)
    assert np.abs(in_order(read_surface(path).points) - in_order(lump.points)).max() < CLOSE
    written = np.asarray(pyvista.read(path).points, dtype=np.float64)  # by VTK's own readers: what stands in the file
    assert np.abs(in_order(place.metres(written)) - in_order(lump.points)).max() < CLOSE


@pytest.mark.parametrize("kind", SURFACE_FORMATS)
@pytest.mark.parametrize("axes", ["LPS", "RAS"])
def test_slicer_finds_the_axes_where_it_looks_for_them(tmp_path: Path, lump: Surface, kind: str, axes: str) -> None:
    """By the members of VTK's readers that vtkMRMLModelStorageNode::ReadDataInternal asks."""
    path = tmp_path / f"organ.{kind}"
    write_surface(path, lump, place=Coordinates("m", axes.lower()))  # type: ignore[arg-type]
    reader = {"stl": vtkSTLReader, "ply": vtkPLYReader, "obj": vtkOBJReader, "vtp": vtkXMLPolyDataReader}[kind]()
    reader.SetFileName(str(path))
    reader.Update()
    if kind == "vtp":
        array = reader.GetOutput().GetFieldData().GetAbstractArray("SPACE")
        said = array.GetValue(0) if array.IsA("vtkStringArray") else ""
        assert said == axes
        return
    if kind == "ply":
        comments = reader.GetComments()
        said = " ".join(comments.GetValue(i) for i in range(comments.GetNumberOfValues()))
    else:
        said = reader.GetHeader() if kind == "stl" else reader.GetComment()
    assert f"SPACE={axes}" in said and "UNIT=m" in said


@pytest.mark.parametrize("kind", ["ply", "vtp"])
def test_points_state_their_coordinates(tmp_path: Path, lump: Surface, kind: str) -> None:
    path, place = tmp_path / f"cloud.{kind}", Coordinates("mm", "ras")
    write_points(path, place.lengths(lump.points), place=place)
    assert (stated_axes(path), stated_unit(path)) == ("ras", "mm")
    assert np.abs(read_cloud(path, "mm", "ras") - lump.points).max() < CLOSE


@pytest.mark.parametrize("place", FRAMES, ids=str)
def test_a_volume_states_its_coordinates(tmp_path: Path, tetrahedral_beam: Body, place: Coordinates) -> None:
    path = tmp_path / "organ.vtu"
    outside = replace(tetrahedral_beam, points=place.lengths(tetrahedral_beam.points), surfaces={}, inner={})
    moved = np.full_like(outside.points, 1.0)
    write_deformed(path, outside, moved, words=place.words)
    points, cells = read_volume(path)
    assert np.abs(points - place.metres(outside.points + moved)).max() < CLOSE
    assert np.array_equal(cells, tetrahedral_beam.cells)


def test_nothing_is_stated_that_nobody_has_said(tmp_path: Path, lump: Surface) -> None:
    for kind in SURFACE_FORMATS:
        write_surface(tmp_path / f"organ.{kind}", lump)
        assert stated_axes(tmp_path / f"organ.{kind}") is None and stated_unit(tmp_path / f"organ.{kind}") is None


def test_what_is_told_is_believed_over_what_a_file_states(tmp_path: Path, lump: Surface) -> None:
    path = tmp_path / "organ.stl"
    write_surface(path, lump, place=Coordinates("mm", "ras"))
    back = read_surface(path, "m", "lps")
    assert np.abs(in_order(back.points) - in_order(lump.points)).max() < CLOSE


def test_a_series_states_its_coordinates_and_opens_all_the_same(tmp_path: Path, lump: Surface) -> None:
    write_surface(tmp_path / "a.vtp", lump)
    write_series(tmp_path / "frames.pvd", [(0.0, "a", "a.vtp")], Coordinates("mm", "ras"))
    assert "SPACE=RAS UNIT=mm" in (tmp_path / "frames.pvd").read_text()
    assert pyvista.get_reader(tmp_path / "frames.pvd").read().n_blocks == 1


@pytest.mark.parametrize("kind", SURFACE_FORMATS)
def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path, lump: Surface, kind: str) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(FileError, match=rf"organ\.{kind}: could not be written"):
        write_surface(tmp_path / "file" / f"organ.{kind}", lump, place=Coordinates("mm"))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
