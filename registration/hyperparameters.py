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

Floats = NDArray[np.float64]
_STEP = 0.1  # of the logarithm of each scale on its grid
_REACH = 3.5  # of the grid, in standard deviations of the prior
_SEEN = 1e-13  # information relative to the largest, below which a direction is round-off


@dataclass(frozen=True)
class LogNormalPrior:
    """What is believed of a positive scale beforehand: log-normal.

    Args:
        median: the scale expected.
        spread: standard deviation of its logarithm; 0 for a scale that is known.
        minimum: no smaller value is believed.
    """

    median: float
    spread: float
    minimum: float = 0.0

    def __post_init__(self) -> None:
        if not (0.0 < self.median < np.inf and 0.0 <= self.spread < np.inf and 0.0 <= self.minimum < np.inf):
            raise ValueError(
                f"LogNormalPrior: expected a positive median, a spread and a least value of 0 or more, got {self}."
            )

    def with_minimum(self, minimum: float) -> LogNormalPrior:
        """The same belief with a larger least value."""
        return replace(self, minimum=max(self.minimum, minimum))

    @cached_property
    def grid(self) -> tuple[Floats, Floats]:
        """Logarithms of values, multiples of one step, (g,), and the logarithm of their probability, (g,)."""
        middle = np.log(max(self.median, self.minimum))
        if self.spread == 0.0:
            return np.round([middle / _STEP]) * _STEP, np.zeros(1)
        low = middle - _REACH * self.spread
        if self.minimum > 0.0:
            low = max(low, np.log(self.minimum))
        steps = np.arange(np.ceil(low / _STEP), np.floor((middle + _REACH * self.spread) / _STEP) + 1)
        return _STEP * steps, -0.5 * ((_STEP * steps - np.log(self.median)) / self.spread) ** 2


@dataclass(frozen=True)
class Hyperparameters:
    """The scales after the data.

    Args:
        noise: standard deviation of a point's distance, metres.
        force: standard deviation of the coefficients of the forces.
        shared: standard deviation of the noise that neighbours share, metres.
        length: over which they share it, metres.
        discrepancy: what the model gets wrong, in units of what it was seen to.
    """

    noise: float
    force: float
    shared: float
    length: float
    discrepancy: float
