import signal

import numpy as np
import pytest
import pyvista

from softtwin.meshes import filling
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.checks import SurfaceError
from softtwin.meshes.filling import filled
from softtwin.meshes.metrics import tetrahedron_quality


def test_a_good_surface_is_filled_with_good_cells_and_keeps_its_shape(ball: Surface) -> None:
    points, cells = filled(ball, 0.012)
    # Flat triangles of edge h cut h^2 / 8R off the radius, three times that relative to the volume.
    assert Body(points, cells, {}).volume == pytest.approx(ball.volume, rel=6 * 0.012**2 / (8 * 0.05**2))
    assert tetrahedron_quality(points, cells).min() > 0.2


def test_the_same_mesh_comes_each_time(ball: Surface) -> None:
    first, second = filled(ball, 0.02), filled(ball, 0.02)
    assert np.array_equal(first[0], second[0]) and np.array_equal(first[1], second[1])


def stretched(axes: tuple[float, float, float]) -> Surface:
    """An ellipsoid of given half axes, metres, by stretching a sphere's triangles."""
    sphere = pyvista.Icosphere(nsub=4)
    return Surface(np.asarray(sphere.points, dtype=np.float64) * axes, sphere.regular_faces.astype(np.int64))


def test_another_number_of_triangles_mends_a_thin_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first number leaves open edges: without other ones this disk cannot be filled."""
    disk = stretched((0.1, 0.1, 0.01))
    points, cells = filled(disk, 0.01)
    assert Body(points, cells, {}).volume == pytest.approx(disk.volume, rel=0.1)
    assert tetrahedron_quality(points, cells).min() > 0.05
    monkeypatch.setattr(filling, "_ATTEMPTS", 1)
    with pytest.raises(SurfaceError, match="choose smaller cells"):
        filled(disk, 0.01)


def test_what_no_number_mends_is_said() -> None:
    with pytest.raises(SurfaceError, match=r"remeshed with triangles of 10 mm it lost its shape.*choose smaller cells"):
        filled(stretched((0.2, 0.02, 0.01)), 0.01)


def test_an_open_surface_is_refused(ball: Surface) -> None:
    with pytest.raises(SurfaceError, match="open edges"):
        filled(Surface(ball.points, ball.triangles[1:]), 0.02)


def test_gmsh_leaves_ctrl_c_alone_and_says_nothing(ball: Surface, capfd: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGINT)
    filled(ball, 0.02)
    assert signal.getsignal(signal.SIGINT) is before
    assert capfd.readouterr() == ("", "")
