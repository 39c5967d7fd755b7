"""The stiffness of the springs that hold a part of an organ's surface, unknown."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs

from .block import Estimate, estimate
from .factor import Factor

Floats = NDArray[np.float64]
_STRIDE = np.log(10.0)  # largest change of the factor's logarithm in one step, as of Young's modulus


@dataclass(frozen=True, eq=False)
class SpringStiffness(Factor):
    """How many times as stiff as expected springs are, across and along the surface alike: log-normal about 1.

    Far below 1 the part is free, far above it is fixed.

    Args:
        deviation: of the factor's logarithm.
        name: of the surface that they hold, or of a ligament.
    """

    deviation: float = 1.0
    name: str = field(kw_only=True)

    @property
    def stride(self) -> float:
        """Largest change of the factor's logarithm in one step."""
        return float(_STRIDE)

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with these springs at the coefficient."""
        return replace(inputs, springs={**inputs.springs, self.name: self.factor(coefficients[0])})

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the factor by the coefficient."""
        return [Change(springs={self.name: self.deviation * self.factor(coefficients[0])})]

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """The factor."""
        name = f"stiffness of the springs {self.name}"
        return [estimate(name, "times what is expected", self.factor, mean[0], covariance[0, 0])]
