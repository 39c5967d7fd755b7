"""The body: what it derives from its mesh, and every mesh that cannot be one."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from softtwin.meshes.body import Body, BodyError, Surface
from softtwin.meshes.shapes import beam


@pytest.fixture
def body() -> Body:
    return beam((3, 2, 2), (0.3, 0.2, 0.1), "tetrahedron")


def parts(body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Writable copies of points, cells and fixed nodes."""
    return body.points.copy(), body.cells.copy(), body.fixed.copy()


@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
def test_the_boundary_is_closed_and_winds_outward(kind: str) -> None:
    made = beam((3, 2, 2), (0.3, 0.2, 0.1), kind)
    assert made.volume == pytest.approx(0.3 * 0.2 * 0.1, rel=1e-12)
    assert made.boundary_surface.area == pytest.approx(2 * (0.06 + 0.03 + 0.02), rel=1e-12)
    edges = np.sort(made.boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_free_and_fixed_nodes_are_all_nodes(body: Body) -> None:
    assert np.array_equal(np.sort(np.concatenate([body.free, body.fixed])), np.arange(len(body.points)))


def test_a_body_cannot_be_changed(body: Body) -> None:
    with pytest.raises(ValueError, match="read-only"):
        body.points[0, 0] = 1.0
    with pytest.raises(AttributeError):
        body.cells = body.cells  # type: ignore[misc]


def test_the_fingerprint_knows_mesh_and_fixed_nodes(body: Body) -> None:
    points, cells, fixed = parts(body)
    assert Body(points, cells, {"fixed": fixed, "other": [1]}).fingerprint == body.fingerprint
    assert Body(points, cells, {"fixed": fixed[1:]}).fingerprint != body.fingerprint
    points[-1] *= 1.0 + 1e-12
    assert Body(points, cells, {"fixed": fixed}).fingerprint != body.fingerprint


def test_inverted_cells_are_counted(body: Body) -> None:
    points, cells, fixed = parts(body)
    cells[[2, 5], :2] = cells[[2, 5], 1::-1]
    with pytest.raises(BodyError, match=r"Body\.cells: expected cells of positive volume, got 2 .* first \[2 5\]"):
        Body(points, cells, {"fixed": fixed})


def test_stray_nodes_are_named(body: Body) -> None:
    points, cells, fixed = parts(body)
    with pytest.raises(BodyError, match=r"got 1 stray nodes, first \[36\]"):
        Body(np.vstack([points, [[9.0, 9.0, 9.0]]]), cells, {"fixed": fixed})


def test_two_components_are_refused_with_their_sizes(body: Body) -> None:
    points, cells, fixed = parts(body)
    twice = np.vstack([points, points + 1.0])
    with pytest.raises(BodyError, match=r"expected one connected component, got 2 with \[36, 36\] nodes"):
        Body(twice, np.vstack([cells, cells + len(points)]), {"fixed": fixed})


@pytest.mark.parametrize("wrong", [-1, 36])
def test_numbers_out_of_range_are_named(body: Body, wrong: int) -> None:
    points, cells, fixed = parts(body)
    cells[0, 0] = wrong
    with pytest.raises(BodyError, match=r"Body\.cells: expected node numbers in 0\.\.35"):
        Body(points, cells, {"fixed": fixed})


@pytest.mark.parametrize("fixed", [[], [0, 1]])
def test_too_few_fixed_nodes_are_refused(body: Body, fixed: list[int]) -> None:
    points, cells, _ = parts(body)
    with pytest.raises(BodyError, match=rf"expected at least 3 fixed nodes, got {len(fixed)}"):
        Body(points, cells, {"fixed": np.array(fixed, dtype=np.int64)})


def test_a_body_without_an_attachment_has_no_fixed_nodes(body: Body) -> None:
    points, cells, _ = parts(body)
    loose = Body(points, cells, {})
    assert len(loose.fixed) == 0 and len(loose.free) == len(points)


def test_everything_fixed_is_refused(body: Body) -> None:
    points, cells, _ = parts(body)
    with pytest.raises(BodyError, match="every node is fixed, nothing can move"):
        Body(points, cells, {"fixed": np.arange(len(points))})


def test_fixed_nodes_inside_only_are_refused() -> None:
    made = beam((6, 4, 4), (0.6, 0.4, 0.4), "hexahedron")
    inside = np.setdiff1d(np.arange(len(made.points)), made.boundary_nodes)
    with pytest.raises(BodyError, match=rf"none of the {len(inside)} fixed nodes lies on the boundary"):
        Body(made.points, made.cells, {"fixed": inside})


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_coordinates_that_are_not_finite_are_counted(body: Body, value: float) -> None:
    points, cells, fixed = parts(body)
    points[4, 1] = value
    with pytest.raises(BodyError, match=r"Body\.points: expected finite coordinates, got 1 rows"):
        Body(points, cells, {"fixed": fixed})


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (np.zeros((2, 5), dtype=int), r"expected shape \(m, 4\) or .* or \(m, 27\) with m >= 1, got \(2, 5\)"),
        (np.zeros((0, 4), dtype=int), r"got \(0, 4\)"),
        (np.zeros((2, 4)), r"expected whole numbers, got float64"),
    ],
)
def test_cells_of_another_kind_are_refused(body: Body, cells: np.ndarray, message: str) -> None:
    with pytest.raises(BodyError, match=message):
        Body(body.points, cells, {"fixed": body.fixed})


