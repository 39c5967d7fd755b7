"""Products of sparse rows are those of SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array, random_array

from softtwin.meshes import sparse_products
from softtwin.meshes.sparse_products import product


@pytest.mark.parametrize("is_compiled", [True, False])
@pytest.mark.parametrize(("count", "columns"), [(0, 3), (1, 1), (40, 7), (5, 0)])
def test_the_product_is_that_of_scipy(monkeypatch, rng, count: int, columns: int, is_compiled: bool) -> None:
    """Rows without entries, several entries of one place, and columns that are not contiguous too."""
    monkeypatch.setattr(sparse_products, "IS_COMPILED", is_compiled)
    rows = csr_array(random_array((count, 30), density=0.2, rng=rng, format="csr"))
    twice = csr_array((np.ones(2), np.array([4, 4]), np.array([0, 2])), shape=(1, 30))
    dense = rng.standard_normal((2 * columns, 30)).T[:, ::2]
    for each in (rows, twice):
        np.testing.assert_allclose(product(each, dense), each.toarray() @ dense, rtol=1e-12, atol=1e-14)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="mismatch"):
        product(csr_array((2, 3)), np.ones((4, 2)))
