"""The hyperparameters of a registration at the maximum of Laplace's evidence, by its gradient.

About a state the residuals are linear in the unknowns c: y = B c + noise of covariance D W^-1, and c has a normal law
of variances v beforehand. D, a variance for each group of points, and v depend on the hyperparameters eta. The evidence
p(y | eta) is that of a normal law with covariance D W^-1 + B v B' (MacKay 1992), diagonal plus low rank: by Woodbury's
formula all of it comes from B' W B, B' W y and y' W y of each group, which are made once, and a trial of eta costs one
factor of the unknowns' size. With m and S the mean and the covariance of the unknowns,

    d(-log p) / d(log v_j) = (1 - (m_j^2 + S_jj) / v_j) / 2

so that a block of unknowns tells its own scale, however that depends on eta, and so does a group of points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrmv
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from .hyperparameters import LogNormalPrior

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
# Logarithms of variances as functions of the logarithms eta of the hyperparameters, with their derivatives.
Known = tuple[float, Floats]  # a value and its gradient
Variances = Callable[[Floats], tuple[Floats, Floats]]
_STEPS, _TRIALS = 20, 10  # of a descent, and lengths of each
_FLAT = 0.1  # slope a standard deviation of a logarithm, below which a descent ends
_GAIN = 1e-7  # of the cost: so little gained ends it, too
_LONGEST = 1.0  # of a logarithm that a step may take: a factor of e
_ENOUGH = 1e-4  # of what the slope promises has a step to gain (Armijo)
_BEHIND = 30.0  # of the logarithm of the evidence: no descent begins so far behind the best so far
_STEP = 1e-5  # of a logarithm, for a difference
_AT_BOUND = 0.02  # of a logarithm: so near to a bound a hyperparameter lies at it
_REACH = 14.0  # of a logarithm about the median: a factor of a million, beyond which sums lose their digits


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """Residuals that are linear in unknowns, in the sums that the evidence needs: points in groups of like variance.

    Args:
        information: B' W B of each group, (g, k, k).
        projection: B' W y, (g, k).
        square: y' W y, (g,).
        count: sums of the weights, (g,).
        tail: what is added to the squares for the tails that robust weights have cut off, (g,).
        known: the same as `information`, `projection` of residuals whose deviation is known, over its square.
    """

    information: Floats
    projection: Floats
    square: Floats
    count: Floats
    tail: Floats
    known: tuple[Floats, Floats] | None = None

    @cached_property
    def upper(self) -> Floats:
        """B' W B of each group, (g, k k), for products with a symmetric matrix of which the upper triangle is known."""
        return (self.information * _doubled(self.projection.shape[1])).reshape(len(self.information), -1)

    def weighted(self, precision: Floats) -> tuple[Floats, Floats]:
        """B' W B and B' W y of all groups over their variances.

        Args:
            precision: of each group, (g,).
        """
        count = self.projection.shape[1]
        matrix = (precision @ self.information.reshape(len(precision), -1)).reshape(count, count)
        projection = precision @ self.projection
        if self.known is not None:
            matrix += self.known[0]
            projection += self.known[1]
        return matrix, projection


