"""Registration on a forward model with a closed form: known forces, outliers, noise found, doubt, pose, outcomes."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.loss import Square
from softtwin.registration.options import RegistrationOptions
from softtwin.registration.outcome import Outcome
from softtwin.registration.parameters.nodal_forces import NodalForces, nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.policy import ACCURACY
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar, register_sequence
from softtwin.registration.result import Registration
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Verdict

from .conftest import Cantilever, cloud_on, tip_forces

NET = (0.0, 0.3, -0.8)


def forces_of(body: Body, scale: LogNormalPrior | None = None) -> NodalForces:
    return nodal_forces(body, body.node_sets["tip"], scale or LogNormalPrior(0.05, 2.0, minimum=1e-4))


def registrar(body: Body, solver: GaussNewton | LBFGS | None = None, **more: object) -> Registrar:
    observed = SurfaceDistance(body, body.surfaces["observed"])
    options = RegistrationOptions(solver=solver or GaussNewton())
    return Registrar(Cantilever(body), observed, forces_of(body), options, **more)


def register(body: Body, cloud: np.ndarray, solver: GaussNewton | LBFGS | None = None) -> Registration:
    return registrar(body, solver).register(cloud)


@pytest.mark.parametrize("solver", [GaussNewton(), LBFGS()])
def test_a_known_force_is_recovered(body: Body, rng, solver: GaussNewton | LBFGS) -> None:
    true = tip_forces(body, NET)
    truth = Cantilever(body).solve(true).displacement
    result = register(body, cloud_on(body, truth, 300, rng), solver)
    assert result.outcome is Outcome.CONVERGED
    assert result.judgement.is_usable and not result.judgement.reasons
    np.testing.assert_allclose(result.net_force[1:], NET[1:], rtol=2e-2)
    assert np.abs(result.displacement - truth)[:, 1:].max() < 5e-4
    idle = np.setdiff1d(np.arange(len(body.points)), body.node_sets["tip"])
    assert np.abs(result.forces[idle]).max() == 0.0


@pytest.mark.parametrize("solver", [GaussNewton(), LBFGS()])
def test_a_search_whose_time_is_over_says_so(body: Body, rng, solver: GaussNewton | LBFGS) -> None:
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    made, cloud = registrar(body, solver), cloud_on(body, truth, 300, rng)
    late = made.limited(time.monotonic() - 1.0).register(cloud)
    assert late.outcome is Outcome.OUT_OF_TIME and late.judgement.verdict is not Verdict.ACCEPTED
    assert made.register(cloud).outcome is Outcome.CONVERGED  # the other is as it was
    found = made.limited(time.monotonic() + 600.0).register(cloud)
    np.testing.assert_array_equal(found.net_force, made.register(cloud).net_force)


@pytest.mark.parametrize("noise", [1e-3, 5e-3])
def test_the_noise_is_found_whatever_was_believed(body: Body, rng, noise: float) -> None:
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    result = register(body, cloud_on(body, truth, 500, rng, noise))
    # The relative deviation of a standard deviation from 500 points is 3 %; at edges the closest point hides a part.
    assert result.noise == pytest.approx(noise, rel=0.15)


def test_outliers_do_not_pull(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    cloud = cloud_on(body, truth, 400, rng, 1e-3)
    wrong = rng.choice(400, 40, replace=False)
    cloud[wrong] += rng.uniform([0.0, 0.0, 0.005], [0.0, 0.0, 0.06], (40, 3))  # something in front of the organ
    dirty, pulled = register(body, cloud), register(body, cloud, GaussNewton(losses=(Square(),)))
    seen = lambda result: np.abs(result.displacement - truth)[:, 1:].mean()  # noqa: E731
    assert seen(dirty) < 5e-4 < seen(pulled)
    assert dirty.noise < 1.5e-3
    assert 0.03 < dirty.outliers < 0.12


def test_doubt_of_the_net_force_covers_the_error(body: Body) -> None:
    """Over 40 draws z^2 = e' S^-1 e / 2 of the seen components has a mean of 1 with a deviation of 0.16."""
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    made = registrar(body)
    scores = []
    for seed in range(40):
        result = made.register(cloud_on(body, truth, 200, np.random.default_rng(seed), 2e-3))
        error = (result.net_force - NET)[1:]
        scores.append(error @ np.linalg.solve(result.net_force_covariance[1:, 1:], error) / 2.0)
    assert 0.4 < np.mean(scores) < 2.0


