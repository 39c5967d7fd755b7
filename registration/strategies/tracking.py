"""From the last frame: its state and hyperparameters are the start; or from rest with its forces, if that is nearer."""

from __future__ import annotations

import numpy as np
from scipy.special import bdtrc

from ..cloud import Cloud
from ..evaluation import Evaluation
from ..loss import REJECTED, robust_deviation
from ..policy import ACCURACY, POLICY
from ..problem import Problem
from ..result import Registration
from ..setup import Ended, Setup
from .cold_start import Localised, begin, finish
from .multifidelity import solved_with


def track(setup: Setup, points: Cloud, last: Registration) -> Ended:
    """Where the solver ends from the frame before.

    Args:
        setup: what is registered.
        points: of the cloud.
        last: the frame before.
    """
    prepared = setup.followed(last.prepared)
    problem = setup.problem(points, prepared, last.evaluation.positions, last.rms_distance)
    near = problem.evaluation(problem.carried(last.evaluation.coefficients, last.problem), last.evaluation)
    if _is_nearer_at_rest(setup, near, last):  # the tool has let go: no way back through all states between
        begun = begin(setup, points, prepared, setup.options.solver)
        return finish(setup, points, Localised(prepared, begun))
    solver = setup.options.solver.following().going_on(last.solved)
    if _is_as_expected(setup, problem, near, last):
        solver = solver.directly()
    if setup.is_exact:  # each state of it is dear
        return Ended(prepared, solved_with(setup, problem, near, solver, last.eta))
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


def _is_as_expected(setup: Setup, problem: Problem, near: Evaluation, last: Registration) -> bool:
    """True where the last state takes no more points of a cloud for outliers than it took of its own.

    Then the convex loss, which keeps a part of the organ that has moved far from being mistaken for outliers, has
    nothing to do. The number of outliers is held against the binomial law of the share that there was.

    Args:
        setup: what is registered.
        problem: of the cloud.
        near: the last state with the cloud.
        last: the frame before.
    """
    deviations = np.hypot(last.noise, last.discrepancy_scale * problem.local_error(near))
    weights = setup.options.solver.losses[-1].weight(problem.residuals(near, last.noise) / deviations)
    count, known = int((weights < REJECTED).sum()), last.solved.is_kept
    share = (np.sum(~known) + 0.5) / (len(known) + 1.0)  # of none that there were nothing is sure (Jeffreys)
    return count == 0 or float(bdtrc(count - 1, len(weights), share)) > POLICY.unlikely
