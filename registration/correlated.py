"""Noise that neighbouring points share: whether a cloud has it, how much, over what length, and what it looks like.

A depth camera's noise has patches (multipath, smoothing, calibration). Taken for independent, it can only be explained
by forces. Here distances err by a smooth field with covariance a^2 exp(-d^2 / 2 l^2) beside each point's own noise, and
the evidence of both pictures decides (MacKay 1992; the smooth field is the discrepancy of Kennedy and O'Hagan 2001).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.linalg.lapack import dpstrf
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from .evidence import Scale

Floats = NDArray[np.float64]
_ASKED = 300  # points that the evidence is taken from
_CHOSEN = 1000  # points among which centres are chosen
_MOST = 120  # centres
_LEFT = 0.01  # of the variance at any point is not carried by the centres
_SIZE, _SIZE_SPREAD = 5e-4, 1.0  # metres, and of its logarithm: what is believed of such noise where there is some
_LENGTH, _LENGTH_SPREAD = 0.15, 0.5  # of the cloud's extent, and of its logarithm
_STARTS = 0.5, 1.0, 2.0  # times the length that is believed
_EVALUATIONS = 160
_EXACT = 0.05  # of the logarithms sought


@dataclass(frozen=True, eq=False)
class CorrelatedNoise:
    """A smooth field of distances, with coefficients of unit variance.

    Args:
        size: standard deviation, metres.
        length: over which neighbours share it, metres.
        centres: points that carry it, (q, 3), metres, in the cloud's coordinates.
    """

    size: float
    length: float
    centres: Floats

    @classmethod
    def over(cls, points: Floats, size: float, length: float) -> CorrelatedNoise:
        """Noise of a cloud, carried by some of its points: by so many that they tell the others' (pivoted Cholesky).

        Args:
            points: (p, 3), metres.
            size: standard deviation, metres.
            length: over which neighbours share it, metres.
        """
        chosen = points[:: -(-len(points) // _CHOSEN)]
        _, pivots, rank, _ = dpstrf(_alike(chosen, chosen, length), tol=_LEFT)
        return cls(size, length, chosen[pivots[: min(int(rank), _MOST)] - 1])

    def of(self, points: Floats) -> CorrelatedNoise:
        """The same kind of noise of another cloud, (p, 3)."""
        return self.over(points, self.size, self.length)

    def resized(self, factor: float) -> CorrelatedNoise:
        """Noise so many times as large, carried by the same points."""
        return replace(self, size=factor * self.size)

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return len(self.centres)

    @cached_property
    def _root(self) -> Floats:
        every = _alike(self.centres, self.centres, self.length)
        every[np.diag_indices(self.count)] += 1e-9
        return np.asarray(cholesky(every, lower=True))

    def patterns(self, points: Floats) -> Floats:
        """What each coefficient adds to the distances of points, (p, q), metres.

        Args:
            points: of the cloud, (p, 3), metres; all of it or some.
        """
        by_centres = _alike(self.centres, points, self.length)
        found: Floats = self.size * solve_triangular(self._root, by_centres, lower=True).T
        return found


def _alike(first: Floats, second: Floats, length: float) -> Floats:
    """Correlation of the noise of two sets of points."""
    return np.asarray(np.exp(-0.5 / length**2 * cdist(first, second, "sqeuclidean")))


@dataclass(frozen=True, eq=False)
class Linear:
    """A cloud's distances, linear in the unknowns about a state, of some of its points.

    Args:
        points: (p, 3), metres.
        data: distances that the unknowns are to make zero, less what they make of them, (p,), metres.
        forces: derivative by the coefficients of the forces, (p, k), metres a newton.
        beside: the same by unknowns of unit variance, (p, m), metres.
        left_out: standard deviation of what neither explains, (p,), metres.
        weights: of the points, (p,), positive.
    """

    points: Floats
    data: Floats
    forces: Floats
    beside: Floats
    left_out: Floats
    weights: Floats

    def some(self) -> Linear:
        """So few points that their covariance is at hand."""
        every = slice(None, None, -(-len(self.data) // _ASKED))
        names = ("points", "data", "forces", "beside", "left_out", "weights")
        return Linear(**{name: getattr(self, name)[every] for name in names})


def find_correlated(linear: Linear, noise: Scale, force: Scale, worth: float) -> tuple[float, float] | None:
    """Size and length of the noise that neighbours share, metres; None where the cloud does without.

    Both pictures are taken at their most likely scales, with what is believed of these beforehand.

    Args:
        linear: distances about a state.
        noise: what is believed of the points' own noise.
        force: of the forces' size.
        worth: least logarithm of the odds for it.
    """
    some = linear.some()
    by_forces, others = some.forces @ some.forces.T, some.beside @ some.beside.T + np.diag(some.left_out**2)
    squares = cdist(some.points, some.points, "sqeuclidean")
    extent = float(np.linalg.norm(np.ptp(some.points, axis=0)))
    beliefs = [noise, force, Scale(_SIZE, _SIZE_SPREAD), Scale(_LENGTH * extent, _LENGTH_SPREAD)]

    def unlikely(logarithms: Floats) -> float:
        scales = np.maximum(np.exp(logarithms), noise.least * np.eye(len(logarithms))[0])
        covariance = others + scales[1] ** 2 * by_forces
        if len(scales) > 2:
            covariance += scales[2] ** 2 * np.exp(-0.5 / scales[3] ** 2 * squares)
        covariance[np.diag_indices(len(covariance))] += scales[0] ** 2 / some.weights
        try:
            factor = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError:
            return np.inf
        off = solve_triangular(factor, some.data, lower=True, check_finite=False)
        believed = sum(
            ((log - np.log(belief.median)) / belief.spread) ** 2
            for log, belief in zip(logarithms, beliefs, strict=False)
            if belief.spread > 0.0
        )
        return 0.5 * float(off @ off + believed) + float(np.log(np.diag(factor)).sum())

    def best(count: int, starts: list[list[float]]) -> tuple[float, Floats]:
        options = {"xatol": _EXACT, "fatol": 0.1, "maxfev": _EVALUATIONS}
        found = [minimize(unlikely, np.log(start), method="Nelder-Mead", options=options) for start in starts]
        least = min(found, key=lambda one: one.fun)
        return float(least.fun), np.exp(least.x)

    median = [max(noise.median, noise.least), force.median]
    without, _ = best(2, [median, [noise.least * 1.2, 10.0 * force.median]])
    with_it, scales = best(4, [[*median, _SIZE, factor * beliefs[3].median] for factor in _STARTS])
    if without - with_it < worth:
        return None
    return float(scales[2]), float(scales[3])
