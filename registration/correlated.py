"""Noise that neighbouring points share: whether a cloud has it, how much, over what length, and what it looks like.

A depth camera's noise has patches (multipath, smoothing, calibration). Taken for independent, it can only be explained
by forces. Here a smooth field of shifts v, each component with covariance a^2 exp(-d^2 / 2 l^2), is added to each
point's own noise: distances along normals n err by n . v. The evidence of both pictures decides (MacKay 1992; the field
is the discrepancy of Kennedy and O'Hagan 2001).
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
from threadpoolctl import threadpool_limits

from .hyperparameters import LogNormalPrior

Floats = NDArray[np.float64]
_ASKED, _FEWEST = 300, 30  # points that the evidence is taken from, and of which it is
_CHOSEN = 1000  # points among which centres are chosen
_MOST = 400  # centres
_ROUND_OFF = 1e-9
_NEAR = 0.5  # of the correlation
_LEFT = 0.01  # of the variance at any point is not carried by the centres
_SIZE, _SIZE_SPREAD = 5e-4, 1.0  # metres, and of its logarithm: what is believed of such noise where there is some
_LENGTH, _LENGTH_SPREAD = 0.15, 0.5  # of the cloud's extent, and of its logarithm
_STARTS = 0.5, 1.0, 2.0  # times the length that is believed
_LARGEST, _LONGEST = 5e-3, 0.4  # metres, of the extent: beyond, it is no noise but another place or shape
_BELOW = 0.8  # of the largest
_QUIET, _STRONG = 0.2, 10.0  # of the noise and the forces that are expected: where forces explain the noise
_EVALUATIONS = 160
_NEVER = 1e12  # minus the logarithm of the chance of scales with no covariance
_EXACT = 0.05  # of the logarithms sought


@dataclass(frozen=True, eq=False)
class CorrelatedNoise:
    """A smooth field that shifts the points of a cloud, seen through their distances, of coefficients of unit variance.

    Args:
        size: standard deviation of each component, metres.
        length: over which neighbours share it, metres.
        centres: points that carry it, (q, 3), metres, in the cloud's coordinates.
        normals: of the surface there, (q, 3), on the same axes.
    """

    size: float
    length: float
    centres: Floats
    normals: Floats

    @classmethod
    def over(cls, points: Floats, normals: Floats, size: float, length: float) -> CorrelatedNoise:
        """Noise of a cloud, carried by some of its points: by so many that they tell the others' (pivoted Cholesky).

        Args:
            points: (p, 3), metres.
            normals: of the surface there, (p, 3).
            size: standard deviation of each component, metres.
            length: over which neighbours share it, metres.
        """
        every = slice(None, None, -(-len(points) // _CHOSEN))
        points, normals = points[every], normals[every]
        inflation_factor = _nearness(points, points, length) * (normals @ normals.T)
        _, pivots, rank, _ = dpstrf(inflation_factor, tol=_LEFT)
        chosen = pivots[: min(int(rank), _MOST)] - 1
        return cls(size, length, points[chosen], normals[chosen])

    def resized(self, factor: float) -> CorrelatedNoise:
        """Noise so many times as large, carried by the same points."""
        return replace(self, size=factor * self.size)

    def reaches(self, points: Floats) -> float:
        """Part of the points that lie about as near to the points that carry it as these do to each other."""
        return float((self.near(points).max(axis=1) > _NEAR).mean())

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return len(self.centres)

    def near(self, points: Floats) -> Floats:
        """How much noise points have in common with those that carry it, (p, q)."""
        return _nearness(points, self.centres, self.length)

    @cached_property
    def _mixing(self) -> Floats:
        """From coefficients to weights of the points that carry the noise, (q, q), metres."""
        inflation_factor = _nearness(self.centres, self.centres, self.length) * (self.normals @ self.normals.T)
        inflation_factor[np.diag_indices(self.count)] += _ROUND_OFF
        return self.size * solve_triangular(cholesky(inflation_factor, lower=True), np.eye(self.count), lower=True).T

    def shifts(self, coefficients: Floats, near: Floats, normals: Floats) -> Floats:
        """What some coefficients, (q,), make of the distances, (p,), metres; see `patterns`."""
        found: Floats = (near * (normals @ self.normals.T)) @ (self._mixing @ coefficients)
        return found

    def patterns(self, near: Floats, normals: Floats) -> Floats:
        """What each coefficient makes of the distances of points, (p, q), metres.

        Args:
            near: what `near` says of the points, (p, q).
            normals: of the surface at them, (p, 3), on the cloud's axes.
        """
        found: Floats = (near * (normals @ self.normals.T)) @ self._mixing
        return found


def _nearness(first: Floats, second: Floats, length: float) -> Floats:
    return np.asarray(np.exp(-0.5 / length**2 * cdist(first, second, "sqeuclidean")))


@dataclass(frozen=True, eq=False)
class Linear:
    """A cloud's distances, linear in the unknowns about a state, of some of its points.

    Args:
        points: (p, 3), metres, in the cloud's coordinates.
        normals: of the surface at them, (p, 3), on the same axes.
        data: distances that the unknowns are to make zero, less what they make of them, (p,), metres.
        forces: derivative by the coefficients of the forces, (p, k), metres a newton.
        beside: the same by unknowns of unit variance, (p, m), metres.
        left_out: standard deviation of what neither explains, (p,), metres.
        weights: of the points, (p,), positive.
    """

    points: Floats
    normals: Floats
    data: Floats
    forces: Floats
    beside: Floats
    left_out: Floats
    weights: Floats

    def some(self) -> Linear:
        """So few points that their covariance is at hand."""
        every = slice(None, None, max(1, -(-len(self.data) // _ASKED)))
        names = ("points", "normals", "data", "forces", "beside", "left_out", "weights")
        return Linear(**{name: getattr(self, name)[every] for name in names})


def is_noise(size: float) -> bool:
    """Whether so large a shift that neighbours share, metres, may be one of noise."""
    return size < _BELOW * _LARGEST


def find_correlated(
    linear: Linear, noise: LogNormalPrior, force: LogNormalPrior, worth: float
) -> tuple[float, float] | None:
    """Size and length of the noise that neighbours share, metres; None where the cloud does without.

    A size near the largest (`is_noise`) would be larger, if it might: it stands for what no force explains.

    Both pictures are taken at their most likely scales, with what is believed of these beforehand.

    Args:
        linear: distances about a state.
        noise: what is believed of the points' own noise.
        force: of the forces' size.
        worth: least logarithm of the odds for it.
    """
    some = linear.some()
    extent = float(np.linalg.norm(np.ptp(some.points, axis=0))) if len(some.points) else 0.0
    if len(some.points) < _FEWEST or extent == 0.0:
        return None
    by_forces, others = some.forces @ some.forces.T, some.beside @ some.beside.T + np.diag(some.left_out**2)
    squares, facing = cdist(some.points, some.points, "sqeuclidean"), some.normals @ some.normals.T
    hyperpriors = [noise, force, LogNormalPrior(_SIZE, _SIZE_SPREAD), LogNormalPrior(_LENGTH * extent, _LENGTH_SPREAD)]
    known = np.array([hyperprior.spread == 0.0 for hyperprior in hyperpriors])
    medians = np.array([hyperprior.median for hyperprior in hyperpriors])

    def unlikely(logarithms: Floats) -> float:
        scales = np.where(known[: len(logarithms)], medians[: len(logarithms)], np.exp(logarithms))
        scales[0] = max(scales[0], noise.minimum)
        if len(scales) > 2 and (scales[2] > _LARGEST or scales[3] > _LONGEST * extent):
            return _NEVER
        covariance = others + scales[1] ** 2 * by_forces
        if len(scales) > 2:
            covariance += scales[2] ** 2 * facing * np.exp(-0.5 / scales[3] ** 2 * squares)
        covariance[np.diag_indices(len(covariance))] += scales[0] ** 2 / some.weights
        try:
            factor = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError:
            return _NEVER
        off = solve_triangular(factor, some.data, lower=True, check_finite=False)
        believed = sum(
            ((log - np.log(hyperprior.median)) / hyperprior.spread) ** 2
            for log, hyperprior in zip(logarithms, hyperpriors, strict=False)
            if hyperprior.spread > 0.0
        )
        return 0.5 * float(off @ off + believed) + float(np.log(np.diag(factor)).sum())

    def best(count: int, starts: list[list[float]]) -> tuple[float, Floats]:
        options = {"xatol": _EXACT, "fatol": 0.1, "maxfev": _EVALUATIONS}
        found = [minimize(unlikely, np.log(start), method="Nelder-Mead", options=options) for start in starts]
        minimum = min(found, key=lambda one: one.fun)
        return float(minimum.fun), np.exp(minimum.x)

    median = [max(noise.median, noise.minimum), force.median]
    with threadpool_limits(1, "blas"):  # for matrices of this size several threads only wait for each other
        without, _ = best(2, [median, [max(_QUIET * noise.median, noise.minimum), _STRONG * force.median]])
        with_it, scales = best(4, [[*median, _SIZE, factor * hyperpriors[3].median] for factor in _STARTS])
    if without - with_it < worth:
        return None
    return float(scales[2]), float(scales[3])
