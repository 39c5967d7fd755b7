"""Losses, scales found from data, and the reduction to what a cloud can tell."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.registration.hyperparameters import Hyperparameters, LogNormalPrior, estimate_hyperparameters, linearised
from softtwin.registration.loss import Huber, Loss, Square, Tukey, robust_deviation
from softtwin.registration.posterior import Posterior, posterior
from softtwin.registration.prepared import Prepared
from softtwin.registration.priors import LikelihoodInformed, NodalForces, contact, localised, nodal_forces
from softtwin.registration.residuals import SurfaceDistance

from .conftest import Cantilever

LOSSES = [Square(), Huber(), Tukey()]


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_are_the_slope_over_the_residual(loss: Loss) -> None:
    x = np.linspace(-7.0, 7.0, 57) + 0.013
    h = 1e-5
    slope = (loss.value(x + h) - loss.value(x - h)) / (2.0 * h)
    np.testing.assert_allclose(loss.weight(x) * x, slope, atol=1e-8)
    np.testing.assert_allclose(loss.value(np.array([1e-3])), 5e-7, rtol=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
def test_weighted_squares_of_normal_residuals_are_consistent(loss: Loss, rng) -> None:
    x = rng.standard_normal(200_000)
    weights = loss.weight(x)
    # The deviation of this mean over 200,000 draws is below 0.4 %.
    assert (weights * x * x).sum() / weights.sum() == pytest.approx(loss.consistency, rel=0.02)


def test_losses_that_cannot_be_are_named() -> None:
    with pytest.raises(ValueError, match=r"Huber\.k: expected a positive number"):
        Huber(0.0)
    with pytest.raises(ValueError, match=r"Tukey\.c: expected a positive number"):
        Tukey(float("nan"))
    with pytest.raises(ValueError, match=r"LogNormalPrior: expected a positive median"):
        LogNormalPrior(-1.0, 1.0)


def test_the_robust_deviation_forgets_outliers(rng) -> None:
    x = rng.standard_normal(4000)
    x[:400] = 100.0
    assert robust_deviation(x) == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize(("noise", "force"), [(1e-3, 0.1), (5e-3, 0.02), (1e-4, 1.0)])
def test_scales_are_found_from_linear_data(rng, noise: float, force: float) -> None:
    """30 coefficients tell their scale to 13 %, 400 points the noise to 4 %: three deviations of each, and the grid."""
    jacobian = rng.standard_normal((400, 30))
    coefficients = force * rng.standard_normal(30)
    data = jacobian @ coefficients + noise * rng.standard_normal(400)
    local = linearised(jacobian, -data, np.ones(400), np.zeros(30), 1.0)
    found = estimate_hyperparameters(local, LogNormalPrior(1e-3, 2.0), LogNormalPrior(0.05, 2.5))
    assert found.noise == pytest.approx(noise, rel=0.15)
    assert found.force == pytest.approx(force, rel=0.45)
    # About another state the linear problem is the same one.
    away = rng.standard_normal(30)
    again = linearised(jacobian, jacobian @ away - data, np.ones(400), away, 1.0)
    assert estimate_hyperparameters(again, LogNormalPrior(1e-3, 2.0), LogNormalPrior(0.05, 2.5)).noise == pytest.approx(
        found.noise, rel=1e-6
    )


def test_a_scale_that_is_known_stays(rng) -> None:
    jacobian = rng.standard_normal((100, 5))
    local = linearised(jacobian, rng.standard_normal(100), np.ones(100), np.zeros(5), 1.0)
    assert estimate_hyperparameters(local, LogNormalPrior(1e-2, 0.0), LogNormalPrior(0.05, 1.0)).noise == pytest.approx(
        1e-2, rel=0.06
    )
    assert (
        estimate_hyperparameters(local, LogNormalPrior(1e-2, 1.0, minimum=5.0), LogNormalPrior(0.05, 1.0)).noise
        >= 5.0 * 0.95
    )


def told_forces(forces: NodalForces, observed: SurfaceDistance, rule: LikelihoodInformed) -> NodalForces:
    return Prepared.of(Cantilever(observed.body), observed, forces).informed(observed, rule).forces


def test_what_is_left_out_keeps_its_variance(body: Body) -> None:
    every = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.1, 1.0))
    observed = SurfaceDistance(body, body.surfaces["observed"])
    few = told_forces(every, observed, LikelihoodInformed(maximum=2))
    assert few.size == 2 and few.every is every.patterns
    prior = every.net_basis @ every.net_basis.T
    np.testing.assert_allclose(few.net_basis @ few.net_basis.T + few.left_out, prior, atol=1e-9 * prior.max())
    np.testing.assert_allclose(few.basis.T @ few.basis, np.eye(2), atol=1e-12)
    # This model moves by three sums of the forces alone: with three directions nothing that moves is left out.
    three = told_forces(every, observed, LikelihoodInformed(maximum=50))
    assert three.size == 3


def test_without_data_the_posterior_is_the_prior() -> None:
    found = posterior(np.zeros((3, 3)), np.array([4.0, 4.0, 1.0]), np.zeros(3), _scales(), 2)
    np.testing.assert_allclose(found.covariance, np.diag([0.25, 0.25, 1.0]))
    assert found.informed == 0.0


def test_doubt_in_the_forces_scale_is_doubt_in_the_forces(rng) -> None:
    """As far as the mean moves with the scale, by differences, beside the covariance at that scale."""
    jacobian, data, spread = rng.standard_normal((20, 3)), rng.standard_normal(20), 0.3

    def found(scale: float) -> Posterior:
        precision = np.array([scale**-2, scale**-2, 1.0])
        inverse = np.linalg.inv(jacobian.T @ jacobian + np.diag(precision))
        scales = Hyperparameters(1.0, scale, (0.0, spread))
        return posterior(jacobian.T @ jacobian, precision, inverse @ (jacobian.T @ data), scales, 2)

    here, step = found(0.3), 1e-4
    slope = (found(0.3 * np.exp(step)).mean - found(0.3 * np.exp(-step)).mean) / (2.0 * step)
    alone = np.linalg.inv(jacobian.T @ jacobian + np.diag([0.3**-2, 0.3**-2, 1.0]))
    np.testing.assert_allclose(here.covariance, alone + spread**2 * np.outer(slope, slope), rtol=1e-5)


def _scales():
    local = linearised(np.eye(3), np.ones(3), np.ones(3), np.zeros(3), 1.0)
    return estimate_hyperparameters(local, LogNormalPrior(1.0, 0.0), LogNormalPrior(0.5, 0.0))


def test_smooth_forces_correlate_and_keep_their_scale(body: Body) -> None:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.3, 1.0), smoothness=0.1)
    covariance = (forces.basis @ forces.basis.T).reshape(len(body.points), 3, len(body.points), 3)
    first, second = forces.nodes[:2]
    assert covariance[first, 0, first, 0] == pytest.approx(1.0, rel=2e-3)
    assert covariance[first, 0, second, 1] == 0.0
    assert covariance[first, 2, second, 2] > 0.5


def test_zones_inside_or_fixed_are_refused(body: Body) -> None:
    with pytest.raises(ValueError, match=r"nodal_forces\.nodes: expected nodes on the free boundary"):
        nodal_forces(body, body.fixed)
    with pytest.raises(ValueError, match=r"nodal_forces\.smoothness: expected a length"):
        nodal_forces(body, body.node_sets["tip"], smoothness=-1.0)


def test_contact_is_where_the_forces_are(body: Body) -> None:
    forces = nodal_forces(body, body.boundary_nodes, LogNormalPrior(0.1, 1.0))
    nodal = np.zeros_like(body.points)
    pulled = forces.nodes[np.argmax(body.points[forces.nodes] @ [1.0, 0.0, 1.0])]
    nodal[pulled] = [0.0, 0.0, 2.0]
    where = contact(forces, nodal, body.points, reach=0.1, minimum=0.03)
    distance = np.linalg.norm(body.points - body.points[pulled], axis=1)
    free = np.setdiff1d(forces.nodes, [pulled])
    assert where[pulled] == 1.0
    assert where[free[distance[free] > 0.31]].max() == 0.03 and where[free].min() == 0.03
    assert (np.diff(where[free[np.argsort(distance[free])]]) <= 1e-12).all()


def test_windowed_forces_keep_the_variance_of_what_is_left_out(body: Body) -> None:
    every = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.1, 1.0), smoothness=0.1)
    observed = SurfaceDistance(body, body.surfaces["observed"])
    few = told_forces(every, observed, LikelihoodInformed(maximum=2))
    where = np.linspace(0.1, 1.0, len(body.points))
    inside = localised(few, where)
    whole = (np.repeat(where, 3)[:, None] * every.basis).reshape(-1, 3, every.size).sum(axis=0)
    np.testing.assert_allclose(inside.net_basis @ inside.net_basis.T + inside.left_out, whole @ whole.T, atol=1e-9)
    assert inside.size == 2
