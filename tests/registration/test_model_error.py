"""A forward model that is wrong in known patterns: told from noise, put right, and part of the doubt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Body
from softtwin.registration.evaluation import Evaluation
from softtwin.registration.forward import reduce_model
from softtwin.registration.hyperparameters import DISCREPANCY, LogNormalPrior
from softtwin.registration.laplace import error_covariance
from softtwin.registration.local_model import LocalModel
from softtwin.registration.loss import Square
from softtwin.registration.options import options_for
from softtwin.registration.parameters.correlated_noise import CorrelatedNoise
from softtwin.registration.parameters.discrepancy import ModelError, RemainderOfModelError
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.policy import POLICY, varied
from softtwin.registration.pose import Pose
from softtwin.registration.problem import Problem
from softtwin.registration.registrar import Registrar
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Verdict

from .conftest import Cantilever, cloud_on, tip_forces

NET = (0.0, 0.3, -0.8)


@dataclass(frozen=True, eq=False)
class Patterns:
    """Two smooth errors, of 5 % and 3 % of the largest displacement."""

    modes: np.ndarray
    rest: np.ndarray
    places: float = 1e6


def patterns(body: Body) -> Patterns:
    x = body.points[:, 0] / body.points[:, 0].max()
    modes = np.zeros((*body.points.shape, 2))
    modes[:, 2, 0], modes[:, 1, 1] = 0.05 * np.sin(np.pi * x), 0.03 * x * (1.0 - x) * 4.0
    modes[body.fixed] = 0.0
    return Patterns(modes.reshape(-1, 2), np.full(len(body.points), 1e-3))


class Biased(Cantilever):
    """The test model, which knows by what patterns it may be wrong."""

    def __init__(self, body: Body, known: bool = True) -> None:
        super().__init__(body)
        self.error = 0.005
        self.discrepancy = patterns(body) if known else None


def true_displacement(body: Body, a: np.ndarray) -> np.ndarray:
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    size = np.linalg.norm(u, axis=1).max()
    return u + size * (patterns(body).modes @ a).reshape(-1, 3)


def registrar(body: Body, known: bool = True) -> Registrar:
    """Forces across the beam alone: along itself a straight side slides, and what covers a cloud may be any longer."""
    every = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4))
    across = np.flatnonzero(np.arange(every.size) % 3 > 0)
    forces = every.combined(np.eye(every.size)[:, across])
    return Registrar(Biased(body, known), SurfaceDistance(body, body.surfaces["observed"]), forces)


def test_an_error_of_known_shape_is_put_right(body: Body, rng) -> None:
    truth = true_displacement(body, np.array([1.0, -1.0]))
    cloud = cloud_on(body, truth, 400, rng, 5e-4)
    plain, known = registrar(body, known=False).register(cloud), registrar(body).register(cloud)
    missed = [np.linalg.norm(r.displacement - truth, axis=1)[body.boundary_nodes].mean() for r in (plain, known)]
    assert missed[1] < 0.3 * missed[0]
    assert known.noise == pytest.approx(5e-4, rel=0.3)
    assert np.abs(known.correction).max() > 1e-3
    np.testing.assert_array_equal(known.correction[body.fixed], 0.0)
    np.testing.assert_array_equal(known.displacement, known.state.displacement + known.correction)


@pytest.mark.slow
def test_doubt_of_the_net_force_knows_of_the_models_error(body: Body) -> None:
    """Errors drawn from their own law: z^2 = e' S^-1 e / 2 has a mean near 1.

    Without patterns of them, that neighbours err alike makes up for most of it, as noise that they share: its z^2 is of
    the order of 4, within its sampling error, and a tenth of what independent points would say at most.
    """
    made = registrar(body)
    scores, blind, alone, shared = [], [], [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cloud = cloud_on(body, true_displacement(body, rng.standard_normal(2)), 400, rng, 5e-4)
        result = made.register(cloud)
        missed = (result.net_force - NET)[1:]
        scores.append(missed @ np.linalg.solve(result.net_force_covariance[1:, 1:], missed) / 2.0)
        for correlated, squares in ((True, blind), (False, alone)):
            options = replace(made.options, correlated=correlated)
            exact = Registrar(Cantilever(body), made.observed, made.forces, options).register(cloud)
            missed = (exact.net_force - NET)[1:]
            squares.append(missed @ np.linalg.solve(exact.net_force_covariance[1:, 1:], missed) / 2.0)
            if correlated:
                shared.append(exact.shared_noise is not None)
    assert 0.5 < np.mean(scores) < 1.5
    least = np.mean(blind) - 2.0 * np.std(blind) / np.sqrt(len(blind))
    assert 1.5 * np.mean(scores) < np.mean(blind) < 0.1 * np.mean(alone) and least < 4.0 * np.mean(scores)
    assert np.mean(shared) > 0.9


@pytest.mark.parametrize(("size", "verdict"), [(1.0, Verdict.ACCEPTED), (6.0, Verdict.DOUBTFUL)])
def test_more_than_the_model_was_seen_to_get_wrong_is_doubtful(body: Body, rng, size: float, verdict: Verdict) -> None:
    cloud = cloud_on(body, true_displacement(body, np.array([size, -size])), 400, rng, 5e-4)
    result = registrar(body).register(cloud)
    assert result.judgement.verdict is verdict, (result.discrepancy_scale, result.judgement.reasons)
    assert any("seen to get wrong" in each for each in result.judgement.reasons) == (verdict is Verdict.DOUBTFUL)


def test_two_patterns_alone_cannot_decide_about_the_level(body: Body, rng) -> None:
    """Of four times what was seen the scale lies about the level of a doubt, by less than its own uncertainty."""
    cloud = cloud_on(body, true_displacement(body, np.array([4.0, -4.0])), 400, rng, 5e-4)
    local = registrar(body).register(cloud).solved.local
    deviation = float(np.sqrt(local.evidence.covariance(local.eta)[DISCREPANCY, DISCREPANCY]))
    assert abs(local.eta[DISCREPANCY] - np.log(POLICY.excess)) < 2.0 * deviation < 0.3


def test_what_few_directions_leave_far_off_is_found_with_all(body: Body, rng) -> None:
    """The model's error is an unknown at once then, unless so much is left that no direction may explain it."""
    plain = registrar(body)
    options = replace(plain.options, localisation=replace(plain.options.localisation, rounds=0))
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.8, -0.8))).displacement
    with varied("leading", 1.0 / 6.0):
        made = Registrar(Biased(body), plain.observed, plain.forces, options)
        result = made.register(cloud_on(body, truth, 400, rng, 5e-4))
    assert result.judgement.verdict is Verdict.ACCEPTED, result.judgement.reasons
    assert np.linalg.norm(result.displacement - truth, axis=1).mean() < 1e-3


