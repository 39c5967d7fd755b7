"""Tangents by way of their cells: all are tabulated, then one sparse product adds them up.

Entry by entry, PETSc would need longer for the adding (benchmarks/assembly.py). The matrix is the same to the last bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from .discretisation import Discretisation
from .fenicsx import CellMatrices, cell_dofs, matrix_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_MOST_ENTRIES = 10_000_000  # of all cells, twelve bytes each beside their values: what a direct solver can factor


def cell_unknowns(space: Discretisation) -> Ints:
    """Unknowns of each cell in the order of its matrix, (cells, k)."""
    blocks, size = cell_dofs(space.space), space.space.dofmap.index_map_bs
    return (blocks[:, :, None] * size + np.arange(size)).reshape(len(blocks), -1)


def suits(space: Discretisation) -> bool:
    """Whether a body is on one rank and small enough for all its cells' matrices to be kept."""
    unknowns = cell_unknowns(space)
    return space.comm.size == 1 and unknowns.shape[0] * unknowns.shape[1] ** 2 <= _MOST_ENTRIES


class CellSum:
    """The sum of cell matrices in a fixed sparsity; held rows and columns are the identity's.

    Args:
        space: numbering and held unknowns, on one rank.
        matrices: of the form.
        pattern: rows' starts and columns of the whole matrix.
    """

    def __init__(self, space: Discretisation, matrices: CellMatrices, pattern: tuple[Ints, Ints]) -> None:
        self._matrices, self._pattern = matrices, pattern
        starts, columns = pattern
        entries, size = len(columns), len(starts) - 1
        place = csr_matrix((np.arange(entries), columns, starts), shape=(size, size))
        unknowns = cell_unknowns(space)
        free = np.ones(size, dtype=bool)
        free[space.fixed] = False
        wanted = np.flatnonzero((free[unknowns][:, :, None] & free[unknowns][:, None, :]).ravel())
        rows, columns = (grid.ravel()[wanted] for grid in np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None]))
        to = np.asarray(place[rows, columns]).ravel()
        shape = (entries, unknowns.shape[0] * unknowns.shape[1] ** 2)
        self._sum = coo_matrix((np.ones(len(to)), (to, wanted)), shape=shape).tocsr()
        held = space.fixed  # no unknown need be, where springs hold the body
        self._ones = np.asarray(place[held, held]).ravel() if len(held) else np.zeros(0, dtype=np.int64)

    def create_matrix(self) -> Any:
        """A PETSc matrix of zeros."""
        return matrix_of(*self._pattern)

    def assemble(self, matrix: Any) -> None:
        """The sum at the present coefficients into a matrix that was created here."""
        values = matrix.getAttr("values")
        values[:] = self._sum @ self._matrices.all().ravel()
        values[self._ones] = 1.0
        matrix.stateIncrease()
