"""The tangent stiffness of a body with its factorisation, kept until it is wanted at another state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..fem.forms import DiscreteLoad, Forms
from .linear import LinearSolver, Method, chosen_method

Floats = NDArray[np.float64]


class Tangent:
    """K at one state at a time, and K^-1.

    Args:
        forms: energy, residual and tangent.
        method: linear algebra that is asked for.
    """

    def __init__(self, forms: Forms, method: Method) -> None:
        self.forms, self.space, self._asked = forms, forms.space, method
        self.matrix = forms.create_matrix()
        self.factorisations = 0
        self._at: tuple[Floats, dict[str, float]] | None = None
        self.assemble_at_rest()  # the linear solver looks at its sparsity
        self.symmetric = True
        self.linear = self._solver()

    def _solver(self) -> LinearSolver:
        method = chosen_method(self._asked, self.space, self.symmetric)
        return LinearSolver(self.matrix, self.space, method, self.symmetric)

    def assemble_at_rest(self) -> None:
        """K(0) under no pressure into the matrix; what was factored is forgotten."""
        self._at = None
        self.forms.tangent(np.zeros(self.space.owned), DiscreteLoad.none(self.space), self.matrix)

    def suit(self, load: DiscreteLoad) -> None:
        """Change to L U where a following pressure makes the tangent unsymmetric, and back."""
        symmetric = self.forms.is_conservative(load)
        if symmetric != self.symmetric:
            self.linear.close()
            self.symmetric, self._at = symmetric, None
            self.linear = self._solver()

    def assemble(self, unknowns: Floats, load: DiscreteLoad) -> None:
        """The tangent at a state, unless it is there already."""
        if self._is_at(unknowns, load):
            return
        self._at = None
        self.forms.tangent(unknowns, load, self.matrix)
        self._at = (unknowns.copy(), dict(load.pressure))
        self.factorisations += 1

    @property
    def is_known(self) -> bool:
        """Whether the matrix is that of some state."""
        return self._at is not None

    def _is_at(self, unknowns: Floats, load: DiscreteLoad) -> bool:
        here = self._at is not None and self._at[1] == load.pressure and np.array_equal(self._at[0], unknowns)
        if self.space.comm.size > 1:
            here = bool(self.space.comm.allreduce(int(here)) == self.space.comm.size)
        return here

    def linearise(self, unknowns: Floats, load: DiscreteLoad) -> None:
        """The tangent at a state that was found, in the linear solver that suits its pressures."""
        if not self._is_at(unknowns, load):
            self.suit(load)
            self.assemble(unknowns, load)

    def solve(self, unknowns: Floats, load: DiscreteLoad, rows: Floats, transpose: bool = False) -> Floats:
        """K^-1 (or K^-T) at a state applied to each row, (k, owned unknowns); held ones are taken for zero."""
        right = rows.copy()
        right[:, self.space.fixed] = 0.0
        self.linearise(unknowns, load)
        return self.linear.solve(right, transpose)

    def solve_as_it_is(self, load: DiscreteLoad, rows: Floats) -> Floats | None:
        """K^-1 of whatever state was assembled last applied to each row, (k, owned unknowns), zero on held ones.

        None where there is none, it suits no such load or is singular, or where nothing is factored (multigrid).
        """
        if not self.is_known or self.linear.method == "multigrid" or self.symmetric != self.forms.is_conservative(load):
            return None
        self.linear.prepare()
        return None if self.linear.cannot_solve else self.linear.solve(rows)

    def negative_pivots(self, unknowns: Floats, load: DiscreteLoad) -> int | None:
        """Negative pivots at a state, less those that pressures bring; None where they are not known."""
        if self.linear.method == "multigrid":
            return None
        self.linearise(unknowns, load)
        pivots = self.linear.negative_pivots()
        return None if pivots is None else pivots - self.space.pressures  # a saddle point has one for each pressure

    def close(self) -> None:
        """Free the PETSc objects."""
        self.linear.close()
        self.matrix.destroy()


def factored(matrix: Any, like: Tangent, turns: bool = True) -> LinearSolver:
    """A solver of the tangent's method for another matrix of the same unknowns; it and the matrix are the caller's.

    Args:
        matrix: the PETSc matrix, symmetric.
        like: tangent whose method is taken.
        turns: rotations cost next to no energy (elasticity), and not translations alone (Poisson's problem).
    """
    return LinearSolver(matrix, like.space, like.linear.method, turns=turns)
