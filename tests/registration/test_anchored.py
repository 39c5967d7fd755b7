"""A fast model moved to an exact one: the same at its state to first order, and away from it by second order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array, eye

from softtwin.meshes.body import Body
from softtwin.registration.forward import reduce_model
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.manifold_mapping import ManifoldMapping, SecantState, ZeroModel
from softtwin.registration.parameters.nodal_forces import nodal_forces

from .conftest import Cantilever, tip_forces
from .test_engines import Bent

NET = (0.0, 0.3, -0.8)


@pytest.fixture
def anchored(body: Body) -> tuple[ManifoldMapping, object, np.ndarray]:
    """The moved model, the exact one and the anchor, for a fast model that moves a third too far."""
    nodes = np.flatnonzero(body.points[:, 2] > 0.199)
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    fast, exact = (reduce_model(model, nodes, forces.basis) for model in (Bent(body, 1.3), Cantilever(body)))
    expansion_point = forces.nearest(tip_forces(body, NET))
    return ManifoldMapping.at(fast, nodes, expansion_point, exact.solve(expansion_point)), exact, expansion_point


def test_it_is_the_exact_model_at_the_anchor(anchored) -> None:
    moved, exact, expansion_point = anchored
    there, wanted = moved.solve(expansion_point), exact.solve(expansion_point)
    every = csr_array(eye(wanted.positions.size))
    np.testing.assert_allclose(there.positions, wanted.positions, atol=1e-14)
    np.testing.assert_allclose(there.jacobian(every), wanted.jacobian(every), atol=1e-14)
    np.testing.assert_allclose(there.full.displacement, wanted.full.displacement, atol=1e-14)


def test_it_leaves_the_exact_model_by_second_order(anchored, rng) -> None:
    moved, exact, expansion_point = anchored
    change = 0.3 * rng.standard_normal(moved.count)
    sizes = 2.0 ** -np.arange(1, 6)
    off = [
        np.abs(
            moved.solve(expansion_point + size * change).positions
            - exact.solve(expansion_point + size * change).positions
        ).max()
        for size in sizes
    ]
    orders = np.log2(np.divide(off[:-1], off[1:]))
    assert off[0] > 1e-6
    np.testing.assert_allclose(orders[-2:], 2.0, atol=0.15)


def test_its_derivative_is_that_of_its_positions(anchored, rng) -> None:
    moved, _, expansion_point = anchored
    place, change, step = expansion_point + 0.2, rng.standard_normal(moved.count), 1e-6
    at = moved.solve(place)
    every = csr_array(eye(at.positions.size))
    two = [moved.solve(place + sign * step * change).positions for sign in (1.0, -1.0)]
    slope = (two[0] - two[1]) / (2.0 * step)
    np.testing.assert_allclose((at.jacobian(every) @ change).reshape(-1, 3), slope, atol=1e-8)
    np.testing.assert_allclose(at.moved(change, 2), slope[::2], atol=1e-8)


def test_combined_directions_are_the_same_model(anchored, rng) -> None:
    moved, _, expansion_point = anchored
    turn = np.linalg.qr(rng.standard_normal((moved.count, moved.count)))[0]
    other, place = moved.combined(turn), expansion_point + 0.1
    np.testing.assert_allclose(other.solve(turn.T @ place).positions, moved.solve(place).positions, atol=1e-12)


@pytest.fixture(params=["fast", "tangent"])
def updatable(request: pytest.FixtureRequest, anchored) -> tuple[ManifoldMapping, object, np.ndarray, np.ndarray]:
    """The moved model, or the exact one's tangent, the exact one, where that is anchored, and a place nearby."""
    moved, exact, expansion_point = anchored
    if request.param == "tangent":
        there = exact.solve(expansion_point)
        zero = ZeroModel(moved.count, len(moved.nodes), len(there.full.displacement))
        moved = ManifoldMapping.at(zero, moved.nodes, expansion_point, there)
    return moved, exact, expansion_point, 1.2 * expansion_point


def test_the_tangent_is_the_exact_models(updatable, rng) -> None:
    moved, exact, expansion_point, place = updatable
    there, every = exact.solve(expansion_point), csr_array(eye(3 * len(moved.nodes)))
    np.testing.assert_allclose(moved.solve(expansion_point).jacobian(every), there.jacobian(every), atol=1e-14)
    np.testing.assert_allclose(moved.solve(expansion_point).positions, there.positions, atol=1e-14)
    change, at = place - expansion_point, moved.solve(place)
    np.testing.assert_allclose(at.moved(change).ravel(), at.jacobian(every) @ change, atol=1e-14)
    turn = np.linalg.qr(rng.standard_normal((moved.count, moved.count)))[0]
    turned = moved.combined(turn).solve(turn.T @ place)
    np.testing.assert_allclose(turned.positions, at.positions, atol=1e-12)
    np.testing.assert_allclose(turned.moved(turn.T @ change, 3), at.moved(change, 3), atol=1e-12)


def test_moved_on_it_is_exact_at_both_states(updatable) -> None:
    """The secant between them is what the exact model did, and what is across it stays."""
    moved, exact, before, place = updatable
    there = exact.solve(place)
    missed = np.abs(moved.solve(place).positions - there.positions).max()
    again = moved.updated(place, there, tolerance=np.inf)
    assert missed > 1e-6
    np.testing.assert_allclose(again.solve(place).positions, there.positions, atol=1e-14)
    np.testing.assert_allclose(again.solve(place).full.displacement, there.full.displacement, atol=1e-14)
    went = (again.slopes - moved.slopes) @ (place - before)
    np.testing.assert_allclose(went, (there.positions - moved.solve(place).positions).ravel(), atol=1e-14)
    across = np.linalg.svd((place - before)[None])[2][1:].T
    np.testing.assert_allclose((again.slopes - moved.slopes) @ across, 0.0, atol=1e-14)


def test_where_its_slopes_have_missed_by_much_it_takes_those_of_the_state(updatable) -> None:
    moved, exact, _, place = updatable
    there, every = exact.solve(place), csr_array(eye(3 * len(moved.nodes)))
    again = moved.updated(place, there, tolerance=0.0)
    np.testing.assert_allclose(again.solve(place).jacobian(every), there.jacobian(every), atol=1e-14)


def test_a_secant_state_is_the_exact_one_with_the_mapped_slopes(updatable) -> None:
    moved, exact, expansion_point, place = updatable
    there, every = exact.solve(place), csr_array(eye(3 * len(moved.nodes)))
    secant = SecantState(there, moved.solve(expansion_point))
    np.testing.assert_array_equal(secant.positions, there.positions)
    assert secant.full is there.full
    np.testing.assert_array_equal(secant.jacobian(every), moved.solve(expansion_point).jacobian(every))
    change = np.ones(moved.count)
    np.testing.assert_allclose(
        secant.moved(change, 2).ravel(), (secant.jacobian(every) @ change).reshape(-1, 3)[::2].ravel()
    )
