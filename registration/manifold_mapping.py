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
        has_secant: the slopes are those of an earlier state with Broyden's update, not the exact ones: see `updated`.
    """

    fast: ReducedModel
    nodes: Ints
    expansion_point: Floats
    offset: Floats
    slopes: Floats
    has_secant: bool = False

    @classmethod
    def at(cls, fast: ReducedModel, nodes: Ints, expansion_point: Floats, exact: ReducedState) -> ManifoldMapping:
        """Moved to an exact state, seen at the same nodes, of coefficients (k,)."""
        own, every = fast.solve(expansion_point), csr_array(eye(3 * len(nodes)))
        offset = exact.full.displacement - own.full.displacement
        return cls(fast, nodes, expansion_point, offset, exact.jacobian(every) - own.jacobian(every))

    def updated(self, coefficients: Floats, exact: ReducedState, tolerance: float) -> ManifoldMapping:
        """The same at another exact state, with Broyden's update of the slopes: their secant is exact (1965).

        Args:
            coefficients: of it, (k,).
            exact: it, seen at the same nodes.
            tolerance: where these slopes missed a larger part of what lies between both states, its own are taken.
        """
        guess, way = self.solve(coefficients), coefficients - self.expansion_point
        missed = (exact.positions - guess.positions).ravel()
        moved = (exact.positions - self.solve(self.expansion_point).positions).ravel()
        if np.linalg.norm(missed) > tolerance * np.linalg.norm(moved):
            return self.at(self.fast, self.nodes, coefficients, exact)
        offset = exact.full.displacement - guess.own.full.displacement
        slopes = self.slopes + np.outer(missed, way) / max(float(way @ way), 1e-300)
        return ManifoldMapping(self.fast, self.nodes, coefficients, offset, slopes, True)

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
class SecantState:
    """An exact reduced state whose derivatives at the chosen nodes are the mapping's: none is computed.

    Args:
        exact: the state.
        mapped: the mapping's.
    """

    exact: ReducedState
    mapped: ManifoldMappingState

    @property
    def positions(self) -> Floats:
        """Displacement of the chosen nodes, (p, 3), metres."""
        return self.exact.positions

    @property
    def full(self) -> State:
        """The whole state, with its own slopes."""
        return self.exact.full

    def jacobian(self, rows: csr_array) -> Floats:
        """As the mapping has it."""
        return self.mapped.jacobian(rows)

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """As the mapping has it."""
        return self.mapped.moved(change, every)


@dataclass(frozen=True, eq=False)
class ZeroModel:
    """A reduced model of a body that nothing moves: mapped to an exact state, it is the tangent there.

    Args:
        count: number of coefficients, k.
        chosen: number of chosen nodes, p.
        nodes: number of the body's, n.
    """

    count: int
    chosen: int
    nodes: int

    def combined(self, matrix: Floats) -> ZeroModel:
        """The same for other combinations of the forces."""
        return ZeroModel(matrix.shape[1], self.chosen, self.nodes)

    def solve(self, coefficients: Floats, near: Any = None) -> ZeroState:
        """At rest."""
        return ZeroState(self)


@dataclass(frozen=True, eq=False)
class ZeroState:
    """Rest, whatever acts.

    Args:
        model: of which.
    """

    model: ZeroModel

    @property
    def positions(self) -> Floats:
        """Zeros, (p, 3)."""
        return np.zeros((self.model.chosen, 3))

    @property
    def full(self) -> ZeroDisplacement:
        """The whole body."""
        return ZeroDisplacement(self.model.nodes)

    def jacobian(self, rows: csr_array) -> Floats:
        """Zeros, (q, k)."""
        return np.zeros((rows.shape[0], self.model.count))

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """Zeros, (p, 3)."""
        return self.positions[::every]


@dataclass(frozen=True)
class ZeroDisplacement:
    """A whole body at rest.

    Args:
        count: number of its nodes, n.
    """

    count: int
    negative_pivots: None = None
    extrapolation_ratio: None = None

    @property
    def displacement(self) -> Floats:
        """Zeros, (n, 3)."""
        return np.zeros((self.count, 3))

    def jvp(self, changes: ArrayLike) -> Floats:
        """Zeros."""
        return np.zeros_like(np.asarray(changes, dtype=np.float64))

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """Zeros."""
        return np.zeros_like(np.asarray(cotangent, dtype=np.float64))


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
