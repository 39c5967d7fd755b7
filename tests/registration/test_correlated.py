"""Noise that neighbouring points share: told from noise of their own and from forces, and an unknown beside them."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from softtwin.meshes.body import Body
from softtwin.registration.cloud import Cloud
from softtwin.registration.correlated import CorrelatedNoise, Linear, find_correlated, is_noise
from softtwin.registration.gauss_newton import LocalModel
from softtwin.registration.hybrid import HybridRegistrar
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import ForceHyperprior, RegistrationOptions, SparseLocalisation
from softtwin.registration.outcome import Outcome
from softtwin.registration.pose import Pose
from softtwin.registration.priors import PosePrior, nodal_forces
from softtwin.registration.registrar import Registrar
from softtwin.registration.residuals import SurfaceDistance
from softtwin.registration.result import Registration, badness
from softtwin.registration.verdict import Verdict

from .conftest import Cantilever, CantileverState, cloud_on, seen_from_above, tip_forces

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


def registrar(body: Body, pose: PosePrior | None = None, model: Cantilever | None = None) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4))
    options = RegistrationOptions(localisation=SparseLocalisation(rounds=0))
    return Registrar(
        model or Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces, options, pose=pose
    )


def truth(body: Body, part: float = 1.0) -> np.ndarray:
    return Cantilever(body).solve(part * tip_forces(body, NET)).displacement


def sphere(count: int, rng: np.random.Generator) -> np.ndarray:
    points = rng.standard_normal((count, 3))
    return 0.1 * points / np.linalg.norm(points, axis=1, keepdims=True)


def linear(data: np.ndarray, points: np.ndarray) -> Linear:
    """Two directions of force that nothing acts along."""
    slopes = np.column_stack([points[:, 0], np.ones(len(points))])
    none = np.zeros((len(points), 0))
    return Linear(points, points / 0.1, data, slopes, none, np.zeros(len(points)), np.ones(len(points)))


def test_its_size_and_length_are_told(rng: np.random.Generator) -> None:
    noise, force, told = LogNormalPrior(5e-4, 1.5, minimum=1e-4), LogNormalPrior(1e-3, 1.0), []
    for _ in range(12):
        points = sphere(600, rng)
        along = np.einsum("pi,pi->p", 1e-3 * field(points, 0.03, rng), points / 0.1)
        found = find_correlated(linear(along + OWN * rng.standard_normal(600), points), noise, force, 5.0)
        assert found is not None
        told.append(found)
    np.testing.assert_allclose(np.mean(told, axis=0), [1e-3, 0.03], rtol=0.1)


@pytest.mark.parametrize("scale", [2e-4, 1e-3])
@pytest.mark.slow
def test_noise_of_single_points_is_not_taken_for_it(rng: np.random.Generator, scale: float) -> None:
    noise, force = LogNormalPrior(5e-4, 1.5, minimum=1e-4), LogNormalPrior(1e-3, 1.0)
    for _ in range(12):
        points = sphere(600, rng)
        assert find_correlated(linear(scale * rng.standard_normal(600), points), noise, force, 0.0) is None


def test_a_spot_and_a_handful_of_points_tell_nothing(rng: np.random.Generator) -> None:
    noise, force = LogNormalPrior(5e-4, 1.5, minimum=1e-4), LogNormalPrior(1e-3, 1.0)
    few = sphere(20, rng)
    assert find_correlated(linear(few[:, 0], few), noise, force, -99.0) is None
    assert find_correlated(linear(np.zeros(0), few[:0]), noise, force, -99.0) is None  # all were outliers
    spot = np.tile(few[:1], (50, 1))
    assert find_correlated(linear(np.ones(50), spot), noise, force, -99.0) is None


def test_a_noise_that_is_known_is_believed(rng: np.random.Generator) -> None:
    """Told 0.2 mm, the rest is shared."""
    points = sphere(600, rng)
    along = np.einsum("pi,pi->p", 1e-3 * field(points, 0.03, rng), points / 0.1) + OWN * rng.standard_normal(600)
    found = find_correlated(linear(along, points), LogNormalPrior(OWN, 0.0), LogNormalPrior(1e-3, 1.0), 5.0)
    assert found is not None
    assert found[0] == pytest.approx(1e-3, rel=0.25)
    assert (
        find_correlated(
            linear(OWN * rng.standard_normal(600), points), LogNormalPrior(OWN, 0.0), LogNormalPrior(1e-3, 1.0), 0.0
        )
        is None
    )


def test_its_patterns_carry_its_covariance(rng: np.random.Generator) -> None:
    """Shifts of covariance a^2 exp(-d^2 / 2 l^2), along the normals: n . n' between points."""
    points = sphere(500, rng)
    normals = points / 0.1
    noise = CorrelatedNoise.over(points, normals, 2e-3, 0.04)
    patterns = noise.patterns(noise.near(points), normals)
    apart = ((points[:, None] - points) ** 2).sum(axis=2)
    wanted = 4e-6 * np.exp(-apart / (2.0 * 0.04**2)) * (normals @ normals.T)
    assert noise.count < 150
    np.testing.assert_allclose(patterns @ patterns.T, wanted, atol=0.01 * 4e-6)
    coefficients = rng.standard_normal(noise.count)
    shifts = noise.shifts(coefficients, noise.near(points), normals)
    np.testing.assert_allclose(shifts, patterns @ coefficients, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        noise.resized(0.5).patterns(noise.near(points), normals), 0.5 * patterns, rtol=1e-9, atol=1e-15
    )


