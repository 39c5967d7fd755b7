"""A few cells, with weights, that stand for the whole body: internal forces along a few modes at their price.

Energy-conserving sampling and weighting (Farhat, Avery, Chapman and Cortial 2014), after the optimised cubature of An,
Kim and James 2008: weights are not negative, so that what is stored stays an energy and tangents stay symmetric.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Singles = NDArray[np.float32]
_BATCH = 8  # cells that are taken at a time
_RIDGE = 1e-13  # of the mean square of a column, for columns that are nearly alike


def sparse_weights(shares: Floats | Singles, tolerance: float, maximum: int) -> tuple[Ints, Floats, float]:
    """Cells with weights that are not negative, whose weighted shares make the sum of all.

    Args:
        shares: of each cell in each figure that is to be kept, (f, cells); single precision is enough.
        tolerance: of what is missing, relative to the sum, in the Euclidean norm.
        maximum: number of cells.

    Returns:
        Numbers of the cells, (c,), their weights, (c,), and what is missing, relative to the sum.
    """
    wanted = shares.sum(axis=1, dtype=np.float64)
    size = float(np.linalg.norm(wanted))
    active: list[int] = []
    weights = np.zeros(0)
    products = np.zeros((0, 0))
    right = _products(shares, wanted)
    missing = wanted.copy()
    while np.linalg.norm(missing) > tolerance * size and len(active) < maximum:
        promise = _products(shares, missing)
        promise[active] = -np.inf
        new = np.argsort(promise)[::-1][: min(_BATCH, maximum - len(active))]
        new = new[promise[new] > 0.0]
        if not len(new):
            break
        products = _grown(products, shares, active, new)
        active += new.tolist()
        weights = np.concatenate([weights, np.zeros(len(new))])
        active, weights, products = _least_squares(active, weights, products, right)
        before, missing = float(np.linalg.norm(missing)), wanted - _columns(shares, active) @ weights
        if np.linalg.norm(missing) >= before:  # rounding leaves no more to gain
            break
    return np.array(active, dtype=np.int64), weights, float(np.linalg.norm(missing)) / max(size, 1e-300)


def _products(shares: Floats | Singles, vector: Floats) -> Floats:
    """With every column, in the precision of the columns."""
    return (shares.T @ vector.astype(shares.dtype)).astype(np.float64)


def _columns(shares: Floats | Singles, places: list[int] | Ints) -> Floats:
    return shares[:, places].astype(np.float64)


def _grown(products: Floats, shares: Floats | Singles, active: list[int], new: Ints) -> Floats:
    """Scalar products of the columns that are taken, with new ones."""
    added = _columns(shares, new)
    mixed, own = _columns(shares, active).T @ added, added.T @ added
    return np.block([[products, mixed], [mixed.T, own]])


def _least_squares(
    active: list[int], weights: Floats, products: Floats, right: Floats
) -> tuple[list[int], Floats, Floats]:
    """Weights that are not negative, by Lawson and Hanson's way out of the corners; cells without weight leave."""
    while True:
        ridge = _RIDGE * np.trace(products) / len(products)
        found = np.linalg.solve(products + ridge * np.eye(len(products)), right[active])
        if (found > 0.0).all():
            return active, found, products
        wrong = found <= 0.0
        step = float(np.min(weights[wrong] / np.maximum(weights[wrong] - found[wrong], 1e-300)))
        weights = weights + step * (found - weights)
        kept = np.flatnonzero(~wrong | (weights > 1e-12 * weights.max(initial=0.0)))
        active = [active[place] for place in kept]
        weights, products = weights[kept], products[np.ix_(kept, kept)]
