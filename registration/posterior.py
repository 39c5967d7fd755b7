"""What is known of the coefficients after the cloud: Laplace's approximation at a state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .hyperparameters import Hyperparameters

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Posterior:
    """A normal law of the coefficients.

    Args:
        mean: (k,).
        covariance: (k, k).
        scales: the hyperparameters that it was taken with.
        informed: directions that the cloud tells more of than the prior did (the sum of their shares).
        force: standard deviation of a coefficient of force of which the cloud tells nothing, newtons: the root of the
            mean square of the forces' scale.
    """

    mean: Floats
    covariance: Floats
    scales: Hyperparameters
    informed: float
    force: float

    def net_force_covariance(self, net: Floats, left_out: Floats) -> Floats:
        """Covariance of the net force, (3, 3), newtons^2, with the prior's share of what was left out.

        Args:
            net: net force of each coefficient, (3, k).
            left_out: covariance for unit scale of directions of force that are no unknowns, (3, 3).
        """
        return net @ self.covariance @ net.T + self.force**2 * left_out
