"""A network under known forces: the state under both, and its derivatives by the unknown ones alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

from softtwin.surrogate.loaded import LoadedReducedState, LoadedSurrogate
from softtwin.surrogate.model import Surrogate


def some_forces(surrogate: Surrogate, scale: float, seed: int) -> np.ndarray:
    whole = np.zeros_like(surrogate.body.points)
    loaded = surrogate.encoder_decoder.loaded
    whole[loaded] = scale * np.random.default_rng(seed).standard_normal((len(loaded), 3))
    return whole


@pytest.fixture
def known(reduced: Surrogate, forces: np.ndarray) -> np.ndarray:
    return some_forces(reduced, float(np.abs(forces).max()), 4)


def test_its_state_is_the_networks_under_both(reduced: Surrogate, forces: np.ndarray, known: np.ndarray) -> None:
    both = reduced.solve(known + forces)
    found = LoadedSurrogate(reduced, known).solve(forces)
    np.testing.assert_array_equal(found.displacement, both.displacement)
    proposed = LoadedSurrogate(reduced, known).propose(forces)
    np.testing.assert_allclose(proposed, both.displacement, atol=1e-5 * np.abs(both.displacement).max())
    assert not np.allclose(found.displacement, reduced.solve(forces).displacement, rtol=0.1)


def test_reduced_it_agrees_with_the_whole(reduced: Surrogate, known: np.ndarray, rng: np.random.Generator) -> None:
    """Values, derivatives by the unknown coefficients, and combinations of these, as of a model that knows of both."""
    model = LoadedSurrogate(reduced, known)
    basis = np.stack([some_forces(reduced, 1.0, seed).ravel() for seed in range(4)], axis=1)
    nodes, turned = reduced.body.boundary_nodes[:7], rng.standard_normal((4, 3))
    small, rows = model.reduced(nodes, basis).combined(turned), csr_array(np.eye(21))
    c = 0.1 * np.abs(known).max() * rng.standard_normal(3)
    state, whole = small.solve(c), model.solve((basis @ turned @ c).reshape(-1, 3))
    picked = (3 * nodes[:, None] + np.arange(3)).ravel()
    pushed = whole.jvp(basis @ turned)[picked]
    assert small.count == 3 and state.jacobian(rows).shape == (21, 3)
    np.testing.assert_allclose(state.positions, whole.displacement[nodes], atol=1e-5 * np.abs(whole.displacement).max())
    np.testing.assert_allclose(state.jacobian(rows), pushed, atol=1e-5 * np.abs(pushed).max())
    np.testing.assert_allclose(state.moved(c).ravel(), pushed @ c, atol=1e-5 * np.abs(pushed @ c).max())
    np.testing.assert_allclose(state.full.displacement, whole.displacement, rtol=1e-9)
    again = small.solve(c, state)
    assert again is state and isinstance(small.solve(2.0 * c, state), LoadedReducedState)


def test_forces_where_it_has_never_seen_any_are_refused(reduced: Surrogate) -> None:
    idle = np.setdiff1d(
        np.arange(len(reduced.body.points)), np.union1d(reduced.encoder_decoder.loaded, reduced.body.fixed)
    )
    inside = np.zeros_like(reduced.body.points)
    inside[idle[0]] = [0.0, 0.0, 1.0]
    with pytest.raises(ValueError, match="nodes loaded in training"):
        LoadedSurrogate(reduced, inside)
