"""Score tests: chi-square where nothing was left out, and far beyond where the cloud is scaled or its pose is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Body
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LENGTH, SHARED, LogNormalPrior
from softtwin.registration.local_model import LocalModel
from softtwin.registration.loss import Square
from softtwin.registration.parameters.correlated_noise import CorrelatedNoise
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.problem import Problem
from softtwin.registration.registrar import Registrar
from softtwin.registration.score import by_rigid_motion, by_scale, gain_by_shared_noise, scores
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Code, Verdict

from .conftest import Cantilever, cloud_on, tip_forces

NOISE = 4e-4


@pytest.fixture(scope="module")
def registrar(body: Body) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    return Registrar(Cantilever(body, learned=2.0), SurfaceDistance(body, body.surfaces["observed"]), forces)


def some_cloud(registrar: Registrar, seed: int, noise: float = NOISE) -> np.ndarray:
    rng, body = np.random.default_rng([5, seed]), registrar.model.body
    truth = registrar.model.solve(tip_forces(body, (0.0, *rng.uniform(-0.8, 0.8, 2)))).displacement
    return cloud_on(body, truth, 400, rng, noise)


def about_its_middle(cloud: np.ndarray, turn: float = 0.0, shift: float = 0.0, scale: float = 1.0) -> np.ndarray:
    middle = cloud.mean(axis=0)
    rotation = Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()
    return middle + scale * (cloud - middle) @ rotation.T + shift * np.array([0.0, 1.0, 0.0])


def test_of_a_right_model_chances_are_no_smaller_than_they_say(registrar: Registrar) -> None:
    """Of 100 clouds: robust weights make them larger; no more than 10 are below 5 %, and hardly a cloud is doubted."""
    tested, doubted = {"scale": list[float](), "motion": list[float]()}, 0
    for seed in range(100):
        found = registrar.register(some_cloud(registrar, seed))
        doubted += found.judgement.verdict is not Verdict.ACCEPTED
        for name, columns in (("scale", by_scale), ("motion", by_rigid_motion)):
            told = scores(found.local, columns(found.local))[0]
            assert told is not None
            tested[name].append(told.p_value)
    assert doubted <= 3
    for chances in tested.values():
        assert np.mean(np.less(chances, 0.05)) <= 0.1 and 0.4 < np.median(chances) < 0.9


@pytest.mark.parametrize(("scale", "better"), [(1.05, "smaller"), (0.97, "larger")])
def test_a_cloud_of_another_scale_is_named(registrar: Registrar, scale: float, better: str) -> None:
    """Of eight clouds most have a chance below 3 in 1,000, and are doubtful; two directions do not show it."""
    unlikely = 0
    for seed in range(8):
        judged = registrar.register(about_its_middle(some_cloud(registrar, seed), scale=scale)).judgement
        (check,) = (check for check in judged.checks if check.code is Code.SCALE)
        assert check.level is not None and check.p_value is not None
        assert check.is_passed == (check.p_value >= 2.7e-3) and check.is_passed == (not check.reason)
        if not check.is_passed:
            assert check.verdict is Verdict.DOUBTFUL and f"% {better}: it has not the scale" in check.reason
        unlikely += check.p_value < 0.003
    assert unlikely >= 5


@pytest.mark.parametrize("noise", [NOISE, 2e-3])
def test_noise_makes_no_cloud_look_larger(registrar: Registrar, noise: float) -> None:
    """Signed roots of the score have no mean, over 40 clouds, beyond three standard errors."""
    roots = []
    for seed in range(40):
        local = registrar.register(some_cloud(registrar, seed, noise)).local
        told = scores(local, by_scale(local))[0]
        assert told is not None
        roots.append(np.sign(told.estimate[0]) * np.sqrt(told.statistic))
    assert abs(np.mean(roots)) < 3.0 / np.sqrt(len(roots))


def test_a_pose_that_is_not_exact_is_named(registrar: Registrar) -> None:
    found = registrar.register(about_its_middle(some_cloud(registrar, 2), turn=0.04, shift=3e-3))
    (check,) = (check for check in found.judgement.checks if check.code is Code.EXACT_POSE)
    assert check.verdict is Verdict.DOUBTFUL and "the pose is not exact" in check.reason


def test_what_is_sure_and_too_small_to_matter_is_passed(registrar: Registrar) -> None:
    """A pose that is off by a fifth of the expected noise, with next to none."""
    body = registrar.model.body
    truth = registrar.model.solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    exact = about_its_middle(cloud_on(body, truth, 400, np.random.default_rng(0), 1e-5), shift=1e-4)
    judged = registrar.register(exact).judgement
    (check,) = (check for check in judged.checks if check.code is Code.EXACT_POSE)
    assert check.is_passed and not check.reason


def test_columns_are_derivatives_of_the_distances(registrar: Registrar) -> None:
    """By differences, where the closest point is within a triangle; a scale is that of the points without noise."""
    local = registrar.register(some_cloud(registrar, 0)).local
    assert local is not None
    at, observed, step = local.evaluation, local.problem.observed, 1e-6
    middle = at.cloud[local.weights > 0.0].mean(axis=0)
    match = observed.match(at.positions, at.cloud)
    before, feet = match.distances, observed.moved_closest_points(match, at.positions)
    turned = Rotation.from_rotvec([0.0, step, 0.0]).as_matrix()
    moved = {
        "scale": (at.cloud + step * (feet - middle), by_scale(local)[:, 0]),
        "turn": (middle + (at.cloud - middle) @ turned.T, by_rigid_motion(local)[:, 1]),
        "shift": (at.cloud + np.array([0.0, 0.0, step]), by_rigid_motion(local)[:, 5]),
    }
    for cloud, column in moved.values():
        slopes = (observed.match(at.positions, cloud).distances - before) / step
        assert np.median(np.abs(slopes - column)) < 1e-5 and np.corrcoef(slopes, column)[0, 1] > 0.99


def test_nothing_is_said_of_what_is_not_seen(registrar: Registrar) -> None:
    local = registrar.register(some_cloud(registrar, 3)).local
    assert local is not None and scores(local, np.zeros((400, 1))) == [None]


def evidence_with(local: LocalModel, problem: Problem, size: float, length: float) -> float:
    """Logarithm of the dense normal law of the distances with noise of a size and length that neighbours share."""
    data = local.jacobian @ local.evaluation.coefficients - local.problem.residuals(local.evaluation, local.point_noise)
    covariance = np.diag(local.deviations**2) + local.jacobian / local.precision @ local.jacobian.T
    assert problem.shared is not None
    modes = problem.shared.by_points(local.evaluation)
    covariance += size**2 * modes * np.exp(np.tile(problem.shared.modes.log_variances(length)[0], 3)) @ modes.T
    return -0.5 * float(np.linalg.slogdet(covariance)[1] + data @ np.linalg.solve(covariance, data))


def least_squares(registrar: Registrar, cloud: np.ndarray) -> tuple[LocalModel, Problem]:
    """Where a registration without shared noise ends, and the problem with it."""
    options = replace(registrar.options, solver=GaussNewton(losses=(Square(),)), correlated=False)
    found = Registrar(registrar.model, registrar.observed, registrar.forces, options).register(cloud)
    assert found.local is not None
    return found.local, found.problem.with_shared(CorrelatedNoise(registrar.observed.modes))


def test_what_shared_noise_may_explain_is_known_before_it_is_sought(registrar: Registrar) -> None:
    cloud, size = some_cloud(registrar, 0), 3e-3
    waves = 10.0 * np.pi * np.random.default_rng(3).standard_normal((3, 3))
    local, whole = least_squares(registrar, cloud + size * np.sin(cloud @ waves))
    gain, log_size, log_length = gain_by_shared_noise(local, whole)
    prior = whole.hyperprior
    off = (np.array([log_size, log_length]) - prior.median[[SHARED, LENGTH]]) / prior.spread[[SHARED, LENGTH]]
    cost = 0.5 * float(off @ off)
    none, some = (evidence_with(local, whole, part, np.exp(log_length)) for part in (0.0, np.exp(log_size)))
    assert gain > 10.0 and some - none - cost == pytest.approx(gain, rel=0.1)  # squares count as if their mean were 1
    assert 0.3 * size < np.exp(log_size) < 3.0 * size


def test_noise_of_its_own_is_seldom_thought_to_be_shared(registrar: Registrar) -> None:
    gains = [gain_by_shared_noise(*least_squares(registrar, some_cloud(registrar, seed)))[0] for seed in range(20)]
    assert gains == [-np.inf] * 20


def test_points_nearer_than_any_camera_sees_share_nothing(registrar: Registrar) -> None:
    """Neighbours that are off alike by a twentieth of the least noise that is believed, as by a model's small error."""
    waves = 10.0 * np.pi * np.random.default_rng(3).standard_normal((3, 3))
    for seed in range(3):
        cloud = some_cloud(registrar, seed, noise=1e-7)
        found = registrar.register(cloud + 5e-6 * np.sin(cloud @ waves))
        assert found.rms_distance < 0.1 * found.noise and found.shared_noise is None and found.local is not None
        whole = found.problem.with_shared(CorrelatedNoise(registrar.observed.modes))
        assert gain_by_shared_noise(found.local, whole)[0] == -np.inf


def test_a_problem_without_shared_noise_gains_nothing(registrar: Registrar) -> None:
    found = registrar.register(some_cloud(registrar, 1))
    assert gain_by_shared_noise(found.local, found.problem.unshared)[0] == -np.inf