@pytest.mark.parametrize("has_pose", [False, True])
def test_residuals_have_the_derivative_that_they_say(body: Body, rng: np.random.Generator, has_pose: bool) -> None:
    prior = PosePrior(Pose.identity(), body.points.mean(axis=0)) if has_pose else None
    made = registrar(body, prior)
    plain = made.register(shaken(cloud_on(body, truth(body), 300, rng), rng))
    points, normals = plain.problem.cloud, plain.problem.normals(plain.evaluation)
    found = made.with_prior(CorrelatedNoise.over(points, normals, SIZE, LENGTH)).register(points)
    problem, at = found.problem, found.evaluation
    assert problem.correlated is not None
    some = rng.standard_normal(problem.size) * np.where(np.arange(problem.size) < problem.forces.size, 0.01, 0.1)
    cotangent = rng.standard_normal(len(problem.cloud))
    step = 1e-4 * some
    ahead, behind = (
        problem.residuals(problem.evaluation(at.coefficients + sign * step, at), OWN) for sign in (1.0, -1.0)
    )
    slope, scale = (ahead - behind) / 2e-4, np.abs(ahead - behind).max() / 2e-4
    # The normals turn with the surface, which the derivative of the shifts along them leaves out: second order.
    assert np.median(np.abs(problem.jacobian(at) @ some - slope)) < 2e-2 * scale
    part = problem.noise_part
    only = np.zeros(problem.size)
    only[part] = some[part]
    moved = problem.residuals(problem.evaluation(at.coefficients + only, at), OWN) - problem.residuals(at, OWN)
    np.testing.assert_allclose(problem.jacobian(at) @ only, moved, atol=1e-9)
    pulled = problem.vjp(at, cotangent)
    np.testing.assert_allclose(pulled, problem.jacobian(at).T @ cotangent, rtol=1e-8, atol=1e-9 * np.abs(pulled).max())


