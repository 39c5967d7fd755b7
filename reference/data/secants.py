"""Steps with a factorisation of before, brought up to date by what they show of the tangent (BFGS)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_LEAST_CURVATURE = 1e-8


class Secants:
    """What steps with a kept factorisation have shown of the tangent that it is not: a BFGS matrix about it.

    The differences of its own steps are its inverse of the differences of the residuals: no solve is needed beside
    those that are made anyway.

    Source: Nocedal 1980 (two-loop recursion), Matthies and Strang 1979 (BFGS about a stiffness matrix).

    Args:
        dot: inner product of unknowns over all ranks.
    """

    def __init__(self, dot: Callable[[Floats, Floats], float]) -> None:
        self._dot = dot
        self.clear()

    def clear(self) -> None:
        """Forget all steps."""
        self._pairs: list[tuple[Floats, Floats, Floats, float]] = []
        self._last: tuple[Floats, Floats, Floats] | None = None
        self._made = -1

    def improved(self, unknowns: Floats, residual: Floats, step: Floats, made: int) -> Floats:
        """The step by the BFGS matrix.

        Args:
            unknowns: where it begins.
            residual: there, zero at held unknowns.
            step: by the factorisation.
            made: number of the factorisation: what was seen with another one is forgotten.
        """
        if made != self._made:
            self.clear()
            self._made = made
        if self._last is not None:
            moved, change = unknowns - self._last[0], residual - self._last[1]
            curvature = self._dot(moved, change)
            if curvature > _LEAST_CURVATURE * np.sqrt(self._dot(moved, moved) * self._dot(change, change)):
                self._pairs.append((moved, change, step - self._last[2], curvature))
        self._last = unknowns, residual, step
        parts = []
        found, left = step.copy(), residual.copy()
        for moved, change, solved, curvature in reversed(self._pairs):
            part = self._dot(moved, left) / curvature
            parts.append(part)
            left -= part * change
            found -= part * solved
        for (moved, change, _, curvature), part in zip(self._pairs, reversed(parts), strict=True):
            found += (part - self._dot(change, found) / curvature) * moved
        return found