def test_a_step_that_is_cut_is_no_convergence(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    cloud = cloud_on(body, truth, 200, rng)
    cut = register(body, cloud, GaussNewton(max_iterations=1, max_step=1e-5))
    assert cut.outcome is Outcome.MAXIMUM_ITERATIONS
    assert not cut.outcome.is_success and "max_iterations" in cut.outcome.advice
    assert any("not converged" in reason for reason in cut.judgement.reasons)


def test_the_end_of_the_descent_is_convergence(body: Body, rng) -> None:
    """Closest points jump from triangle to triangle: no step gets below what is asked here, and none is needed."""
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    cloud = cloud_on(body, truth, 200, rng, noise=2e-3)
    far = register(body, cloud, GaussNewton(settled=1e-12))
    near = register(body, cloud)
    assert far.outcome is Outcome.CONVERGED and near.outcome is Outcome.CONVERGED
    assert far.rms_distance == pytest.approx(near.rms_distance, rel=0.02)


def test_a_model_that_refuses_ends_refused_and_says_so(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.0, -1.5))).displacement
    observed = SurfaceDistance(body, body.surfaces["observed"])
    timid = Registrar(Cantilever(body, refuse_above=0.5), observed, forces_of(body))
    result = timid.register(cloud_on(body, truth, 200, rng))
    assert result.outcome is Outcome.NO_STATE
    assert result.judgement.verdict.value != "accepted"


def test_a_model_that_refuses_large_steps_is_led_by_small_ones(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.0, -0.5))).displacement
    observed = SurfaceDistance(body, body.surfaces["observed"])
    options = RegistrationOptions(solver=GaussNewton(max_step=10.0))
    timid = Registrar(Cantilever(body, refuse_above=0.6), observed, forces_of(body), options)
    assert timid.register(cloud_on(body, truth, 200, rng)).rms_distance < 1e-3


def test_l_bfgs_with_a_model_that_refuses_the_start_says_so(body: Body, rng) -> None:
    """It was an IndexError."""
    observed = SurfaceDistance(body, body.surfaces["observed"])
    hopeless = Registrar(
        Cantilever(body, refuse_above=-1.0), observed, forces_of(body), RegistrationOptions(solver=LBFGS())
    )
    with pytest.raises(NotConverged):
        hopeless.register(cloud_on(body, np.zeros_like(body.points), 100, rng))


