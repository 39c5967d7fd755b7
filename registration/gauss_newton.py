"""Gauss-Newton in a trust region, with the scales of noise and forces found on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.outcome import NotConverged

from .evaluation import Evaluation
from .hyperparameters import LENGTH, SHARED
from .laplace import posterior
from .local_model import LocalModel, without_shared_noise
from .loss import REJECTED, Huber, Loss, Tukey, robust_deviation
from .outcome import Outcome
from .policy import ACCURACY, POLICY
from .posterior import Posterior
from .problem import Problem
from .score import gain_by_shared_noise

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class IterationRecord:
    """One iteration.

    Args:
        rms_distance: of the cloud to the surface, metres.
        objective: robust objective at the scales of this iteration.
        noise: scale of the points' noise, metres.
        force_scale: of the coefficients, newtons.
        largest_movement: of an observed node, predicted, metres.
        length: of the whole Gauss-Newton step in posterior deviations a coefficient.
        gain: decrease of the objective over the one predicted.
    """

    rms_distance: float
    objective: float
    noise: float
    force_scale: float
    largest_movement: float
    length: float
    gain: float


@dataclass(frozen=True, eq=False)
class SolverResult:
    """Where a solver ended.

    Args:
        evaluation: the problem at the coefficients returned.
        weights: of the points at the end, (p,).
        posterior: there.
        outcome: how it ended.
        evaluations: states solved for.
        trace: one entry an iteration.
        local: the objective's model there.
    """

    evaluation: Evaluation
    weights: Floats
    posterior: Posterior
    outcome: Outcome
    evaluations: int
    trace: tuple[IterationRecord, ...]
    local: LocalModel

    @classmethod
    def at(
        cls, local: LocalModel, outcome: Outcome, evaluations: int, trace: tuple[IterationRecord, ...]
    ) -> SolverResult:
        """What is found where a model of the objective was taken."""
        return cls(local.evaluation, local.weights, posterior(local), outcome, evaluations, trace, local)

    @property
    def is_kept(self) -> NDArray[np.bool_]:
        """True of the points that count, (p,): all but outliers, which pulled nothing."""
        return self.weights >= REJECTED

    @property
    def has_shared_noise(self) -> bool:
        """Whether neighbours share more noise than the least that any camera has."""
        is_sought = self.local.problem.shared is not None
        return is_sought and self.local.scales.shared >= POLICY.noise_minimum

    @property
    def rms_distance(self) -> float:
        """Root mean square distance of the points that count, metres; of all where none does."""
        distances = self.evaluation.match.distances
        return float(np.sqrt(np.mean((distances[self.is_kept] if self.is_kept.any() else distances) ** 2)))


@dataclass(frozen=True)
class GaussNewton:
    """Trust-region Gauss-Newton on a robust loss.

    The losses are taken one after the other: a convex one first, so that a part of the organ that has moved far is not
    mistaken for outliers. Within each, scales are found anew from every linearisation. What a linear model promises to
    change holds only in part: the noise is taken as at least that part of it, so that a far start does not overfit its
    way into a wrong minimum.

    Args:
        losses: one after the other.
        max_iterations: of all losses together; what neighbours share is sought in as many more.
        settled: it has converged where less than this will be left after one more step, in posterior deviations a
            coefficient, by how much shorter steps become.
        enough: where no step lowers the objective further, or iterations run out, a step shorter than this counts as
            settled: closest points pass from triangle to triangle, and no objective falls for ever.
        handed_on: the same for all losses but the last.
        graduation: the noise is taken as at least this part of what the linear model promises to change.
        max_step: first limit on the movement of any observed node in one step, part of the body's size.
        minimum_step: no step that moves all observed nodes less than this is tried, metres.
        is_near: the start is near: hyperparameters that are known there are sought anew with the last loss alone, and
            whether a step was the last is seen by the derivatives before it, where it kept what they promised.
        is_shared: neighbours are known to share noise: it is sought from the first step on. Else forces would explain
            it first, as far as they can.
        length_before: length of the step that led to the start, in posterior deviations a coefficient, where it kept
            what it promised: by it the rate of convergence is known at the first step. Infinite if not known.
        until: no step is begun after this time of the monotonic clock, seconds.
        before_step: called before each; it may wait.
    """

    losses: tuple[Loss, ...] = (Huber(), Tukey())
    max_iterations: int = field(default_factory=lambda: ACCURACY.iterations)
    settled: float = field(default_factory=lambda: ACCURACY.settled)
    enough: float = field(default_factory=lambda: ACCURACY.enough)
    handed_on: float = field(default_factory=lambda: ACCURACY.handed_on)
    graduation: float = field(default_factory=lambda: ACCURACY.graduation)
    max_step: float = field(default_factory=lambda: ACCURACY.first_step)
    minimum_step: float = 1e-6
    is_near: bool = False
    is_shared: bool = False
    length_before: float = np.inf
    until: float = np.inf
    before_step: Callable[[], None] | None = None

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise ValueError(f"GaussNewton.max_iterations: expected at least 1, got {self.max_iterations}.")
        for name in ("settled", "enough", "handed_on", "max_step", "minimum_step"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"GaussNewton.{name}: expected a positive number, got {getattr(self, name)}.")

    def coarse(self) -> GaussNewton:
        """The same with the first loss alone, ended early: for a start."""
        few = min(self.max_iterations, ACCURACY.few_iterations)
        return replace(self, losses=self.losses[:1], settled=self.handed_on, max_iterations=few)

    def unsettled(self) -> GaussNewton:
        """The same, ended early: where another goes on from there."""
        return replace(self, settled=self.handed_on)

    def following(self) -> GaussNewton:
        """The same from the state of a frame before: scales stay nearly the same over so short a way."""
        return replace(self, is_near=True)

    def directly(self) -> GaussNewton:
        """The same with the last loss alone: where no part of the organ would be mistaken for outliers."""
        return replace(self, losses=self.losses[-1:])

    def without_steps(self) -> GaussNewton:
        """The same, which takes any start for the end: to judge it."""
        return replace(self, losses=self.losses[:1], settled=1e9, handed_on=1e9, graduation=0.0)

    def solve(
        self, problem: Problem, start: Floats, near: Evaluation | None = None, eta: Floats | None = None
    ) -> SolverResult:
        """The coefficients that minimise the robust distance plus the prior.

        Args:
            problem: what is registered.
            start: coefficients to start from, (k,).
            near: a trial whose state is near the start's.
            eta: logarithms of the hyperparameters at the start, where they are known.

        Raises:
            NotConverged: the model found no state at the start.
        """
        return _Search(self, problem, start, near, eta).run()

    def going_on(self, found: SolverResult) -> GaussNewton:
        """The same from a result, in which neighbours may share noise: then it is sought from the first step on.

        Args:
            found: the result.
        """
        return replace(self, is_shared=found.has_shared_noise)


class _Search:
    """One run of the solver: where it is, how far it may step, what it has seen."""

    def __init__(
        self, options: GaussNewton, problem: Problem, start: Floats, near: Evaluation | None, eta: Floats | None
    ) -> None:
        self.options, self.whole = options, problem
        self.problem = problem if options.is_shared else problem.unshared
        self.evaluation = _begun(self.problem, start, near)
        self.evaluations, self.limit = 1, self._first_limit
        self.noise = max(robust_deviation(self.evaluation.match.distances), problem.noise.minimum)
        self.point_noise, self.begun, self.comparable = 0.0, 0, 0
        self.takes_last = options.graduation > 0.0
        self.is_at_edge = False  # the model has refused states ahead: steps along the edge of those it has are short
        self.eta, self.starts = eta, list[Floats]()
        self.trace: list[IterationRecord] = []
        self._at: LocalModel | None = None

    @property
    def _first_limit(self) -> float:
        return self.options.max_step * self.problem.observed.body.size

    @property
    def _gained_by_settled(self) -> float:
        """What the objective falls by in a step that counts as settled."""
        return 0.5 * self.problem.size * self.options.settled**2

    def run(self) -> SolverResult:
        options = self.options
        ended = [self._descend(loss, options.handed_on) for loss in options.losses[:-1]]
        last = options.losses[-1]
        if self.problem is self.whole:
            outcome = self._descend(last, options.settled)
        else:  # points far off are told first, then what neighbours share
            outcome = self._descend(last, options.settled, min(ACCURACY.few_iterations, options.max_iterations))
            self.begun, is_whole = len(self.trace), self._takes_whole(last)
            if not is_whole and outcome is not Outcome.CONVERGED:
                outcome = self._descend(last, options.settled)
                is_whole = self._takes_whole(last)
            if is_whole:
                ended.append(outcome)
                self.begun = self.comparable = len(self.trace)
                outcome = self._descend(last, options.settled)
        outcome, local = self._concluded(outcome, last)
        if Outcome.OUT_OF_TIME in ended:  # far off, the last loss takes all points for outliers, and is content
            outcome = Outcome.OUT_OF_TIME
        return SolverResult.at(local, outcome, self.evaluations, tuple(self.trace))

    def _concluded(self, outcome: Outcome, loss: Loss) -> tuple[Outcome, LocalModel]:
        """How it ended, and the model there, after the last step; where that helps nothing, the search goes on."""
        if outcome in (Outcome.NO_DESCENT, Outcome.MAXIMUM_ITERATIONS, Outcome.OUT_OF_TIME) and self._has_enough():
            outcome = Outcome.CONVERGED
        local = self._local(loss)
        if outcome is not Outcome.CONVERGED or not self.takes_last:
            return outcome, local
        after = self._ended(local)
        if after is not local or local.length < self.options.enough:
            return outcome, after
        self.takes_last = False
        return self._concluded(self._descend(loss, self.options.settled), loss)

    def _takes_whole(self, loss: Loss) -> bool:
        """Goes on with noise that neighbours share, where that may make the cloud more likely and does."""
        gain, size, length = gain_by_shared_noise(self._local(loss), self.whole)
        if not np.isfinite(gain):
            return False
        before = self.problem, self._at, self.evaluation, self.noise, self.point_noise, self.eta
        self.problem, self._at = self.whole, None
        self.evaluation = replace(self.evaluation, coefficients=self.whole.sized(self.evaluation.coefficients))
        without = self._without()
        self.starts = [without, without.copy()]
        self.starts[1][[SHARED, LENGTH]] = size, length
        if self._local(loss).eta[SHARED] > 0.5 * (without[SHARED] + size):
            return True
        self.problem, self._at, self.evaluation, self.noise, self.point_noise, self.eta = before  # it fell back to none
        return False

    def _known(self) -> list[Floats]:
        """Where hyperparameters are sought at first: with shared noise where there was some before, and without."""
        without = self._without()
        if self.eta is None or not self.options.is_shared or self.problem.shared is None:
            return [without]
        return [self.eta, without]

    def _without(self) -> Floats:
        """Where hyperparameters are sought when none is known there: without noise that neighbours share."""
        return without_shared_noise(self.problem, self.noise, self.eta)

    def _local(self, loss: Loss) -> LocalModel:
        """The model about the trial; what is known there already is not computed again."""
        at = self._at
        if at is None or at.evaluation is not self.evaluation or at.loss is not loss:
            is_there = at is not None and at.evaluation is self.evaluation
            is_held = self.options.is_near and self.eta is not None and loss is not self.options.losses[-1]
            starts = self.starts if at is None or at.loss is not loss else [at.eta]
            at = LocalModel(
                self.problem,
                self.evaluation,
                loss,
                self.noise,
                self.options.graduation,
                at.jacobian if at is not None and is_there else None,
                starts or self._known(),
                self.point_noise,
                is_held=is_held,
                linearised_at=at.linearised_at if at is not None and is_there else None,
            )
            self._at, self.noise, self.point_noise, self.eta, self.starts = at, at.noise, at.point_noise, at.eta, []
        return at

    def _renewed(self, loss: Loss) -> LocalModel:
        """The same with derivatives at the trial itself."""
        before = self._local(loss)
        self._at, self.starts = None, [before.eta]
        return self._local(loss)

    def _descend(self, loss: Loss, settled: float, most: int = 0) -> Outcome:
        most = len(self.trace) + most if most else self.begun + self.options.max_iterations
        is_handed_on = settled >= self.options.handed_on
        left = float if is_handed_on else self._left
        while len(self.trace) < most:
            local = self._local(loss)
            if local.is_carried and (left(local.length) >= settled or local.is_graduated):
                local = self._renewed(loss)
            if left(local.length) < settled and not local.is_graduated:
                return Outcome.CONVERGED
            if self.options.before_step is not None:
                self.options.before_step()
            if time.monotonic() >= self.options.until:
                return Outcome.OUT_OF_TIME
            refused = self._step(local, loss)
            if refused is not None:
                return refused
            if is_handed_on and local.is_undamped and abs(self.trace[-1].gain - 1.0) < ACCURACY.kept:
                return Outcome.CONVERGED
        return Outcome.MAXIMUM_ITERATIONS

    def _ended(self, local: LocalModel) -> LocalModel:
        """After the last step, too: too short for new derivatives, and all the same a part of the doubt."""
        coefficients = self.evaluation.coefficients + local.step(self.limit)[0]
        with suppress(NotConverged):
            self.evaluations += 1
            after = local.moved_to(self.problem.evaluation(coefficients, self.evaluation))
            if after.value < local.value:
                self.evaluation = after.evaluation
                return after
        return local

    def _has_enough(self) -> bool:
        local = self._local(self.options.losses[-1])
        return local.length < self.options.enough and not local.is_graduated

    def _left(self, length: float) -> float:
        """How long the steps after the next will be in all, where each is shorter than the last by the same factor.

        What simplified Newton iterations are stopped by (Hairer and Wanner 1996, IV.8). Where nothing is known of the
        factor, and where the next is long or will not be taken, its own length.

        Args:
            length: of the next.
        """
        known = self.trace[self.comparable :]
        if known and abs(known[-1].gain - 1.0) >= ACCURACY.kept:
            return length
        before = known[-1].length if known else self.options.length_before if not self.comparable else np.inf
        if before == np.inf or not self.takes_last or length >= self.options.handed_on:
            return length
        rate = min(length / before, ACCURACY.slowest)
        return length * rate / (1.0 - rate)

    def _step(self, local: LocalModel, loss: Loss) -> Outcome | None:
        """Take the best step within the limit; None when one was taken."""
        unsolved = False
        while self.limit > self.options.minimum_step:
            change, largest = local.step(self.limit)
            promised = local.decrease(change)
            if self.is_at_edge and not local.is_undamped and promised < self._gained_by_settled:
                break
            try:
                self.evaluations += 1
                evaluation = self.problem.evaluation(self.evaluation.coefficients + change, self.evaluation)
                value = local.objective(evaluation, loss)
                gain = (local.value - value) / promised
            except NotConverged:
                unsolved = self.is_at_edge = True
                gain, value = -1.0, np.inf
            self.limit = _next_limit(self.limit, largest, gain)
            if gain > 0.0:
                self.evaluation, self.is_at_edge = evaluation, self.is_at_edge and not local.is_undamped
                if self.options.is_near and local.is_undamped and abs(gain - 1.0) < ACCURACY.kept:
                    self._at = local.moved_to(evaluation)
                self.trace.append(
                    IterationRecord(
                        evaluation.match.rms, value, local.noise, local.scales.force, largest, local.length, gain
                    )
                )
                return None
        self.limit = self._first_limit
        return Outcome.NO_STATE if unsolved else Outcome.NO_DESCENT


def _begun(problem: Problem, start: Floats, near: Evaluation | None) -> Evaluation:
    """The trial at the start: the one given, where it is of this cloud and has just these coefficients."""
    sized = problem.sized(start)
    if near is None or near.given is not problem.cloud or near.coefficients is not start:
        return problem.evaluation(sized, near)
    return near if sized is start else replace(near, coefficients=sized)


def _next_limit(limit: float, taken: float, gain: float) -> float:
    if gain <= 0.0:
        return min(limit, taken) / 3.0
    if gain < 0.3:
        return limit / 2.0
    return max(limit, 2.0 * taken) if gain > 0.7 else limit
