"""How a search for an equilibrium ended (no FEniCSx here, so that registration can know it)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A state of equilibrium and how it was found.

    Args:
        displacement: (n, 3), metres, in the body's node order.
        energy: strain energy minus work of the forces, joules.
        residual: norm of the out-of-balance nodal forces, newtons.
        iterations: Newton iterations of all load steps, failed ones included.
        factorisations: tangents factored for them.
        load_steps: successful load steps; 1 means that the full load converged at once.
        reason: why the solver stopped, in words.
        negative_pivots: negative pivots of the tangent at the state: 0 is a stable state, None was not asked for.
    """

    displacement: Floats
    energy: float
    residual: float
    iterations: int
    factorisations: int
    load_steps: int
    reason: str
    negative_pivots: int | None

    @property
    def is_stable(self) -> bool:
        """True when the energy has a strict local minimum here; needs the pivots."""
        return self.negative_pivots == 0


class NotConverged(RuntimeError):  # noqa: N818 - the way a search ended, named as one says it
    """No equilibrium was found; the message says how far the load was taken and what to try."""
