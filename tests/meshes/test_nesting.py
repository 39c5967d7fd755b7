"""Closed surfaces inside others: cavities, whichever way they wind; components that lie apart."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from softtwin.meshes.body import Surface
from softtwin.meshes.checks import SurfaceError, put_in_order
from softtwin.meshes.components import ComponentError, check_component, component_of_cells
from softtwin.meshes.nesting import winding_numbers
from softtwin.meshes.shapes import beam
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
        chosen, others = _component(both, component, none_known)
        if wanted is not None:
            assert put_in_order(chosen)[0].volume == pytest.approx(wanted, rel=1e-9) and len(others) == 1
    with pytest.raises(ComponentError, match="has 2 components, got 3"):
        _component(both, "3", none_known)
    with pytest.raises(ComponentError, match="one component that is no crumb"):
        _component(left, "left", none_known)


def none_known(name: str) -> np.ndarray:
    raise ComponentError(f"no structure {name}")


@pytest.mark.parametrize("kind", ["surface", "cells"])
@pytest.mark.parametrize("middle, wanted", [((0.1, 0.0, 0.0), 0), ((-0.1, 0.0, 0.02), 1), ((-0.03, 0.0, 0.0), 1)])
def test_a_component_is_chosen_by_the_structure_in_it(kind: str, middle: tuple[float, float, float],
                                                      wanted: int) -> None:  # fmt: skip
    """Inside one of two, or nearer to one of them; the middle of a large one is farther from its surface."""
    tumour = ball(0.004, middle)
    structures = {"tumour": tumour.points}.__getitem__
    if kind == "surface":
        balls = ball(0.05, (0.1, 0.0, 0.0)), ball(0.06, (-0.1, 0.0, 0.0))
        chosen, others = _component(together(*balls), "near:tumour", structures)
        assert chosen.volume == pytest.approx(balls[wanted].volume, rel=1e-9)
        assert others == pytest.approx([balls[1 - wanted].volume], rel=1e-9)
    else:
        one = beam((6, 2, 2), (0.1, 0.1, 0.1), "tetrahedron")
        centred = one.points - 0.05
        places = centred + np.array([0.1, 0.0, 0.0]), 1.1 * centred - np.array([0.1, 0.0, 0.0])
        points, cells = np.concatenate(places), np.concatenate([one.cells, one.cells + len(one.points)])
        nodes, kept, said = component_of_cells(points, cells, "near:tumour", structures)
        np.testing.assert_array_equal(points[nodes], places[wanted])
        np.testing.assert_array_equal(kept, one.cells)
        left_out = 1e3 * (1.1**3, 1.0)[wanted]
        assert f"{left_out:.4g} ml in 1 others left out" in said


@pytest.mark.parametrize("shape", ["tetrahedron", "hexahedron"])
def test_the_largest_component_of_cells_is_that_of_most_volume(shape: str) -> None:
    fine, coarse = beam((6, 2, 2), (0.1, 0.1, 0.1), shape), beam((3, 2, 2), (0.2, 0.1, 0.1), shape)
    points = np.concatenate([fine.points, coarse.points + np.array([1.0, 0.0, 0.0])])
    cells = np.concatenate([fine.cells, coarse.cells + len(fine.points)])
    nodes, kept, _ = component_of_cells(points, cells, "1", none_known)
    assert nodes[0] == len(fine.points) and len(kept) == len(coarse.cells)
    nodes, kept, said = component_of_cells(fine.points, fine.cells, "1", none_known)
    assert len(nodes) == len(fine.points) and len(kept) == len(fine.cells) and said == ""
    with pytest.raises(ComponentError, match="the mesh has 1 components, got 2"):
        component_of_cells(fine.points, fine.cells, "2", none_known)


@pytest.mark.parametrize("words", ["", "0", "-1", "near:", "top", "1.5"])
def test_words_that_name_no_component_are_refused(words: str) -> None:
    with pytest.raises(ComponentError, match="expected largest, left, right, a number from 1 or near:STRUCTURE"):
        check_component(words)


def test_nothing_is_left_of_nothing() -> None:
    with pytest.raises(SurfaceError):
        put_in_order(Surface(np.zeros((3, 3)), np.array([[0, 0, 1]])))
