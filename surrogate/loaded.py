"""A network under nodal forces that are known to act along: it is asked for the state under both."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from softtwin.meshes.body import Body
from softtwin.reference.data.discrepancy import Discrepancy

from .model import ReducedSurrogate, ReducedSurrogateState, Surrogate, SurrogateState

Floats = NDArray[np.float64]


class LoadedSurrogate:
    """A surrogate as a forward model of the forces that are added to some that are known.

    Args:
        surrogate: the surrogate.
        known: nodal forces that act at all times, (n, 3), newtons.

    Raises:
        ValueError: another shape, numbers that are not finite, or forces at nodes that the surrogate never saw loaded.
    """

    def __init__(self, surrogate: Surrogate, known: ArrayLike) -> None:
        self.surrogate, self.known = surrogate, np.asarray(known, dtype=np.float64)
        surrogate.solve(self.known)  # refuses what it has never seen

    @property
    def body(self) -> Body:
        """The body that deforms."""
        return self.surrogate.body

    @property
    def error(self) -> float:
        """As the surrogate's own."""
        return self.surrogate.error

    @property
    def discrepancy(self) -> Discrepancy | None:
        """As the surrogate's own."""
        return self.surrogate.discrepancy

    @property
    def is_linear(self) -> bool:
        """As the surrogate's own."""
        return self.surrogate.is_linear

    @property
    def learned_material(self) -> Mapping[str, Any] | None:
        """As the surrogate's own."""
        return self.surrogate.learned_material

    def solve(self, forces: ArrayLike, near: Any = None) -> SurrogateState:
        """The state under the known forces and others, (n, 3) newtons; see `Surrogate.solve`."""
        return self.surrogate.solve(self.known + np.asarray(forces, dtype=np.float64))

    def propose(self, forces: ArrayLike, linear: Floats | None = None) -> Floats:
        """Where Newton's method may start under both; see `Surrogate.propose`.

        Args:
            forces: those beside the known ones, (n, 3), newtons.
            linear: linear response to both, (n, 3), metres.
        """
        return self.surrogate.propose(self.known + np.asarray(forces, dtype=np.float64), linear)

    def reduced(self, nodes: ArrayLike, basis: ArrayLike) -> LoadedReduced:
        """Between force coefficients and a few nodes; see `Surrogate.reduced`."""
        both = np.column_stack([np.asarray(basis, dtype=np.float64), self.known.ravel()])
        return LoadedReduced(self.surrogate.reduced(nodes, both))


class LoadedReduced:
    """A reduced surrogate whose last coefficient is one: that of the known forces.

    Args:
        inner: of the unknown forces and the known ones.
    """

    def __init__(self, inner: ReducedSurrogate) -> None:
        self.inner = inner

    @property
    def count(self) -> int:
        """Number of coefficients of the unknown forces, k."""
        return self.inner.count - 1

    def combined(self, matrix: Floats) -> LoadedReduced:
        """The same for the basis times a matrix, (k, j)."""
        return LoadedReduced(self.inner.combined(block_diag(matrix, 1.0)))

    def solve(self, coefficients: ArrayLike, near: Any = None) -> LoadedReducedState:
        """The state for coefficients of the unknown forces, (k,): `near` itself where it is that."""
        whole = np.append(np.asarray(coefficients, dtype=np.float64), 1.0)
        found = self.inner.solve(whole, getattr(near, "inner", None))
        return near if isinstance(near, LoadedReducedState) and found is near.inner else LoadedReducedState(found)


class LoadedReducedState:
    """A state of `LoadedReduced`, as a function of the unknown forces alone.

    Args:
        inner: as a function of both.
    """

    def __init__(self, inner: ReducedSurrogateState) -> None:
        self.inner = inner

    @property
    def positions(self) -> Floats:
        """Displacement of the chosen nodes, (p, 3), metres."""
        return self.inner.positions

    @property
    def full(self) -> SurrogateState:
        """The whole state."""
        return self.inner.full

    def jacobian(self, rows: csr_array) -> Floats:
        """Derivative of linear functions of the chosen displacements, (q, k), for rows (q, 3p)."""
        return self.inner.jacobian(rows)[:, :-1]

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """First-order displacement of every so-manieth chosen node, (p, 3), for a change of the coefficients, (k,)."""
        return self.inner.moved(np.append(change, 0.0), every)
