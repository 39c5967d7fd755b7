"""The hyperparameters of a registration at the maximum of Laplace's evidence, by its gradient.

About a state the residuals are linear in unknowns c, y = B c + noise of covariance sigma^2 W^-1, and c has a normal law
of variances v(eta) beforehand. The evidence p(y | eta) is that of a normal law with covariance sigma^2 W^-1 + B v B'
(MacKay 1992), low rank plus diagonal: by Woodbury's formula all of it comes from B' W B, B' W y and y' W y, which are
made once, and a trial of eta costs the factor of one matrix of the unknowns' size. With m and S the mean and covariance
of the unknowns,

    d(-log p) / d(log v_j) = (1 - (m_j^2 + S_jj) / v_j) / 2

so that a group of unknowns tells its own scale, however it depends on eta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.optimize import minimize

Floats = NDArray[np.float64]
# Logarithms of the variances of all unknowns, (k,), and their derivatives by the logarithms eta, (h, k).
Variances = Callable[[Floats], tuple[Floats, Floats]]


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """Residuals that are linear in unknowns, in the sums that the evidence needs: points in groups of like variance.

    Args:
        information: B' W B of each group, (g, k, k).
        pull: B' W y, (g, k).
        square: y' W y, (g,).
        count: sums of the weights, (g,).
        tail: what is added to the squares for the tails that robust weights have cut off, (g,).
        known: the same as `information`, `pull` of residuals whose deviation is known, over its square.
    """

    information: Floats
    pull: Floats
    square: Floats
    count: Floats
    tail: Floats
    known: tuple[Floats, Floats] | None = None

    def weighted(self, precision: Floats) -> tuple[Floats, Floats]:
        """B' W B and B' W y of all groups over their variances.

        Args:
            precision: of each group, (g,).
        """
        count = self.pull.shape[1]
        matrix = (precision @ self.information.reshape(len(precision), -1)).reshape(count, count)
        pull = precision @ self.pull
        if self.known is not None:
            matrix, pull = matrix + self.known[0], pull + self.known[1]
        return matrix, pull


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of the hyperparameters beforehand: independent, log-normal within bounds.

    Args:
        median: logarithms, (h,); the first is that of the noise.
        spread: standard deviations of the logarithms, (h,); 0 of one that is known.
        lowest: (h,).
        highest: (h,).
    """

    median: Floats
    spread: Floats
    lowest: Floats
    highest: Floats

    def with_minimum(self, place: int, value: float) -> Belief:
        """The same with a larger least value, a logarithm, of one."""
        lowest = self.lowest.copy()
        lowest[place] = max(lowest[place], value)
        return Belief(self.median, self.spread, lowest, np.maximum(self.highest, lowest))

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which are not known, (h,)."""
        return (self.spread > 0.0) & (self.highest > self.lowest)

    def within(self, eta: Floats) -> Floats:
        """Values, those that are known as they are."""
        return np.clip(np.where(self.spread > 0.0, eta, self.median), self.lowest, self.highest)

    def cost(self, eta: Floats) -> tuple[float, Floats]:
        """Minus the logarithm of the density, and its gradient."""
        off = np.where(self.spread > 0.0, (eta - self.median) / np.where(self.spread > 0.0, self.spread, 1.0), 0.0)
        return 0.5 * float(off @ off), np.where(self.spread > 0.0, off / np.maximum(self.spread, 1e-300), 0.0)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Minus the logarithm of the evidence times what is believed, as a function of the hyperparameters.

    Args:
        problem: about a state.
        noise: logarithms of the groups' variances, (g,), and their derivatives, (h, g).
        variances: of the unknowns.
        belief: about the hyperparameters.
    """

    problem: LinearProblem
    noise: Variances
    variances: Variances
    belief: Belief
    evaluations: list[int] = field(default_factory=lambda: [0])

    def value(self, eta: Floats) -> tuple[float, Floats]:
        """At logarithms of the hyperparameters, (h,), with the gradient, (h,)."""
        self.evaluations[0] += 1
        problem = self.problem
        (noise, by_noise), (logs, slopes) = self.noise(eta), self.variances(eta)
        precision, root = np.exp(-noise), np.exp(0.5 * logs)
        matrix, pull = problem.weighted(precision)
        matrix = matrix * root[:, None] * root
        matrix[np.diag_indices(len(root))] += 1.0
        factor, failed = dpotrf(matrix, lower=True, overwrite_a=True)
        if failed:
            return np.inf, np.zeros_like(eta)
        half = float(np.log(np.diag(factor)).sum())
        inverse, _ = dpotri(factor, lower=True, overwrite_c=True)  # its lower triangle
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        mean = inverse @ (root * pull)  # over the roots of the variances
        believed, gradient = self.belief.cost(eta)
        square = float(precision @ (problem.square + problem.tail))
        value = 0.5 * float(problem.count @ noise) + half + 0.5 * (square - float(mean @ (root * pull))) + believed
        gradient = gradient + 0.5 * slopes @ (1.0 - mean**2 - np.diag(inverse))
        # y' W y - 2 m' B' W y + tr(B' W B (m m' + S)) of each group, over its variance
        moved = root * mean
        second = inverse * root[:, None] * root + moved[:, None] * moved
        data = problem.square + problem.tail - 2.0 * problem.pull @ moved
        data = data + problem.information.reshape(len(noise), -1) @ second.ravel()
        return value, gradient + 0.5 * by_noise @ (problem.count - precision * data)

    def maximum(self, starts: list[Floats], tolerance: float = 1e-2, iterations: int = 20) -> Floats:
        """The most likely hyperparameters, (h,), by descents from several starts.

        Args:
            starts: (h,) each.
            tolerance: of the gradient: a change of the logarithm of the evidence by a logarithm.
            iterations: of each descent.
        """
        belief, free = self.belief, self.belief.free
        best, lowest = belief.within(starts[0]), np.inf
        if not free.any():
            return best
        for start in starts:
            eta = belief.within(start)

            def cost(part: Floats, eta: Floats = eta) -> tuple[float, Floats]:
                whole = eta.copy()
                whole[free] = part
                value, gradient = self.value(whole)
                return value, gradient[free]

            bounds = list(zip(belief.lowest[free], belief.highest[free], strict=True))
            options = {"maxiter": iterations, "gtol": tolerance, "ftol": 1e-7, "maxls": 10}
            found = minimize(cost, eta[free], jac=True, method="L-BFGS-B", bounds=bounds, options=options)
            if found.fun < lowest:
                lowest = float(found.fun)
                best = eta.copy()
                best[free] = found.x
        return best

    def curvature(self, eta: Floats, step: float = 0.02) -> Floats:
        """Covariance of the hyperparameters' logarithms by the curvature at the maximum, (h, h)."""
        free = np.flatnonzero(self.belief.free)
        hessian = np.zeros((len(free), len(free)))
        for row, place in enumerate(free):
            moved = np.zeros_like(eta)
            moved[place] = step
            up, down = self.value(eta + moved)[1], self.value(eta - moved)[1]
            hessian[row] = (up - down)[free] / (2.0 * step)
        values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        floor = 1.0 / np.maximum(self.belief.spread[free].max(initial=1.0), 1.0) ** 2  # no flatter than the belief
        covariance = np.zeros((len(eta), len(eta)))
        covariance[np.ix_(free, free)] = (vectors / np.maximum(values, floor)) @ vectors.T
        return covariance
