"""One contact of unknown place and force."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs

from .block import Estimate, check_deviation, estimate
from .input_block import InputBlock

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Contact(InputBlock):
    """One force spread over a patch of unknown place: its share at a node falls off as a normal law with distance.

    Args:
        nodes: that the patch may touch, (a,).
        place: where its middle is expected, (3,), metres, at rest.
        reach: standard deviation of that along each axis, metres.
        radius: of the patch, metres: deviation of the share's law.
        force: standard deviation of each component of the force, newtons.
    """

    nodes: Ints
    place: Floats
    reach: float
    radius: float
    force: float

    def __post_init__(self) -> None:
        for name in ("reach", "radius", "force"):
            check_deviation(f"Contact.{name}", getattr(self, name))
        if len(self.nodes) == 0:
            raise ValueError("Contact.nodes: expected at least one node that may be touched, got none.")

    @property
    def is_force(self) -> bool:
        """True."""
        return True

    @property
    def size(self) -> int:
        """6: place and force."""
        return 6

    @property
    def strides(self) -> Floats:
        """Largest changes of the coefficients in one step: twice the patch; forces are held by how far nodes move."""
        return np.repeat([2.0 * self.radius / self.reach, np.inf], 3)

    def _shares(self, coefficients: Floats, body: Body) -> tuple[Floats, Floats]:
        """Share of the force at each node, (a,), and its derivative by the place, (a, 3), 1/metre."""
        arms = body.points[self.nodes] - (self.place + self.reach * coefficients[:3])
        exponents = -0.5 * np.einsum("ai,ai->a", arms, arms) / self.radius**2
        shares = np.exp(exponents - exponents.max())
        shares /= shares.sum()
        return shares, shares[:, None] * (arms - shares @ arms) / self.radius**2

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the force at coefficients."""
        forces = np.zeros_like(body.points) if inputs.forces is None else inputs.forces.copy()
        shares, _ = self._shares(coefficients, body)
        forces[self.nodes] += shares[:, None] * (self.force * coefficients[3:])
        return replace(inputs, forces=forces)

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the nodal forces by each coefficient, (n, 3)."""
        shares, slopes = self._shares(coefficients, body)
        columns = [self.reach * slope[:, None] * (self.force * coefficients[3:]) for slope in slopes.T]
        columns += [shares[:, None] * (self.force * axis) for axis in np.eye(3)]
        found = []
        for column in columns:
            whole = np.zeros_like(body.points)
            whole[self.nodes] = column
            found.append(Change(forces=whole))
        return found

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """Place of the patch's middle at rest, metres, and force, newtons."""
        found = []
        for place, (kind, axis) in enumerate((kind, axis) for kind in ("place", "force") for axis in range(3)):
            middle, scale = (self.place[axis], self.reach) if kind == "place" else (0.0, self.force)
            unit = "m" if kind == "place" else "N"

            def at(c: float, middle: float = middle, scale: float = scale) -> float:
                return float(middle + scale * c)

            found.append(
                estimate(f"{kind} of the contact along {'xyz'[axis]}", unit, at, mean[place], covariance[place, place])
            )
        return found
