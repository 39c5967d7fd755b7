"""The chain that Laplace's posterior is compared with: its likelihood, its quantities, what it finds of a known law."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from pcn import Law, compared, effective, walked

from softtwin.meshes.body import Body
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.registrar import Registrar
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import Cantilever, cloud_on, tip_forces

pytestmark = pytest.mark.fenicsx


@pytest.fixture
def law(body: Body, rng: np.random.Generator) -> Law:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5), 0.2)
    observed, options = (
        SurfaceDistance(body, body.surfaces["observed"]),
        RegistrationOptions(localisation=SparseLocalisation(rounds=0), solver=GaussNewton(settled=5e-3)),
    )
    made = Registrar(Cantilever(body), observed, forces, options)
    truth = made.model.solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    return Law.of(made.register(cloud_on(body, truth, 300, rng, 2e-3)))


def test_the_solver_has_ended_where_the_density_is_largest(law: Law, rng: np.random.Generator) -> None:
    variances, vectors = np.linalg.eigh(law.covariance())
    told = variances < 0.5  # elsewhere it is the prior's whatever the likelihood
    assert told.sum() >= 2

    def density(x: np.ndarray) -> float:
        return law.log_likelihood(x) - 0.5 * float(x @ x)

    at_mode = density(law.mode)
    for _ in range(6):
        drawn = rng.standard_normal(int(told.sum()))
        step = vectors[:, told] @ (np.sqrt(variances[told]) * drawn)
        fall = at_mode - np.mean([density(law.mode + sign * step) for sign in (1.0, -1.0)])
        assert fall == pytest.approx(
            0.5 * float(drawn @ drawn), rel=0.5
        )  # its curvature is Laplace's, up to points between losses


def test_the_quantities_move_as_their_slopes_say(law: Law, rng: np.random.Generator) -> None:
    step = 1e-5 * rng.standard_normal(len(law.scale))
    moved = 0.5 * (law.quantities(law.mode + step) - law.quantities(law.mode - step))
    np.testing.assert_allclose(law.slopes() @ step, moved, atol=1e-6 * np.abs(moved).max())


@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_a_chain_counts_as_so_many_independent_states(rng: np.random.Generator, alike: float) -> None:
    """Of x' = a x + noise: (1 - a) / (1 + a) of its length."""
    values = np.zeros(20_000)
    for place in range(1, len(values)):
        values[place] = alike * values[place - 1] + rng.standard_normal()
    assert effective(values) == pytest.approx(len(values) * (1.0 - alike) / (1.0 + alike), rel=0.2)
    assert effective(np.ones(10)) == 1.0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("about", ["prior", "law"])
def test_a_chain_finds_a_normal_law(about: str) -> None:
    pytest.importorskip("cuqi", reason="CUQIpy is absent: the extra `benchmark`")
    mean, variance = np.array([1.0, -0.5]), 0.25 / 1.25  # of y = x + noise of deviation one half
    middle, root = (0.8 * mean, np.sqrt(variance) * np.eye(2)) if about == "law" else (np.zeros(2), np.eye(2))
    chain = walked(lambda x: -2.0 * float(((x - mean) ** 2).sum()), middle, root, 3000, 0.5)
    assert chain.states.shape == (3000, 2) and 0.2 < chain.acceptance <= 1.0
    for place in range(2):
        values = chain.states[:, place]
        assert abs(values.mean() - 0.8 * mean[place]) < 4.0 * np.sqrt(variance / effective(values))
        assert values.var() == pytest.approx(variance, rel=0.3)


@pytest.mark.filterwarnings("ignore")
def test_a_tiny_chain_of_a_registration(law: Law) -> None:
    pytest.importorskip("cuqi", reason="CUQIpy is absent: the extra `benchmark`")
    row = compared(law, 150, "laplace", 0.5, 0)
    assert row["unknowns"] == len(law.scale) and 0.1 < row["acceptance"] <= 1.0 and row["effective"] >= 1.0
    for name in ("net force", "mean displacement"):
        assert np.isfinite(row[name]["chain"]["mean"]).all() and row[name]["apart"] < 3.0
