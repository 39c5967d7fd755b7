"""A registration's problem at one set of coefficients: the state, the surface that it has, the cloud on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from .forward import ReducedState
from .pose import Pose
from .surface_distance import Correspondence, SurfaceDistance

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The problem at one set of coefficients.

    Args:
        coefficients: of all parameter blocks, (k,).
        observed: the observed side.
        state: the body's state as the model has it.
        positions: displacement of the observed nodes with what blocks add to the state, (m, 3), metres.
        pose: from the body's coordinates to the cloud's; None where it is not unknown.
        given: points as they were given, (p, 3), metres: the array tells which cloud it is.
        cloud: the same in the body's coordinates, (p, 3), metres.
        match: the cloud on the surface.
        stiffness_scaling: factor of the nodal forces by the body's stiffness.
    """

    coefficients: Floats
    observed: SurfaceDistance
    state: ReducedState
    positions: Floats
    pose: Pose | None
    given: Floats
    cloud: Floats
    match: Correspondence
    stiffness_scaling: float = 1.0
    _cache: dict[Any, Floats] = field(default_factory=dict, init=False, repr=False)

    def once(self, key: Any, found: Callable[[], Floats]) -> Floats:
        """What depends on this trial alone, found when it is first asked for.

        Args:
            key: names it.
            found: finds it.
        """
        if key not in self._cache:
            self._cache[key] = found()
        return self._cache[key]

    @property
    def rotation(self) -> Floats:
        """From the body's axes to the cloud's, (3, 3)."""
        return np.eye(3) if self.pose is None else self.pose.rotation

    def in_body(self, places: Floats) -> Floats:
        """Places in the cloud's coordinates, (q, 3), in the body's."""
        return places if self.pose is None else self.pose.inverse().apply(places)


@dataclass(frozen=True, eq=False)
class Slopes:
    """How residuals follow from what parameters move: the observed nodes, and what a camera has measured.

    A residual is a length along a vector, from a measured place to a place of the surface: it grows as the surface
    moves along that vector, and shrinks as the measured place does.

    Args:
        rows: derivative by the displacement of the observed nodes, (q, 3m), body's axes.
        along: the vectors, over the residuals' units, (q, 3), body's axes.
        places: that were measured, (q, 3), metres, body's coordinates; of a measured direction, that.
        are_directions: directions were measured: they turn with the camera, and are not shifted with it.
        match: where distances of the cloud are meant, which some blocks explain without moving anything: the cloud on
            the surface. None for all other residuals.
    """

    rows: csr_array
    along: Floats
    places: Floats
    are_directions: bool = False
    match: Correspondence | None = None