def test_an_unknown_pose_is_found_with_the_forces(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    pose = Pose.identity().moved([0.02, -0.03, 0.025, 2e-3, -1e-3, 2e-3], body.points.mean(axis=0))
    cloud = pose.apply(cloud_on(body, truth, 500, rng, 2e-4))
    prior = PosePrior(Pose.identity(), body.points.mean(axis=0))
    result = registrar(body, pose=prior).register(cloud)
    seen = np.unique(body.surfaces["observed"])
    found = result.pose.apply((body.points + result.displacement)[seen])
    fixed = np.linalg.norm(registrar(body).register(cloud).displacement - truth, axis=1)
    normal = np.abs(found - pose.apply((body.points + truth)[seen]))
    assert result.outcome is Outcome.CONVERGED
    assert normal.mean() < 1e-3 < fixed.mean()


def test_sequences_start_warm_and_refuse_bad_clouds(body: Body, rng) -> None:
    model = Cantilever(body)
    clouds = [
        cloud_on(body, model.solve(tip_forces(body, (0.0, 0.0, f))).displacement, 150, rng) for f in (-1.0, -1.02)
    ]
    cold, warm = register_sequence(registrar(body), clouds)
    assert warm.evaluations < cold.evaluations
    bad = clouds[0].copy()
    bad[3, 1] = np.nan  # a pixel without a measurement is no point
    (holed,) = register_sequence(registrar(body), [bad])
    (without,) = register_sequence(registrar(body), [np.delete(clouds[0], 3, axis=0)])
    assert np.array_equal(holed.displacement, without.displacement)
    bad[:] = np.nan
    with pytest.raises(CloudError):
        list(register_sequence(registrar(body), [bad]))
    with pytest.raises(CloudError):
        list(register_sequence(registrar(body), [clouds[0] + 1.0]))


@pytest.mark.parametrize(("shift", "losses"), [(0.0, 1), (0.02, 2)], ids=["as before", "a part has moved far"])
def test_the_convex_loss_is_for_clouds_that_are_met_worse_than_the_last(
    body: Body, rng, shift: float, losses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points in the same place as before need none; a part of them far off could be mistaken for outliers."""
    made, model = registrar(body), Cantilever(body)
    first, second = (model.solve(tip_forces(body, (0.0, 0.0, f))).displacement for f in (-0.8, -0.81))
    last = made.register(cloud_on(body, first, 300, rng, 5e-4))
    cloud = cloud_on(body, second, 300, rng, 5e-4)
    cloud[cloud[:, 0] > 0.6, 2] -= shift
    taken: list[int] = []
    solve = GaussNewton.solve

    def counted(solver: GaussNewton, *given: object) -> object:
        taken.append(len(solver.losses))
        return solve(solver, *given)

    monkeypatch.setattr(GaussNewton, "solve", counted)
    found = made.track(cloud, last)
    assert set(taken) == {losses}
    assert found.outcome is Outcome.CONVERGED
    if not shift:
        assert np.abs(found.displacement - second).max() < 1e-3


def test_a_tool_that_lets_go_is_no_way_back(body: Body, rng) -> None:
    """A cloud of the body at rest after a large movement: from rest, with no step."""
    made = registrar(body)
    pulled = made.register(cloud_on(body, Cantilever(body).solve(tip_forces(body, NET)).displacement, 300, rng))
    released = made.register(cloud_on(body, np.zeros_like(body.points), 300, rng, 2e-4), pulled)
    assert released.outcome is Outcome.CONVERGED and released.judgement.is_usable
    assert np.abs(released.displacement).max() < 2e-3
    assert released.trace == ()
    assert np.linalg.norm(released.net_force[1:]) < 0.05 * np.linalg.norm(NET)


def test_little_time_is_spent_on_nonsense(body: Body, rng) -> None:
    made = registrar(body)
    nonsense = rng.uniform(body.points.min(axis=0) - 0.1, body.points.max(axis=0) + 0.1, (300, 3))
    result = made.register(nonsense)
    assert result.judgement.verdict is Verdict.REFUSED
    assert result.evaluations < 25


def test_large_clouds_are_thinned_and_answer_alike(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    made = registrar(body)
    missed = []
    for _ in range(15):
        large = made.register(cloud_on(body, truth, 50_000, rng, 1e-3))
        assert 500 < large.points <= made.options.maximum_points
        assert large.noise == pytest.approx(1e-3, rel=0.15)
        missed.append(np.abs(large.displacement - truth)[:, 1:].max())  # along the beam hardly anything is seen
    assert np.median(missed) < 5e-4  # of many: one cloud proves nothing


def test_points_that_are_there_again_tell_nothing_more(body: Body, rng) -> None:
    truth = Cantilever(body).solve(tip_forces(body, NET)).displacement
    cloud = cloud_on(body, truth, 150, rng, 1e-3)
    made = registrar(body)
    once, often = made.register(cloud), made.register(np.concatenate([cloud, cloud[::-1], cloud]))
    assert (once.points, often.points) == (150, 150)
    np.testing.assert_array_equal(often.displacement, once.displacement)
    np.testing.assert_array_equal(often.net_force_covariance, once.net_force_covariance)


@pytest.mark.parametrize("name", ["settled", "enough", "handed_on", "max_step", "minimum_step"])
def test_options_that_cannot_be_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=rf"GaussNewton\.{name}: expected a positive number"):
        GaussNewton(**{name: 0.0})
    with pytest.raises(ValueError, match=r"GaussNewton\.max_iterations: expected at least 1"):
        GaussNewton(max_iterations=0)
    with pytest.raises(ValueError, match="maximum_points"):
        RegistrationOptions(maximum_points=0)
    with pytest.raises(ValueError, match="LBFGS"):
        LBFGS(memory=0)


@pytest.mark.parametrize(("scatters", "taken"), [((8e-4,), 0), ((8e-4, 2e-4), 1), ((8e-4, 7e-4), 0)])
def test_a_cold_start_that_leaves_patches_is_tried_once_more(
    body: Body, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, scatters: tuple[float, ...], taken: int
) -> None:
    """From half of the directions; the second is taken where it is better by more than half. No third is tried."""
    made, begun = registrar(body), []
    points = made.setup.checked(cloud_on(body, np.zeros_like(body.points), 100, rng, 5e-4))
    found = [SimpleNamespace(shared_noise_dominates=len(scatters) > 1, scatter=each) for each in scatters]
    monkeypatch.setattr("softtwin.registration.registrar.localise", lambda *words: begun.append(words[2:]))
    monkeypatch.setattr("softtwin.registration.registrar.finish", lambda *_: None)
    monkeypatch.setattr(made, "_concluded", lambda *_: found[len(begun) - 1])
    assert made._cold(points, 0.0) is found[taken]
    assert begun == [(), (ACCURACY.leading // 2,)][: len(scatters)]
