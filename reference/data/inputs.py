"""What an equilibrium depends on beside its forces, and how all of it may change: no FEniCSx here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .materials import Parameter

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Inputs:
    """Material parameters and prescribed displacements in place of those that a model has by itself, and more forces.

    Args:
        parameters: of the material, by name, each with the shape that the model's has; others stay.
        displacement: prescribed displacement of named node sets, (k, 3), metres; others stay.
        forces: nodal forces beside those that the model is asked for, (n, 3), newtons; none if not given.
        springs: how many times as stiff as the model's springs on a named surface are, by its name; others stay.
    """

    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    displacement: Mapping[str, Floats] = field(default_factory=dict)
    forces: Floats | None = None
    springs: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("parameters", "displacement", "springs"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def has_same_parameters(self, other: Inputs) -> bool:
        """Whether both have the same parameters and springs."""
        return _same(self.parameters, other.parameters) and self.springs == other.springs


def _same(one: Mapping[str, Parameter], other: Mapping[str, Parameter]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(value, other[name]) for name, value in one.items())


@dataclass(frozen=True, eq=False)
class Change:
    """A direction in which forces, parameters or prescribed displacements change.

    Args:
        forces: (n, 3); none if not given.
        parameters: a number or (cells,) for each name; others stay.
        displacement: (n, 3), its free axes are ignored; none if not given.
        springs: change of how many times as stiff springs on a named surface are, by its name; others stay.
    """

    forces: ArrayLike | None = None
    parameters: Mapping[str, ArrayLike] = field(default_factory=dict)
    displacement: ArrayLike | None = None
    springs: Mapping[str, float] = field(default_factory=dict)