@dataclass(frozen=True, eq=False)
class Hyperprior:
    """What is believed of the logarithms of the hyperparameters beforehand: normal and independent, within bounds.

    Args:
        median: (h,).
        spread: standard deviations, (h,); 0 of one that is known.
        lowest: (h,).
        highest: (h,).
        below: standard deviations below the medians, (h,).
    """

    median: Floats
    spread: Floats
    lowest: Floats
    highest: Floats
    below: Floats

    @classmethod
    def of(cls, priors: Sequence[LogNormalPrior]) -> Hyperprior:
        """The same of the scales themselves."""
        return cls._of(tuple(priors))

    @classmethod
    @lru_cache(maxsize=64)  # the same with each frame
    def _of(cls, priors: tuple[LogNormalPrior, ...]) -> Hyperprior:
        rows = [(np.clip(each.median, each.minimum, each.maximum), each.minimum, each.maximum) for each in priors]
        with np.errstate(divide="ignore"):
            median, lowest, highest = np.log(np.array(rows)).T
        spread = np.array([each.spread for each in priors])
        reach = np.where(spread > 0.0, _REACH, np.inf)
        below = np.array([each.spread if each.spread_below is None else each.spread_below for each in priors])
        return cls(median, spread, np.maximum(lowest, median - reach), np.minimum(highest, median + reach), below)

    def with_minimum(self, place: int, value: float) -> Hyperprior:
        """The same with a larger least value of one."""
        lowest = self.lowest.copy()
        lowest[place] = max(lowest[place], value)
        return replace(self, lowest=lowest, highest=np.maximum(self.highest, lowest))

    @cached_property
    def is_sought(self) -> NDArray[np.bool_]:
        """Which are not known, (h,)."""
        return (self.spread > 0.0) & (self.highest > self.lowest)

    def within(self, eta: Floats) -> Floats:
        """Values within the bounds, those that are known as they are."""
        found: Floats = np.clip(np.where(self.spread > 0.0, eta, self.median), self.lowest, self.highest)
        return found

    @cached_property
    def bend(self) -> Floats:
        """Second derivatives of the cost above the medians, (h,)."""
        return 1.0 / np.where(self.spread > 0.0, self.spread, 1.0) ** 2

    def bend_at(self, eta: Floats) -> Floats:
        """The same below the medians, too."""
        return 1.0 / self.spread_at(eta) ** 2

    def spread_at(self, eta: Floats) -> Floats:
        """Standard deviations on the side of the medians where the logarithms are, (h,); 1 of what is known."""
        return np.where(self.spread > 0.0, np.where(eta < self.median, self.below, self.spread), 1.0)

    def cost(self, eta: Floats) -> tuple[float, Floats]:
        """Minus the logarithm of the density, and its gradient."""
        spread = self.spread_at(eta)
        scaled = np.where(self.spread > 0.0, eta - self.median, 0.0) / spread
        return 0.5 * float(scaled @ scaled), scaled / spread


