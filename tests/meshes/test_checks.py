import logging

import numpy as np
import pytest

from softtwin.meshes.body import Surface
from softtwin.meshes.checks import SurfaceError, checked_surface, merged, piece_numbers, put_in_order


def _two(first: Surface, second: Surface) -> Surface:
    points = np.concatenate([first.points, second.points])
    return Surface(points, np.concatenate([first.triangles, second.triangles + len(first.points)]))


def test_a_good_surface_stays_as_it_is(ball: Surface) -> None:
    ordered, defects = put_in_order(ball)
    assert np.array_equal(ordered.points, ball.points) and np.array_equal(ordered.triangles, ball.triangles)
    assert (defects.open_edges, defects.pieces, defects.winds_inward) == (0, 1, False)


def test_vertices_at_one_place_are_merged_in_order(ball: Surface) -> None:
    points = ball.points[ball.triangles].reshape(-1, 3)
    rounding = 1e-9 * np.random.default_rng(0).standard_normal(points.shape)
    surface = merged(Surface(points + rounding, np.arange(len(points)).reshape(-1, 3)))
    assert len(surface.points) == len(ball.points)
    assert checked_surface(surface).volume == pytest.approx(ball.volume, rel=1e-6)


def test_narrow_gaps_are_stitched(ball: Surface) -> None:
    points = ball.points[ball.triangles].reshape(-1, 3)
    points = points + 1e-5 * np.random.default_rng(0).uniform(-1, 1, points.shape)
    ordered, defects = put_in_order(Surface(points, np.arange(len(points)).reshape(-1, 3)))
    assert (defects.open_edges, defects.pieces) == (0, 1)
    assert checked_surface(ordered).volume == pytest.approx(ball.volume, rel=1e-3)


def test_a_third_of_the_triangles_turned_are_turned_back(ball: Surface) -> None:
    triangles = ball.triangles.copy()
    triangles[::3] = triangles[::3, ::-1]
    ordered, defects = put_in_order(Surface(ball.points, triangles))
    assert defects.clashing_edges > 100
    assert checked_surface(ordered).volume == ordered.volume == pytest.approx(ball.volume, rel=1e-12)


def test_an_inside_out_surface_is_turned(ball: Surface) -> None:
    ordered, defects = put_in_order(Surface(ball.points, ball.triangles[:, ::-1]))
    assert defects.winds_inward and ordered.volume == ball.volume


def test_holes_get_flat_lids(ball: Surface) -> None:
    height = ball.points[ball.triangles, 2].mean(axis=1)
    ordered, defects = put_in_order(Surface(ball.points, ball.triangles[np.abs(height) < 0.042]))
    assert defects.holes == 2 and defects.open_edges > 8
    assert checked_surface(ordered).volume == pytest.approx(ball.volume, rel=0.1)


def test_a_hole_of_an_inside_out_surface_gets_a_lid_that_winds_alike(ball: Surface) -> None:
    low = ball.points[ball.triangles, 2].mean(axis=1) < 0.042
    ordered, _ = put_in_order(Surface(ball.points, ball.triangles[low, ::-1]))
    assert checked_surface(ordered).volume == pytest.approx(ball.volume, rel=0.1)


def test_triangles_that_touch_nothing_get_no_lids(ball: Surface) -> None:
    """A lid on a lone triangle would be its other side, and nothing would have an inside any more."""
    points = ball.points[ball.triangles].reshape(-1, 3)
    middles = np.repeat(points.reshape(-1, 3, 3).mean(axis=1), 3, axis=0)
    points = middles + 0.9 * (points - middles)
    ordered, defects = put_in_order(Surface(points, np.arange(len(points)).reshape(-1, 3)))
    assert defects.pieces == len(ball.triangles) == len(ordered.triangles)


def test_triangles_that_are_there_twice_count_once(ball: Surface) -> None:
    both = np.concatenate([ball.triangles, ball.triangles[:, ::-1]])
    ordered, defects = put_in_order(Surface(ball.points, both))
    assert defects.degenerate_triangles == len(ball.triangles)
    assert checked_surface(ordered).volume == pytest.approx(ball.volume, rel=1e-12)


def test_pieces_are_numbered(ball: Surface) -> None:
    far = Surface(ball.points + np.array([0.2, 0, 0]), ball.triangles)
    assert np.bincount(piece_numbers(_two(ball, far))).tolist() == [len(ball.points)] * 2


def test_an_inside_out_surface_is_turned_with_a_note(ball: Surface, caplog: pytest.LogCaptureFixture) -> None:
    turned = Surface(ball.points, ball.triangles[:, ::-1])
    with caplog.at_level(logging.INFO):
        assert checked_surface(turned).volume == ball.volume
    assert "inside out" in caplog.text


def test_an_open_surface_is_refused_with_the_number_of_open_edges(ball: Surface) -> None:
    with pytest.raises(SurfaceError, match="got 3 open edges"):
        checked_surface(Surface(ball.points, ball.triangles[1:]))


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


def test_two_components_are_refused(ball: Surface) -> None:
    far = Surface(ball.points + np.array([0.2, 0, 0]), ball.triangles)
    with pytest.raises(SurfaceError, match=r"expected one component, got 2 with \[512, 512\] triangles"):
        checked_surface(_two(ball, far))
