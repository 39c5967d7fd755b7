"""The reference as a forward model for registration: equilibria, adjoints and sensitivities at the last state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

from .equilibrium import Problem
from .outcome import Equilibrium

Floats = NDArray[np.float64]


class ReferenceModel:
    """Forces to displacement by finite elements, with exact derivatives at the last state.

    Each solve starts from the last state, moved along the tangent by the change of the forces.

    Args:
        problem: body, material and options; stays owned by the caller.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.reset()

    def reset(self) -> None:
        """Forget the last state: the next solve starts from rest."""
        self._forces = np.zeros_like(self._problem.body.points)
        self._displacement = np.zeros_like(self._problem.body.points)
        self.last: Equilibrium | None = None

    @property
    def body(self) -> Body:
        """The body that deforms."""
        return self._problem.body

    def solve(self, forces: ArrayLike) -> Floats:
        """Displacement, (n, 3) metres, under nodal forces, (n, 3) newtons.

        Raises:
            NotConverged: no equilibrium was found; the last state is kept.
        """
        load = np.asarray(forces, dtype=np.float64)
        guess = None
        if self.last is not None:
            change = self._problem.apply_inverse((load - self._forces).ravel(), self._displacement)
            guess = self._displacement + change.reshape(-1, 3)
            if not np.isfinite(self._problem.energy(guess)):
                guess = self._displacement
        result = self._problem.solve(load, guess, stability=False, fallback=self.last is None)
        self.last, self._forces, self._displacement = result, load.copy(), result.displacement
        return result.displacement

    def pullback(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3), from the one with respect to the displacement.

        It is the adjoint K(u)^-1 g at the last state (Odot 2023, eq. 6.8-6.10), zero at fixed nodes.

        Args:
            cotangent: g, (n, 3).
        """
        flat = np.asarray(cotangent, dtype=np.float64).ravel()
        return self._problem.apply_inverse(flat, self._displacement).reshape(-1, 3)

    def sensitivity(self, columns: ArrayLike) -> Floats:
        """Change of the displacement, (3n, k), for small changes of the forces, (3n, k), at the last state."""
        return self._problem.apply_inverse(columns, self._displacement)

    def state(self) -> Equilibrium:
        """The last equilibrium with its stability: negative pivots of its tangent."""
        if self.last is None:
            raise RuntimeError("ReferenceModel.state: nothing was solved yet.")
        if self.last.negative_pivots is None:
            self.last = replace(self.last, negative_pivots=self._problem.negative_pivots(self._displacement))
        return self.last
