"""Losses, scales found from data and their doubt, and the reduction to what a cloud can tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.registration.forward import reduce_model
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.laplace import posterior
from softtwin.registration.local_model import LocalModel
from softtwin.registration.loss import Huber, Loss, Square, Tukey, robust_deviation
from softtwin.registration.options import noise_prior
from softtwin.registration.parameters.correlated_noise import CorrelatedNoise
from softtwin.registration.parameters.discrepancy import ModelError
from softtwin.registration.parameters.nodal_forces import (
    LikelihoodInformed,
    NodalForces,
    localised,
    nodal_forces,
    normal_forces,
    reweighting,
)
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.policy import POLICY
from softtwin.registration.pose import Pose
from softtwin.registration.prepared import Prepared
from softtwin.registration.problem import Problem
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import Cantilever, cloud_on, tip_forces
from .test_model_error import patterns

Floats = NDArray[np.float64]
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
    assert ((weights * x) ** 2).sum() / weights.sum() == pytest.approx(loss.shrinkage, rel=0.02)


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


@pytest.mark.parametrize("stiffer", [1e-4, 1e4])
def test_an_organ_of_any_stiffness_keeps_the_same_directions(body: Body, stiffer: float) -> None:
    """The forces that are expected grow with the stiffness: what a cloud can tell stays what it was."""
    observed = SurfaceDistance(body, body.surfaces["observed"])

    def directions(stiffness: float) -> int:
        every = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.003 * stiffness, 1.0))
        softer = replace(every, patterns=every.patterns / stiffness)  # as far moved by forces that are so much larger
        whole = Cantilever(body)
        model = reduce_model(whole, observed.nodes, softer.basis)
        return Prepared(every, model, whole).informed(observed, LikelihoodInformed()).forces.size

    assert directions(stiffer) == directions(1.0) == 3


def problem(body: Body, rng: np.random.Generator, **given: Any) -> Problem:
    """Of a cloud with a millimetre of noise, in which neighbours share none; what is given is otherwise."""
    observed = given.pop("observed", SurfaceDistance(body, body.surfaces["observed"]))
    forces = given.pop("forces", nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 1.0)))
    model = Cantilever(body)
    truth = model.solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    known: dict[str, Any] = {
        "model": reduce_model(model, observed.nodes, forces.basis),
        "observed": observed,
        "cloud": cloud_on(body, truth, 300, rng, 1e-3),
        "noise": LogNormalPrior(1e-3, 0.0),
        "blocks": (forces, *given.pop("blocks", ())),
    }
    return Problem.of(**{**known, **given})


def settled(given: Problem) -> LocalModel:
    """About the minimum of squares."""
    return GaussNewton((Square(),), settled=1e-5).solve(given, np.zeros(given.size)).local


def test_a_scale_that_is_known_stays(body: Body, rng: np.random.Generator) -> None:
    """A noise that is 3 or 50 times the cloud's own; one that is bounded from below; forces of a size that is told."""
    for known in (3e-3, 5e-2):
        assert settled(problem(body, rng, noise=LogNormalPrior(known, 0.0))).noise == pytest.approx(known)
    assert settled(problem(body, rng, noise=LogNormalPrior(1e-3, 1.0))).noise == pytest.approx(1e-3, rel=0.2)
    bounded = settled(problem(body, rng, noise=LogNormalPrior(1e-3, 1.0, minimum=5e-3)))
    assert bounded.noise == pytest.approx(5e-3)
    told = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.002, 0.0))
    assert settled(problem(body, rng, forces=told)).scales.force == pytest.approx(0.002)


def test_without_data_the_posterior_is_the_prior(body: Body, rng: np.random.Generator) -> None:
    """All points are outliers: each block of unknowns keeps its own variance, each scale its median.

    Of forces the variance is the mean of the square of their scale, which is log-normal.
    """
    observed = SurfaceDistance(body, body.surfaces["observed"])
    error = ModelError(patterns(body), observed)
    pose = PosePrior(Pose.identity(), body.points.mean(axis=0))
    far = cloud_on(body, np.full_like(body.points, 5.0), 50, rng)
    given = problem(body, rng, cloud=far, blocks=(pose, error, CorrelatedNoise(observed.modes)), noise=noise_prior())
    local = LocalModel(given, given.evaluation(np.zeros(given.size)), Tukey(), 1e-3)
    assert not local.weights.any()
    found, hyperprior = posterior(local), given.hyperprior
    np.testing.assert_allclose(local.eta, hyperprior.median, atol=0.05)
    shared = POLICY.shared_size**2 * np.exp(observed.modes.log_variances(local.scales.length)[0])
    force = 0.05**2 * np.exp(2.0 * given.forces.scale.spread**2)
    variances = [np.full(given.forces.size, force), np.ones(6 + 2), np.exp(error.remainder.logs), np.tile(shared, 3)]
    np.testing.assert_allclose(np.diag(found.covariance), np.concatenate(variances), rtol=0.02)
    off = found.covariance - np.diag(np.diag(found.covariance))
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
    assert found.informed == pytest.approx(0.0, abs=1e-12)


def dense_evidence(local: LocalModel, force: float) -> float:
    """Minus the logarithm of the normal law of all points for a force scale, with its prior, but for a constant."""
    data = local.jacobian @ local.evaluation.coefficients - local.problem.residuals(local.evaluation, local.point_noise)
    covariance = local.noise**2 * np.eye(len(data)) + force**2 * local.jacobian @ local.jacobian.T
    scale = local.problem.forces.scale
    believed = (np.log(force / scale.median) / scale.spread) ** 2
    return 0.5 * float(np.linalg.slogdet(covariance)[1] + data @ np.linalg.solve(covariance, data) + believed)


