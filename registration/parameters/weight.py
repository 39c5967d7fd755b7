"""The weight of a body, known in direction and, but for a factor, in size: forces that every forward model takes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs

from .block import Estimate, estimate
from .factor import Factor

Floats = NDArray[np.float64]
_STRIDE = 0.7  # largest change of the factor's logarithm in one step: half as much, or twice


@dataclass(frozen=True, eq=False)
class Weight(Factor):
    """Known forces times an unknown factor, log-normal about 1.

    How much an organ sags from one state to another is of its density over its stiffness, and both are known badly.

    Args:
        deviation: of the factor's logarithm.
        forces: expected nodal forces, (n, 3), newtons.
    """

    forces: Floats = field(kw_only=True)

    @property
    def is_force(self) -> bool:
        """True."""
        return True

    @property
    def stride(self) -> float:
        """Largest change of the factor's logarithm in one step."""
        return _STRIDE

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the weight among the forces."""
        forces = self.factor(coefficients[0]) * self.forces
        return replace(inputs, forces=forces if inputs.forces is None else inputs.forces + forces)

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the forces by the coefficient."""
        return [Change(forces=self.deviation * self.factor(coefficients[0]) * self.forces)]

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """The factor."""
        return [estimate("weight", "times what is expected", self.factor, mean[0], covariance[0, 0])]
