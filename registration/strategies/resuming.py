"""From what another process has found for a cloud: its forces, its coefficients, its hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..cloud import Cloud
from ..gauss_newton import GaussNewton
from ..parameters.nodal_forces import NodalForces
from ..result import Registration
from ..setup import Ended, Setup

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Found:
    """What a registration has to tell where another process is to go on: arrays alone.

    Args:
        forces: that were sought.
        coefficients: of all parameters, (k,).
        eta: logarithms of the hyperparameters, (5,).
        positions: displacement of the observed nodes, (m, 3), metres.
        rms_distance: of the cloud to the surface, metres.
        shares_noise: neighbours share noise.
    """

    forces: NodalForces
    coefficients: Floats
    eta: Floats
    positions: Floats
    rms_distance: float
    shares_noise: bool

    @classmethod
    def of(cls, found: Registration) -> Found:
        """What there is to tell of a registration."""
        evaluation = found.evaluation
        return cls(
            found.prepared.forces,
            evaluation.coefficients,
            found.eta,
            evaluation.positions,
            found.rms_distance,
            found.solved.has_shared_noise,
        )


def resume(setup: Setup, points: Cloud, found: Found) -> Ended:
    """Where the solver ends from there.

    Args:
        setup: what is registered.
        points: of the cloud.
        found: for the same cloud.
    """
    prepared = setup.prepared(found.forces)
    problem = setup.problem(points, prepared, found.positions, found.rms_distance)
    solver = setup.options.solver.following()
    if isinstance(solver, GaussNewton):
        solver = replace(solver.directly(), is_shared=found.shares_noise)
    return Ended(prepared, solver.solve(problem, problem.sized(found.coefficients), None, found.eta))
