"""Whether forces outside the zone explain what those within it leave: when that is asked, and what the answer says."""

from __future__ import annotations

import numpy as np

from ..checks import shared
from ..policy import POLICY
from ..result import Registration
from ..setup import Setup
from ..verdict import Check, Code, checked


def is_missed(setup: Setup, found: Registration) -> bool:
    """Whether neighbouring points are missed alike, by more than the least noise.

    Args:
        setup: what was registered.
        found: with forces in the zone alone.
    """
    match = found.evaluation.match  # with those points that were taken for outliers: patches of them are none
    part = shared(setup.observed.closest_points(match), match.distances, np.ones(len(match.distances)))
    return match.rms * np.sqrt(part) > setup.noise.minimum


def compared(within: Registration, anywhere: Registration) -> Check:
    """The check: how much of the distances is left with forces anywhere.

    Args:
        within: with forces in the zone alone.
        anywhere: of the same cloud with all forces.
    """
    ours, others = within.evaluation.match.rms, anywhere.evaluation.match.rms
    reason = (
        f"forces outside the zone explain the cloud better: points lie {1e3 * ours:.2f} mm from the surface, with "
        f"forces anywhere {1e3 * others:.2f} mm"
    )
    unit = "of the distances that are left"
    return checked(Code.FORCES_ELSEWHERE, others / ours, POLICY.elsewhere, reason, unit=unit, is_minimum=True)
