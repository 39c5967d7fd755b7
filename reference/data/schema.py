"""The arrays of a block of samples: names, shapes and types, in one place. Their order is that of the checksum."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

FIELDS: dict[str, tuple[str, ...]] = {
    "forces": ("loaded", "space"),
    "displacements": ("nodes", "space"),
    "probes": ("modes",),
    "adjoints": ("loaded", "space"),
}
FIGURES: dict[str, str] = {
    "energy": "f8",
    "residual": "f8",
    "iterations": "i4",
    "load_steps": "i4",
    "negative_pivots": "i4",
    "reason": "u1",
}
NAMES = (*FIELDS, *FIGURES)


class Reason(IntEnum):
    """Why a draw was kept or kept apart; the numbers are what is stored."""

    ACCEPTED = 0
    NOT_CONVERGED = 1
    UNSTABLE = 2
    BEYOND = 3

    @property
    def words(self) -> str:
        """For people."""
        return _WORDS[self]


_WORDS = {
    Reason.ACCEPTED: "accepted",
    Reason.NOT_CONVERGED: "not converged",
    Reason.UNSTABLE: "unstable equilibrium",
    Reason.BEYOND: "displacement beyond the wanted range",
}


@dataclass(frozen=True)
class Sizes:
    """What the shape of a sample depends on.

    Args:
        loaded: number of the nodes that may carry force.
        nodes: number of all nodes.
        modes: number of the modes.
        space: dimensions.
    """

    loaded: int
    nodes: int
    modes: int
    space: int = 3

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of one sample's entry: () for figures."""
        return tuple(getattr(self, axis) for axis in FIELDS.get(name, ()))

    def failed(self) -> dict[str, Any]:
        """A sample whose solve failed, all zero but for the reason."""
        row: dict[str, Any] = {name: np.zeros(self.shape(name), dtype=kind(name)) for name in NAMES}
        return row | {"reason": np.uint8(Reason.NOT_CONVERGED)}


def kind(name: str) -> str:
    """NumPy's word for the type of an entry."""
    return FIGURES.get(name, "f8")
