"""The Gauss-Newton model of the objective about a trial, and what is doubtful of an estimate made with it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .evaluation import Evaluation
from .evidence import Conditional, Evidence, LinearProblem
from .hyperparameters import DISCREPANCY, LENGTH, NOISE, SHARED, Hyperparameters
from .loss import Loss
from .policy import ACCURACY
from .problem import Problem
from .residuals.term import ResidualTerm

Floats = NDArray[np.float64]


class LocalModel:
    """The Gauss-Newton model of the objective about a trial, at the hyperparameters found there.

    Args:
        problem: what is registered.
        evaluation: where.
        loss: of the points.
        noise: their scale so far, metres, for the weights that the hyperparameters are found with.
        graduation: the noise is taken as at least this part of what the linear model promises to change.
        jacobian: of the distances at the trial, (p, k), where it is known.
        starts: logarithms of hyperparameters that the search for them begins with; those that are believed if none.
        point_noise: the points' own noise so far, metres, without what is yet to be explained; None for all of it.
        is_held: the hyperparameters are the first of the starts, and not sought.
        linearised_at: trial nearby whose derivatives these are; this one if not given.
    """

    def __init__(
        self,
        problem: Problem,
        evaluation: Evaluation,
        loss: Loss,
        noise: float,
        graduation: float = 0.0,
        jacobian: Floats | None = None,
        starts: Sequence[Floats] = (),
        point_noise: float | None = None,
        *,
        is_held: bool = False,
        linearised_at: Evaluation | None = None,
    ) -> None:
        self.problem, self.evaluation, self.loss = problem, evaluation, loss
        self.linearised_at = evaluation if linearised_at is None else linearised_at
        self.is_undamped, self.point_noise = True, noise if point_noise is None else point_noise
        self.jacobian = problem.jacobian(evaluation) if jacobian is None else jacobian
        told = [_told(problem, evaluation, term, loss) for term in problem.terms]
        self._by_terms = np.sum([each[0] for each in told], axis=0) if told else None
        self._beside: Floats | float = np.sum([each[1] for each in told], axis=0) if told else 0.0
        self._groups, self.local_error = _grouped(problem.local_error(evaluation))
        start = problem.hyperprior.within(starts[0]) if len(starts) else _believed(problem, noise)
        self.evidence_weights: Floats  # weights that what the points tell is summed with, (p,)
        self.evidence = self._evidence_near(start, noise)
        if is_held:
            self.eta, self.is_graduated = start, False
        else:
            self.eta, self.is_graduated = self._found(graduation, list(starts) or [start])
        self.scales = Hyperparameters(*np.exp(self.eta))
        self.noise = self.scales.noise
        self.deviations = np.hypot(self.noise, self.scales.discrepancy * self.local_error)
        residuals = problem.residuals(evaluation, self.point_noise)
        self.weights = loss.weight(residuals / self.deviations)
        if np.abs(self.weights - self.evidence_weights).sum() > ACCURACY.summed * self.weights.sum():
            summed = replace(self._evidence_of(residuals, self.weights).problem, tail=self.evidence.problem.tail)
            self.evidence, self.evidence_weights = replace(self.evidence, problem=summed), self.weights
        self.precision = np.exp(-problem.prior_variances(self.eta)[0])
        self.gradient = self._gradient(residuals, self.weights)

    @property
    def is_carried(self) -> bool:
        """Whether the derivatives are those of a trial nearby."""
        return self.linearised_at is not self.evaluation

    def _gradient(self, residuals: Floats, weights: Floats) -> Floats:
        by_distances = weights * residuals / self.deviations**2
        return by_distances @ self.jacobian + self.precision * self.evaluation.coefficients + self._beside

    def _evidence_near(self, eta: Floats, noise: float) -> Evidence:
        """Of the hyperparameters, with the weights that the points have at some noise.

        Weights cut tails off: what a normal law has there is added to the squares of what the linear model leaves.

        Args:
            eta: logarithms of hyperparameters near those sought, (5,).
            noise: standard deviation of a point's distance, metres.
        """
        residuals = self.problem.residuals(self.evaluation, self.point_noise)
        self.evidence_weights = self.loss.weight(
            residuals / np.hypot(noise, np.exp(eta[DISCREPANCY]) * self.local_error)
        )
        found = self._evidence_of(residuals, self.evidence_weights)
        left = (
            self.evidence_weights * (residuals + self.jacobian @ (found.mean(eta) - self.evaluation.coefficients)) ** 2
        )
        tail = (1.0 / self.loss.consistency - 1.0) * np.array([left[group].sum() for group in self._groups])
        return found.with_tail(tail)

    def _evidence_of(self, residuals: Floats, weights: Floats) -> Evidence:
        """The same with given weights, (p,), and no tails."""
        problem, coefficients, groups = self.problem, self.evaluation.coefficients, self._groups
        data = self.jacobian @ coefficients - residuals
        root = np.sqrt(weights)
        parts = [root[group, None] * self.jacobian[group] for group in groups]
        known = None if self._by_terms is None else (self._by_terms, self._by_terms @ coefficients - self._beside)
        linear = LinearProblem(
            np.stack([part.T @ part for part in parts]),
            np.stack([(root[group] * data[group]) @ part for group, part in zip(groups, parts, strict=True)]),
            np.array([data[group] @ (weights[group] * data[group]) for group in groups]),
            np.array([weights[group].sum() for group in groups]),
            np.zeros(len(groups)),
            known,
        )
        there = np.array([self.local_error[group[0]] for group in groups])
        return Evidence(linear, problem.noise_variances(there), problem.prior_variances, problem.hyperprior)

    def _found(self, graduation: float, starts: list[Floats]) -> tuple[Floats, bool]:
        """Logarithms of the hyperparameters, and whether the noise is held above what the model would believe."""
        evidence = self.evidence
        eta = evidence.maximum(starts)
        self.point_noise = float(np.exp(eta[NOISE]))
        minimum = np.log(max(graduation * self._promised(evidence, eta), 1e-300))
        if minimum <= eta[NOISE]:
            return eta, False
        return evidence.with_minimum(NOISE, minimum).maximum([eta]), True

    def _promised(self, evidence: Evidence, eta: Floats) -> float:
        """Root mean square change of the residuals by the best step at some hyperparameters, metres."""
        linear, step = evidence.problem, evidence.mean(eta) - self.evaluation.coefficients
        square = float((linear.information @ step @ step).sum())
        return float(np.sqrt(max(square, 0.0) / max(linear.count.sum(), 1.0)))

    def score_of(self, columns: Floats) -> tuple[Floats, Floats]:
        """Slope of the logarithm of the likelihood by parameters that are none here, (m,), and its covariance, (m, m).

        All unknowns are integrated out with what is believed of them.

        Args:
            columns: derivative of the distances by these parameters, (p, m).
        """
        weighted = (self.evidence_weights / self.deviations**2)[:, None] * columns
        residuals = self.problem.residuals(self.evaluation, self.point_noise)
        across = self.jacobian.T @ weighted
        solved = self.solved(across)
        # What the last step, which was not taken, would still change of the residuals counts, too.
        pull = solved.T @ self.gradient - (self.weights * residuals / self.deviations**2) @ columns
        return pull, columns.T @ weighted - across.T @ solved

    @cached_property
    def _law(self) -> Conditional | None:
        """The normal law of the unknowns; None where information and prior are too far apart for Cholesky's factor."""
        return self.evidence.conditional(self.eta)

    @cached_property
    def _eigen(self) -> tuple[Floats, Floats]:
        """Of the Hessian in coefficients of unit prior variance, for steps that have to be damped."""
        values, vectors = np.linalg.eigh(self.evidence.scaled(self.eta))
        return values, vectors

    def solved(self, right: Floats) -> Floats:
        """The inverse of the Hessian, the posterior's precision, times columns, (k, m)."""
        if self._law is not None:
            return self._law.solved(right)
        root, (values, vectors) = 1.0 / np.sqrt(self.precision)[:, None], self._eigen
        # With the prior none is below 1, whatever round-off says.
        return np.asarray(root * (vectors @ (vectors.T @ (root * right) / np.maximum(values, 1.0)[:, None])))

    @cached_property
    def inverse(self) -> Floats:
        """Of the Hessian."""
        return self.solved(np.eye(self.problem.size)) if self._law is None else self._law.covariance

    @property
    def informed(self) -> Floats:
        """Share of each coefficient that the points tell, and not what was believed, (k,)."""
        return 1.0 - self.precision * np.diag(self.inverse)

    @cached_property
    def _whole(self) -> Floats:
        """The whole step."""
        return -self.solved(self.gradient[:, None])[:, 0]

    @cached_property
    def value(self) -> float:
        """Of the objective at the trial."""
        return self.objective(self.evaluation, self.loss)

    def objective(self, evaluation: Evaluation, loss: Loss) -> float:
        """Robust distances and prior at these scales."""
        prior = 0.5 * float(self.precision @ evaluation.coefficients**2)
        scaled = self.problem.residuals(evaluation, self.point_noise) / self.deviations
        held = self.evaluation.match
        beside = sum(
            float((term.loss or loss).value(term.values(evaluation, held)).sum()) for term in self.problem.terms
        )
        return float(loss.value(scaled).sum()) + beside + prior

    @property
    def length(self) -> float:
        """Length of the whole step in posterior deviations a coefficient."""
        return _length(self._whole, self.gradient)

    def length_of(self, change: Floats) -> float:
        """Length of any change of the coefficients, (k,), in the same measure."""
        gained = change * np.sqrt(self.precision)
        square = gained @ self.evidence.scaled(self.eta) @ gained if self._law is None else self._law.square(change)
        return float(np.sqrt(square / len(change)))

    def moved_to(self, evaluation: Evaluation) -> LocalModel:
        """The same about a trial so near that derivatives, hyperparameters and what the points tell are the same."""
        other = copy.copy(self)
        other.is_undamped = True
        for name in ("_whole", "value"):
            other.__dict__.pop(name, None)
        residuals = self.problem.residuals(evaluation, self.point_noise)
        other.evaluation, other.weights = evaluation, self.loss.weight(residuals / self.deviations)
        if self._by_terms is not None:
            other._beside = self._beside + self._by_terms @ (evaluation.coefficients - self.evaluation.coefficients)
        other.gradient = other._gradient(residuals, other.weights)
        return other

    def _damped(self, damping: float) -> Floats:
        values, vectors = self._eigen
        root = 1.0 / np.sqrt(self.precision)
        rotated = vectors.T @ (root * self.gradient)
        return -root * (vectors @ (rotated / (np.maximum(values, 1.0) + damping)))

    def step(self, limit: float) -> tuple[Floats, float]:
        """The best change of the coefficients that moves no observed node further than the limit, and how far it does.

        Args:
            limit: metres.
        """
        change, damping = self._whole, 0.0
        while (largest := self.largest_movement(change)) > 1.05 * limit or self.problem.is_too_far(change):
            self.is_undamped = False
            damping = max(1.6 * damping, 0.1)
            change = self._damped(damping)
        return change, largest

    def decrease(self, change: Floats) -> float:
        """Decrease of the objective that the model predicts."""
        if self._law is not None:
            return -float(self.gradient @ change) - 0.5 * self._law.square(change)
        scaled = change * np.sqrt(self.precision)
        return -float(self.gradient @ change + 0.5 * scaled @ self.evidence.scaled(self.eta) @ scaled)

    def largest_movement(self, change: Floats) -> float:
        """Largest predicted movement of an observed node, metres."""
        return float(self.problem.moved(self.linearised_at, change).max())