def test_a_pull_of_an_unexpected_size_is_taken_for_no_turn(body: Body, rng) -> None:
    """Of an unknown pose, ten times as large as forces were expected: margins hold in the organ's own coordinates."""
    model, plain = Biased(body), registrar(body)
    small = replace(plain.forces, scale=replace(plain.forces.scale, median=0.1 * plain.forces.scale.median))
    options, pose = options_for(model, has_zone=True), PosePrior(Pose.identity(), body.points.mean(axis=0))
    truth = true_displacement(body, np.array([0.5, -0.5]))
    result = Registrar(model, plain.observed, small, options, pose=pose).register(cloud_on(body, truth, 400, rng, 5e-4))
    assert result.judgement.is_usable
    turn = np.linalg.norm(Rotation.from_matrix(result.pose.rotation).as_rotvec())
    assert turn < 0.2 * np.linalg.norm(truth, axis=1).max() / np.ptp(body.points[:, 0])  # a fifth of the whole pull
    missed = np.linalg.norm(result.displacement - truth, axis=1)
    assert np.mean(missed <= result.uncertainty.margin() + 1e-12) > 0.9


def test_the_next_frame_starts_from_the_error_found(body: Body, rng) -> None:
    truth = true_displacement(body, np.array([1.0, -1.0]))
    made = registrar(body)
    cold = made.register(cloud_on(body, truth, 400, rng, 5e-4))
    warm = made.register(cloud_on(body, truth, 400, rng, 5e-4), cold)
    assert warm.judgement.is_usable and warm.evaluations < cold.evaluations
    assert np.linalg.norm(warm.correction - cold.correction, axis=1).max() < 2e-3


