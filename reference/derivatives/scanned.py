"""A forward model of an organ scanned under its weight: displacements from the scan, equilibria of what is behind it.

The tissue of the scanned shape is stressed. A stress-free body is behind it (`unloaded`); states are its equilibria,
told from the scanned shape, so that all who use the model need not know of the other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

from ..data.discrepancy import Discrepancy
from ..data.inputs import Change, Inputs
from .model import ReferenceModel, ReferenceState

Floats = NDArray[np.float64]


class ScannedModel:
    """Forces to states from the scanned shape.

    Args:
        scanned: the body as the scan shows it.
        model: of the unloaded body, with all that acts now among its loading.
        loaded: displacement from the unloaded to the scanned shape, (n, 3), metres.
    """

    def __init__(self, scanned: Body, model: ReferenceModel, loaded: Floats) -> None:
        self.body, self._model, self.loaded = scanned, model, loaded

    @property
    def error(self) -> float:
        """0: it is what others are measured by."""
        return self._model.error

    @property
    def is_linear(self) -> bool:
        """Whether the law is linear: it holds where nothing turns or stretches much."""
        return self._model.is_linear

    @property
    def discrepancy(self) -> Discrepancy | None:
        """What is not known of the organ, as patterns that the model may be wrong by."""
        return self._model.discrepancy

    def solve(self, forces: ArrayLike, near: Any = None, inputs: Inputs | None = None) -> ScannedState:
        """The state under nodal forces beside all that acts, (n, 3) newtons.

        Args:
            forces: nodal forces.
            near: a state to start from; where not given, the scanned shape itself.
            inputs: prescribed displacements, from the scanned shape.

        Raises:
            NotConverged: no equilibrium was found.
        """
        if isinstance(near, ScannedState):
            start: Any = near.unloaded
        else:
            start = _Guess(self.loaded + (0.0 if near is None else near.displacement))
        return ScannedState(self._model.solve(forces, start, inputs), self.loaded)


@dataclass(frozen=True, eq=False)
class _Guess:
    displacement: Floats


@dataclass(frozen=True, eq=False)
class ScannedState:
    """An equilibrium, told from the scanned shape.

    Args:
        unloaded: the state of the unloaded body.
        loaded: displacement from the unloaded to the scanned shape, (n, 3), metres.
    """

    unloaded: ReferenceState
    loaded: Floats

    @property
    def displacement(self) -> Floats:
        """Of the nodes from the scanned shape, (n, 3), metres."""
        return self.unloaded.displacement - self.loaded

    @property
    def extrapolation_ratio(self) -> None:
        """None: the reference has learned nothing that it could leave."""

    @property
    def negative_pivots(self) -> int | None:
        """Negative pivots of the tangent: 0 is stable."""
        return self.unloaded.negative_pivots

    def jvp(self, changes: ArrayLike) -> Floats:
        """Changes of the displacement, (3n, k), for small changes of the forces, (3n, k)."""
        return self.unloaded.jvp(changes)

    def jvp_inputs(self, changes: Sequence[Change]) -> Floats:
        """Changes of the displacement, (3n, k), for small changes of prescribed displacements."""
        return self.unloaded.jvp_inputs(changes)

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3), from the one with respect to the displacement."""
        return self.unloaded.vjp(cotangent)
