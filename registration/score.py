"""Whether a cloud asks for something that is no unknown of the registration: Rao's score test at the state found.

With distances y = J theta + c a + noise about the state, all unknowns theta are integrated out with what is believed of
them; of a the estimate is (c' V c)^-1 c' V y with V = (C + J P^-1 J')^-1, and its square in that metric is chi-square
where a is zero (Rao 1948). By Woodbury's formula V y are the weighted residuals that the registration has left. Robust
weights make the statistic smaller where the model is right, so that chances are upper bounds there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from .hyperparameters import LENGTH, SHARED
from .policy import ACCURACY

if TYPE_CHECKING:
    from .evidence import Hyperprior
    from .local_model import LocalModel
    from .parameters.correlated_noise import CorrelatedNoise
    from .problem import Problem

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Score:
    """What a cloud says of parameters that were left out.

    Args:
        estimate: of each to first order, (m,).
        statistic: its square over its covariance: chi-square with m degrees of freedom where all are zero.
    """

    estimate: Floats
    statistic: float

    @property
    def p_value(self) -> float:
        """Chance of so large a statistic where all are zero."""
        return float(chdtrc(len(self.estimate), self.statistic))


def scores(local: LocalModel, *columns: Floats) -> list[Score | None]:
    """The test at the end, of each of several sets of parameters; None of which the cloud tells nothing.

    Args:
        local: the objective's model there.
        columns: derivatives of the distances by the parameters of each set, (p, m).
    """
    every = np.hstack(columns)
    pull, information = local.score_of(every)
    scales = np.square(every / local.deviations[:, None]).sum(axis=0)
    ends = np.cumsum([each.shape[1] for each in columns])
    parts = [slice(end - each.shape[1], end) for end, each in zip(ends, columns, strict=True)]
    lost = float(np.finfo(float).eps) * len(every)
    return [_score(pull[part], information[part, part], lost * float(scales[part].max(initial=0.0))) for part in parts]


def _score(pull: Floats, information: Floats, least: float) -> Score | None:
    values, vectors = np.linalg.eigh(information)
    if not len(values) or not values[0] > least:
        return None
    estimate = vectors @ ((vectors.T @ pull) / values)
    return Score(estimate, float(pull @ estimate))


def gain_by_shared_noise(local: LocalModel, problem: Problem) -> tuple[float, float, float]:
    """What noise that neighbours share may add to the logarithm of the evidence, beyond what is believed of it.

    With s the slope by the modes' coefficients, M its covariance, V their variances for a length, and t the variance of
    such noise, the evidence grows by the factor of logarithm (s' (V^-1 / t + M)^-1 s - log |1 + t M V|) / 2. That costs
    an eigendecomposition, and is looked at where the parabola about t = 0 promises something: its slope is
    U = (s' V s - tr(M V)) / 2, its bend I = tr(M V M V) / 2, its top U^2 / (2 I). Robust weights make s smaller than M
    tells, which is made good, as far as normal noise would need it: points nearer than their noise is believed to be,
    as those without any are, say nothing of their neighbours by that. The other hyperparameters stay as they are. The
    smoothest modes are asked first.

    Args:
        local: the objective's model at the end of a registration without shared noise.
        problem: the same with it.

    Returns:
        The most of it, and the logarithms of size and length where that is, metres; minus infinity where none promises
        anything worth looking for.
    """
    best = (-np.inf, 0.0, 0.0)
    if problem.shared is None:
        return best
    few = _SharedNoise(local, problem.shared.leading(ACCURACY.first_modes), problem.hyperprior)
    if few.promised.max() < ACCURACY.worth:
        return best
    every = _SharedNoise(local, problem.shared, problem.hyperprior)
    found = max(best, *(every.best(length) for length in every.lengths))
    return found if found[0] >= ACCURACY.worth else best


class _SharedNoise:
    """Noise that neighbours share beside a local model without it.

    Args:
        local: the objective's model at the end of a registration without shared noise.
        shared: that noise.
        hyperprior: of its size and length, among others.
    """

    def __init__(self, local: LocalModel, shared: CorrelatedNoise, hyperprior: Hyperprior) -> None:
        self._modes = shared.modes
        pull, self._covariance = local.score_of(shared.by_points(local.evaluation))
        weights, scaled = local.weights, local.problem.residuals(local.evaluation, local.point_noise) / local.deviations
        shrunk = float(np.sum((weights * scaled) ** 2) / max(weights.sum(), 1e-300))
        self._pull = pull / np.sqrt(max(shrunk, local.loss.shrinkage))
        median, high = float(hyperprior.median[SHARED]), float(hyperprior.highest[SHARED])
        self._sizes = np.linspace(max(float(hyperprior.lowest[SHARED]), median), high, ACCURACY.sizes)
        self._costs = 0.5 * ((self._sizes - median) / hyperprior.spread[SHARED]) ** 2
        self._hyperprior = hyperprior
        self.lengths: list[float] = np.linspace(
            hyperprior.lowest[LENGTH], hyperprior.highest[LENGTH], ACCURACY.lengths
        ).tolist()

    def _variances(self, length: float) -> Floats:
        """Of the coefficients of a field of unit variance, for the logarithm of a length, (c,)."""
        return np.tile(np.exp(self._modes.log_variances(np.exp(length))[0]), 3)

    @property
    def promised(self) -> Floats:
        """Top of the parabola for each length; 0 where it falls."""
        variances = np.array([self._variances(length) for length in self.lengths])
        slopes = 0.5 * variances @ (self._pull**2 - np.diag(self._covariance))
        bends = 0.5 * ((variances @ self._covariance**2) * variances).sum(axis=1)
        found: Floats = 0.5 * np.maximum(slopes, 0.0) ** 2 / bends
        return found

    def best(self, length: float) -> tuple[float, float, float]:
        """The most of the gain for the logarithm of a length, and the logarithms of size and length, metres."""
        root = np.sqrt(self._variances(length))
        slopes = root * self._pull
        values, vectors = np.linalg.eigh(root[:, None] * self._covariance * root)
        grown = np.exp(2.0 * self._sizes)[:, None] * np.maximum(values, 0.0)
        squares = np.exp(2.0 * self._sizes)[:, None] * (vectors.T @ slopes) ** 2
        off = (length - self._hyperprior.median[LENGTH]) / self._hyperprior.spread[LENGTH]
        gains = 0.5 * (squares / (1.0 + grown) - np.log1p(grown)).sum(axis=1) - self._costs - 0.5 * off**2
        top = int(gains.argmax())
        return float(gains[top]), float(self._sizes[top]), length


def by_scale(local: LocalModel) -> Floats:
    """Derivative of the distances by the logarithm of the cloud's scale about its middle, (p, 1), metres.

    Each point is taken where it is on the surface, without its noise. With it this derivative and the distances would
    hold the same noise, and every cloud would look larger than its organ, the more so the noisier it is.
    """
    match = local.evaluation.match
    return -(np.einsum("pi,pi->p", match.directions, _arms(local)) + match.distances)[:, None]


def by_rigid_motion(local: LocalModel) -> Floats:
    """Derivative of the distances by a turn, radians, and a shift, metres, of the cloud about its middle, (p, 6)."""
    normals, arms, motion = local.evaluation.match.directions, _arms(local), np.empty((len(local.weights), 6))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # the cross product, written out
        motion[:, i] = arms[:, k] * normals[:, j] - arms[:, j] * normals[:, k]
    motion[:, 3:] = -normals
    return motion


def _arms(local: LocalModel) -> Floats:
    """From the middle of the points that count to each point, (p, 3), metres."""
    cloud, kept = local.evaluation.cloud, local.weights > 0.0
    return np.asarray(cloud - cloud[kept].mean(axis=0)) if kept.any() else cloud - cloud.mean(axis=0)
