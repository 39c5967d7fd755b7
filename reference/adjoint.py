"""The reference as a forward model for registration: equilibria, adjoints and sensitivities at the last state."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

from .equilibrium import Problem
from .outcome import Equilibrium

Floats = NDArray[np.float64]
_REMEMBERED = 4


class ReferenceModel:
    """Forces to displacement by finite elements, with exact derivatives at the last state.

    Each solve starts from the nearest of the last few states, moved along its tangent by the change of the forces, so
    that a search may try a step, turn back and go on where it was.

    Args:
        problem: body, material and options; stays owned by the caller.
        patient: try the other ways where the nearest state is too far; False refuses at once, for a search that can
            shorten its step.
    """

    def __init__(self, problem: Problem, patient: bool = True) -> None:
        self._problem = problem
        self._patient = patient
        self.reset()

    def reset(self) -> None:
        """Forget all states: the next solve starts from rest."""
        self._states: deque[tuple[Floats, Equilibrium]] = deque(maxlen=_REMEMBERED)

    @property
    def body(self) -> Body:
        """The body that deforms."""
        return self._problem.body

    @property
    def last(self) -> Equilibrium | None:
        """The last equilibrium; None before the first."""
        return self._states[-1][1] if self._states else None

    @property
    def _displacement(self) -> Floats:
        return np.zeros_like(self.body.points) if self.last is None else self.last.displacement

    def solve(self, forces: ArrayLike) -> Floats:
        """Displacement, (n, 3) metres, under nodal forces, (n, 3) newtons.

        Raises:
            NotConverged: no equilibrium was found; the last state is kept.
        """
        load = np.array(forces, dtype=np.float64)
        if not self._states:
            self._states.append((load, self._problem.solve(load, stability=False)))
            return self._displacement
        nearest = min(self._states, key=lambda state: float(np.linalg.norm(load - state[0])))
        if np.array_equal(nearest[0], load):
            found = nearest[1]
        else:
            guess = self._ahead(nearest[1].displacement, load - nearest[0])
            found = self._problem.solve(load, guess, stability=False, fallback=self._patient)
        self._states.append((load, found))
        return found.displacement

    def _ahead(self, displacement: Floats, change: Floats) -> Floats:
        """The displacement after a change of the load, along the tangent, unless that turns a cell inside out."""
        guess = displacement + self._problem.apply_inverse(change.ravel(), displacement).reshape(-1, 3)
        return guess if np.isfinite(self._problem.energy(guess)) else displacement

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
        """The last equilibrium with its stability: negative pivots of its tangent.

        Raises:
            RuntimeError: nothing was solved yet.
        """
        if not self._states:
            raise RuntimeError("ReferenceModel.state: nothing was solved yet.")
        forces, found = self._states[-1]
        if found.negative_pivots is None:
            found = replace(found, negative_pivots=self._problem.negative_pivots(found.displacement))
            self._states[-1] = (forces, found)
        return found
