"""An exact model's minimum, most of the way to which a cheaper one knows from any state of it (`ManifoldMapping`)."""

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
from ..manifold_mapping import ManifoldMapping, MendedState, Still
from ..policy import ACCURACY
from ..problem import Problem
from ..setup import Setup, after

Floats = NDArray[np.float64]


def approached(
    setup: Setup,
    problem: Problem,
    near: Evaluation,
    solver: GaussNewton | LBFGS,
    eta: Floats | None,
    fast: ForwardModel | None = None,
) -> SolverResult:
    """Where the solver ends from a trial of the exact model.

    The cheaper model is a fast one, or the exact one's tangent: with it points are matched, weighed and their noise is
    found as often as it takes, for the price of one state and its slopes. Each exact state where it ends mends it.
    A cheaper model takes no unknown inputs: with them, and where the exact one finds no state, the way is the latter's,
    as it is of L-BFGS, which wants the whole body's slopes.

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
        mapping = mapping.onward(near.coefficients[problem.force_part], near.state, ACCURACY.kept)
        solver = replace(solver, before=length if mapping.is_mended else np.inf)
    if near.given is not problem.cloud:
        near = problem.evaluation(near.coefficients.copy(), near)
    if mapping is not None:
        near = replace(near, state=MendedState(near.state, mapping.solve(mapping.expansion_point)))
    found = solver.solve(problem, near.coefficients, near, eta)
    if isinstance(found.evaluation.state, MendedState):
        found = replace(found, evaluation=replace(found.evaluation, state=found.evaluation.state.exact))
    return reduce(after, [*spent, found])


def _cheaper(setup: Setup, problem: Problem, fast: ForwardModel | None) -> ReducedModel:
    """The fast model between the same forces and nodes, or none that moves."""
    if fast is not None:
        return setup.reduced(fast, problem.forces)
    return Still(problem.forces.size, len(setup.observed.nodes), len(setup.model.body.points))
