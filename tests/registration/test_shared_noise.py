"""Noise that neighbouring points share: told from noise of their own and from forces, and an unknown beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hybrid import HybridRegistrar
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.parameters.correlated_noise import CorrelatedNoise
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import Cantilever, cloud_on, seen_from_above, tip_forces

OWN, SIZE, LENGTH = 2e-4, 2e-3, 0.1
NET = (0.0, 0.3, -0.8)


@pytest.fixture(scope="module")
def body() -> Body:
    """Of edges that are short beside the length of the noise."""
    return seen_from_above((24, 6, 6))


def field(points: np.ndarray, length: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth field of shifts, (p, 3), of unit variance: random Fourier features of a Gaussian correlation."""
    waves, phases = rng.standard_normal((300, 3)) / length, rng.uniform(0.0, 2.0 * np.pi, 300)
    return np.sqrt(2.0 / 300.0) * np.cos(points @ waves.T + phases) @ rng.standard_normal((300, 3))


def shaken(cloud: np.ndarray, rng: np.random.Generator, size: float = SIZE) -> np.ndarray:
    return cloud + size * field(cloud, LENGTH, rng) + OWN * rng.standard_normal(cloud.shape)


def registrar(body: Body, pose: PosePrior | None = None, solver: GaussNewton | None = None) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4))
    options = RegistrationOptions(localisation=SparseLocalisation(rounds=0), solver=solver or GaussNewton())
    return Registrar(Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces, options, pose=pose)


def truth(body: Body, part: float = 1.0) -> np.ndarray:
    return Cantilever(body).solve(part * tip_forces(body, NET)).displacement


@pytest.mark.parametrize("has_pose", [False, True])
def test_residuals_have_the_derivative_that_they_say(body: Body, rng: np.random.Generator, has_pose: bool) -> None:
    prior = PosePrior(Pose.identity(), body.points.mean(axis=0)) if has_pose else None
    found = registrar(body, prior).register(shaken(cloud_on(body, truth(body), 300, rng), rng))
    problem, at = found.problem, found.evaluation
    only, part = np.zeros(problem.size), problem.part(CorrelatedNoise)
    only[part] = 1e-3 * rng.standard_normal(part.stop - part.start)
    moved = problem.residuals(problem.evaluation(at.coefficients + only, at), OWN) - problem.residuals(at, OWN)
    np.testing.assert_allclose(problem.jacobian(at) @ only, moved, atol=1e-9)
    cotangent = rng.standard_normal(len(problem.cloud))
    gradient = problem.vjp(at, cotangent)
    wanted = problem.jacobian(at).T @ cotangent
    np.testing.assert_allclose(gradient, wanted, rtol=1e-8, atol=1e-9 * np.abs(gradient).max())


def test_its_size_and_length_are_told(body: Body) -> None:
    """Matern's length for a Gaussian correlation's: within a factor of two; the size within a third."""
    made, told = registrar(body), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        found = made.register(shaken(cloud_on(body, truth(body), 400, rng), rng))
        assert found.shared_noise is not None and found.judgement.is_usable
        assert found.scatter > 0.5 * SIZE > 2.0 * found.noise
        told.append(found.shared_noise)
    size, length = np.median(told, axis=0)
    assert size == pytest.approx(SIZE, rel=0.34) and 0.5 * LENGTH < length < 2.0 * LENGTH


