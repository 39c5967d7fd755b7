"""One unknown input of the forward model: what the body is made of, how it is moved, which forces are known by form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import Parameter

from .block import Estimate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class InputBlock:
    """Coefficients of unit variance, and a part of the inputs that they stand for; `InputBlocks` takes several."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Parameters of the material that it changes, by name."""
        return ()

    @property
    def label(self) -> str:
        """What makes it one of its kind: there is none other of this name beside it."""
        return f"{type(self).__name__} {getattr(self, 'name', '')}".strip()

    @property
    def is_force(self) -> bool:
        """Whether nodal forces are all that it changes: every forward model takes those."""
        return False

    @property
    def size(self) -> int:
        """Number of coefficients, c."""
        raise NotImplementedError

    @property
    def strides(self) -> Floats:
        """Largest change of each coefficient that one step may make, (c,)."""
        return np.full(self.size, np.inf)

    def check(self, body: Body, parameters: Mapping[str, Parameter]) -> None:
        """Refuse what does not go with a body or its material.

        Args:
            body: the body.
            parameters: of its material, by name: what is expected of them beforehand.

        Raises:
            ValueError: it does not.
        """

    def moved_nodes(self, body: Body) -> Ints:
        """Numbers of the nodes whose displacement it prescribes."""
        return np.zeros(0, dtype=np.int64)

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with this one at coefficients, (c,)."""
        raise NotImplementedError

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the inputs by each coefficient, at the inputs that all unknowns lead to."""
        raise NotImplementedError

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """What is known of it.

        Args:
            inputs: at all coefficients' medians beforehand.
            mean: coefficients found, (c,).
            covariance: of theirs, (c, c).
        """
        raise NotImplementedError


def with_parameters(inputs: Inputs, **parameters: Parameter) -> Inputs:
    """The inputs with other parameters of the material."""
    return replace(inputs, parameters={**inputs.parameters, **parameters})