@pytest.mark.parametrize("axes", [(1, 2), (0, 1, 2)])
def test_doubt_in_the_forces_scale_is_doubt_in_the_forces(
    body: Body, rng: np.random.Generator, axes: tuple[int, ...]
) -> None:
    """As far as the mean moves with the scale, by differences, beside the covariance's own mean over all scales.

    The scale is the most likely one, its doubt the curvature there, of the normal law of all points. These are few and
    said to be bad, so that what is found depends on the scale; planes let the descent end at the minimum itself. Of a
    pull along the axis they tell little: its variance is larger in the mean than at the most likely scale.
    """
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    cloud, planes = cloud_on(body, truth, 60, rng, 1e-3), SurfaceDistance(body, body.surfaces["observed"], "plane")
    every = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 1.0))
    across = np.kron(np.full((len(every.nodes), 1), len(every.nodes) ** -0.5), np.eye(3)[:, axes])  # all nodes together
    forces, noise = every.combined(across), LogNormalPrior(0.05, 0.0)
    local = settled(problem(body, rng, forces=forces, cloud=cloud, observed=planes, noise=noise))
    force, step = local.scales.force, 0.02
    ahead, here, behind = (dense_evidence(local, force * np.exp(sign * step)) for sign in (1.0, 0.0, -1.0))
    curvature = (ahead - 2.0 * here + behind) / step**2
    assert abs(ahead - behind) / (2.0 * step) < 0.05 * np.sqrt(curvature)

    def mean(scale: float) -> Floats:
        forces = replace(local.problem.forces, scale=LogNormalPrior(scale, 0.0))
        known = replace(local.problem, blocks=(forces, *local.problem.blocks[1:]))
        held = LocalModel(known, local.evaluation, Square(), local.noise, point_noise=local.point_noise)
        return held.evaluation.coefficients - held.solved(held.gradient[:, None])[:, 0]

    slope = (mean(force * np.exp(1e-4)) - mean(force * np.exp(-1e-4))) / 2e-4

    def alone(scale: float) -> Floats:
        told = local.jacobian.T @ local.jacobian / local.noise**2
        return np.linalg.inv(told + np.eye(len(slope)) / scale**2)

    every = force * np.exp(np.linspace(-5.0, 5.0, 101) / np.sqrt(curvature))
    density = np.exp(here - np.array([dense_evidence(local, scale) for scale in every]))
    density /= density.sum()
    mean_covariance = sum(part * alone(scale) for part, scale in zip(density, every, strict=True))
    found, by_mean = posterior(local), np.outer(slope, slope) / curvature
    added, wanted = found.covariance - alone(force), by_mean + mean_covariance - alone(force)
    np.testing.assert_allclose(added, wanted, atol=0.03 * np.abs(wanted).max())
    if 0 in axes:
        assert found.covariance[0, 0] > 1.05 * (alone(force) + by_mean)[0, 0]
    else:
        assert np.trace(by_mean) > 0.1 * np.trace(alone(force))
    assert found.force == pytest.approx(np.sqrt(density @ every**2), rel=0.03)


def test_smooth_forces_correlate_and_keep_their_scale(body: Body) -> None:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.3, 1.0), smoothness=0.1)
    covariance = (forces.basis @ forces.basis.T).reshape(len(body.points), 3, len(body.points), 3)
    first, second = forces.nodes[:2]
    assert covariance[first, 0, first, 0] == pytest.approx(1.0, rel=2e-3)
    assert covariance[first, 0, second, 1] == 0.0
    assert covariance[first, 2, second, 2] > 0.5


@pytest.mark.parametrize("smoothness", [0.05, 0.1])
@pytest.mark.parametrize("radius", [0.04, 0.06, 0.09])
def test_a_pull_on_a_patch_with_an_edge_is_a_likely_one(radius: float, smoothness: float) -> None:
    """What it takes of smooth and of rough patterns is of one size, as of a draw; a smoother law takes tenfold."""
    body = beam((40, 10, 10), (0.8, 0.2, 0.2), "tetrahedron")
    top = np.setdiff1d(np.flatnonzero(body.points[:, 2] > 0.2 - 1e-9), body.fixed)
    forces = nodal_forces(body, top, smoothness=smoothness)
    pull = np.zeros_like(body.points)
    pull[top[np.linalg.norm(body.points[top] - [0.4, 0.1, 0.2], axis=1) < radius], 2] = 1.0
    found = forces.nearest(pull)[2::3]
    assert np.linalg.norm(forces.forces(forces.nearest(pull)) - pull) < 0.3 * np.linalg.norm(pull)
    told = found[np.abs(found) > 1e-9]  # others are of another symmetry
    rough, smooth = told[: len(told) // 3], told[-(len(told) // 3) :]
    assert 0.5 < np.sqrt(np.mean(rough**2) / np.mean(smooth**2)) < 2.0


def test_of_a_large_zone_the_smoothest_patterns_are_kept_and_of_a_pressure_all() -> None:
    """Rough patterns of forces with an edge are many and move little; a pressure's are few where it is smooth."""
    body = beam((20, 6, 6), (0.8, 0.2, 0.2), "tetrahedron")
    zone = np.setdiff1d(body.boundary_nodes, body.fixed)
    forces, pressure = (make(body, zone, smoothness=0.02) for make in (nodal_forces, normal_forces))
    assert forces.size == 3 * 300 < 3 * len(zone)
    assert pressure.size == 6 + len(zone)
    carried = np.square(forces.patterns).sum(axis=1)
    assert 0.5 < carried.mean() < 1.0 and carried.max() < 1.0 + 1e-9


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
    where = reweighting(forces, nodal, body.points, reach=0.1, minimum=0.03)
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
