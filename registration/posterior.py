"""What is known of the coefficients after the cloud: Laplace's approximation at a state, in its own eigenvectors."""

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
        scales: noise and force scale that it was taken with.
        informed: directions that the cloud tells more of than the prior did (the sum of their shares).
    """

    mean: Floats
    covariance: Floats
    scales: Hyperparameters
    informed: float

    def net_force_covariance(self, net: Floats, left_out: Floats) -> Floats:
        """Covariance of the net force, (3, 3), newtons^2, with the prior's share of what was left out.

        Args:
            net: net force of each coefficient, (3, k).
            left_out: covariance for unit scale of directions of force that are no unknowns, (3, 3).
        """
        return net @ self.covariance @ net.T + self.scales.force**2 * left_out


def posterior(
    information: Floats, precision: Floats, mean: Floats, scales: Hyperparameters, forces: int, apart: slice = slice(0)
) -> Posterior:
    """The posterior for the information of the points, (k, k), and the prior's precision, (k,).

    The force scale is found from the same cloud: how far its own doubt moves the mean is part of the covariance (Kass
    and Steffey 1989).

    Args:
        information: J^T W J with the weights over the variances, per squared unit of the coefficients.
        precision: of the prior, (k,).
        mean: the coefficients found, (k,).
        scales: noise and force scale.
        forces: number of coefficients that the force scale belongs to, the first.
        apart: coefficients that count for no direction told: those of noise.
    """
    covariance = np.linalg.inv(information + np.diag(precision))
    by_scale = 2.0 * covariance[:, :forces] @ (precision * mean)[:forces]  # of the mean, by the logarithm of the scale
    moved: Floats = scales.spread[1] * by_scale
    shares = np.einsum("ij,ji->i", covariance, information)
    informed = float(shares.sum() - shares[apart].sum())
    return Posterior(mean, covariance + moved[:, None] * moved, scales, informed)
