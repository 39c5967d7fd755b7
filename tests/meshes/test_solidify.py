import logging
import re
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pytetwild", reason="the extra mesh is absent")

from softtwin.meshes import solidify as module
from softtwin.meshes import tetwild
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.checks import SurfaceError
from softtwin.meshes.metrics import scaled_jacobians
from softtwin.meshes.solidify import MAXIMUM_NODES, Solid, solidify

SIZE = 0.018
# fTetWild's tolerance about the thinned surface; in its middle a triangle of edge h sags by h^2 / 6R on a sphere of
# radius R.
REACH = max(module._TOLERANCE * 0.1 * np.sqrt(3), module._TOLERANCE_OF_EDGE * SIZE)
REACH += (module._TRIANGLE_EDGE * SIZE) ** 2 / (6 * 0.05)


def joined(*surfaces: Surface) -> Surface:
    """Several surfaces as one."""
    starts = np.cumsum([0, *(len(s.points) for s in surfaces)])
    triangles = [s.triangles + start for s, start in zip(surfaces, starts, strict=False)]
    return Surface(np.concatenate([s.points for s in surfaces]), np.concatenate(triangles))


def opened(surface: Surface) -> Surface:
    """Without the triangles of a cap."""
    return Surface(surface.points, surface.triangles[surface.points[surface.triangles, 2].mean(axis=1) < 0.045])


def crossed(surface: Surface) -> Surface:
    """The north pole pulled through the south."""
    points = surface.points.copy()
    points[points[:, 2].argmax(), 2] *= -1.5
    return Surface(points, surface.triangles)


def unshared(surface: Surface) -> Surface:
    """Every triangle with vertices of its own."""
    return Surface(surface.points[surface.triangles].reshape(-1, 3), np.arange(surface.triangles.size).reshape(-1, 3))


def inward(surface: Surface) -> Surface:
    return Surface(surface.points, surface.triangles[:, ::-1])


def mixed(surface: Surface) -> Surface:
    """A third of the triangles turned."""
    triangles = surface.triangles.copy()
    triangles[::3] = triangles[::3, ::-1]
    return Surface(surface.points, triangles)


def crumbs(surface: Surface) -> Surface:
    """With two small balls beside it."""
    small = 0.06 * surface.points
    return joined(surface, *(Surface(small + np.array([0.0, 0.07, z]), surface.triangles) for z in (-0.02, 0.02)))


def check(solid: Solid, volume: float) -> Body:
    """A body of the volume (within 2 %), without bad cells."""
    body = Body(solid.points, solid.cells, {})
    assert body.volume == pytest.approx(volume, rel=0.02)
    assert scaled_jacobians(solid.points, solid.cells).min() >= 0.15
    assert solid.mending.volume_after == pytest.approx(body.volume, rel=1e-12)
    return body


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda s: s, "nothing was wrong"),
        (opened, r"1 holes \(\d+ open edges\) closed"),
        (unshared, "1278 vertices merged"),
        (inward, "wound inward: turned outward"),
        (mixed, r"\d+ edges between triangles of opposite winding"),
        (crumbs, "2 components left out, the largest 0.1"),
    ],
)
def test_a_ball_with_any_defect_becomes_a_solid_ball(ball: Surface, damage: Callable, said: str) -> None:  # type: ignore[type-arg]
    solid = solidify(damage(ball), cell_size=SIZE)
    check(solid, ball.volume if damage is not opened else solid.mending.volume_before)
    assert solid.mending.distance < REACH
    assert re.search(said, str(solid.mending)), str(solid.mending)


def test_a_surface_that_cuts_itself_becomes_solid(ball: Surface) -> None:
    solid = solidify(crossed(ball), cell_size=SIZE)
    assert scaled_jacobians(solid.points, solid.cells).min() >= 0.15
    assert 0.7 * ball.volume < Body(solid.points, solid.cells, {}).volume < 1.1 * ball.volume


def test_a_large_component_is_not_left_out_without_a_warning(ball: Surface) -> None:
    beside = Surface(0.6 * ball.points + np.array([0.0, 0.1, 0.0]), ball.triangles)
    said = str(solidify(joined(ball, beside), cell_size=SIZE).mending)
    assert re.search(r"^warning: 18 % of the surface's volume is in components that were left out", said, re.MULTILINE)
    assert "warning" not in str(solidify(crumbs(ball), cell_size=SIZE).mending)