@pytest.mark.slow
def test_forces_are_as_far_off_as_they_say(body: Body) -> None:
    """Net forces across the beam: z^2 = e' S^-1 e / 2."""
    made, scores, told = registrar(body), [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        found = made.register(shaken(cloud_on(body, truth(body), 400, rng), rng))
        noise = found.problem.correlated
        assert found.judgement.is_usable
        if noise is not None:
            assert found.scatter > 0.5 * SIZE > 2.0 * found.noise
            told.append((noise.size, noise.length))
        missed = (found.net_force - NET)[1:]
        scores.append(missed @ np.linalg.solve(found.net_force_covariance[1:, 1:], missed) / 2.0)
    assert len(told) > 12
    np.testing.assert_allclose(np.median(told, axis=0), [SIZE, LENGTH], rtol=0.3)
    assert 0.1 < np.median(scores) < 3.0  # of two components: 0.69


def test_what_is_shared_over_less_than_the_edges_only_counts_points(rng: np.random.Generator) -> None:
    """No force of a coarser mesh follows it, and faces that are flat where the organ is round leave as much."""
    coarse = seen_from_above()
    cloud = cloud_on(coarse, truth(coarse), 400, rng)
    found = registrar(coarse).register(shaken(cloud, rng))
    assert found.problem.correlated is None and found.looked_for == 1
    again = registrar(coarse).follow(shaken(cloud, rng), found)
    assert again.looked_for == 2  # a frame on
    assert found.inflation_factor > 2.0


def test_what_is_larger_than_noise_is_called_so(rng: np.random.Generator) -> None:
    """Two centimetres over three: the size ends at its bound, and stands for what no force explains."""
    points = sphere(600, rng)
    along = np.einsum("pi,pi->p", 2e-2 * field(points, 0.03, rng), points / 0.1)
    found = find_correlated(
        linear(along, points), LogNormalPrior(5e-4, 1.5, minimum=1e-4), LogNormalPrior(1e-3, 1.0), 5.0
    )
    assert found is not None and not is_noise(found[0])
    assert is_noise(SIZE)


def test_what_no_force_explains_is_doubtful_and_so_are_frames_that_follow(
    body: Body, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is no unknown beside the forces: the state stays the one that was found without."""
    made, cloud = registrar(body), shaken(cloud_on(body, truth(body), 400, rng), rng)
    without = Registrar(made.model, made.observed, made.forces, replace(made.options, correlated=False))

    def in_vain(self: Registrar, points: Cloud, near: Registration, begin: float) -> Registration:
        return replace(near, outcome=Outcome.NO_DESCENT, problem=replace(near.problem, correlated=self.correlated))

    monkeypatch.setattr(LocalModel, "correlated", lambda self, worth: (4.9e-3, LENGTH))
    monkeypatch.setattr(Registrar, "_sought_anew", in_vain)
    found = made.register(cloud)
    np.testing.assert_array_equal(found.displacement, without.register(cloud).displacement)
    assert found.problem.correlated is None and found.unexplained == LENGTH
    monkeypatch.undo()
    again = made.register(cloud, found)
    assert (found.looked_for, again.looked_for) == (1, 2)
    for each in (found, again):
        assert each.judgement.verdict is Verdict.DOUBTFUL
        assert "within 100 mm of each other err alike, by more than noise does" in each.judgement.reasons[-1]


def test_a_frame_that_is_noisier_keeps_what_is_known_of_the_forces_if_it_is_met_as_well(body: Body) -> None:
    """A clear cloud has told their size; noise tells it to nobody who begins at rest."""
    scale = LogNormalPrior(0.005, 0.5, minimum=1e-5)
    forces = nodal_forces(body, body.node_sets["tip"], scale)
    options = RegistrationOptions(localisation=SparseLocalisation(rounds=0), hyperprior=ForceHyperprior(clear=2e-4))
    made, kept = Registrar(Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces, options), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        clear = made.register(cloud_on(body, truth(body), 400, rng))
        noisy = cloud_on(body, truth(body), 400, rng, 1e-3)
        found, afresh = made.register(noisy, clear), made.register(noisy)
        assert badness(found) <= badness(afresh)
        kept.append(abs(np.log(found.force_scale / clear.force_scale)) < 0.1)
        assert abs(np.log(afresh.force_scale / clear.force_scale)) > 0.5
    assert any(kept)


def test_a_clean_cloud_knows_of_none(body: Body, rng: np.random.Generator) -> None:
    for noise in (0.0, 1e-4, 1e-3):
        found = registrar(body).register(cloud_on(body, truth(body), 400, rng, noise))
        assert found.problem.correlated is None and found.scatter == found.noise


def test_frames_that_follow_keep_it_until_it_is_gone(body: Body, rng: np.random.Generator) -> None:
    made, last, kept = registrar(body), None, []
    for frame in range(5):
        cloud = cloud_on(body, truth(body, 1.0 + 0.02 * frame), 400, rng)
        last = made.follow(shaken(cloud, rng), last)
        kept.append(last.problem.correlated)
        assert last.judgement.is_usable
    assert all(noise is not None for noise in kept)
    assert kept[1].centres is kept[4].centres  # found once
    for _ in range(8):
        last = made.follow(cloud_on(body, truth(body, 1.1), 400, rng, OWN), last)
    assert last.problem.correlated is None
    assert np.linalg.norm(last.displacement - truth(body, 1.1), axis=1).mean() < 4e-4


def test_another_view_is_looked_at_anew(body: Body, rng: np.random.Generator) -> None:
    """What carries the noise is where the cloud was: a cloud of the other end has its own."""
    made, cloud = registrar(body), cloud_on(body, truth(body), 1500, rng)
    near, far = (shaken(part, rng) for part in (cloud[cloud[:, 0] < 0.4], cloud[cloud[:, 0] > 0.4]))
    first = made.register(near)
    second = made.follow(far, first)
    for found, points in ((first, near), (second, far)):
        assert found.problem.correlated is not None
        assert found.problem.correlated.reaches(points) > 0.95
    assert second.problem.correlated.reaches(near) < 0.5


def test_l_bfgs_finds_it_too(body: Body, rng: np.random.Generator) -> None:
    """Of so many more unknowns it often ends at its limit of iterations, doubtful and hardly farther off."""
    cloud, made = shaken(cloud_on(body, truth(body), 300, rng), rng), registrar(body)
    first = made.register(cloud)
    other = Registrar(made.model, made.observed, made.forces, replace(made.options, solver=LBFGS())).register(cloud)
    assert other.problem.correlated is not None
    apart = np.linalg.norm(first.displacement - other.displacement, axis=1).mean()
    assert apart < other.uncertainty.deviation.mean()


def test_the_exact_model_goes_on_with_what_the_fast_one_has_told(body: Body, rng: np.random.Generator) -> None:
    fast, exact = registrar(body), registrar(body)
    both, last = HybridRegistrar(fast, exact), None
    for _ in range(3):
        last = both.follow(shaken(cloud_on(body, truth(body), 400, rng), rng), last)
        assert last.draft is not None and last.problem.correlated is not None
        assert last.problem.correlated.centres is last.draft.problem.correlated.centres
    apart = (last.displacement - last.draft.displacement)[:, 1:]  # along itself the beam slides
    assert np.linalg.norm(apart, axis=1).mean() < SIZE  # it is the same model


class Ticking(Cantilever):
    """A model of which each state takes a second of a clock that nothing else moves."""

    now = 0.0

    def solve(self, forces: ArrayLike, near: Any = None) -> CantileverState:
        self.now += 1.0
        return super().solve(forces, near)


def test_without_time_to_tell_it_from_forces_a_frame_is_doubtful(
    body: Body, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Ticking(body)
    monkeypatch.setattr(time, "monotonic", lambda: model.now)
    made, cloud = registrar(body, model=model), shaken(cloud_on(body, truth(body), 400, rng), rng)
    model.now = 0.0
    whole, needed = made.register(cloud), model.now
    assert whole.problem.correlated is not None
    said = "no time was left to tell that from forces"
    judged = []
    for budget in np.arange(1.0, needed):
        model.now = 0.0
        judgement = made.limited(float(budget)).register(cloud).judgement
        judged.append(any(said in reason for reason in judgement.reasons))
        assert judgement.verdict is not Verdict.ACCEPTED or not judged[-1]
    assert any(judged)
