"""L-BFGS with the gradient by the adjoint: no derivatives of single coefficients are needed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from softtwin.reference.data.outcome import NotConverged

from .evaluation import Evaluation
from .gauss_newton import IterationRecord, SolverResult
from .hyperparameters import LENGTH, SHARED
from .local_model import LocalModel, without_shared_noise
from .loss import Huber, Loss, Tukey, robust_deviation
from .outcome import Outcome
from .penalties import Penalty
from .problem import Problem
from .score import gain_by_shared_noise

Floats = NDArray[np.float64]
_WALL = 10.0  # times the objective: what a coefficient costs at which the model finds no state


@dataclass(frozen=True)
class LBFGS:
    """SciPy's L-BFGS on the robust loss with the adjoint's gradient (Odot 2023, eq. 6.10).

    The scales of noise and forces are found between the runs, from one linearisation each.

    Args:
        losses: one run for each.
        max_iterations: of one run.
        memory: pairs that the Hessian is built from.
        tolerance: relative fall of the objective below which a run ends.
        penalty: what forces cost in place of their Gaussian prior; None for that. What is said of doubt is by the
            prior all the same.
        until: no state is looked for after this time of the monotonic clock, seconds.
        before_step: called before each; it may wait.
    """

    losses: tuple[Loss, ...] = (Huber(), Huber(), Tukey())
    max_iterations: int = 200
    memory: int = 30
    tolerance: float = 1e-9
    penalty: Penalty | None = None
    until: float = np.inf
    before_step: Callable[[], None] | None = None

    def __post_init__(self) -> None:
        if self.max_iterations < 1 or self.memory < 1:
            raise ValueError(
                f"LBFGS.max_iterations, LBFGS.memory: expected at least 1, got {self.max_iterations} and {self.memory}."
            )

    def coarse(self) -> LBFGS:
        """The same with the first loss alone: for a start."""
        return replace(self, losses=self.losses[:1])

    def unsettled(self) -> LBFGS:
        """The same: where it ends is not known before."""
        return self

    def following(self) -> LBFGS:
        """The same: it asks nothing of where it starts."""
        return self

    def going_on(self, found: SolverResult) -> LBFGS:
        """The same: see `GaussNewton.going_on`."""
        return self

    def directly(self) -> LBFGS:
        """The same with the last loss alone."""
        return replace(self, losses=self.losses[-1:])

    def without_steps(self) -> LBFGS:
        """The same with one short run: to judge a start."""
        return replace(self, losses=self.losses[:1], max_iterations=1)

    def solve(
        self, problem: Problem, start: Floats, near: Evaluation | None = None, eta: Floats | None = None
    ) -> SolverResult:
        """The coefficients that minimise the robust distance plus the prior.

        Args:
            problem: what is registered.
            start: coefficients to start from, (k,).
            near: a trial whose state is near the start's.
            eta: without effect.

        Raises:
            NotConverged: the model found no state at the start.
        """
        return _Run(self, problem, start, near).found()


class _TimeIsOver(Exception):  # noqa: N818 - no error
    """Leaves SciPy's loop."""


class _Run:
    def __init__(self, options: LBFGS, problem: Problem, start: Floats, near: Evaluation | None) -> None:
        self.options, self.whole, self.problem = options, problem, problem.unshared
        self.evaluation = self.best = self.problem.evaluation(self.problem.sized(start), near)
        self.evaluations, self.trace = 1, list[IterationRecord]()
        penalty = options.penalty
        self.cost = None if penalty is None else penalty.of(problem.observed.body, problem.forces)

    def found(self) -> SolverResult:
        noise = max(robust_deviation(self.evaluation.match.distances), self.problem.noise.minimum)
        last, outcome = self.options.losses[-1], Outcome.CONVERGED
        for loss in self.options.losses:
            local = self._local(loss, noise)
            noise, outcome = local.noise, self._descend(loss, local)
        local = self._local(last, noise)
        gain, size, length = gain_by_shared_noise(local, self.whole)
        if gain > 0.0:
            self.problem = self.whole
            self.evaluation = self.best = replace(
                self.evaluation, coefficients=self.whole.sized(self.evaluation.coefficients)
            )
            shared = self.whole.hyperprior.within(local.eta)
            shared[[SHARED, LENGTH]] = size, length
            outcome = self._descend(last, self._local(last, local.noise, shared))
            local = self._local(last, local.noise, shared)
        return SolverResult.at(local, outcome, self.evaluations, tuple(self.trace))

    def _local(self, loss: Loss, noise: float, *others: Floats) -> LocalModel:
        starts = [without_shared_noise(self.problem, noise), *others]
        return LocalModel(self.problem, self.evaluation, loss, noise, starts=starts)

    def _descend(self, loss: Loss, local: LocalModel) -> Outcome:
        """One run at fixed scales, in coefficients of unit prior variance."""
        problem, scales = self.problem, local.scales
        root = 1.0 / np.sqrt(local.precision)
        minimum = np.inf
        met_wall = False

        def evaluate(scaled: Floats) -> tuple[float, Floats]:
            nonlocal minimum, met_wall
            if self.options.before_step is not None:
                self.options.before_step()
            if time.monotonic() >= self.options.until:
                raise _TimeIsOver
            self.evaluations += 1
            try:
                evaluation = problem.evaluation(root * scaled, self.evaluation)
            except NotConverged:  # a wall that the line search steps back from
                met_wall = True
                return _WALL * max(minimum, 1.0), np.zeros_like(scaled)
            value, gradient = _objective(problem, evaluation, loss, local)
            held = scaled.copy()  # what the Gaussian priors pull back
            if self.cost is not None:
                part = problem.force_part
                held[part] = 0.0
                paid, slope = self.cost(evaluation.coefficients[part])
                value, gradient[part] = value + paid, gradient[part] + slope
            value += 0.5 * float(held @ held)
            if value < minimum:
                minimum, self.best = value, evaluation
            return value, root * gradient + held

        limits = {"maxiter": self.options.max_iterations, "ftol": self.options.tolerance, "maxcor": self.options.memory}
        try:
            done = minimize(evaluate, self.evaluation.coefficients / root, jac=True, method="L-BFGS-B", options=limits)
        except _TimeIsOver:
            done = None
        moved = float(problem.moved(self.evaluation, self.best.coefficients - self.evaluation.coefficients).max())
        self.evaluation = self.best
        self.trace.append(
            IterationRecord(
                self.evaluation.match.rms, minimum, scales.noise, scales.force, moved, float("nan"), float("nan")
            )
        )
        if done is None:
            return Outcome.OUT_OF_TIME
        if done.success:
            return Outcome.CONVERGED
        if done.status == 1:
            return Outcome.MAXIMUM_ITERATIONS
        return Outcome.NO_STATE if met_wall else Outcome.NO_DESCENT


def _objective(problem: Problem, evaluation: Evaluation, loss: Loss, local: LocalModel) -> tuple[float, Floats]:
    """Robust distances and their gradient by the coefficients, (k,), at the scales of a model."""
    scaled = problem.residuals(evaluation, local.point_noise) / local.deviations
    slope = loss.weight(scaled) * scaled / local.deviations
    value, gradient = float(loss.value(scaled).sum()), problem.vjp(evaluation, slope)
    held = local.evaluation.match
    for term in problem.terms:
        off, cost = term.values(evaluation, held), term.loss or loss
        value += float(cost.value(off).sum())
        gradient = gradient + problem.vjp(evaluation, cost.weight(off) * off, term.slopes(evaluation, held))
    return value, gradient
