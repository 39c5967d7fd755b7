"""Load steps: halved where they fail, grown where they succeed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .newton import Attempt, Newton
from .path import LoadPath
from .start import Starts

_GROWTH, _CUT = 1.5, 0.5  # of load steps after a success and a failure
_SMALLEST_STEP = 1e-6  # of the load; where not even that can be added there is a limit point


@dataclass(frozen=True, eq=False)
class Continued:
    """How far a load was taken.

    Args:
        reached: part of the load at which the last equilibrium was found.
        last: the run that found it; None where there was none.
        tried: the last run, whether it converged or not.
        load_steps: successful ones.
        iterations: Newton iterations of all steps, failed ones included.
        is_limit: not even the smallest step could be added.
    """

    reached: float
    last: Attempt | None
    tried: Attempt
    load_steps: int
    iterations: int
    is_limit: bool


def in_load_steps(newton: Newton, starts: Starts, path: LoadPath, first_step: float) -> Continued:
    """Take a load from nothing to its whole, or as far as it goes.

    Args:
        newton: iterations.
        starts: carries prescribed displacements into the body.
        path: parts of the load.
        first_step: part of it that is tried first.
    """
    reached, step, good, spent = 0.0, first_step, 0, 0
    screws = starts.screws(path)
    state, last = np.zeros_like(path.whole.dead), None
    for _ in range(newton.options.max_load_steps):
        target = min(1.0, reached + step)
        start = starts.ahead(path, screws, state, reached, target)
        tried = newton.run(path.load(target), start, target, eliminate=True)
        spent += tried.iterations
        if not tried.converged:
            step *= _CUT
            if step < _SMALLEST_STEP:
                break
            continue
        reached, state, good, last = target, tried.unknowns, good + 1, tried
        step *= _GROWTH
        if reached == 1.0:
            break
    return Continued(reached, last, tried, good, spent, step < _SMALLEST_STEP)