def without_shared_noise(problem: Problem, noise: float, eta: Floats | None = None) -> Floats:
    """Logarithms of hyperparameters to begin with, (5,), without noise that neighbours share.

    Args:
        problem: what is registered.
        noise: standard deviation of a point's distance so far, metres.
        eta: logarithms of the hyperparameters so far; what is believed of them if not given.
    """
    median = problem.hyperprior.median
    found = median.copy() if eta is None else eta.copy()
    found[NOISE], found[[SHARED, LENGTH]] = np.log(noise), median[[SHARED, LENGTH]]
    return found


def _believed(problem: Problem, noise: float) -> Floats:
    """What is believed of the hyperparameters, and a noise, metres."""
    start = problem.hyperprior.median.copy()
    start[NOISE] = np.log(noise)
    return problem.hyperprior.within(start)


def _grouped(local_error: Floats) -> tuple[list[NDArray[np.int64]], Floats]:
    """Points of like variance: numbers of those in each group, and the root mean square of it for each point, (p,)."""
    if not local_error.any():
        return [np.arange(len(local_error))], local_error
    groups = [group for group in np.array_split(np.argsort(local_error), ACCURACY.groups) if len(group)]
    alike = np.empty_like(local_error)
    for group in groups:
        alike[group] = np.sqrt(np.mean(local_error[group] ** 2))
    return groups, alike


def _told(problem: Problem, evaluation: Evaluation, term: ResidualTerm, loss: Loss) -> tuple[Floats, Floats]:
    """Information, (k, k), and gradient, (k,), of what pulls beside the distances and carries its own deviation.

    The scales of noise and forces are found from the distances alone.

    Args:
        problem: what is registered.
        evaluation: where.
        term: what pulls.
        loss: of the points.
    """
    off = term.values(evaluation)
    slopes, weights = problem.jacobian(evaluation, term.slopes(evaluation)), (term.loss or loss).weight(off)
    return (weights[:, None] * slopes).T @ slopes, (weights * off) @ slopes


def _length(step: Floats, gradient: Floats) -> float:
    return float(np.sqrt(max(-float(step @ gradient), 0.0) / len(step)))