def test_a_frame_after_one_with_it_seeks_it_from_its_first_step(body: Body) -> None:
    """No step is lost to forces that explain it, and states are as near as those of searches from rest."""
    made, steps, errors = registrar(body), [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        last, fresh = (made.register(shaken(cloud_on(body, truth(body), 400, rng), rng)) for _ in range(2))
        found = made.track(fresh.problem.cloud, last)
        assert found.shared_noise is not None and found.judgement.is_usable
        steps.append((len(found.solved.trace), len(fresh.solved.trace)))
        errors.append([np.linalg.norm(each.displacement - truth(body), axis=1).mean() for each in (found, fresh)])
    followed, from_rest = np.sum(steps, axis=0)
    assert followed < 0.5 * from_rest
    followed, from_rest = np.median(errors, axis=0)
    assert followed < 1.3 * from_rest


@pytest.mark.slow
def test_forces_are_as_far_off_as_they_say(body: Body) -> None:
    """Net forces across the beam: z^2 = e' S^-1 e / 2, 0.69 in the median of a right law; a few are far off."""
    made, scores = registrar(body), []
    for seed in range(140):
        rng = np.random.default_rng(seed)
        found = made.register(shaken(cloud_on(body, truth(body), 400, rng), rng))
        missed = (found.net_force - NET)[1:]
        scores.append(missed @ np.linalg.solve(found.net_force_covariance[1:, 1:], missed) / 2.0)
    assert 0.2 < np.median(scores) < 1.6 and np.mean(scores) < 3.0


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
def test_a_cloud_without_knows_of_none(body: Body, rng: np.random.Generator, noise: float) -> None:
    """What is reckoned with then changes no margin."""
    made, cloud = registrar(body), cloud_on(body, truth(body), 400, rng, noise)
    found = made.register(cloud)
    without = Registrar(made.model, made.observed, made.forces, replace(made.options, correlated=False)).register(cloud)
    assert found.shared_noise is None and found.scatter == pytest.approx(found.noise, rel=0.02)
    ratio = found.uncertainty.deviation.mean() / without.uncertainty.deviation.mean()
    assert 0.95 < ratio < 1.1


def test_a_patch_that_is_something_else_is_no_noise(body: Body, rng: np.random.Generator) -> None:
    """Points far off are told before noise is thought of."""
    cloud = cloud_on(body, truth(body), 600, rng, OWN)
    apart = np.linalg.norm(cloud - cloud[7], axis=1)
    cloud[apart < np.quantile(apart, 0.12)] += [0.0, 0.0, 0.03]
    found = registrar(body).register(cloud)
    assert found.outliers > 0.08 and found.shared_noise is None
    assert np.linalg.norm(found.displacement - truth(body), axis=1).mean() < 1e-3


def test_frames_that_follow_keep_it_until_it_is_gone(body: Body, rng: np.random.Generator) -> None:
    made, last = registrar(body), None
    for frame in range(4):
        cloud = cloud_on(body, truth(body, 1.0 + 0.02 * frame), 400, rng)
        last = made.follow(shaken(cloud, rng), last)
        assert last.shared_noise is not None and last.judgement.is_usable
    for _ in range(2):
        last = made.follow(cloud_on(body, truth(body, 1.1), 400, rng, OWN), last)
    assert last.shared_noise is None
    assert np.linalg.norm(last.displacement - truth(body, 1.1), axis=1).mean() < 4e-4


def test_l_bfgs_finds_it_too(body: Body, rng: np.random.Generator) -> None:
    cloud, made = shaken(cloud_on(body, truth(body), 300, rng), rng), registrar(body)
    first = made.register(cloud)
    other = Registrar(made.model, made.observed, made.forces, replace(made.options, solver=LBFGS())).register(cloud)
    assert other.shared_noise is not None
    apart = np.linalg.norm(first.displacement - other.displacement, axis=1).mean()
    assert apart < other.uncertainty.deviation.mean()


def test_the_exact_model_goes_on_with_what_the_fast_one_has_told(body: Body, rng: np.random.Generator) -> None:
    fast, exact = (registrar(body, solver=GaussNewton(settled=0.02)) for _ in range(2))  # each far down its valley
    both, last = HybridRegistrar(fast, exact), None
    for _ in range(2):
        last = both.follow(shaken(cloud_on(body, truth(body), 400, rng), rng), last)
        assert last.draft is not None and last.shared_noise is not None
        assert last.shared_noise == pytest.approx(last.draft.shared_noise, rel=0.2)
    apart = np.linalg.norm(last.displacement - last.draft.displacement, axis=1)
    assert apart.mean() < 0.1 * SIZE  # it is the same model
