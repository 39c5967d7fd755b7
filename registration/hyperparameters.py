"""The few scales that everything else depends on: noise, forces, what neighbours share, what the model gets wrong.

All are positive and sought as logarithms eta, at once: see `evidence`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .policy import POLICY

Floats = NDArray[np.float64]
NOISE, FORCE, SHARED, LENGTH, DISCREPANCY = range(5)  # their order in arrays, that of `Hyperparameters`
# Gauss-Hermite quadrature: places in standard deviations about the mean, and their weights, which sum to one.
_PLACES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
QUADRATURE = tuple(zip(_PLACES.tolist(), (_WEIGHTS / _WEIGHTS.sum()).tolist(), strict=True))


@dataclass(frozen=True)
class LogNormalPrior:
    """What is believed of a positive scale beforehand: log-normal within bounds.

    Args:
        median: the scale expected.
        spread: standard deviation of its logarithm; 0 for a scale that is known.
        minimum: no smaller value is believed.
        maximum: no larger value is believed.
        spread_below: standard deviation of its logarithm below the median; the same as above if not given.
    """

    median: float
    spread: float
    minimum: float = 0.0
    maximum: float = np.inf
    spread_below: float | None = None

    def __post_init__(self) -> None:
        if not (0.0 < self.median < np.inf and 0.0 <= self.spread < np.inf and 0.0 <= self.minimum < np.inf):
            raise ValueError(
                f"LogNormalPrior: expected a positive median, a spread and a least value of 0 or more, got {self}."
            )
        if self.spread_below is not None and not 0.0 < self.spread_below < np.inf:
            raise ValueError(f"LogNormalPrior.spread_below: expected a positive number, got {self.spread_below}.")
        if not self.maximum > 0.0:
            raise ValueError(f"LogNormalPrior.maximum: expected a positive number, got {self.maximum}.")

    def with_minimum(self, minimum: float) -> LogNormalPrior:
        """The same belief with a larger least value."""
        return replace(self, minimum=max(self.minimum, minimum))


@dataclass(frozen=True)
class Hyperparameters:
    """The scales after the data.

    Args:
        noise: standard deviation of a point's distance, metres.
        force: standard deviation of the coefficients of the forces, newtons.
        shared: standard deviation of the noise that neighbours share, metres.
        length: over which they share it, metres.
        discrepancy: what the model gets wrong over what it was seen to.
    """

    noise: float
    force: float
    shared: float
    length: float
    discrepancy: float

    @property
    def margin_discrepancy(self) -> float:
        """The discrepancy that margins reckon with: where it is below 1, forces may have explained some."""
        return self.discrepancy if self.discrepancy >= 1.0 else self.discrepancy**POLICY.discrepancy_in_margins
