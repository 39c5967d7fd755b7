"""How a search for an equilibrium ended (no FEniCSx here, so that registration can know it)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .loading import Loading

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Iteration:
    """One line of a convergence trace.

    Args:
        load_factor: part of the full load.
        iteration: number within the load step; 0 is its start.
        residual: norm of the out-of-balance forces, newtons.
        potential: strain energy minus work of dead forces, joules; None where the search did not need it.
        length: of the step that led here, relative to Newton's; negative where an indefinite tangent had to be turned.
        factorisations: tangents factored so far.
    """

    load_factor: float
    iteration: int
    residual: float
    potential: float | None
    length: float
    factorisations: int


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A state of equilibrium and how it was found.

    Args:
        displacement: (n, 3), metres, in the body's node order.
        energy: strain energy minus work of the dead forces, joules; with a following pressure, plus its work against
            the volume that its surface encloses with the origin.
        residual: norm of the out-of-balance nodal forces, newtons.
        iterations: Newton iterations of all load steps, failed ones included.
        factorisations: tangents factored for them.
        load_steps: successful load steps; 1 means that the full load converged at once.
        reason: why the solver stopped, in words.
        negative_pivots: negative pivots of the tangent at the state (of what is left of it when pressures are
            eliminated): 0 is a stable state, None was not asked for or is not known (multigrid, L U).
        pressure: (n,), pascals, positive in compression, where it is an unknown.
        trace: every iteration, where asked for.
        local_iterations: Newton iterations of a few cells alone (nonlinear elimination).
        load: what is in balance; its following pressures belong to the tangent.
        start: where Newton's method came from: `guess`, `proposal`, `linear response`, `rotation` (prescribed ones
            carried into the body), `rest` or `load steps`.
    """

    displacement: Floats
    energy: float
    residual: float
    iterations: int
    factorisations: int
    load_steps: int
    reason: str
    negative_pivots: int | None
    pressure: Floats | None = None
    trace: tuple[Iteration, ...] = ()
    local_iterations: int = 0
    load: Loading = field(default_factory=Loading)
    start: str = ""

    @property
    def is_stable(self) -> bool:
        """True when the energy has a strict local minimum here; needs the pivots."""
        return self.negative_pivots == 0


class NotConverged(RuntimeError):  # noqa: N818 - the way a search ended, named as one says it
    """No equilibrium was found; the message says how far the load was taken and what to try.

    Args:
        message: what happened.
        load_factor: part of the load at which the last equilibrium was found (see `LoadPath`); 0 if there was none.
        last: that equilibrium; None if there was none.
        trace: every iteration.
    """

    def __init__(
        self,
        message: str,
        load_factor: float = 0.0,
        last: Equilibrium | None = None,
        trace: tuple[Iteration, ...] = (),
    ) -> None:
        super().__init__(message)
        self.load_factor, self.last, self.trace = load_factor, last, trace
