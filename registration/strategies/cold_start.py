"""From rest: the leading directions of force first, then all; each round of gathering the forces goes on from there.

A model whose error is known in patterns has them among its unknowns only with all points, in `finish`: before that they
count as noise. An exact model, each state of which is dear, goes to the end of it at once. Points that lie by
themselves wait for `finish`, too: about the edges of a surface that is yet far off they would be more than its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.outcome import NotConverged

from ..cloud import Cloud
from ..gauss_newton import GaussNewton, SolverResult
from ..lbfgs import LBFGS
from ..outcome import Outcome
from ..parameters.nodal_forces import localised, reweighting
from ..prepared import Prepared
from ..problem import Problem
from ..setup import Ended, Setup, after

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Localised(Ended):
    """Where forces act, as far as a search from rest has found it, the model's error taken for noise.

    Args:
        is_settled: whether the solver has gone to the end of it.
    """

    is_settled: bool = True


def localise(setup: Setup, points: Cloud, leading: int | None = None) -> Localised:
    """Where the forces act, from rest; where time is over before the end, as far as it was found.

    Args:
        setup: what is registered.
        points: of the cloud.
        leading: directions of force to begin with; those of the options if not given.
    """
    prepared, rule, solver = setup.unlocalised, setup.options.localisation, setup.options.solver
    if rule.rounds == 0:
        return Localised(prepared, begin(setup, points, prepared, solver.unsettled(), leading), False)
    points = points.without_isolated
    few = points.thinned(rule.points)
    found = _from_rest(setup, few, prepared, solver, leading)
    for left in reversed(range(rule.rounds)):
        if setup.is_hopeless(found) or setup.is_late:
            break
        nodal = prepared.forces.forces(found.evaluation.coefficients[: prepared.forces.size])
        prepared, seen = _gathered(setup, nodal), few if left or setup.error is not None else points
        try:
            again = _carried_on(setup.plain(seen, prepared), solver, found, nodal)
        except NotConverged:  # gathered, such forces may have no state
            again = _from_rest(setup, seen, prepared, solver, leading)
        found = after(found, again)
    return Localised(prepared, found)


def begin(
    setup: Setup, points: Cloud, prepared: Prepared, solver: GaussNewton | LBFGS, leading: int | None = None
) -> SolverResult:
    """What `finish` goes on from, where forces are not gathered: from rest.

    Args:
        setup: what is registered.
        points: of the cloud.
        prepared: forces.
        solver: that ends it, where the model's error is not known in patterns.
        leading: as for `localise`.
    """
    points = points.without_isolated
    begun = _led(setup, points, prepared, leading)
    if setup.error is not None and not setup.is_hopeless(begun):
        return begun
    return _with_all(setup, points, prepared, solver, begun)


def _carried_on(problem: Problem, solver: GaussNewton | LBFGS, found: SolverResult, nodal: Floats) -> SolverResult:
    """With gathered forces, from those of them that are nearest to the ones found, (n, 3), newtons."""
    start = problem.carried(found.evaluation.coefficients, found.local.problem)
    start[problem.force_part] = problem.forces.nearest(nodal)
    return solver.solve(problem, start, found.evaluation, found.local.eta)


def _led(setup: Setup, points: Cloud, prepared: Prepared, leading: int | None) -> SolverResult:
    """From rest, with the leading directions of force alone, which cannot fold the surface into a wrong minimum."""
    rule = setup.options.localisation
    few, first = points.thinned(rule.points), prepared.leading(leading or rule.leading)
    coarse = setup.plain(few, first).unshared
    return setup.options.solver.coarse().solve(coarse, np.zeros(coarse.size))


def _from_rest(
    setup: Setup, points: Cloud, prepared: Prepared, solver: GaussNewton | LBFGS, leading: int | None
) -> SolverResult:
    """First the leading directions alone, then all, the model's error taken for noise."""
    return _with_all(setup, points, prepared, solver, _led(setup, points, prepared, leading))


def _with_all(
    setup: Setup, points: Cloud, prepared: Prepared, solver: GaussNewton | LBFGS, begun: SolverResult
) -> SolverResult:
    """All directions, from where the leading ones have ended."""
    if setup.is_hopeless(begun):  # what few directions leave as far off is judged by what all would do, to first order
        solver = solver.without_steps()
    return _from(setup.plain(points, prepared), solver, begun)


def finish(setup: Setup, points: Cloud, begun: Localised) -> Ended:
    """With all points, and with the model's error in patterns, from a result that took it for noise.

    Noise that neighbours share is asked for where the search has nearly ended: before that all are off alike.

    Args:
        setup: what is registered.
        points: of the cloud.
        begun: where the search from rest has ended.
    """
    prepared, found, solver = begun.prepared, begun.found, setup.options.solver
    if setup.is_hopeless(found):
        solver = solver.without_steps()
    few = points.without_isolated
    if setup.error is None:
        if not begun.is_settled or len(found.evaluation.cloud) < len(few):
            found = _from(setup.plain(few, prepared), solver, found)
        if few is points or len(found.evaluation.cloud) == len(points):
            return Ended(prepared, found)
        return Ended(prepared, _from(setup.plain(points, prepared), solver.directly(), found))
    problem, first = (
        setup.problem(each, prepared, found.evaluation.positions, found.rms_distance) for each in (points, few)
    )
    found = _from(first.unshared, solver.unsettled(), found)
    if found.outcome is Outcome.CONVERGED:  # the convex loss has nothing left to do
        solver = solver.directly()
    return Ended(prepared, _from(problem, solver, found))


def _from(problem: Problem, solver: GaussNewton | LBFGS, found: SolverResult) -> SolverResult:
    """Goes on from a result; its directions of force may be the first of this problem's, or all of them."""
    before, coefficients = found.local.problem, found.evaluation.coefficients
    start = problem.carried(coefficients, before)
    count = min(before.forces.size, problem.forces.size)
    start[problem.force_part][:count] = coefficients[before.force_part][:count]
    return after(found, solver.solve(problem, start, found.evaluation, found.local.eta))


def _gathered(setup: Setup, nodal: Floats) -> Prepared:
    """The unknown forces once more, where forces were found."""
    body, rule = setup.model.body, setup.options.localisation
    where = reweighting(setup.forces, nodal, body.points, rule.reach * body.size)
    return setup.prepared(localised(setup.forces, where)).informed(setup.observed, rule.informed)
