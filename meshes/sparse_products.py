"""Products of sparse rows with dense columns, for rows that are few entries long and made anew at every step."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from .body import Floats, Ints
from .compiled import IS_COMPILED, compiled


def product(rows: csr_array, dense: Floats) -> Floats:
    """The rows times dense columns, (q, k): SciPy's product, sooner where numba is installed.

    Args:
        rows: (q, n).
        dense: (n, k).

    Raises:
        ValueError: shapes that do not fit.
    """
    if not IS_COMPILED or dense.ndim != 2 or rows.shape[1] != len(dense):
        return np.asarray(rows @ dense)
    found = np.zeros((rows.shape[0], dense.shape[1]))
    _added(found, rows.indptr, rows.indices, rows.data, np.ascontiguousarray(dense))
    return found


@compiled
def _added(found: Floats, ends: Ints, places: Ints, values: Floats, dense: Floats) -> None:
    """Add to what there is, (q, k): numbers of rows of the dense matrix and their factors, between the ends."""
    for row in range(len(found)):
        for entry in range(ends[row], ends[row + 1]):
            place, value = places[entry], values[entry]
            for column in range(found.shape[1]):
                found[row, column] += value * dense[place, column]
