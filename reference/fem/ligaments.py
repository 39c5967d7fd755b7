"""Ligaments on the unknowns of a body: energy, forces and stiffness of a few nodes each."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.springs import Ligament
from .discretisation import Discretisation
from .fenicsx import PETSc

Floats = NDArray[np.float64]


class LigamentForms:
    """One ligament.

    Args:
        space: the body's discretisation, on one rank.
        name: of the ligament.
        ligament: where it is, and how stiff.

    Raises:
        ValueError: a mesh shared between ranks.
    """

    def __init__(self, space: Discretisation, name: str, ligament: Ligament) -> None:
        if space.comm.size > 1:
            raise ValueError(f"Problem.springs[{name!r}]: expected one rank where a ligament holds, got several.")
        self.name, self.factor, self._ligament, self._space = name, 1.0, ligament, space
        carried = ligament.carried(name, space.body)
        places = np.empty(len(space.body.points), dtype=np.int64)
        places[space.local_nodes] = np.arange(len(space.local_nodes))
        self._numbers = space.numbers[places[carried.nodes[0]]]  # (k, 3)
        self._weights = carried.weights[0]

    def scale(self, factor: float) -> None:
        """So many times as stiff as it was given."""
        self.factor = factor

    def _response(self, unknowns: Floats) -> tuple[float, Floats, Floats]:
        return self._ligament.response(self._weights @ unknowns[self._numbers])

    def energy(self, unknowns: Floats) -> float:
        """Stored, joules."""
        return self.factor * self._response(unknowns)[0]

    def forces(self, unknowns: Floats) -> Floats:
        """That it needs to be as it is, newtons."""
        out = np.zeros(self._space.owned)
        np.add.at(out, self._numbers, self.factor * self._weights[:, None] * self._response(unknowns)[1])
        return out

    def stiffness_times(self, unknowns: Floats, direction: Floats) -> Floats:
        """Derivative of the forces in a direction."""
        out = np.zeros(self._space.owned)
        pulled = self._response(unknowns)[2] @ (self._weights @ direction[self._numbers])
        np.add.at(out, self._numbers, self.factor * self._weights[:, None] * pulled)
        return out

    def add_to(self, matrix: Any, unknowns: Floats) -> None:
        """Add the stiffness to a matrix, held rows and columns left out."""
        is_free = ~np.isin(self._numbers, self._space.fixed)
        spread = (self._weights[:, None, None] * np.eye(3) * is_free[:, :, None]).reshape(-1, 3)
        block = self.factor * spread @ self._response(unknowns)[2] @ spread.T
        numbers = self._numbers.ravel().astype(PETSc.IntType)
        matrix.setValues(numbers, numbers, block, addv=PETSc.InsertMode.ADD_VALUES)
        matrix.assemble()
