"""From what a faster model has found: most of the way is its own, corrected by this one's (`ManifoldMapping`)."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.outcome import NotConverged

from ..cloud import Cloud
from ..evaluation import Evaluation
from ..forward import ForwardModel
from ..gauss_newton import GaussNewton, SolverResult
from ..lbfgs import LBFGS
from ..manifold_mapping import ManifoldMapping
from ..policy import ACCURACY
from ..problem import Problem
from ..result import Registration
from ..setup import Ended, Setup, after
from .cold_start import Localised, finish

Floats = NDArray[np.float64]


def refine(
    setup: Setup, points: Cloud, draft: Registration, fast: ForwardModel, last: Registration | None = None
) -> Ended:
    """Where the solver ends from a faster model's result.

    Args:
        setup: what is registered, with the exact model.
        points: of the cloud.
        draft: the faster model's result, in which forces are sought where it has found them.
        fast: that model.
        last: the exact model's result for the frame before, from which it goes on where forces are sought in the same
            place.
    """
    solver = setup.options.solver.following().going_on(draft.solved)
    is_same_place = last is not None and last.draft is not None and last.draft.prepared is draft.prepared
    if last is not None and is_same_place and last.prepared is not draft.prepared:  # else it is the draft itself
        problem = setup.problem(points, last.prepared, last.evaluation.positions, last.rms_distance)
        near = replace(last.evaluation, coefficients=problem.carried(last.evaluation.coefficients, last.problem))
        return Ended(last.prepared, _approached(setup, problem, near, fast, solver, last.eta))
    # Told a zone, the exact model gathers no forces within it, and takes none that were: see `options_for`.
    prepared = setup.unlocalised
    if setup.options.localisation.rounds:
        prepared = setup.prepared(replace(draft.prepared.forces, scale=setup.forces.scale))
    problem = setup.plain(points, prepared)
    start = problem.carried(draft.coefficients, draft.problem)
    start[problem.force_part] = prepared.forces.nearest(draft.unknown_forces)
    found = _approached(setup, problem, problem.evaluation(start, draft.evaluation), fast, solver, draft.eta)
    return finish(setup, points, Localised(prepared, found))


def _approached(
    setup: Setup,
    problem: Problem,
    near: Evaluation,
    fast: ForwardModel,
    solver: GaussNewton | LBFGS,
    eta: Floats | None,
) -> SolverResult:
    """The minimum, to which the fast model knows most of the way from any trial of the exact one.

    A fast model takes no unknown inputs: with them, and where the exact one finds no state, the way is the latter's, as
    it is of L-BFGS, which wants the whole body's slopes.
    """
    spent: list[SolverResult] = []
    for _ in range(ACCURACY.expansion_points):
        if problem.inputs is not None or not isinstance(solver, GaussNewton):
            break
        place = near.coefficients[problem.force_part]
        reduced = setup.reduced(fast, problem.forces)
        cheap = replace(problem, model=ManifoldMapping.at(reduced, setup.observed.nodes, place, near.state))
        way = solver.solve(cheap, near.coefficients, cheap.evaluation(near.coefficients), eta)
        eta = way.local.eta
        if not way.trace or setup.is_late:
            break
        try:
            exact = problem if way.local.problem.shared is not None else problem.unshared
            near = exact.evaluation(way.evaluation.coefficients, replace(way.evaluation, state=near.state))
        except NotConverged:
            break
        spent.append(replace(way, evaluations=1))  # states of the exact model alone are counted
        if solver.has_settled(exact, near, way.local.noise, eta):
            break
    if near.given is not problem.cloud:
        near = problem.evaluation(near.coefficients.copy(), near)
    return reduce(after, [*spent, solver.solve(problem, near.coefficients, near, eta)])