def test_two_balls_that_overlap_become_one(ball: Surface) -> None:
    shift = np.array([0.06, 0.0, 0.0])
    solid = solidify(joined(ball, Surface(ball.points + shift, ball.triangles)), cell_size=SIZE)
    # Two caps of height 20 mm overlap: the union's volume counts them once.
    cap = np.pi * 0.02**2 * (3 * 0.05 - 0.02) / 3
    assert Body(solid.points, solid.cells, {}).volume == pytest.approx(2 * ball.volume - 2 * cap, rel=0.03)


@pytest.mark.parametrize("node_count", [150, 450, pytest.param(800, marks=pytest.mark.slow)])
def test_a_wanted_number_of_nodes_is_about_met(
    ball: Surface, node_count: int, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        points = solidify(ball, node_count=node_count).points
    assert len(points) == pytest.approx(node_count, rel=0.25)
    assert 1 <= caplog.text.count("wanted") <= 5


def test_the_search_for_a_size_closes_in_from_both_sides() -> None:
    assert module._next_size({0.01: 1600}, 400) > 0.015
    assert module._next_size({0.01: 100}, 400) < 0.007
    # Between a mesh too coarse and one too fine, on the straight line through the logarithms.
    assert module._next_size({0.01: 100, 0.004: 1600}, 400) == pytest.approx(np.sqrt(0.01 * 0.004))


def test_smaller_cells_make_more_of_them(ball: Surface) -> None:
    counts = [len(solidify(ball, cell_size=size).cells) for size in (0.02, 0.008)]
    assert counts[1] > 3 * counts[0]


def test_what_is_farther_off_is_measured(ball: Surface) -> None:
    solid = solidify(ball, cell_size=SIZE)
    bulge = ball.points.copy()
    bulge[bulge[:, 0].argmax(), 0] += 0.02
    mending = module._mending(Surface(bulge, ball.triangles), solid.mending.defects, solid.points, solid.cells)
    assert 0.015 < mending.distance < 0.021 and mending.mean_distance < 0.002


def test_a_sheet_is_refused(ball: Surface) -> None:
    sheet = Surface(ball.points[[0, 1, 2, 3]] * [1, 1, 0], np.array([[0, 1, 2]]))
    with pytest.raises(SurfaceError, match="sheet"):
        solidify(sheet, cell_size=0.01)


def test_a_wrong_unit_is_refused_before_anything_is_made(ball: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "tetrahedra", lambda *_: pytest.fail("fTetWild was started"))
    metres = Surface(1000 * ball.points, ball.triangles)
    with pytest.raises(
        ValueError, match=rf"makes about .* nodes, expected at most {MAXIMUM_NODES}; is the .*--unit mm"
    ):
        solidify(metres, cell_size=0.01)


def test_neither_or_both_of_size_and_count_is_refused(ball: Surface) -> None:
    for wish in ({}, {"cell_size": 0.01, "node_count": 100}):
        with pytest.raises(ValueError, match="expected one of cell_size and node_count"):
            solidify(ball, **wish)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="cell_size: expected a positive length in metres, got -1"):
        solidify(ball, cell_size=-1)
    with pytest.raises(ValueError, match="node_count: expected 20 to 200000, got 3"):
        solidify(ball, node_count=3)


def test_a_crash_of_the_mesher_is_a_message(ball: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tetwild.sys, "executable", "/bin/false")
    with pytest.raises(SurfaceError, match=r"fTetWild ended with code 1 and gave no solid .* try another number"):
        solidify(ball, cell_size=SIZE)


def test_the_mesher_leaves_ctrl_c_alone_says_nothing_and_leaves_no_file(
    ball: Surface, capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    solidify(ball, cell_size=0.03)
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGINT) is before
    assert capfd.readouterr() == ("", "")


TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


def test_a_part_that_hangs_on_by_an_edge_or_a_node_is_taken_off() -> None:
    for shared in ([0], [0, 3]):
        other = np.array([[0, 0, 0], [-0.5, 0, 0], [0, -0.5, 0], [0, 0, 1.0]])
        new = [i for i in range(4) if i not in shared]
        numbers = np.arange(4)
        numbers[new] = np.arange(4, 4 + len(new))
        points = np.concatenate(
            [TETRAHEDRON, other[new] - ([0, 0, 1.2] if shared == [0] else 0) * (other[new][:, 2:] > 0)]
        )
        cells = np.stack([np.arange(4), numbers[[0, 2, 1, 3]] if shared == [0] else numbers])
        assert module._unpinched(points, cells).tolist() == [[0, 1, 2, 3]]
