"""A surrogate made small enough to travel with a package: fewer directions, numbers in single precision."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .maps import LinearMaps
from .model import Surrogate

Floats = NDArray[np.float64]


def compacted(surrogate: Surrogate, rank: int, load_modes: int) -> Surrogate:
    """The surrogate with the leading directions of its linear response alone, and numbers that single precision holds.

    It predicts otherwise than the one it was made from, if little: what was measured of that one (held-out errors,
    certificate, patterns of error) is to be measured of it anew, and is left out of its card.

    Args:
        surrogate: a trained surrogate.
        rank: directions of the linear response that are kept.
        load_modes: directions of the training loads that are kept; what the others hold is spread evenly.

    Raises:
        ValueError: a number below 1.
    """
    for name, value in (("rank", rank), ("load_modes", load_modes)):
        if value < 1:
            raise ValueError(f"compacted.{name}: expected at least 1, got {value}.")
    maps = _fewer_load_modes(_of_rank(surrogate.maps, rank), load_modes)
    network = copy.deepcopy(surrogate.network).float().double()
    measured = ("held_out", "certificate", "discrepancy")
    card = {name: entry for name, entry in surrogate.card.items() if name not in measured}
    return Surrogate(surrogate.body, _single(replace(maps, error_modes=None, error_rest=None)), network, card)


def _of_rank(maps: LinearMaps, rank: int) -> LinearMaps:
    whole = maps.left if maps.right is None else maps.left @ maps.right
    left, sizes, right = np.linalg.svd(whole, full_matrices=False)
    return replace(maps, left=left[:, :rank] * sizes[:rank], right=right[:rank])


def _fewer_load_modes(maps: LinearMaps, count: int) -> LinearMaps:
    if maps.load_modes is None or maps.load_rest is None:
        return maps
    squares = np.square(maps.load_modes).sum(axis=0)
    order = np.argsort(-squares)
    left_out = squares[order[count:]].sum() / len(maps.load_modes)
    return replace(maps, load_modes=maps.load_modes[:, order[:count]], load_rest=maps.load_rest + left_out)


def _single(maps: LinearMaps) -> LinearMaps:
    """Each number as single precision holds it, in double precision."""
    numbers: dict[str, Any] = {
        name: array.astype(np.float32).astype(np.float64) for name, array in maps.arrays().items() if name != "loaded"
    }
    return replace(maps, **numbers)
