import logging
import signal

import numpy as np
import pytest

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.metrics import tetrahedron_quality
from softtwin.meshes.solidify import SurfaceError, checked_surface, intersecting_triangles, repair, solidify


def _two(first: Surface, second: Surface) -> Surface:
    points = np.concatenate([first.points, second.points])
    return Surface(points, np.concatenate([first.triangles, second.triangles + len(first.points)]))


def _opened(surface: Surface) -> Surface:
    return Surface(surface.points, surface.triangles[1:])


def _crossed(surface: Surface) -> Surface:
    points = surface.points.copy()
    points[points[:, 2].argmax(), 2] *= -1.5  # the north pole is pulled out through the south
    return Surface(points, surface.triangles)


def test_kept_triangles_are_the_boundary_of_the_solid(ball: Surface) -> None:
    points, cells = solidify(ball, cell_size=0.015, remesh=False)
    body = Body(points, cells, {"fixed": np.arange(len(points) - 1)})
    assert len(body.boundary) == len(ball.triangles)
    # Exact in principle; the nodes went through gmsh in double precision.
    assert body.volume == pytest.approx(ball.volume, rel=1e-12)


def test_a_remeshed_solid_keeps_the_shape_and_has_good_cells(ball: Surface) -> None:
    points, cells = solidify(ball, cell_size=0.012)
    body = Body(points, cells, {"fixed": np.arange(len(points) - 1)})
    # Flat triangles of edge h cut h^2 / 8R off the radius, three times that relative to the volume.
    assert body.volume == pytest.approx(ball.volume, rel=6 * 0.012**2 / (8 * 0.05**2))
    assert tetrahedron_quality(points, cells).min() > 0.2


@pytest.mark.parametrize("node_count", [150, 600])
def test_a_wanted_number_of_nodes_is_met(ball: Surface, node_count: int, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        points, _ = solidify(ball, node_count=node_count)
    assert len(points) == pytest.approx(node_count, rel=0.1)
    assert f"asked for {node_count} nodes, made {len(points)}" in caplog.text


def test_smaller_cells_make_more_of_them(ball: Surface) -> None:
    counts = [len(solidify(ball, cell_size=size)[1]) for size in (0.02, 0.01)]
    assert counts[1] > 4 * counts[0]


def test_an_inside_out_surface_is_turned_with_a_note(ball: Surface, caplog: pytest.LogCaptureFixture) -> None:
    turned = Surface(ball.points, ball.triangles[:, ::-1])
    with caplog.at_level(logging.INFO):
        assert checked_surface(turned).volume == ball.volume
    assert "inside out" in caplog.text


def test_an_open_surface_is_refused_with_the_number_of_open_edges(ball: Surface) -> None:
    with pytest.raises(SurfaceError, match=r"got 3 open edges .* of 768; close the holes .*\(--repair\)"):
        solidify(_opened(ball), cell_size=0.01)


def test_an_edge_of_three_triangles_is_refused(ball: Surface) -> None:
    a, b, c = ball.triangles[0]
    points = np.concatenate([ball.points, [[0.2, 0.2, 0.2]]])
    top = len(ball.points)
    fins = [[a, b, top], [b, c, top], [c, a, top]]
    with pytest.raises(SurfaceError, match="got 3 edges shared by more than two triangles"):
        checked_surface(Surface(points, np.concatenate([ball.triangles, fins])))


def test_a_surface_of_mixed_winding_is_refused(ball: Surface) -> None:
    triangles = ball.triangles.copy()
    triangles[0] = triangles[0, ::-1]
    with pytest.raises(SurfaceError, match="wind against each other"):
        checked_surface(Surface(ball.points, triangles))


def test_a_self_intersecting_surface_is_refused_with_the_number_of_triangles(ball: Surface) -> None:
    assert len(intersecting_triangles(ball)) == 0
    crossed = _crossed(ball)
    count = len(intersecting_triangles(crossed))
    assert count > 0
    with pytest.raises(SurfaceError, match=rf"got {count} of 512 triangles that cut others; repair it \(--repair\)"):
        solidify(crossed, cell_size=0.01)


def test_two_components_are_refused(ball: Surface) -> None:
    far = Surface(ball.points + np.array([0.2, 0, 0]), ball.triangles)
    with pytest.raises(SurfaceError, match=r"expected one component, got 2 with \[512, 512\] triangles"):
        solidify(_two(ball, far), cell_size=0.01)


@pytest.mark.parametrize("damage", [_opened, _crossed, lambda s: _two(s, Surface(0.1 * s.points + 0.2, s.triangles))])
def test_a_repaired_surface_can_be_made_solid(ball: Surface, damage) -> None:  # type: ignore[no-untyped-def]
    damaged = damage(ball)
    with pytest.raises(SurfaceError):
        checked_surface(damaged)
    repaired = repair(damaged)
    assert repaired.volume == pytest.approx(ball.volume, rel=0.1)
    assert len(solidify(repaired, cell_size=0.015)[1]) > 100


def test_neither_or_both_of_size_and_count_is_refused(ball: Surface) -> None:
    for wish in ({}, {"cell_size": 0.01, "node_count": 100}):
        with pytest.raises(ValueError, match="expected one of cell_size and node_count"):
            solidify(ball, **wish)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="cell_size: expected a positive length in metres, got -1"):
        solidify(ball, cell_size=-1)
    with pytest.raises(ValueError, match="node_count: expected at least 20, got 3"):
        solidify(ball, node_count=3)


def test_gmsh_leaves_ctrl_c_alone_and_says_nothing(ball: Surface, capfd: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGINT)
    solidify(ball, cell_size=0.02)
    assert signal.getsignal(signal.SIGINT) is before
    assert capfd.readouterr() == ("", "")
