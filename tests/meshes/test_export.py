"""Surfaces, points and series written: what a reader finds is what was given, in the unit and on the axes asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.export import SURFACE_FORMATS, Coordinates, write_points, write_series, write_surface
from softtwin.meshes.files import FileError, read_cloud, read_surface

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