def test_the_derivative_of_the_distances_is_exact(body: Body, rng) -> None:
    """By central differences, with forces, pose and model error at once; the adjoint gives the same.

    What patterns leave out and what neighbours share move no point: the residuals are linear in them.
    """
    model, observed = Biased(body), SurfaceDistance(body, body.surfaces["observed"])
    forces = nodal_forces(body, body.node_sets["tip"][:4], LogNormalPrior(0.05, 0.5))
    prior = PosePrior(Pose.identity(), body.points.mean(axis=0))
    error = ModelError(model.discrepancy, observed, 0.1)
    cloud = cloud_on(body, true_displacement(body, np.array([1.0, -1.0])), 100, rng, 5e-3)
    reduced = reduce_model(model, observed.nodes, forces.basis)
    noise, shared = LogNormalPrior(1e-3, 1.0), CorrelatedNoise(observed.modes.leading(10))
    problem = Problem.of(reduced, observed, cloud, noise, (forces, prior, error, shared))
    at = 0.1 * rng.standard_normal(problem.size)
    evaluation, direction, step = problem.evaluation(at), rng.standard_normal(problem.size), 1e-6
    moving = problem.moving.stop
    alone = problem.size - moving
    assert moving == forces.size + 6 + 2 and alone == error.remainder.size + 3 * 10

    def near(sign: float) -> Evaluation:
        return problem.evaluation(at + sign * step * direction, evaluation)

    ahead, behind = near(1.0), near(-1.0)
    stays = (ahead.match.triangles == evaluation.match.triangles) & (
        behind.match.triangles == evaluation.match.triangles
    )
    jacobian = problem.jacobian(evaluation)
    differences = (ahead.match.distances - behind.match.distances) / (2.0 * step)
    assert stays.mean() > 0.9
    moved = jacobian[:, :moving] @ direction[:moving]
    np.testing.assert_allclose(moved[stays], differences[stays], rtol=1e-4, atol=1e-7)
    change = np.concatenate([np.zeros(moving), direction[moving:]])
    taken = problem.residuals(replace(evaluation, coefficients=at + change), 1e-3)
    taken -= problem.residuals(evaluation, 1e-3)
    np.testing.assert_allclose(jacobian @ change, taken, rtol=1e-9, atol=1e-12)
    assert np.abs(jacobian[:, problem.part(RemainderOfModelError)]).max() > 0.0
    cotangent = rng.standard_normal(len(cloud))
    np.testing.assert_allclose(problem.vjp(evaluation, cotangent), jacobian.T @ cotangent, rtol=1e-8, atol=1e-10)


def test_margins_are_those_of_an_estimate_that_believed_the_model_too_much(
    body: Body, rng: np.random.Generator
) -> None:
    """Drawn: unknowns and distances with the model's error as it was seen, an estimate made with 0.6 of it."""
    model, observed = Biased(body), SurfaceDistance(body, body.surfaces["observed"])
    forces = nodal_forces(body, body.node_sets["tip"][:2], LogNormalPrior(0.05, 0.0))
    error = ModelError(model.discrepancy, observed, 0.1)
    cloud = cloud_on(body, true_displacement(body, np.zeros(2)), 100, rng, 1e-3)
    reduced = reduce_model(model, observed.nodes, forces.basis)
    problem = Problem.of(reduced, observed, cloud, LogNormalPrior(1e-4, 0.0), (forces, error))
    start = problem.hyperprior.median.copy()
    start[DISCREPANCY] = np.log(0.6)
    evaluation = problem.evaluation(np.zeros(problem.size))
    local = LocalModel(problem, evaluation, Square(), 1e-4, starts=[start], is_held=True)
    assert local.scales.discrepancy == pytest.approx(0.6)

    believed = problem.hyperprior.median.copy()
    believed[DISCREPANCY] = np.log(local.scales.margin_discrepancy)
    variances = np.exp(problem.prior_variances(believed)[0])
    unknown = np.sqrt(variances)[:, None] * rng.standard_normal((problem.size, 40_000))
    noise = np.hypot(local.noise, local.local_error)[:, None] * rng.standard_normal((len(cloud), 40_000))
    data = (local.jacobian @ unknown + noise) / local.deviations[:, None] ** 2
    off = local.solved(local.jacobian.T @ data) - unknown
    wanted = np.cov(off)
    found = error_covariance(local)
    np.testing.assert_allclose(found, wanted, atol=0.04 * np.sqrt(np.outer(np.diag(wanted), np.diag(wanted))).max())
    assert (np.diag(found) > 0.999 * np.diag(local.solved(np.eye(problem.size)))).all()
    assert (
        np.diag(found)[problem.part(RemainderOfModelError)].sum()
        > 2.0 * 0.6**2 * variances[problem.part(RemainderOfModelError)].sum()
    )
