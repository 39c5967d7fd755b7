"""A fast model moved to where an exact one stands, and turned to its slopes: what is left to it is how they change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, eye

from .forward import ReducedModel, ReducedState, State

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ManifoldMapping:
    """A reduced model whose states are moved by what it was wrong by at one of them, in place and in slope.

    At the anchor it is the exact model to first order. A minimum found with it is the exact model's, once no step leads
    on from an exact state (manifold mapping: Echeverria and Hemker 2005).

    Args:
        fast: the fast model.
        nodes: numbers of its chosen nodes, (p,).
        expansion_point: coefficients there, (k,).
        offset: what is added to all displacements, (n, 3), metres.
        slopes: what is added to the derivatives of the chosen ones, (3p, k).
    """

    fast: ReducedModel
    nodes: Ints
    expansion_point: Floats
    offset: Floats
    slopes: Floats

    @classmethod
    def at(cls, fast: ReducedModel, nodes: Ints, expansion_point: Floats, exact: ReducedState) -> ManifoldMapping:
        """Moved to an exact state, seen at the same nodes, of coefficients (k,)."""
        own, every = fast.solve(expansion_point), csr_array(eye(3 * len(nodes)))
        offset = exact.full.displacement - own.full.displacement
        return cls(fast, nodes, expansion_point, offset, exact.jacobian(every) - own.jacobian(every))

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return self.fast.count

    def combined(self, matrix: Floats) -> ManifoldMapping:
        """The same for other combinations of the forces: the anchor is the nearest of theirs."""
        expansion_point = np.linalg.lstsq(matrix, self.expansion_point, rcond=None)[0]
        return ManifoldMapping(
            self.fast.combined(matrix), self.nodes, expansion_point, self.offset, self.slopes @ matrix
        )

    def solve(self, coefficients: Floats, near: Any = None) -> ManifoldMappingState:
        """The fast model's state for coefficients, (k,), moved."""
        start = near.own if isinstance(near, ManifoldMappingState) else None
        return ManifoldMappingState(self, coefficients, self.fast.solve(coefficients, start))


@dataclass(frozen=True, eq=False)
class ManifoldMappingState:
    """A reduced state that is moved.

    Args:
        model: by which.
        coefficients: of it, (k,).
        own: the fast model's.
    """

    model: ManifoldMapping
    coefficients: Floats
    own: ReducedState

    @property
    def positions(self) -> Floats:
        """Displacement of the chosen nodes, (p, 3), metres."""
        turned = self.model.slopes @ (self.coefficients - self.model.expansion_point)
        return self.own.positions + self.model.offset[self.model.nodes] + turned.reshape(-1, 3)

    @property
    def full(self) -> CorrectedState:
        """The whole state, without what the slopes add."""
        return CorrectedState(self.own.full, self.model.offset)

    def jacobian(self, rows: csr_array) -> Floats:
        """Derivative of linear functions of the chosen displacements, (q, k), for rows (q, 3p)."""
        return self.own.jacobian(rows) + rows @ self.model.slopes

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """First-order displacement of every so-manieth chosen node, (p, 3)."""
        added = (self.model.slopes @ change).reshape(-1, 3)
        return self.own.moved(change, every) + added[::every]


@dataclass(frozen=True, eq=False)
class CorrectedState:
    """A state that is shifted: its slopes are its own.

    Args:
        own: the state.
        offset: (n, 3), metres.
    """

    own: State
    offset: Floats

    @property
    def displacement(self) -> Floats:
        """Of the nodes, (n, 3), metres."""
        return self.own.displacement + self.offset

    @property
    def negative_pivots(self) -> None:
        """None: it is no equilibrium."""
        return None

    @property
    def extrapolation_ratio(self) -> float | None:
        """How far the load lies out: see `State.extrapolation_ratio`."""
        return self.own.extrapolation_ratio

    def jvp(self, changes: ArrayLike) -> Floats:
        """As the fast model has it."""
        return self.own.jvp(changes)

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """As the fast model has it."""
        return self.own.vjp(cotangent)
