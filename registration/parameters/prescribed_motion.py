"""A node set that is moved as a rigid whole, by an unknown motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import Parameter

from ..pose import Pose
from .block import Estimate, check_deviation, estimate
from .input_block import InputBlock

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_STRIDE = 0.3  # radians, largest change in one step


@dataclass(frozen=True)
class PrescribedMotion(InputBlock):
    """A node set that is moved as a rigid whole: what grips it, a support that has shifted.

    Args:
        name: of the node set; the model's problem holds all its axes.
        rotation_deviation: standard deviation of the turn about each axis, radians.
        translation_deviation: of the shift along each axis, metres.
    """

    name: str
    rotation_deviation: float = 0.2
    translation_deviation: float = 0.01

    def __post_init__(self) -> None:
        check_deviation("PrescribedMotion.rotation_deviation", self.rotation_deviation)
        check_deviation("PrescribedMotion.translation_deviation", self.translation_deviation)

    @property
    def size(self) -> int:
        """6: turn and shift."""
        return 6

    @property
    def strides(self) -> Floats:
        """Largest changes of the coefficients in one step; shifts are held by how far nodes may move."""
        return np.repeat([_STRIDE / self.rotation_deviation, np.inf], 3)

    def _twist(self, coefficients: Floats) -> Floats:
        return np.repeat([self.rotation_deviation, self.translation_deviation], 3) * coefficients

    def _places(self, body: Body) -> tuple[Floats, Floats]:
        places = body.points[body.node_sets[self.name]]
        return places, places.mean(axis=0)

    def check(self, body: Body, parameters: Mapping[str, Parameter]) -> None:
        """See `InputBlock.check`: a node set of the body."""
        if self.name not in body.node_sets:
            raise ValueError(
                f"PrescribedMotion.name: expected a node set among {sorted(body.node_sets)}, got {self.name!r}."
            )

    def moved_nodes(self, body: Body) -> Ints:
        """See `InputBlock.moved_nodes`."""
        return body.node_sets[self.name]

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the region where coefficients put it."""
        places, centre = self._places(body)
        moved = Pose.identity().moved(self._twist(coefficients), centre).apply(places) - places
        return replace(inputs, displacement={**inputs.displacement, self.name: moved})

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the prescribed displacements by each coefficient, (n, 3)."""
        places, centre = self._places(body)
        columns = Pose.identity().moved_jacobian(places, self._twist(coefficients), centre)
        found = []
        for column in (columns * np.repeat([self.rotation_deviation, self.translation_deviation], 3)).T:
            whole = np.zeros_like(body.points)
            whole[body.node_sets[self.name]] = column.reshape(-1, 3)
            found.append(Change(displacement=whole))
        return found

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """Turn, radians, and shift, metres, about and along each axis."""
        found = []
        for place, (kind, axis) in enumerate((kind, axis) for kind in ("turn", "shift") for axis in "xyz"):
            scale, unit = (self.rotation_deviation, "rad") if kind == "turn" else (self.translation_deviation, "m")

            def at(c: float, scale: float = scale) -> float:
                return scale * c

            name = f"{kind} of {self.name} {'about' if kind == 'turn' else 'along'} {axis}"
            found.append(estimate(name, unit, at, mean[place], covariance[place, place]))
        return found
