"""A fast model moved to an exact one: the same at its state to first order, and away from it by second order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array, eye

from softtwin.meshes.body import Body
from softtwin.registration.forward import reduce_model
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.manifold_mapping import ManifoldMapping
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
