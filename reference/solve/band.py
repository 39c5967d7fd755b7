"""Band Cholesky (LAPACK) for slender bodies: numbered along their axis, few diagonals are filled.

On the thesis's beam it is about three times faster than MUMPS, whose fronts are small there. It has no pivoting: where
the matrix is not positive definite, somebody else has to factor it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Sparse factorisations in space take about 10 n^2 operations at half the speed of band's n b^2 (benchmarks/growth.py).
_WIDEST = 4.0  # times the square root of the number of unknowns


class BandFactor:
    """A Cholesky factor of a matrix whose values change and whose sparsity stays, in band storage.

    Args:
        matrix: sequential PETSc matrix.
        order: its unknowns in the order of elimination.
    """

    def __init__(self, matrix: Any, order: Ints) -> None:
        indptr, columns, _ = matrix.getValuesCSR()
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        rows, columns = place[np.repeat(np.arange(len(order)), np.diff(indptr))], place[columns]
        below = rows - columns
        self._entries = np.flatnonzero(below >= 0)
        self._width = int(below.max()) + 1
        # LAPACK's lower band: entry (i, j) is in row i - j of column j, columns one after the other.
        self._places = below[self._entries] + columns[self._entries] * self._width
        self._order = order
        self._storage = np.zeros(self._width * len(order))
        self._factor: Floats | None = None

    def factor(self, matrix: Any) -> bool:
        """Factor the matrix as it is now; False if it is not positive definite."""
        self._storage[:] = 0.0
        self._storage[self._places] = matrix.getValuesCSR()[2][self._entries]
        band = self._storage.reshape(len(self._order), self._width).T  # column-major without a copy
        factor, failed = dpbtrf(band, lower=1, overwrite_ab=1)
        self._factor = None if failed else factor
        return not failed

    def solve(self, rows: Floats) -> Floats:
        """The inverse applied to each row, (k, n)."""
        solved, _ = dpbtrs(self._factor, np.asfortranarray(rows[:, self._order].T), lower=1, overwrite_b=1)
        out = np.empty_like(rows)
        out[:, self._order] = solved.T
        return out


def band_order(matrix: Any, points: Floats, nodes: Ints) -> Ints | None:
    """An order of elimination with a narrow band, or None where a sparse factorisation is faster.

    Args:
        matrix: sequential PETSc matrix.
        points: positions of the body's nodes, (n, d).
        nodes: node of each block of d unknowns.
    """
    indptr, columns, _ = matrix.getValuesCSR()
    size, dimension = len(indptr) - 1, points.shape[1]
    pattern = csr_matrix((np.ones(len(columns), dtype=np.int8), columns, indptr), shape=(size, size))
    centred = points[nodes] - points[nodes].mean(axis=0)
    orders = [reverse_cuthill_mckee(pattern, True).astype(np.int64)]
    for axes in (np.linalg.svd(centred, full_matrices=False)[2], np.eye(dimension)):
        blocks = _layers(centred @ axes.T)
        orders.append((dimension * blocks[:, None] + np.arange(dimension)).ravel())
    order = min(orders, key=lambda o: _bandwidth(pattern, o))
    return order if _bandwidth(pattern, order) <= _WIDEST * np.sqrt(size) else None


def _layers(positions: Floats) -> Ints:
    """Numbers of points sorted along the longest axis, then the next; rounded, so that layers stay layers."""
    rounded = np.rint(positions / (1e-6 * np.ptp(positions, axis=0).max()))
    return np.lexsort(rounded[:, np.argsort(np.ptp(positions, axis=0))].T)


def _bandwidth(pattern: csr_matrix, order: Ints) -> int:
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    rows = np.repeat(place, np.diff(pattern.indptr))
    return int(np.abs(rows - place[pattern.indices]).max())
