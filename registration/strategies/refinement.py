"""From what a faster model has found: most of the way is its own, corrected by this one's (`ManifoldMapping`)."""

from __future__ import annotations

from dataclasses import replace

from ..cloud import Cloud
from ..forward import ForwardModel
from ..result import Registration
from ..setup import Ended, Setup
from .cold_start import Localised, finish
from .multifidelity import solved_with


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
    if last is not None and is_same_place(last, draft):
        problem = setup.problem(points, last.prepared, last.evaluation.positions, last.rms_distance)
        near = replace(last.evaluation, coefficients=problem.carried(last.evaluation.coefficients, last.problem))
        return Ended(last.prepared, solved_with(setup, problem, near, solver, last.eta))
    # Told a zone, the exact model gathers no forces within it, and takes none that were: see `options_for`.
    prepared = setup.unlocalised
    if setup.options.localisation.rounds:
        prepared = setup.prepared(replace(draft.prepared.forces, scale=setup.forces.scale))
    problem = setup.plain(points, prepared)
    start = problem.carried(draft.coefficients, draft.problem)
    start[problem.force_part] = prepared.forces.nearest(draft.unknown_forces)
    found = solved_with(setup, problem, problem.evaluation(start, draft.evaluation), solver, draft.eta, fast)
    return finish(setup, points, Localised(prepared, found))


def is_same_place(last: Registration | None, draft: Registration) -> bool:
    """Whether an exact model's last result has forces where a draft seeks them, so that it can be gone on from.

    Args:
        last: of the frame before; None for none.
        draft: the faster model's result.
    """
    if last is None or last.draft is None or last.prepared is draft.prepared:  # the last: it is a draft itself
        return False
    return last.draft.prepared is draft.prepared
