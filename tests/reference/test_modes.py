"""Eigenmodes against dense LAPACK, and the loads that they make."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eigh

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body
from softtwin.meshes.io import FileError, read_body, write_body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.samplers import LoadPlan, draw_load, draw_smooth_load, loaded_nodes
from softtwin.reference.modes import eigenmodes, load_modes, save_modes
from softtwin.reference.solve.problem import Problem
from softtwin.registration.parameters.nodal_forces import nodal_forces


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


def test_smooth_loads_have_the_correlation_that_is_said() -> None:
    """Over many draws of the same patch: exp(-d^2 / 2 s^2) between nodes, none between components.

    Registration's forces have exp(-d / s): smooth draws are as likely there, and the edge of a tool is, too.
    """
    body = beam((4, 4, 4), (0.06, 0.06, 0.06), "tetrahedron")
    plan = LoadPlan(radius=(2.0, 2.0), smoothness=0.02)  # each patch is the whole free boundary
    draws = np.stack([draw_smooth_load(body, plan, np.random.default_rng(i)) for i in range(2000)])
    nodes = loaded_nodes(body, plan)
    assert np.abs(draws[:, np.setdiff1d(np.arange(len(body.points)), nodes)]).max() == 0.0
    apart = np.linalg.norm(body.points[nodes][:, None] - body.points[nodes], axis=2)
    prior = nodal_forces(body, nodes, smoothness=0.02).patterns[::3, ::3]
    np.testing.assert_allclose(prior @ prior.T, np.exp(-apart / 0.02), atol=1e-4)
    said = np.exp(-(apart**2) / (2.0 * 0.02**2))
    for axis in range(3):
        one = draws[:, nodes, axis]
        # The mean of 2,000 products of unit variance is off by 1 / sqrt(2000): five times that, over all pairs.
        assert np.abs(one.T @ one / len(one) - said).max() < 5.5 * np.sqrt(2.0 / len(one))
        assert np.abs(one.T @ draws[:, nodes, axis - 1] / len(one)).max() < 5.5 / np.sqrt(len(one))


def test_smooth_loads_stay_on_a_patch_of_a_zone(modal) -> None:
    problem, _ = modal
    plan = LoadPlan(zones=("tip",), radius=(0.1, 0.3))
    first, again, other = (draw_smooth_load(problem.body, plan, np.random.default_rng(s)) for s in (4, 4, 5))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    carrying = np.flatnonzero(np.abs(first).max(axis=1))
    assert len(carrying) > 0 and np.isin(carrying, problem.body.node_sets["tip"]).all()


def test_zones_confine_the_loads(modal, rng) -> None:
    problem, modes = modal
    plan = LoadPlan(modes=3, zones=("tip",), kind="random")
    load = draw_load(problem.body, modes.shapes, plan, rng)
    assert np.isin(np.flatnonzero(np.abs(load).max(axis=1)), problem.body.node_sets["tip"]).all()


def test_unknown_zones_are_named(hexahedral_beam: Body) -> None:
    with pytest.raises(ValueError, match=r"LoadPlan\.zones: expected names among .*'tip'.* got \['nowhere'\]"):
        loaded_nodes(hexahedral_beam, LoadPlan(zones=("nowhere",)))


def test_modes_weighted_by_mass_agree_with_lapack(modal) -> None:
    problem, _ = modal
    modes = eigenmodes(problem, 8, "mass", density=1050.0)
    free = (3 * problem.body.free[:, None] + np.arange(3)).ravel()
    K, M = (matrix.toarray()[np.ix_(free, free)] for matrix in (problem.stiffness(), problem.mass(1050.0)))
    assert problem.mass(1050.0).sum() == pytest.approx(3 * 1050.0 * problem.body.volume)
    np.testing.assert_allclose(modes.eigenvalues, eigh(K, M, eigvals_only=True)[:8], rtol=1e-9)


@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
def test_quadratic_cells_have_softer_modes_and_none_spurious(kind: str) -> None:
    linear = beam((4, 2, 2), (0.6, 0.2, 0.2), kind)
    values = []
    for body in (linear, linear.quadratic()):
        with Problem(body, NeoHookean(5000.0, 0.3)) as problem:
            modes = eigenmodes(problem, 5, "mass")
            values.append(modes.eigenvalues)
            assert np.abs(modes.shapes[:, body.fixed]).max() == 0.0
    assert (values[1] < values[0]).all() and values[1][0] > 0.1 * values[0][0]


def test_modes_are_saved_with_their_body(modal, tmp_path) -> None:
    problem, modes = modal
    save_modes(tmp_path / "body.vtu", problem.body, modes)
    again = load_modes(tmp_path / "body.vtu")
    np.testing.assert_array_equal(again.eigenvalues, modes.eigenvalues)
    np.testing.assert_array_equal(again.shapes, modes.shapes)
    assert read_body(tmp_path / "body.vtu").fingerprint == problem.body.fingerprint
    write_body(tmp_path / "bare.vtu", problem.body)
    with pytest.raises(FileError, match="expected a body with eigenmodes"):
        load_modes(tmp_path / "bare.vtu")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"weighting": "volume"}, "eigenmodes.weighting"), ({"density": -1.0}, "eigenmodes.density")],
)
def test_weightings_that_cannot_be_are_refused(modal, arguments, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        eigenmodes(modal[0], 3, **arguments)
