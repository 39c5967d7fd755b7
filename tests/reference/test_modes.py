"""Eigenmodes against dense LAPACK, and the loads that they make."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eigh

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body
from softtwin.reference.equilibrium import Problem
from softtwin.reference.loads import LoadPlan, draw_load, loaded_nodes
from softtwin.reference.materials import NeoHookean
from softtwin.reference.modes import eigenmodes


@pytest.fixture(scope="module")
def modal(request: pytest.FixtureRequest):
    body = request.getfixturevalue("hexahedral_beam")
    with Problem(body, NeoHookean(5000.0, 0.45)) as problem:
        yield problem, eigenmodes(problem, 10)


def test_modes_agree_with_lapack(modal) -> None:
    problem, modes = modal
    free = (3 * problem.body.free[:, None] + np.arange(3)).ravel()
    K = problem.stiffness().toarray()[np.ix_(free, free)]
    np.testing.assert_allclose(modes.eigenvalues, eigh(K, eigvals_only=True)[:10], rtol=1e-9)
    vectors = modes.shapes.reshape(10, -1)[:, free].T
    residual = K @ vectors - vectors * modes.eigenvalues
    assert np.linalg.norm(residual, axis=0).max() < 1e-8 * modes.eigenvalues[-1]


def test_modes_are_normalised_and_vanish_where_fixed(modal) -> None:
    problem, modes = modal
    assert np.abs(modes.shapes[:, problem.body.fixed]).max() == 0.0
    np.testing.assert_allclose(np.linalg.norm(modes.shapes, axis=2).max(axis=1), 1.0)


@pytest.mark.parametrize("count", [0, 10_000])
def test_counts_out_of_range_are_refused(modal, count: int) -> None:
    with pytest.raises(ValueError, match=r"eigenmodes\.count: expected 1\.\."):
        eigenmodes(modal[0], count)


def test_modal_loads_are_masked_modes(modal, rng) -> None:
    problem, modes = modal
    body: Body = problem.body
    plan = LoadPlan(modes=10, radius=(0.1, 0.4))
    load = draw_load(body, modes.shapes, plan, rng)
    carrying = np.flatnonzero(np.abs(load).max(axis=1))
    assert 0 < len(carrying) < len(loaded_nodes(body, plan))
    assert np.isin(carrying, loaded_nodes(body, plan)).all()
    # On the patch the load is in the span of the modes.
    span = modes.shapes[:, carrying].reshape(10, -1).T
    target = load[carrying].ravel()
    if len(target) > 10:
        q, *_ = np.linalg.lstsq(span, target, rcond=None)
        np.testing.assert_allclose(span @ q, target, atol=1e-9)
        assert np.abs(q).max() <= 1.0 + 1e-9


def test_loads_are_a_function_of_their_seed(modal) -> None:
    problem, modes = modal
    plan = LoadPlan(modes=10, patches=3)
    first, again, other = (draw_load(problem.body, modes.shapes, plan, np.random.default_rng(s)) for s in (4, 4, 5))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_zones_confine_the_loads(modal, rng) -> None:
    problem, modes = modal
    plan = LoadPlan(modes=3, zones=("tip",), kind="random")
    load = draw_load(problem.body, modes.shapes, plan, rng)
    assert np.isin(np.flatnonzero(np.abs(load).max(axis=1)), problem.body.node_sets["tip"]).all()


def test_unknown_zones_are_named(hexahedral_beam: Body) -> None:
    with pytest.raises(ValueError, match=r"LoadPlan\.zones: expected names among .*'tip'.* got \['nowhere'\]"):
        loaded_nodes(hexahedral_beam, LoadPlan(zones=("nowhere",)))
