"""Closed surfaces inside others: cavities, whichever way they wind; components that lie apart."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from softtwin.meshes.body import Surface
from softtwin.meshes.checks import SurfaceError, put_in_order
from softtwin.meshes.components import ComponentError, check_component
from softtwin.meshes.nesting import winding_numbers
from softtwin.meshes.solidify import _component, solidify


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), inward: bool = False) -> Surface:
    corners = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=np.float64)
    triangles = np.array([(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)])
    points = corners
    for _ in range(3):
        middles = {}
        split = []
        points = points.tolist()
        for triangle in triangles.tolist():
            new = []
            for a, b in zip(triangle, triangle[1:] + triangle[:1], strict=True):
                key = (min(a, b), max(a, b))
                if key not in middles:
                    middles[key] = len(points)
                    points.append(((np.array(points[a]) + points[b]) / 2).tolist())
                new.append(middles[key])
            (a, b, c), (d, e, f) = triangle, new
            split += [(a, d, f), (b, e, d), (c, f, e), (d, e, f)]
        points, triangles = np.array(points), np.array(split)
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return Surface(radius * points + centre, triangles[:, ::-1] if inward else triangles)


def together(*surfaces: Surface) -> Surface:
    starts = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    triangles = [surface.triangles + start for surface, start in zip(surfaces, starts, strict=False)]
    return Surface(np.concatenate([surface.points for surface in surfaces]), np.concatenate(triangles))


@pytest.mark.parametrize("windings", list(itertools.product([False, True], repeat=3)))
def test_depth_decides_whatever_the_windings(windings: tuple[bool, ...]) -> None:
    radii = (0.06, 0.04, 0.02)  # a wall, its cavity, and a stone in it
    balls = [ball(radius, inward=inward) for radius, inward in zip(radii, windings, strict=True)]
    ordered, defects = put_in_order(together(*balls))
    volumes = [abs(each.volume) for each in balls]
    assert ordered.volume == pytest.approx(volumes[0] - volumes[1] + volumes[2], rel=1e-9)
    assert defects.cavities == pytest.approx((volumes[1],), rel=1e-9)
    filled, defects = put_in_order(together(*balls), "fill")
    assert filled.volume == pytest.approx(volumes[0], rel=1e-9) and defects.filled


def test_a_cavity_that_winds_like_a_solid_is_said() -> None:
    assert put_in_order(together(ball(0.06), ball(0.04)))[1].misleading
    assert not put_in_order(together(ball(0.06), ball(0.04, inward=True)))[1].misleading
    said = str(solidify(together(ball(0.06), ball(0.04)), node_count=600).mending)
    assert "1 cavities (closed surfaces inside others) of 26" in said and "--cavities fill" in said


def test_components_that_overlap_or_lie_apart_are_solids() -> None:
    apart = together(ball(0.05), ball(0.03, (0.1, 0.0, 0.0), inward=True))
    ordered, defects = put_in_order(apart)
    assert defects.cavities == () and ordered.volume == pytest.approx(abs(ball(0.05).volume) + abs(ball(0.03).volume))
    overlapping = together(ball(0.05), ball(0.03, (0.04, 0.0, 0.0)))
    assert put_in_order(overlapping)[1].cavities == ()


def test_winding_numbers_are_one_inside_and_zero_outside() -> None:
    surface = ball(0.05)
    points = np.array([[0.0, 0, 0], [0.03, 0, 0.03], [0.06, 0, 0], [1.0, 1, 1]])
    assert winding_numbers(surface, surface.triangles, points) == pytest.approx([1, 1, 0, 0], abs=1e-9)


def test_a_component_is_chosen_with_its_cavity() -> None:
    left, right = (ball(0.05, (0.1, 0.0, 0.0)), ball(0.06, (-0.1, 0.0, 0.0)))
    both = together(left, right, ball(0.02, (0.1, 0.0, 0.0), inward=True))
    for component, wanted in (("left", left.volume + ball(0.02, inward=True).volume), ("right", right.volume),
                              ("2", left.volume + ball(0.02, inward=True).volume), ("largest", None)):  # fmt: skip
        chosen = _component(both, component)
        if wanted is not None:
            assert put_in_order(chosen)[0].volume == pytest.approx(wanted, rel=1e-9)
    with pytest.raises(ComponentError, match="has 2 components, got 3"):
        _component(both, "3")
    with pytest.raises(ComponentError, match="a surface knows no labels"):
        _component(both, "near:tumour")
    with pytest.raises(ComponentError, match="one component that is no crumb"):
        _component(left, "left")


@pytest.mark.parametrize("words", ["", "0", "-1", "near:", "top", "1.5"])
def test_words_that_name_no_component_are_refused(words: str) -> None:
    with pytest.raises(ComponentError, match="expected largest, left, right, a number from 1 or near:STRUCTURE"):
        check_component(words)


def test_nothing_is_left_of_nothing() -> None:
    with pytest.raises(SurfaceError):
        put_in_order(Surface(np.zeros((3, 3)), np.array([[0, 0, 1]])))
