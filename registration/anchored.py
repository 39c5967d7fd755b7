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
class Anchored:
    """A reduced model whose states are moved by what it was wrong by at one of them, in place and in slope.

    At the anchor it is the exact model to first order. A minimum found with it is the exact model's, once no step leads
    on from an exact state (manifold mapping: Echeverria and Hemker 2005).

    Args:
        fast: the fast model.
        nodes: numbers of its chosen nodes, (p,).
        anchor: coefficients there, (k,).
        offset: what is added to all displacements, (n, 3), metres.
        slopes: what is added to the derivatives of the chosen ones, (3p, k).
    """

    fast: ReducedModel
    nodes: Ints
    anchor: Floats
    offset: Floats
    slopes: Floats

    @classmethod
    def at(cls, fast: ReducedModel, nodes: Ints, anchor: Floats, exact: ReducedState) -> Anchored:
        """Moved to an exact state, seen at the same nodes, of coefficients (k,)."""
        own, every = fast.solve(anchor), csr_array(eye(3 * len(nodes)))
        offset = exact.full.displacement - own.full.displacement
        return cls(fast, nodes, anchor, offset, exact.jacobian(every) - own.jacobian(every))

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return self.fast.count

    def combined(self, matrix: Floats) -> Anchored:
        """The same for other combinations of the forces: the anchor is the nearest of theirs."""
        anchor = np.linalg.lstsq(matrix, self.anchor, rcond=None)[0]
        return Anchored(self.fast.combined(matrix), self.nodes, anchor, self.offset, self.slopes @ matrix)

    def solve(self, coefficients: Floats, near: Any = None) -> AnchoredState:
        """The fast model's state for coefficients, (k,), moved."""
        start = near.own if isinstance(near, AnchoredState) else None
        return AnchoredState(self, coefficients, self.fast.solve(coefficients, start))


@dataclass(frozen=True, eq=False)
class AnchoredState:
    """A reduced state that is moved.

    Args:
        model: by which.
        coefficients: of it, (k,).
        own: the fast model's.
    """

    model: Anchored
    coefficients: Floats
    own: ReducedState

    @property
    def positions(self) -> Floats:
        """Displacement of the chosen nodes, (p, 3), metres."""
        turned = self.model.slopes @ (self.coefficients - self.model.anchor)
        return self.own.positions + self.model.offset[self.model.nodes] + turned.reshape(-1, 3)

    @property
    def full(self) -> Shifted:
        """The whole state, without what the slopes add."""
        return Shifted(self.own.full, self.model.offset)

    def jacobian(self, rows: csr_array) -> Floats:
        """Derivative of linear functions of the chosen displacements, (q, k), for rows (q, 3p)."""
        return self.own.jacobian(rows) + rows @ self.model.slopes

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """First-order displacement of every so-manieth chosen node, (p, 3)."""
        added = (self.model.slopes @ change).reshape(-1, 3)
        return self.own.moved(change, every) + added[::every]


@dataclass(frozen=True, eq=False)
class Shifted:
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
    def extent(self) -> float | None:
        """How far the load lies out: see `State.extent`."""
        return self.own.extent

    def push(self, changes: ArrayLike) -> Floats:
        """As the fast model has it."""
        return self.own.push(changes)

    def pull(self, cotangent: ArrayLike) -> Floats:
        """As the fast model has it."""
        return self.own.pull(cotangent)
