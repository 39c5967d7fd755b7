"""An exact model's minimum with the help of a cheaper one that is corrected at each exact state (`ManifoldMapping`)."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.outcome import NotConverged

from ..evaluation import Evaluation
from ..forward import ForwardModel, ReducedModel
from ..gauss_newton import GaussNewton, SolverResult
from ..lbfgs import LBFGS
from ..manifold_mapping import ManifoldMapping, SecantState, ZeroModel
from ..policy import ACCURACY
from ..problem import Problem
from ..setup import Setup, after

Floats = NDArray[np.float64]


def solved_with(
    setup: Setup,
    problem: Problem,
    near: Evaluation,
    solver: GaussNewton | LBFGS,
    eta: Floats | None,
    fast: ForwardModel | None = None,
) -> SolverResult:
    """Where the solver ends from a trial of the exact model.

    The solver minimises with a cheaper model: a fast one, or the exact one's tangent. The exact model then solves for
    one state at that minimum, by which the cheaper one is corrected, and so on; derivatives are made once. The exact
    model is minimised alone with unknown inputs, which a cheaper model does not take, with L-BFGS, which needs the
    whole body's gradient, and from where it has found no state.

    Args:
        setup: what is registered.
        problem: of the exact model.
        near: where it begins.
        solver: for either model.
        eta: logarithms of the hyperparameters there, where they are known.
        fast: a fast model; the exact one's tangent if not given.
    """
    spent: list[SolverResult] = []
    mapping: ManifoldMapping | None = None
    for _ in range(ACCURACY.expansion_points):
        if problem.inputs is not None or not isinstance(solver, GaussNewton):
            break
        here = near.coefficients[problem.force_part]
        if mapping is None:
            mapping = ManifoldMapping.at(_cheaper(setup, problem, fast), setup.observed.nodes, here, near.state)
        cheap = replace(problem, model=mapping)
        way = solver.solve(cheap, near.coefficients, cheap.evaluation(near.coefficients), eta)
        eta = way.local.eta
        if not way.trace or setup.is_late:
            break
        length = way.local.length_of(way.evaluation.coefficients - way.local.problem.sized(near.coefficients))
        try:
            exact = problem if way.local.problem.shared is not None else problem.unshared
            near = exact.evaluation(way.evaluation.coefficients, replace(way.evaluation, state=near.state))
        except NotConverged:
            break
        spent.append(replace(way, evaluations=1))  # states of the exact model alone are counted
        mapping = mapping.updated(near.coefficients[problem.force_part], near.state, ACCURACY.kept)
        solver = replace(solver, length_before=length if mapping.has_secant else np.inf)
    if near.given is not problem.cloud:
        near = problem.evaluation(near.coefficients.copy(), near)
    if mapping is not None:
        near = replace(near, state=SecantState(near.state, mapping.solve(mapping.expansion_point)))
    found = solver.solve(problem, near.coefficients, near, eta)
    if isinstance(found.evaluation.state, SecantState):
        found = replace(found, evaluation=replace(found.evaluation, state=found.evaluation.state.exact))
    return reduce(after, [*spent, found])


def _cheaper(setup: Setup, problem: Problem, fast: ForwardModel | None) -> ReducedModel:
    """The fast model between the same forces and nodes, or none that moves."""
    if fast is not None:
        return setup.reduced(fast, problem.forces)
    return ZeroModel(problem.forces.size, len(setup.observed.nodes), len(setup.model.body.points))
