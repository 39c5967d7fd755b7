"""From the last frame: its state and hyperparameters are the start; or from rest with its forces, if that is nearer."""

from __future__ import annotations

import numpy as np

from ..cloud import Cloud
from ..evaluation import Evaluation
from ..loss import robust_deviation
from ..policy import ACCURACY, POLICY
from ..result import Registration
from ..setup import Ended, Setup
from .cold_start import Localised, finish, from_rest


def track(setup: Setup, points: Cloud, last: Registration) -> Ended:
    """Where the solver ends from the frame before.

    Args:
        setup: what is registered.
        points: of the cloud.
        last: the frame before.
    """
    prepared = setup.followed(last.prepared)
    problem = setup.problem(points, prepared, last.evaluation.positions, last.rms_distance)
    near = problem.begun(problem.carried(last.evaluation.coefficients, last.problem), last.evaluation)
    if _is_nearer_at_rest(setup, near, last):  # the tool has let go: no way back through all states between
        begun = from_rest(setup, points, prepared, setup.options.solver)
        return finish(setup, points, Localised(prepared, begun))
    solver = setup.options.solver.following()
    return Ended(prepared, solver.solve(problem, near.coefficients, near, last.eta))


def has_left(setup: Setup, found: Registration, last: Registration) -> bool:
    """True where the cloud is met so much worse than before that the forces may act elsewhere now."""
    return found.scatter > POLICY.excess * max(last.scatter, setup.noise.minimum)


def _is_nearer_at_rest(setup: Setup, near: Evaluation, last: Registration) -> bool:
    """True where a cloud lies nearer to the body at rest than to what the last frame has found."""
    far = robust_deviation(near.match.distances)
    if far < ACCURACY.far * max(last.noise, setup.options.noise.minimum):
        return False
    few = near.cloud[:: max(1, len(near.cloud) // ACCURACY.glance)]
    rest = setup.observed.match(np.zeros_like(near.positions), few)
    return robust_deviation(rest.distances) < far
