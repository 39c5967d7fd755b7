"""The weight of a body, known in direction and, but for a factor, in size: forces that every forward model takes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs

from .block import Estimate, check_deviation, estimate
from .input_block import InputBlock

Floats = NDArray[np.float64]
_STRIDE = 0.7  # largest change of the factor's logarithm in one step: half as much, or twice
_HIGHEST = 50.0  # of the factor's logarithm: far out it grows no further


@dataclass(frozen=True, eq=False)
class Weight(InputBlock):
    """Known forces times an unknown factor, log-normal about 1.

    How much an organ sags from one state to another is of its density over its stiffness, and both are known badly.

    Args:
        forces: expected nodal forces, (n, 3), newtons.
        deviation: of the factor's logarithm.
    """

    forces: Floats
    deviation: float = 0.5

    def __post_init__(self) -> None:
        check_deviation("Weight", self.deviation)

    @property
    def is_force(self) -> bool:
        """True."""
        return True

    @property
    def size(self) -> int:
        """1."""
        return 1

    @property
    def strides(self) -> Floats:
        """Largest change of the coefficient in one step."""
        return np.array([_STRIDE / self.deviation])

    def _factor(self, coefficient: float) -> float:
        return float(np.exp(np.clip(self.deviation * coefficient, -_HIGHEST, _HIGHEST)))

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the weight among the forces."""
        forces = self._factor(coefficients[0]) * self.forces
        return replace(inputs, forces=forces if inputs.forces is None else inputs.forces + forces)

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the forces by the coefficient."""
        return [Change(forces=self.deviation * self._factor(coefficients[0]) * self.forces)]

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """The factor."""
        return [estimate("weight", "times what is expected", self._factor, mean[0], covariance[0, 0])]
