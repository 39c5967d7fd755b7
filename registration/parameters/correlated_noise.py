"""Noise that neighbouring points share: a smooth field of shifts over the observed side, which moves nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..evaluation import Evaluation, Slopes
from ..hyperparameters import LENGTH, SHARED, LogNormalPrior
from ..policy import ACCURACY, POLICY
from ..surface_distance import SurfaceDistance
from ..surface_modes import SurfaceModes
from .block import ParameterBlock

Floats = NDArray[np.float64]


class CorrelatedNoise(ParameterBlock):
    """Three components of a Gaussian process on the observed side, each in its smoothest functions.

    Args:
        modes: these functions.
    """

    has_own_figures: ClassVar[bool] = True

    def __init__(self, modes: SurfaceModes) -> None:
        self.modes = modes

    def leading(self, count: int) -> CorrelatedNoise:
        """The same in the first functions alone."""
        return CorrelatedNoise(self.modes.leading(count))

    @property
    def size(self) -> int:
        """Three for each function."""
        return 3 * len(self.modes.values)

    @property
    def is_moving(self) -> bool:
        """False."""
        return False

    def hyperpriors(self, observed: SurfaceDistance) -> Mapping[int, LogNormalPrior]:
        """Of its size and its length."""
        least = ACCURACY.shared_length_minimum * observed.edge
        median = max(POLICY.shared_length * np.sqrt(self.modes.area), least)
        longest = POLICY.shared_length_maximum * median
        most = POLICY.misfit * observed.body.size  # what is more is another place or another shape
        return {
            SHARED: LogNormalPrior(POLICY.shared_size, POLICY.shared_size_spread, maximum=most),
            LENGTH: LogNormalPrior(median, POLICY.shared_length_spread, least, longest),
        }

    def log_variances(self, eta: Floats) -> tuple[Floats, Mapping[int, Floats | float]]:
        """See `ParameterBlock.log_variances`."""
        spread, by_length = self.modes.log_variances(float(np.exp(eta[LENGTH])))
        return 2.0 * eta[SHARED] + np.tile(spread, 3), {SHARED: 2.0, LENGTH: np.tile(by_length, 3)}

    def jacobian(self, at: Evaluation, coefficients: Floats, slopes: Slopes) -> Floats:
        """See `ParameterBlock.jacobian`."""
        return self.by_points(at) if slopes.match is not None else np.zeros((slopes.rows.shape[0], self.size))

    def by_points(self, at: Evaluation) -> Floats:
        """Derivative of the distances of the cloud's points by the coefficients, (p, c)."""
        modes = self.modes.at(at.observed.triangles[at.match.triangles], at.match.weights)
        return np.hstack([-along[:, None] * modes for along in at.match.directions.T])

    def explained(self, at: Evaluation, coefficients: Floats) -> Floats:
        """See `ParameterBlock.explained`."""
        shifts = at.observed.vectors_at(at.match, self.modes.modes @ coefficients.reshape(3, -1).T)
        found: Floats = np.einsum("pi,pi->p", shifts, at.match.directions)
        return found