@dataclass(frozen=True, eq=False)
class Conditional:
    """The unknowns' normal law at given hyperparameters, over the roots of their prior variances.

    Args:
        root: of the prior variances, (k,).
        factor: Cholesky's factor L of the precision L L', (k, k), of which the lower triangle is meant.
        mean: (k,), over the roots.
    """

    root: Floats
    factor: Floats
    mean: Floats

    @cached_property
    def lower(self) -> Floats:
        """The covariance, (k, k), of which the lower triangle is meant."""
        found: Floats = dpotri(self.factor, lower=True)[0]
        return found

    @cached_property
    def inverse(self) -> Floats:
        """The covariance, (k, k)."""
        lower = np.tril(self.lower)
        return lower + np.tril(lower, -1).T

    @cached_property
    def covariance(self) -> Floats:
        """Of the unknowns themselves, (k, k)."""
        return self.root[:, None] * self.inverse * self.root

    def solved(self, right: Floats) -> Floats:
        """The unknowns' covariance times columns, (k, m)."""
        found: Floats = self.root[:, None] * dpotrs(self.factor, self.root[:, None] * right, lower=True)[0]
        return found

    def square(self, change: Floats) -> float:
        """A change of the unknowns, (k,), in their precision."""
        turned = dtrmv(self.factor, change / self.root, lower=True, trans=True)
        return float(turned @ turned)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Minus the logarithm of the evidence times what is believed, as a function of the hyperparameters.

    Args:
        problem: about a state.
        noise: logarithms of the groups' variances, (g,), and their derivatives, (h, g).
        prior: logarithms of the unknowns' variances, (k,), and their derivatives, (h, k).
        hyperprior: of the hyperparameters.
    """

    problem: LinearProblem
    noise: Variances
    prior: Variances
    hyperprior: Hyperprior
    _known: dict[bytes, Conditional | None] = field(default_factory=dict, init=False, repr=False)

    def with_tail(self, tail: Floats) -> Evidence:
        """The same with squares for the tails that robust weights have cut off, (g,)."""
        return self._alike(replace(self, problem=replace(self.problem, tail=tail)))

    def with_minimum(self, place: int, value: float) -> Evidence:
        """The same with a larger least value of one hyperparameter."""
        return self._alike(replace(self, hyperprior=self.hyperprior.with_minimum(place, value)))

    def _alike(self, other: Evidence) -> Evidence:
        """The other, in which the unknowns have the same laws."""
        other._known.update(self._known)
        return other

    def value(self, eta: Floats) -> tuple[float, Floats]:
        """At logarithms of the hyperparameters, (h,), with the gradient, (h,)."""
        return self._at(eta)[:2]

    def value_alone(self, eta: Floats) -> float:
        """The same without its gradient; infinity where information and prior are too far apart."""
        law = self.conditional(eta)
        return np.inf if law is None else self._value(eta, law, self.noise(eta)[0])[0]

    def _value(self, eta: Floats, law: Conditional, noise: Floats) -> tuple[float, Floats]:
        """With the gradient of what is believed, (h,)."""
        problem, precision = self.problem, np.exp(-noise)
        projection = precision @ problem.projection
        if problem.known is not None:
            projection += problem.known[1]
        believed, gradient = self.hyperprior.cost(eta)
        square = float(precision @ (problem.square + problem.tail)) - float((law.root * law.mean) @ projection)
        half = float(np.log(np.diag(law.factor)).sum())
        return 0.5 * (float(problem.count @ noise) + square) + half + believed, gradient

    def _at(self, eta: Floats) -> tuple[float, Floats, Floats]:
        """The same with about the second derivative by each: that expected of right hyperparameters, (h,)."""
        problem = self.problem
        (noise, by_noise), (logs, slopes) = self.noise(eta), self.prior(eta)
        law = self._law(eta, noise, logs)
        if law is None:
            return np.inf, np.zeros_like(eta), np.ones_like(eta)
        precision, moved = np.exp(-noise), law.root * law.mean
        value, gradient = self._value(eta, law, noise)
        told = 1.0 - np.diag(law.lower)
        gradient = gradient + 0.5 * slopes @ (told - law.mean**2)
        bend = self.hyperprior.bend + 0.5 * (slopes**2 @ told**2 + by_noise**2 @ problem.count)
        # y' W y - 2 m' B' W y + tr(B' W B (m m' + S)) of each group, over its variance
        second = law.root[:, None] * law.lower.T  # of it the upper triangle counts
        second *= law.root
        second += moved[:, None] * moved
        data = problem.square + problem.tail - 2.0 * problem.projection @ moved + problem.upper @ second.ravel()
        return value, gradient + 0.5 * by_noise @ (problem.count - precision * data), bend

    def conditional(self, eta: Floats) -> Conditional | None:
        """The unknowns' law at logarithms of the hyperparameters; None where information and prior are too far apart.

        Args:
            eta: (h,).
        """
        return self._law(eta, self.noise(eta)[0], self.prior(eta)[0])

    def _law(self, eta: Floats, noise: Floats, logs: Floats) -> Conditional | None:
        key = eta.tobytes()
        if key not in self._known:
            root = np.exp(0.5 * logs)
            matrix, projection = self._scaled(np.exp(-noise), root)
            # By columns: nothing is copied.
            factor, failed = dpotrf(matrix.T, lower=True, clean=False, overwrite_a=True)
            law = None if failed else Conditional(root, factor, dpotrs(factor, projection, lower=True)[0])
            self._known[key] = law
        return self._known[key]

    def mean(self, eta: Floats) -> Floats:
        """The unknowns' posterior mean at logarithms of the hyperparameters, (k,)."""
        law = self.conditional(eta)
        if law is None:
            raise np.linalg.LinAlgError("Evidence.mean: what is known of the unknowns is not finite.")
        return law.root * law.mean

    def scaled(self, eta: Floats) -> Floats:
        """The unknowns' precision over the roots of their prior variances, (k, k)."""
        return self._scaled(np.exp(-self.noise(eta)[0]), np.exp(0.5 * self.prior(eta)[0]))[0]

    def _scaled(self, precision: Floats, root: Floats) -> tuple[Floats, Floats]:
        """Precision of the unknowns over the roots of their prior variances, (k, k), and B' W y over them, (k,)."""
        matrix, projection = self.problem.weighted(precision)
        matrix *= root[:, None]
        matrix *= root
        matrix.flat[:: len(root) + 1] += 1.0 + _rounding(matrix)
        return matrix, root * projection

    def maximum(self, starts: Sequence[Floats]) -> Floats:
        """The most likely logarithms of the hyperparameters, (h,): the best of the descents from several starts.

        Args:
            starts: (h,) each, at least one.

        Raises:
            ArithmeticError: the evidence is finite at none of them.
        """
        hyperprior, sought = self.hyperprior, self.hyperprior.is_sought
        best, lowest = hyperprior.within(starts[0]), np.inf
        if not sought.any():
            return best
        bounds = np.column_stack([hyperprior.lowest, hyperprior.highest])[sought]
        begun = [(start, *self._at(start)) for start in map(hyperprior.within, starts)]
        for start, first, slope, bend in sorted(begun, key=lambda at: at[1]):
            if first > lowest + _BEHIND:
                break
            # In standard deviations of each, where the cost bends like a square.
            place, unit = start[sought], 1.0 / np.sqrt(bend[sought])

            def cost(part: Floats, start: Floats = start, unit: Floats = unit) -> Known:
                eta = start.copy()
                eta[sought] += unit * part
                value, gradient, _ = self._at(hyperprior.within(eta))
                return value, gradient[sought] * unit

            low, high = ((bounds - place[:, None]) / unit[:, None]).T
            least, found = _descended(cost, (first, slope[sought] * unit), low, high, _LONGEST / unit)
            if np.isfinite(least) and least < lowest:
                lowest, best = least, start.copy()
                best[sought] += unit * found
                best = hyperprior.within(best)
        if not np.isfinite(lowest):
            raise ArithmeticError("Evidence.maximum: the evidence is finite at none of the starts.")
        there = self.conditional(best)
        self._known.clear()  # of a result that is kept only this is asked for again
        self._known[best.tobytes()] = there
        return best

    def covariance(self, eta: Floats) -> Floats:
        """Of the logarithms of the hyperparameters, by the curvature at the maximum, (h, h).

        One that lies at a bound is taken as known.

        Args:
            eta: at the maximum, (h,).
        """
        hyperprior = self.hyperprior
        inside = (eta > hyperprior.lowest + _AT_BOUND) & (eta < hyperprior.highest - _AT_BOUND)
        places = np.flatnonzero(hyperprior.is_sought & inside)
        covariance = np.zeros((len(eta), len(eta)))
        if not len(places):
            return covariance
        spread = hyperprior.spread_at(eta)[places]
        curvature = self.curvature(eta, places) * spread[:, None] * spread
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        root = spread[:, None] * vectors / np.sqrt(np.maximum(values, 1.0))  # in no direction wider than was believed
        covariance[np.ix_(places, places)] = root @ root.T
        return covariance

    def curvature(self, eta: Floats, places: Ints) -> Floats:
        """Second derivatives of minus the logarithm, (q, q), exact but for those of the variances.

        With S^-1 scaled by the roots of v, z = m / sqrt(v), D_b the slopes of log v by a hyperparameter b, N_b what
        S^-1 loses with the groups' variances by it, and p_b = D_b z - c_b, where c_b is as much of what the residuals
        at m pull: S changes by S (D_b + N_b) S and z by S p_b, and the gradient is differentiated by these.

        Args:
            eta: logarithms of the hyperparameters, (h,).
            places: which of them, (q,).
        """
        problem = self.problem
        (noise, by_noise), (logs, slopes) = self.noise(eta), self.prior(eta)
        law = self._law(eta, noise, logs)
        if law is None:
            raise np.linalg.LinAlgError("Evidence.curvature: what is known of the unknowns is not finite.")
        precision, root, mean, inverse = np.exp(-noise), law.root, law.mean, law.inverse
        spread, moved = law.covariance, root * mean
        upon = problem.projection - problem.information @ moved  # what the residuals of each group pull, (g, k)
        data = problem.square + problem.tail - 2.0 * problem.projection @ moved
        data += problem.upper @ (spread + moved[:, None] * moved).ravel()
        told, fit = 1.0 - np.diag(inverse) - mean**2, problem.count - precision * data
        sloped, weighed = slopes[places], by_noise[places] * precision
        pulls = sloped * mean - root * (weighed @ upon)
        grown = sloped[:, :, None] * inverse  # (D_b + N_b) S
        for each in np.flatnonzero(weighed.any(axis=1)):
            part = (weighed[each] @ problem.information.reshape(len(precision), -1)).reshape(inverse.shape)
            grown[each] += (root[:, None] * part * root) @ inverse
        flat = (len(places), -1)
        found = (sloped * (np.diag(inverse) + mean**2)) @ sloped.T + (by_noise[places] * data) @ weighed.T
        found -= grown.reshape(flat) @ grown.transpose(0, 2, 1).reshape(flat).T + 2.0 * pulls @ inverse @ pulls.T
        for column, place in enumerate(places):
            nearby = eta.copy()
            nearby[place] += _STEP
            found[:, column] += (self.prior(nearby)[1] - slopes)[places] @ told / _STEP
            found[:, column] += (self.noise(nearby)[1] - by_noise)[places] @ fit / _STEP
        return 0.5 * found + np.diag(self.hyperprior.bend_at(eta)[places])