def test_surfaces_are_checked(body: Body) -> None:
    with pytest.raises(BodyError, match=r"Body\.surfaces\['seen'\]: expected shape \(t, 3\), got \(2, 4\)"):
        Body(body.points, body.cells, {"fixed": body.fixed}, {"seen": np.zeros((2, 4), dtype=int)})
    with pytest.raises(BodyError, match=r"Surface\.triangles: expected shape \(t, 3\) with t >= 1"):
        Surface(body.points, np.zeros((0, 3), dtype=int))


def test_fractions_are_part_of_a_body(body: Body) -> None:
    """They fill the volume, make another body of it, stay with what is derived from it, and are checked."""
    filled = np.linspace(0.1, 1.0, len(body.cells))
    sparse = replace(body, fractions=filled)
    cell = body.volume / len(body.cells)
    assert sparse.volume == pytest.approx(cell * filled.sum()) and replace(
        body, fractions=0.0 * filled + 1.0
    ).volume == (pytest.approx(body.volume))
    assert sparse.fingerprint != body.fingerprint
    for derived in (sparse.quadratic(), sparse.with_sets(zone=[0])):
        np.testing.assert_array_equal(derived.fractions, filled)
    assert sparse.fractions is not None and not sparse.fractions.flags.writeable
    with pytest.raises(BodyError, match=rf"Body.fractions: expected one number for each of the {len(filled)} cells"):
        replace(body, fractions=filled[1:])
    for wrong in (0.0, 1.5, np.nan):
        with pytest.raises(BodyError, match=r"Body.fractions: expected numbers in \(0, 1\]"):
            replace(body, fractions=np.r_[wrong, filled[1:]])


def test_a_body_with_other_names_is_the_same_body_and_checked() -> None:
    """What is known of its cells is taken over; what depends on names is not."""
    body = beam((4, 2, 2), (0.4, 0.1, 0.1), "tetrahedron")
    known = body.boundary, body.boundary_nodes, body.free, body.fingerprint
    tip = body.node_sets["tip"]
    other = body.with_sets(fixed=tip, spot=tip[:2])
    assert other.boundary is known[0] and other.boundary_nodes is known[1]
    assert np.array_equal(other.free, np.setdiff1d(np.arange(len(body.points)), tip))
    assert other.fingerprint == Body(body.points, body.cells, {"fixed": tip}).fingerprint != known[3]
    assert np.array_equal(body.fixed, np.setdiff1d(np.arange(len(body.points)), known[2]))
    named = other.with_surfaces(seen=body.boundary[:5])
    assert np.array_equal(named.surfaces["seen"], body.boundary[:5]) and not other.surfaces
    assert np.array_equal(named.fixed, tip) and named.fingerprint == other.fingerprint
    again = pickle.loads(pickle.dumps(named))
    assert again.fingerprint == named.fingerprint and set(again.node_sets) == {*body.node_sets, "spot"}
    with pytest.raises(BodyError, match="at least 3 fixed nodes, got 2"):
        body.with_sets(fixed=tip[:2])
    with pytest.raises(BodyError, match="expected node numbers"):
        body.with_sets(spot=[len(body.points)])
    with pytest.raises(BodyError, match="surfaces"):
        body.with_surfaces(seen=[[0, 1, len(body.points)]])
