"""Clouds to states of one body: prepared once, then frame after frame, each from what the last one found."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.clouds import check_cloud
from softtwin.reference.data.outcome import NotConverged

from .checks import judge, shared
from .cloud import Cloud
from .evaluation import Evaluation
from .expectations import Expectations
from .forward import ForwardModel, ReducedModel, reduce_model
from .gauss_newton import GaussNewton, SolverResult
from .hyperparameters import LogNormalPrior
from .lbfgs import LBFGS
from .loss import robust_deviation
from .manifold_mapping import ManifoldMapping
from .options import RegistrationOptions
from .outcome import Outcome
from .parameters.block import ParameterBlock
from .parameters.correlated_noise import CorrelatedNoise
from .parameters.discrepancy import ModelError
from .parameters.inputs import InputBlocks
from .parameters.nodal_forces import (
    LikelihoodInformed,
    NodalForces,
    contact,
    known_forces,
    localised,
    nodal_forces,
)
from .parameters.pose import PosePrior
from .policy import POLICY
from .pose import Pose
from .prepared import Prepared
from .problem import Problem
from .residuals.normals import Normals
from .residuals.term import ResidualTerm
from .result import Registration, badness
from .surface_distance import SurfaceDistance
from .tracker import Tracker
from .verdict import Check, Code, Verdict

Floats = NDArray[np.float64]
_FAR = 3.0  # times its noise: as far from the last frame's surface, a cloud may lie nearer to the body at rest
_GLANCE = 100  # points that this is seen from
_LEFT = 1.5  # times the noise of the frame before
_SEARCHING = 0.7  # of the time that is left for a frame: the search from rest, whose end takes the others
_MISSED, _EXPLAINED = 1.0, 0.5  # times the least noise, shared by neighbours; part of it that forces anywhere leave
_HOPELESS = 1.25  # times the largest noise expected: no more time is spent
_LEADING = 6  # directions of force that a cold start begins with
_ANCHORS = 3  # exact states from which a fast model goes on


class Registrar:
    """Registers clouds to one body with one model; what does not depend on the cloud is prepared once.

    Args:
        model: forward model.
        observed: the observed side.
        forces: the unknown forces.
        options: noise, solver, thinning, search for the place of the forces.
        pose: prior of the pose; None for clouds in the body's coordinates.
        expectations: what a usable result looks like; by the body's size and the noise if not given.
        inputs: unknown inputs beside the forces, which the model takes; none if not given.
        blocks: further parameters.
        modulus_deviation: of the logarithm of Young's modulus, where this is no unknown: forces found are the more in
            doubt by it. Under nodal forces alone states depend on forces over stiffness, and are not.
        anywhere: makes the same with forces anywhere, which is asked where neighbouring points are missed alike; None
            for forces that act nowhere else.

    Raises:
        ValueError: conditions that the model does not take, or a negative deviation.
    """

    def __init__(
        self,
        model: ForwardModel,
        observed: SurfaceDistance,
        forces: NodalForces,
        options: RegistrationOptions | None = None,
        *,
        pose: PosePrior | None = None,
        expectations: Expectations | None = None,
        inputs: InputBlocks | None = None,
        blocks: Sequence[ParameterBlock] = (),
        modulus_deviation: float = 0.0,
        anywhere: Callable[[], Registrar] | None = None,
    ) -> None:
        if not 0.0 <= modulus_deviation < np.inf:
            raise ValueError(f"Registrar.modulus_deviation: expected 0 or more, got {modulus_deviation}.")
        self.model, self.observed, self.forces, self.pose = model, observed, forces, pose
        is_found = inputs is not None and inputs.modulus is not None
        self.inputs, self.modulus_deviation = inputs, 0.0 if is_found else modulus_deviation
        self.blocks = tuple(blocks)
        self.anywhere = None if anywhere is None else cache(anywhere)  # made when it is first asked for
        self.terms: tuple[ResidualTerm, ...] = ()
        self.options = options or RegistrationOptions()
        discrepancy = model.discrepancy
        self.error = None if discrepancy is None else ModelError(discrepancy, observed)
        # Where it is not known what the model gets wrong, points tell no more than the model can meet.
        self.noise = self.options.noise.with_minimum(model.error)
        self._told = expectations
        self.expectations = expectations or Expectations.of(model, self.noise)
        self._everywhere = self._prepared(forces)
        self._fast: list[tuple[ForwardModel, NodalForces, ReducedModel]] = []  # the last, which copies share

    def _prepared(self, forces: NodalForces) -> Prepared:
        return Prepared.of(self.model, self.observed, forces, self.inputs)

    def with_pose(self, pose: PosePrior, options: RegistrationOptions) -> Registrar:
        """The same with an unknown pose, and the options that suit it."""
        anywhere = self.anywhere
        return Registrar(
            self.model,
            self.observed,
            self.forces,
            options,
            pose=pose,
            expectations=self._told,
            inputs=self.inputs,
            blocks=self.blocks,
            modulus_deviation=self.modulus_deviation,
            anywhere=None if anywhere is None else lambda: anywhere().with_pose(pose, options),
        )

    def limited(self, until: float) -> Registrar:
        """The same, which begins no step after a time of the monotonic clock, seconds, and gives the best so far."""
        other = copy.copy(self)
        other.options = replace(self.options, solver=replace(self.options.solver, until=until))
        return other

    def with_terms(self, *terms: ResidualTerm) -> Registrar:
        """The same with other measurements that pull beside the cloud, landmarks say, in place of those before.

        Args:
            terms: of the same observed side; normals come with the cloud.
        """
        other = copy.copy(self)
        other.terms = terms
        return other

    def register(self, cloud: ArrayLike, start: Registration | None = None) -> Registration:
        """The forces, the state and the pose that bring the observed side to a cloud.

        Args:
            cloud: observed points, (p, 3), metres; with the normals measured there behind them (p, 6): see `Cloud`.
            start: an earlier frame's result to start from; no force if not given.

        Raises:
            CloudError: a cloud that is empty, holds NaN, or lies too far from the body.
            NotConverged: the model found no state at the start.
        """
        return self._asked(cloud, self._registered(cloud, start))

    def _asked(self, cloud: ArrayLike, found: Registration) -> Registration:
        """The result, doubtful where forces elsewhere explain what the cloud has left and neighbours share."""
        if self.anywhere is None or not found.judgement.is_usable:
            return found
        match = found.evaluation.match  # with those points that were taken for outliers: patches of them are none
        inflation_factor = shared(self.observed.closest_points(match), match.distances, np.ones(len(match.distances)))
        is_missed = match.rms * np.sqrt(inflation_factor) > _MISSED * self.noise.minimum
        if not is_missed or self._is_late:
            return found
        try:
            anywhere = self.anywhere()
        except ValueError:  # a network has learned no forces there
            return found
        with suppress(NotConverged):
            other = anywhere.limited(self.options.solver.until).with_terms(*self.terms).register(cloud)
            if other.judgement.is_usable:
                return found.with_check(_elsewhere(match.rms, other.evaluation.match.rms))
        return found

    def _registered(self, cloud: ArrayLike, start: Registration | None) -> Registration:
        begin = time.perf_counter()
        points = self._checked(cloud)
        if start is None:
            return self._cold(points, begin)
        result = self._followed(points, start, begin)
        if self._has_left(result, start) and not self._is_late:
            now = time.monotonic()
            hurried = self.limited(now + _SEARCHING * (self.options.solver.until - now))
            other = hurried._cold(points, begin, result)
            return (
                other
                if other is result
                else replace(min(other, result, key=badness), seconds=time.perf_counter() - begin)
            )
        return result

    def _followed(self, points: Cloud, start: Registration, begin: float) -> Registration:
        """From the frame before, or from rest with its forces."""
        problem = self._problem(points, start.prepared, start)
        near = problem.begun(problem.carried(start.evaluation.coefficients, start.problem), start.evaluation)
        if self._is_nearer_at_rest(near, start):  # the tool has let go: no way back through all states between
            found = self._from_rest(points, start.prepared, self.options.solver)
            return self._finished(points, start.prepared, found, begin)
        found = self.options.solver.following().solve(problem, near.coefficients, near, start.eta)
        return self._result(problem, found, start.prepared, begin)

    @property
    def _is_late(self) -> bool:
        return time.monotonic() >= self.options.solver.until

    def refine(
        self, cloud: ArrayLike, draft: Registration, fast: ForwardModel, last: Registration | None = None
    ) -> Registration:
        """What this model makes of a cloud, from what a faster model of the same body has found for it.

        Most of the way is the faster model's, corrected by this one's (`ManifoldMapping`); the end is this one's.

        Args:
            cloud: observed points, (p, 3), metres.
            draft: the faster model's result, in which forces are sought where it has found them.
            fast: that model.
            last: this model's result for the frame before, from which it goes on where forces are sought in the same
                place.

        Raises:
            CloudError: a cloud that is empty, holds NaN, or lies too far from the body.
            NotConverged: the model found no state there.
        """
        begin = time.perf_counter()
        points = self._checked(cloud)
        found = self._refined(points, draft, fast, last, begin)
        return replace(found, draft=draft)

    def _refined(
        self, points: Cloud, draft: Registration, fast: ForwardModel, last: Registration | None, begin: float
    ) -> Registration:
        solver = self.options.solver.following()
        if last is not None and last.draft is not None and last.draft.prepared is draft.prepared:
            return self._carried_on(points, fast, last, begin)
        # Told a zone, the exact model gathers no forces within it, and takes none that were: see `options_for`.
        prepared = self._everywhere
        if self.options.localisation.rounds:
            prepared = self._prepared(replace(draft.prepared.forces, scale=self.forces.scale))
        problem = self._plain(points, prepared)
        start = problem.carried(draft.coefficients, draft.problem)
        start[problem.force_part] = prepared.forces.nearest(draft.unknown_forces)
        found = self._approached(problem, problem.begun(start, draft.evaluation), fast, solver, draft.eta)
        return self._finished(points, prepared, found, begin)

    def _carried_on(self, points: Cloud, fast: ForwardModel, last: Registration, begin: float) -> Registration:
        problem = self._problem(points, last.prepared, last)
        solver = self.options.solver.following()
        near = replace(last.evaluation, coefficients=problem.carried(last.evaluation.coefficients, last.problem))
        found = self._approached(problem, near, fast, solver, last.eta)
        return self._result(problem, found, last.prepared, begin)

    def _approached(
        self, problem: Problem, near: Evaluation, fast: ForwardModel, solver: GaussNewton | LBFGS, eta: Floats | None
    ) -> SolverResult:
        """The minimum, to which the fast model knows most of the way from any trial of the exact one.

        A fast model takes no conditions: with them, and where the exact one finds no state, the way is the latter's, as
        it is of L-BFGS, which wants the whole body's slopes.
        """
        spent: list[SolverResult] = []
        for _ in range(_ANCHORS):
            if problem.inputs is not None or not isinstance(solver, GaussNewton):
                break
            place = near.coefficients[problem.force_part]
            reduced = self._reduced(fast, problem.forces)
            cheap = replace(problem, model=ManifoldMapping.at(reduced, self.observed.nodes, place, near.state))
            way = solver.solve(cheap, near.coefficients, cheap.begun(near.coefficients), eta)
            eta = way.local.eta
            if not way.trace or self._is_late:
                break
            try:
                exact = problem if way.local.problem.shared is not None else problem.unshared
                near = exact.evaluation(way.evaluation.coefficients, replace(way.evaluation, state=near.state))
            except NotConverged:
                break
            spent.append(replace(way, evaluations=1))  # states of the exact model alone are counted
            if solver.has_settled(exact, near, way.local.noise, eta):
                break
        if near.cloud is not problem.cloud:
            near = problem.begun(near.coefficients.copy(), near)
        return reduce(_after, [*spent, solver.solve(problem, near.coefficients, near, eta)])

    def _reduced(self, fast: ForwardModel, forces: NodalForces) -> ReducedModel:
        """The fast model between this one's forces and the observed nodes; that of the last forces is kept."""
        if not self._fast or self._fast[0][0] is not fast or self._fast[0][1] is not forces:
            self._fast[:] = [(fast, forces, reduce_model(fast, self.observed.nodes, forces.basis))]
        return self._fast[0][2]

    def follow(self, cloud: ArrayLike, last: Registration | None) -> Registration:
        """The next frame of a sequence: from the last one, and from rest where that is not accepted.

        Args:
            cloud: observed points, (p, 3), metres.
            last: the last usable result; None for the first frame.

        Raises:
            CloudError: a cloud that is empty, holds NaN, or lies too far from the body.
            NotConverged: the model found no state at rest.
        """
        if last is None:
            return self.register(cloud)
        try:
            warm = self.register(cloud, last)
        except NotConverged:
            return self.register(cloud)
        began_anew = warm.prepared is not last.prepared
        if warm.judgement.verdict is Verdict.ACCEPTED or began_anew or self._is_late:
            return warm
        return min(warm, self.register(cloud), key=badness)

    def _plain(self, points: Cloud, prepared: Prepared) -> Problem:
        """The problem with the model's error as the least noise."""
        return self._posed(points, prepared, self.noise)

    def _posed(
        self, points: Cloud, prepared: Prepared, noise: LogNormalPrior, error: ModelError | None = None
    ) -> Problem:
        """The problem of a cloud: all blocks of parameters, and all that pulls."""
        shared = CorrelatedNoise(self.observed.modes) if self.options.correlated else None
        blocks = (prepared.forces, self.pose, self.inputs, error, *self.blocks, shared)
        basis = points.tangent_basis
        normals = None if basis is None else Normals(basis, self.options.normal_deviation)
        return Problem.of(prepared.model, self.observed, points.points, noise, blocks, (*self.terms, normals))

    def _problem(self, points: Cloud, prepared: Prepared, near: SolverResult | Registration) -> Problem:
        """The problem with the model's error in patterns, of the size that belongs to a movement like a trial's."""
        if self.error is None:
            return self._plain(points, prepared)
        moved = np.linalg.norm(near.evaluation.positions, axis=1).max() + near.rms_distance
        return self._posed(points, prepared, self.options.noise, self.error.with_amplitude(float(moved)))

    def _cold(self, points: Cloud, begin: float, known: Registration | None = None) -> Registration:
        """From rest; where the place of the forces is unknown, once more for each round of gathering them.

        Where time is over before the end, the better one of this and what is known; that at once, if it is accepted.
        """
        prepared, localisation, solver = self._everywhere, self.options.localisation, self.options.solver
        few, is_gathered = points.thinned(localisation.points), localisation.rounds > 0
        begun = (few, prepared, solver) if is_gathered else (points, prepared, solver.unsettled())
        found = self._from_rest(*begun)
        for left in reversed(range(localisation.rounds)):
            if self._is_hopeless(found) or self._is_late:
                break
            prepared = self._gathered(prepared.forces.forces(found.evaluation.coefficients[: prepared.forces.size]))
            found = _after(found, self._from_rest(few if left else points, prepared, solver))
        if known is not None and self._is_late and known.judgement.verdict is Verdict.ACCEPTED:
            return known
        cold = self._finished(points, prepared, found, begin, is_gathered)
        return cold if known is None or not self._is_late else min(known, cold, key=badness)

    def _from_rest(self, points: Cloud, prepared: Prepared, solver: GaussNewton | LBFGS) -> SolverResult:
        """First the leading directions alone, which cannot fold the surface into a wrong minimum, then all."""
        few, first = points.thinned(self.options.localisation.points), prepared.leading(_LEADING)
        rough, problem = self._plain(few, first).unshared, self._plain(points, prepared)
        begun = solver.rough().solve(rough, np.zeros(rough.size))
        start = problem.carried(begun.evaluation.coefficients, rough)
        start[: first.forces.size] = begun.evaluation.coefficients[rough.force_part]
        if self._is_hopeless(begun):  # what six directions leave as far off is no state of this organ
            solver = solver.without_steps()
        return _after(begun, solver.solve(problem, start, begun.evaluation, begun.local.eta))

    def _finished(
        self, points: Cloud, prepared: Prepared, found: SolverResult, begin: float, is_settled: bool = True
    ) -> Registration:
        """With all points, and with the model's error in patterns, from a result that took it for noise."""
        solver, is_hopeless = self.options.solver, self._is_hopeless(found)
        if is_hopeless:
            solver = solver.without_steps()
        believed = prepared if self.error is not None else self._believed(prepared, found)
        problem, before = self._problem(points, believed, found), found.local.problem
        is_settled = is_settled and believed is prepared and len(found.evaluation.cloud) == len(points)
        if self.error is not None or not is_settled:
            start = problem.carried(found.evaluation.coefficients, before)
            found = _after(found, solver.solve(problem, start, found.evaluation, found.local.eta))
        wider = self._believed(believed, found)
        if wider is not believed:  # seen only now that the model's error is told from noise
            believed, problem = wider, problem.with_forces(wider.forces)
            found = _after(
                found, solver.solve(problem, found.evaluation.coefficients, found.evaluation, found.local.eta)
            )
        return self._result(problem, found, believed, begin)

    def _believed(self, prepared: Prepared, found: SolverResult) -> Prepared:
        """The forces' size as the cloud tells it, where it can: what was expected would call a sharp pull outliers."""
        hyperprior, noise = self.options.hyperprior, found.local.noise
        is_told = noise < hyperprior.clear or noise > hyperprior.loud
        if not is_told or prepared.forces.scale.spread >= hyperprior.spread:
            return prepared
        return prepared.with_prior(hyperprior.spread)

    def _is_hopeless(self, found: SolverResult) -> bool:
        if found.outcome is Outcome.OUT_OF_TIME:  # who knows
            return False
        return found.local.noise > _HOPELESS * self.expectations.noise

    def _gathered(self, nodal: Floats) -> Prepared:
        """The unknown forces once more, where forces were found."""
        body = self.model.body
        where = contact(self.forces, nodal, body.points, self.options.localisation.reach * body.size)
        every = self._prepared(localised(self.forces, where))
        return every.informed(self.observed, self.options.localisation.informed)

    def _is_nearer_at_rest(self, near: Evaluation, start: Registration) -> bool:
        """True where a cloud lies nearer to the body at rest than to what the last frame has found."""
        far = robust_deviation(near.match.distances)
        if far < _FAR * max(start.noise, self.options.noise.minimum):
            return False
        few = near.cloud[:: max(1, len(near.cloud) // _GLANCE)]
        rest = self.observed.match(np.zeros_like(near.positions), few)
        return robust_deviation(rest.distances) < far

    def beside(self, before_step: Callable[[], None]) -> Registrar:
        """The same for a thread beside the frames: see `Tracker`.

        Args:
            before_step: called before each step; it may wait.
        """
        other = copy.copy(self)
        other.options = replace(
            self.options, solver=replace(self.options.solver, until=np.inf, before_step=before_step)
        )
        return other

    def track(self, cloud: ArrayLike, last: Registration) -> Registration:
        """The next frame of a sequence from the last one alone; see `Tracker`.

        Args:
            cloud: observed points, (p, 3), metres.
            last: the last usable result.

        Raises:
            CloudError: a cloud that is empty, holds NaN, or lies too far from the body.
            NotConverged: the model found no state there.
        """
        begin = time.perf_counter()
        return self._asked(cloud, self._followed(self._checked(cloud), last, begin))

    def is_lost(self, found: Registration, last: Registration) -> bool:
        """Whether what was tracked has to be searched for from rest: it is not accepted, or met much worse.

        Args:
            found: what was tracked.
            last: from where.
        """
        return found.judgement.verdict is not Verdict.ACCEPTED or self._has_left(found, last)

    def _has_left(self, result: Registration, start: Registration) -> bool:
        """True where the cloud is met so much worse than before that the forces may act elsewhere now."""
        return result.scatter > _LEFT * max(start.scatter, self.noise.minimum)

    def _checked(self, cloud: ArrayLike) -> Cloud:
        given = Cloud.of(cloud)
        if given.is_finite:
            given = given.thinned(self.options.maximum_points).distinct()
            if self.pose is not None:
                check_cloud(self.pose.mean.inverse().apply(given.points), self.model.body)
                return given
        check_cloud(given.points, self.model.body)
        return given

    def _told_in(self, pose: Pose) -> tuple[Pose, Pose]:
        """The pose that a result is told in, and what the one found is beside it: a motion of the body."""
        if self.pose is None or not self.pose.is_said:
            return pose, Pose.identity()
        return self.pose.mean, pose.then(self.pose.mean.inverse())

    def _result(self, problem: Problem, found: SolverResult, prepared: Prepared, begin: float) -> Registration:
        problem, discrepancy_scale = found.local.problem, found.local.scales.discrepancy
        evaluation, net = found.evaluation, problem.net_forces(found.evaluation)
        nodal = problem.nodal_forces(evaluation)
        total = nodal.sum(axis=0)
        covariance = found.posterior.net_force_covariance(net, prepared.forces.left_out)
        covariance += self.modulus_deviation**2 * total[:, None] * total
        state = evaluation.state.full
        pose, pose_correction = self._told_in(evaluation.pose or Pose.identity())
        correction = problem.correction(evaluation)
        moved = self.model.body.points + state.displacement + correction
        return Registration(
            prepared=prepared,
            evaluation=evaluation,
            forces=nodal,
            state=state,
            correction=correction + (pose_correction.apply(moved) - moved),
            discrepancy_scale=discrepancy_scale,
            pose=pose,
            pose_correction=pose_correction,
            net_force=total,
            net_force_covariance=covariance,
            noise=found.posterior.scales.noise,
            force_scale=found.posterior.scales.force,
            rms_distance=found.rms_distance,
            outliers=float(np.mean(~found.is_kept)),
            informed=found.posterior.informed,
            points=len(problem.cloud),
            outcome=found.outcome,
            judgement=judge(problem, found, state, self.expectations),
            evaluations=found.evaluations,
            seconds=time.perf_counter() - begin,
            trace=found.trace,
            problem=problem,
            posterior=found.posterior,
            local=found.local,
        )


def prepare(
    model: ForwardModel,
    nodes: ArrayLike | None,
    triangles: ArrayLike | None = None,
    *,
    force_scale: float,
    smoothness: float = 0.02,
    directions: int = 64,
    options: RegistrationOptions | None = None,
    pose: PosePrior | None = None,
    inputs: InputBlocks | None = None,
    blocks: Callable[[SurfaceDistance], Sequence[ParameterBlock]] | None = None,
    modulus_deviation: float = 0.0,
    elsewhere: ArrayLike | None = None,
) -> Registrar:
    """A registrar with forces at the nodes that may carry some, reduced to what a cloud can tell.

    Args:
        model: forward model.
        nodes: nodes that may carry force; None where all forces are known (the model's own loading).
        triangles: the observed side, (t, 3); the whole boundary if not given.
        force_scale: size of a nodal force to begin with, newtons; see `expected_force`.
        smoothness: correlation length of neighbouring forces, metres; 0 for none.
        directions: most directions of force kept.
        options: noise, solver, thinning, search for the place of the forces.
        pose: prior of the pose; None for clouds in the body's coordinates.
        inputs: unknown inputs beside the forces; none if not given. Nodes that they move carry no unknown force.
        blocks: further parameters, by the observed side.
        modulus_deviation: as for `Registrar`.
        elsewhere: further nodes, where forces are thought of when those given leave what neighbouring points share.

    Raises:
        ValueError: no node is left on the free boundary; nothing is unknown; conditions that the model does not take.
    """
    options = options or RegistrationOptions()
    observed = SurfaceDistance(model.body, triangles, options.distance)
    is_anywhere = options.localisation.rounds > 0 and model.error > 0.0
    spread = POLICY.force_spread_anywhere if is_anywhere else POLICY.force_spread
    scale = LogNormalPrior(force_scale, spread, minimum=1e-2 * force_scale)
    if nodes is None:
        if inputs is None and pose is None:
            raise ValueError("prepare.nodes: expected nodes that may carry force where nothing else is unknown.")
        options = replace(options, localisation=replace(options.localisation, rounds=0))
        forces = known_forces(model.body, scale)
    else:
        carrying = np.asarray(nodes, dtype=np.int64)
        if inputs is not None:
            carrying = np.setdiff1d(carrying, inputs.moved_nodes)
        every = nodal_forces(model.body, carrying, scale, smoothness)
        rule = LikelihoodInformed(options.noise.minimum, scale=10.0 * force_scale, maximum=directions)
        forces = Prepared.of(model, observed, every, inputs).informed(observed, rule).forces

    def anywhere() -> Registrar:
        return prepare(
            model,
            np.union1d(np.asarray(nodes, dtype=np.int64), np.asarray(elsewhere, dtype=np.int64)),
            triangles,
            force_scale=force_scale,
            smoothness=smoothness,
            directions=directions,
            options=options,
            pose=pose,
            inputs=inputs,
            blocks=blocks,
        )

    return Registrar(
        model,
        observed,
        forces,
        options,
        pose=pose,
        inputs=inputs,
        blocks=() if blocks is None else blocks(observed),
        modulus_deviation=modulus_deviation,
        anywhere=None if elsewhere is None or nodes is None else anywhere,
    )


def _elsewhere(within: float, anywhere: float) -> Check:
    """Whether forces outside the zone explain a cloud better: root mean square distances with both, metres."""
    ratio = anywhere / within
    is_better = ratio < _EXPLAINED
    reason = (
        f"forces outside the zone explain the cloud better: points lie {1e3 * within:.2f} mm from the surface, with "
        f"forces anywhere {1e3 * anywhere:.2f} mm"
    )
    verdict = Verdict.DOUBTFUL if is_better else Verdict.ACCEPTED
    unit = "of the distances that are left"
    return Check(
        Code.FORCES_ELSEWHERE, verdict, ratio, _EXPLAINED, unit, is_minimum=True, reason=reason if is_better else ""
    )


def _after(first: SolverResult, second: SolverResult) -> SolverResult:
    """The second result, with what the first took."""
    return replace(second, evaluations=first.evaluations + second.evaluations, trace=(*first.trace, *second.trace))


def register_sequence(registrar: Registrar, clouds: Iterable[ArrayLike]) -> Iterator[Registration]:
    """Register clouds in their order, as they come; the caller may stop between any two.

    A frame starts from the last one that was not refused: see `Tracker`.

    Args:
        registrar: model, observed side, unknowns and options.
        clouds: one cloud a frame, (p, 3), metres.

    Raises:
        CloudError: a cloud that is empty, holds NaN, or lies too far from the body.
    """
    tracker = Tracker()
    for cloud in clouds:
        yield tracker.take(cloud, registrar)