@lru_cache
def _doubled(count: int) -> Floats:
    """Weights of the upper triangle in the product of two symmetric matrices, (k, k)."""
    return 2.0 * np.triu(np.ones((count, count))) - np.eye(count)


def _descended(
    cost: Callable[[Floats], Known], first: Known, low: Floats, high: Floats, longest: Floats
) -> tuple[float, Floats]:
    """The least of a smooth cost within bounds, and where, (q,), by projected BFGS from zero.

    For the handful of unknowns here, a step in which takes less than a library spends on calling itself.

    Args:
        cost: value and gradient, in units in which the cost bends about like a square.
        first: the same at zero.
        low: least values, (q,).
        high: largest values, (q,).
        longest: steps, (q,).
    """
    place, (value, slope), inverse = np.zeros(len(low)), first, np.eye(len(low))
    for _ in range(_STEPS):
        held = ((place <= low) & (slope > 0.0)) | ((place >= high) & (slope < 0.0))
        if not np.abs(slope[~held]).max(initial=0.0) > _FLAT:
            break
        free = np.where(held, 0.0, slope)
        step = np.where(held, 0.0, -inverse @ free)
        if not step @ free < 0.0:
            step, inverse = -free, np.eye(len(low))
        step *= min(1.0, 1.0 / (np.abs(step) / longest).max())
        for _ in range(_TRIALS):
            trial = np.clip(place + step, low, high)
            reached, there = cost(trial)
            if reached <= value + _ENOUGH * float(slope @ (trial - place)):
                break
            step *= 0.3
        else:
            break
        moved, turned = trial - place, there - slope
        bend, gained = float(moved @ turned), value - reached
        place, value, slope = trial, reached, there
        if gained <= _GAIN * max(abs(value), 1.0):
            break
        if bend > 0.0:
            wanted = inverse @ turned
            inverse = inverse + (bend + turned @ wanted) / bend**2 * moved[:, None] * moved
            inverse -= (wanted[:, None] * moved + moved[:, None] * wanted) / bend
    return value, place


def _rounding(matrix: Floats) -> float:
    """What is lost of a diagonal where unknowns of very different sizes are told."""
    return float(np.finfo(float).eps * np.trace(matrix))
