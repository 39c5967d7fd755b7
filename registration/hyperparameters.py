"""The noise of a cloud and the size of the forces, found from the cloud itself: evidence of a linearised problem.

With residuals linearised about a state, data y = J c + noise have the evidence p(y | s, sigma) of a normal law with
covariance sigma^2 W^-1 + s^2 J J^T (MacKay 1992), diagonal in the eigenvectors of J^T W J. It is taken on a grid of
both scales with wide log-normal priors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Floats = NDArray[np.float64]
_STEP = 0.1  # of the logarithm of each scale on its grid
_REACH = 3.5  # of the grid, in standard deviations of the prior
_SEEN = 1e-13  # information relative to the largest, below which a direction is round-off


@dataclass(frozen=True)
class LogNormalPrior:
    """What is believed of a positive scale beforehand: log-normal within bounds.

    Args:
        median: the scale expected.
        spread: standard deviation of its logarithm; 0 for a scale that is known.
        minimum: no smaller value is believed.
        maximum: no larger value is believed.
    """

    median: float
    spread: float
    minimum: float = 0.0
    maximum: float = np.inf

    def __post_init__(self) -> None:
        if not (0.0 < self.median < np.inf and 0.0 <= self.spread < np.inf and 0.0 <= self.minimum < np.inf):
            raise ValueError(
                f"LogNormalPrior: expected a positive median, a spread and a least value of 0 or more, got {self}."
            )
        if not self.maximum > 0.0:
            raise ValueError(f"LogNormalPrior.maximum: expected a positive number, got {self.maximum}.")

    def with_minimum(self, minimum: float) -> LogNormalPrior:
        """The same belief with a larger least value."""
        return replace(self, minimum=max(self.minimum, minimum))

    @cached_property
    def grid(self) -> tuple[Floats, Floats]:
        """Logarithms of values, multiples of one step, (g,), and the logarithm of their probability, (g,)."""
        middle = np.log(min(max(self.median, self.minimum), self.maximum))
        if self.spread == 0.0:
            return np.round([middle / _STEP]) * _STEP, np.zeros(1)
        low = middle - _REACH * self.spread
        if self.minimum > 0.0:
            low = max(low, np.log(self.minimum))
        high = min(middle + _REACH * self.spread, np.log(self.maximum))
        steps = np.arange(np.ceil(low / _STEP), np.floor(high / _STEP) + 1)
        return _STEP * steps, -0.5 * ((_STEP * steps - np.log(self.median)) / self.spread) ** 2


@dataclass(frozen=True, eq=False)
class Linearised:
    """A weighted linear problem y = J c + noise in the eigenvectors of J^T W J.

    Args:
        vectors: V, (k, k).
        information: eigenvalues, (k,), 1/m^2 of unit noise: how strongly the data see each direction.
        projections: V^T J^T W y, (k,).
        rest: part of y^T W y that no coefficients explain.
        count: points that carry weight.
    """

    vectors: Floats
    information: Floats
    projections: Floats
    rest: float
    count: float

    def promised(self, scales: Hyperparameters, coefficients: Floats) -> float:
        """Root mean square change of the residuals by the best step at some scales, metres.

        Args:
            scales: noise and force scale.
            coefficients: at the state, (k,).
        """
        best = self.projections / (self.information + (scales.noise / scales.force) ** 2)
        step = best - self.vectors.T @ coefficients
        return float(np.sqrt(float(self.information @ step**2) / max(self.count, 1.0)))


def linearised(
    jacobian: Floats,
    residuals: Floats,
    weights: Floats,
    coefficients: Floats,
    consistency: float,
    noise: float = 1.0,
    beside: tuple[Floats, Floats] | None = None,
    shares: Floats | None = None,
) -> Linearised:
    """The linear problem about a state.

    Unknowns beside those whose scale is wanted are integrated out with their unit variance at the noise so far: in the
    formulas W gives way to (W^-1 + N N^T / sigma^2)^-1.

    Args:
        jacobian: derivative of the residuals by the coefficients, (p, k).
        residuals: at the state, (p,), metres.
        weights: of the points, (p,), between 0 and 1.
        coefficients: at the state, (k,).
        consistency: of the loss that gave the weights.
        noise: standard deviation of a point's distance so far, metres.
        beside: N, derivative of the residuals by unknowns of unit variance, (p, q), and their values, (q,).
        shares: part of the variance of each point's distance that is its noise so far, (p,); all of it if not given.
    """
    count = jacobian.shape[1]
    columns, values = (np.zeros((len(residuals), 0)), np.zeros(0)) if beside is None else beside
    root = np.sqrt(weights if shares is None else weights * shares)
    stacked = np.column_stack([jacobian, jacobian @ coefficients - residuals + columns @ values, columns / noise])
    stacked *= root[:, None]
    products = stacked.T @ stacked
    if len(values):
        across = products[count + 1 :, : count + 1]
        factor = cho_factor(np.eye(len(values)) + products[count + 1 :, count + 1 :], check_finite=False)
        products = products[: count + 1, : count + 1] - across.T @ cho_solve(factor, across, check_finite=False)
    matrix, pulled, square = products[:count, :count], products[:count, count], float(products[count, count])
    information, vectors = np.linalg.eigh(matrix)
    information = np.maximum(np.asarray(information, dtype=np.float64), 0.0)
    projections: Floats = vectors.T @ pulled
    seen = information > _SEEN * information.max(initial=0.0)
    explained = float((projections[seen] ** 2 / information[seen]).sum())
    rest = max(square - explained, 0.0) / consistency
    return Linearised(vectors, information, projections, rest, float(weights.sum()))


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """The two scales after the data.

    Args:
        noise: standard deviation of a point's distance, metres.
        force: standard deviation of the coefficients.
        spread: standard deviation of the logarithms of both, (2,).
    """

    noise: float
    force: float
    spread: tuple[float, float]


def estimate_hyperparameters(problem: Linearised, noise: LogNormalPrior, force: LogNormalPrior) -> Hyperparameters:
    """Posterior geometric means of noise and force scale.

    Args:
        problem: the linearised problem.
        noise: prior of the noise.
        force: prior of the coefficients' scale.
    """
    log_noise, noise_prior = noise.grid
    log_force, force_prior = force.grid
    seen = problem.information > _SEEN * problem.information.max(initial=0.0)
    information, projections = problem.information[seen], problem.projections[seen]
    # Both grids have one step: sums over the directions depend on the ratio of the scales alone.
    ratios = _STEP * np.arange(
        round((log_force[0] - log_noise[-1]) / _STEP), round((log_force[-1] - log_noise[0]) / _STEP) + 1
    )
    stiffness_scaling = 1.0 + np.exp(2.0 * ratios)[:, None] * information
    logarithms, explained = (
        np.log(stiffness_scaling).sum(axis=1),
        (projections**2 / information / stiffness_scaling).sum(axis=1),
    )
    index = np.arange(len(log_force))[None, :] - np.arange(len(log_noise))[:, None] + len(log_noise) - 1
    count = float(max(problem.count, len(information) + 1.0))
    chance = -0.5 * (logarithms[index] + (explained[index] + problem.rest) * np.exp(-2.0 * log_noise)[:, None])
    chance += (noise_prior - count * log_noise)[:, None] + force_prior[None, :]
    chance = np.exp(chance - chance.max())
    chance /= chance.sum()
    noise_found, noise_spread = _moments(log_noise, chance.sum(axis=1))
    force_found, force_spread = _moments(log_force, chance.sum(axis=0))
    return Hyperparameters(float(np.exp(noise_found)), float(np.exp(force_found)), (noise_spread, force_spread))


def _moments(values: Floats, chance: Floats) -> tuple[float, float]:
    mean = float(values @ chance)
    return mean, float(np.sqrt(max(float((values - mean) ** 2 @ chance), 0.0)))
