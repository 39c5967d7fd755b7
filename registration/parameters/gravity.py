"""Gravity of unknown direction and size, near an expected one: forces that every forward model takes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs

from .block import Estimate, check_deviation, estimate
from .input_block import InputBlock

Floats = NDArray[np.float64]
_STRIDE = 4.0  # largest change of a component in one step, m/s^2


@dataclass(frozen=True, eq=False)
class Gravity(InputBlock):
    """The weight under gravity g = g0 + s c: how an organ lies is often not written down.

    Args:
        masses: nodal forces of a gravity of 1 m/s^2 along each of three axes, (3, n, 3), newtons.
        expected: g0 on these axes, (3,), m/s^2.
        deviation: s, of each component, m/s^2.
    """

    masses: Floats
    expected: Floats
    deviation: float = 3.0

    def __post_init__(self) -> None:
        check_deviation("Gravity", self.deviation)

    @property
    def is_force(self) -> bool:
        """True."""
        return True

    @property
    def size(self) -> int:
        """3."""
        return 3

    @property
    def strides(self) -> Floats:
        """Largest change of each coefficient in one step."""
        return np.full(3, _STRIDE / self.deviation)

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the weight among the forces."""
        forces = np.tensordot(self.expected + self.deviation * coefficients, self.masses, axes=1)
        return replace(inputs, forces=forces if inputs.forces is None else inputs.forces + forces)

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the forces by each coefficient."""
        return [Change(forces=self.deviation * each) for each in self.masses]

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """Its components."""
        return [
            estimate(
                f"gravity along {axis}",
                "m/s^2",
                lambda c, middle=middle: float(middle + self.deviation * c),  # type: ignore[misc]
                mean[place],
                covariance[place, place],
            )
            for place, (axis, middle) in enumerate(zip("xyz", self.expected, strict=True))
        ]
