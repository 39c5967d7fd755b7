"""Two models behind one registration: the exact one's answer, from where the fast one has been, whatever that was."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hybrid import HybridRegistrar
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.outcome import Outcome
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar, register_sequence
from softtwin.registration.residuals.landmarks import LandmarkPairs
from softtwin.registration.result import Registration
from softtwin.registration.strategies.refinement import is_same_place
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Judgement, Verdict

from .conftest import Cantilever, CantileverState, cloud_on, tip_forces

NET = (0.0, 0.3, -0.8)


class Bent(Cantilever):
    """A fast model that moves too far, and the number of states that it was asked for."""

    def __init__(self, body: Body, too_far: float = 1.0, refuse_above: float = np.inf) -> None:
        super().__init__(body, refuse_above)
        self.too_far, self.asked = too_far, 0

    def solve(self, forces: ArrayLike, near: Any = None) -> CantileverState:
        self.asked += 1
        found = super().solve(forces)
        return CantileverState(found.shape, found.mean, self.too_far * found.reach)


def engine(fast: Bent, exact: Bent, pose: PosePrior | None = None) -> HybridRegistrar:
    def alone(model: Bent, options: RegistrationOptions) -> Registrar:
        body = model.body
        forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
        return Registrar(model, SurfaceDistance(body, body.surfaces["observed"]), forces, options, pose=pose)

    thorough = RegistrationOptions(solver=GaussNewton(settled=0.02))  # to a fiftieth of a deviation
    return HybridRegistrar(alone(fast, RegistrationOptions()), alone(exact, thorough))


@pytest.fixture
def truth(body: Body) -> np.ndarray:
    return Cantilever(body).solve(tip_forces(body, NET)).displacement


@pytest.mark.parametrize("too_far", [1.0, 1.2, 0.7])
def test_it_ends_where_the_exact_model_ends_alone(body: Body, truth: np.ndarray, rng, too_far: float) -> None:
    cloud = cloud_on(body, truth, 300, rng, 5e-4)
    fast, exact = Bent(body, too_far), Bent(body)
    both = engine(fast, exact)
    found = both.register(cloud)
    spent = exact.asked
    alone = both.exact.register(cloud)
    assert found.judgement.verdict is alone.judgement.verdict is Verdict.ACCEPTED
    deviation = np.sqrt(np.diag(alone.net_force_covariance)[1:])
    assert (np.abs(found.net_force - alone.net_force)[1:] < 0.1 * deviation).all()
    assert found.draft is not None and found.draft.state.reach == pytest.approx(0.2 * too_far)
    assert found.state.reach == pytest.approx(0.2)
    if too_far == 1.0:
        assert spent < exact.asked - spent  # it has saved the way


def test_all_engines_stop_by_one_rule_within_what_is_uncertain(body: Body, truth: np.ndarray, rng) -> None:
    """Each ends where a further step would move less than a tenth of a deviation, so that they lie no further apart."""
    cloud = cloud_on(body, truth, 300, rng, 5e-4)
    both = engine(Bent(body, 1.2), Bent(body))
    rule = GaussNewton()
    exact = both.exact.limited(np.inf)
    exact.setup = replace(exact.setup, options=replace(exact.options, solver=rule))
    same = HybridRegistrar(both.fast, exact)
    found, alone = same.register(cloud), exact.register(cloud)
    for result in (found, alone, found.draft):
        assert result is not None and result.outcome.is_success
    # Each of the two may have a tenth to go in every direction, and forces may be gathered a little otherwise.
    apart = np.abs(found.net_force - alone.net_force) / alone.net_force_deviation
    assert np.sqrt(np.mean(apart**2)) < 3.0 * rule.settled


def test_each_frame_starts_from_the_draft_of_the_one_before(body: Body, rng) -> None:
    model = Cantilever(body)
    truths = [model.solve(tip_forces(body, tuple(part * np.array(NET)))).displacement for part in (0.8, 0.9, 1.0)]
    clouds = [cloud_on(body, truth, 300, rng, 5e-4) for truth in truths]
    fast, exact = Bent(body, 1.1), Bent(body)
    both = engine(fast, exact)
    found = list(register_sequence(both, clouds))
    for result, truth in zip(found, truths, strict=True):
        assert result.judgement.verdict is Verdict.ACCEPTED and result.draft is not None
        assert np.abs(result.displacement - truth)[:, 1:].max() < 1e-3
    counts = [fast.asked]
    for last in (None, found[1]):
        both.follow(clouds[2], last)
        counts.append(fast.asked)
    cold, warm = np.diff(counts)
    assert warm < cold


def test_a_frame_goes_on_from_the_one_before_by_what_the_draft_has_moved(body: Body, rng) -> None:
    """What the fast model always gets wrong is nothing to find again: the exact one needs fewer states, ends alike."""
    model = Cantilever(body)
    truths = [model.solve(tip_forces(body, tuple(part * np.array(NET)))).displacement for part in (0.9, 1.0)]
    clouds = [cloud_on(body, truth, 300, rng, 5e-4) for truth in truths]
    exact = Bent(body)
    both = engine(Bent(body, 1.3), exact)
    first = both.follow(clouds[0], None)
    before = exact.asked
    second = both.follow(clouds[1], first)
    carried = exact.asked - before
    assert second.draft is not None and first.draft is not None and second.draft.prepared is first.draft.prepared
    anew = both.exact.refine(clouds[1], second.draft, both.fast.model)
    assert carried < exact.asked - before - carried
    assert second.judgement.verdict is anew.judgement.verdict is Verdict.ACCEPTED
    deviation = np.sqrt(np.diag(anew.net_force_covariance)[1:])
    assert (np.abs(second.net_force - anew.net_force)[1:] < 0.3 * deviation).all()


def test_a_pose_is_found_by_both(body: Body, truth: np.ndarray, rng) -> None:
    centre = body.points.mean(axis=0)
    turned = Pose.identity().moved(np.array([0.0, 0.02, 0.03, 2e-3, -1e-3, 1e-3]), centre)
    prior = PosePrior(Pose.identity(), centre, np.deg2rad(5.0), 0.01)
    cloud = turned.apply(cloud_on(body, truth, 400, rng, 2e-4))
    both = engine(Bent(body, 1.05), Bent(body), prior)
    found, alone = both.register(cloud), both.exact.register(cloud)
    apart = found.pose.apply(body.points) - alone.pose.apply(body.points)
    assert found.judgement.is_usable and np.abs(apart).max() < 2e-3


def test_a_state_that_the_exact_model_has_not_is_looked_for_from_rest(body: Body, truth: np.ndarray, rng) -> None:
    class Shy(Bent):
        """Refuses its first states, as a solver far from its start."""

        def solve(self, forces: ArrayLike, near: Any = None) -> CantileverState:
            if self.asked == 0:
                self.asked += 1
                raise NotConverged("too far")
            return super().solve(forces, near)

    both = engine(Bent(body, 1.3), Shy(body))
    found = both.register(cloud_on(body, truth, 300, rng, 5e-4))
    assert found.judgement.verdict is Verdict.ACCEPTED and found.draft is not None
    assert np.abs(found.displacement - truth)[:, 1:].max() < 1e-3


def test_nonsense_of_the_fast_model_is_left_aside(body: Body, truth: np.ndarray, rng) -> None:
    class Nonsense(Bent):
        """Moves the wrong way, whatever pulls."""

        def solve(self, forces: ArrayLike, near: Any = None) -> CantileverState:
            found = super().solve(forces, near)
            return CantileverState(found.shape, np.abs(found.mean), found.reach)

    both = engine(Nonsense(body), Bent(body))
    found = both.register(cloud_on(body, truth, 300, rng, 5e-4))
    assert found.judgement.verdict is Verdict.ACCEPTED
    assert np.abs(found.displacement - truth)[:, 1:].max() < 1e-3


def test_where_time_is_over_the_better_of_both_is_given(
    body: Body, truth: np.ndarray, rng, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]  # a clock of its own: the machine may be busy
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    cloud = cloud_on(body, truth, 300, rng, 5e-4)
    fast, exact = Bent(body, 1.1), Bent(body)
    both = engine(fast, exact)
    late = both.limited(now[0] - 1.0).register(cloud)
    assert exact.asked == 0 and late.outcome is Outcome.OUT_OF_TIME and late.judgement.verdict is not Verdict.ACCEPTED

    class Slow(Bent):
        """Takes so long that the time is over after its first state."""

        def solve(self, forces: ArrayLike, near: Any = None) -> CantileverState:
            now[0] += 1.0
            return super().solve(forces, near)

    slow = engine(Bent(body, 1.1), Slow(body))
    draft = slow.fast.register(cloud)
    found = slow.limited(now[0] + 0.5).register(cloud)
    assert slow.exact.model.asked <= 1
    assert found.judgement.verdict is Verdict.ACCEPTED  # the draft: the exact model came no further than its start
    np.testing.assert_allclose(found.net_force, draft.net_force)
    assert found.draft is not None and both.limited(np.inf).register(cloud).judgement.verdict is Verdict.ACCEPTED


def test_a_cloud_of_something_else_is_refused_by_both(body: Body, rng) -> None:
    both = engine(Bent(body), Bent(body))
    other = body.points.mean(axis=0) + rng.uniform(-0.15, 0.15, (300, 3))
    found = both.register(other)
    assert found.judgement.verdict is Verdict.REFUSED
    with pytest.raises(CloudError):
        both.register(np.full((10, 3), np.nan))


def test_after_a_frame_without_time_the_exact_model_is_asked_again(body: Body, truth: np.ndarray, rng) -> None:
    """A frame whose time was over is the fast model's; the next one is the exact model's all the same."""
    fast, exact = Bent(body, 1.3), Bent(body)
    both = engine(fast, exact)
    hurried = engine(fast, exact)
    hurried.exact = hurried.exact.limited(time.monotonic() - 1.0)
    late = hurried.register(cloud_on(body, truth, 400, rng, 5e-4))
    assert late.draft is not None and late.prepared is late.draft.prepared
    asked = exact.asked
    found = both.follow(cloud_on(body, truth, 400, rng, 5e-4), late)
    assert exact.asked > asked and found.draft is not None and found.prepared is not found.draft.prepared
    assert np.linalg.norm(found.displacement - truth, axis=1).mean() < 1e-3


def test_another_pose_keeps_what_pulls_beside_the_cloud(body: Body) -> None:
    made = engine(Bent(body), Bent(body)).exact
    marks = LandmarkPairs.of(made.observed, body.points[made.observed.nodes[:3]], body.points[made.observed.nodes[:3]])
    pose = PosePrior(Pose.identity(), body.points.mean(axis=0))
    posed = made.with_terms(marks).with_pose(pose)
    assert posed.setup.terms == (marks,) and posed.options is made.options


def judged(found: Registration, verdict: Verdict) -> Registration:
    return replace(found, judgement=Judgement(verdict))


def test_of_all_that_the_exact_model_finds_the_best_is_given(
    body: Body, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the last frame doubtful, from the draft and from rest refused: the first is the answer."""
    model = Cantilever(body)
    truths = [model.solve(tip_forces(body, tuple(part * np.array(NET)))).displacement for part in (0.9, 1.0)]
    clouds = [cloud_on(body, truth, 300, rng, 5e-4) for truth in truths]
    both = engine(Bent(body), Bent(body))
    first, starts = both.follow(clouds[0], None), []
    refine = both.exact.refine

    def refined(cloud: Any, draft: Any, fast: Any, last: Any = None) -> Registration:
        starts.append(last)
        return judged(refine(cloud, draft, fast, last), Verdict.REFUSED if last is None else Verdict.DOUBTFUL)

    register = both.exact.register
    monkeypatch.setattr(both.exact, "refine", refined)
    monkeypatch.setattr(both.exact, "register", lambda cloud: judged(register(cloud), Verdict.REFUSED))
    assert both.follow(clouds[1], first).judgement.verdict is Verdict.DOUBTFUL
    assert starts == [first, None]
    elsewhere, starts[:] = replace(first, draft=both.fast.register(clouds[0])), []
    both.follow(clouds[1], elsewhere)
    assert starts == [None] or starts[0] is elsewhere  # where forces are sought elsewhere, the last frame tells nothing
    other = replace(first, draft=replace(first, prepared=both.fast.setup.unlocalised))
    assert not is_same_place(other, first.draft) and not is_same_place(None, first.draft)


def test_a_frame_that_is_lost_is_searched_for_from_rest_once(
    body: Body, truth: np.ndarray, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether forces are gathered or not, and whether the model is the one of the frame before or another."""
    searched = []
    cold = Registrar._cold
    monkeypatch.setattr(Registrar, "_cold", lambda *given: searched.append(1) or cold(*given))
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    good = cloud_on(body, truth, 300, rng, 5e-4)
    odd = good + 0.03 * np.sin(40.0 * good[:, :1]) * [0.0, 0.0, 1.0]  # waves that no force at the tip makes
    few = good[:20]  # as near as before, and doubtful
    for rounds in (0, 2):
        options = RegistrationOptions(localisation=SparseLocalisation(rounds=rounds))
        observed = SurfaceDistance(body, body.surfaces["observed"])
        made = Registrar(Cantilever(body), observed, forces, options)
        first = made.register(good)
        for cloud, ways in ((odd, made), (few, made), (few, made.with_model(Cantilever(body)))):
            searched.clear()
            assert ways.follow(cloud, first).judgement.verdict is not Verdict.ACCEPTED
            assert len(searched) == 1
