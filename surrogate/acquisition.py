"""Which loads to solve next: where a network is least in balance, and far from each other (active learning)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from .error_indicators import IndicatorReader
from .model import Surrogate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_SHORT_LIST = 4  # times as many loads as are wanted, those least in balance, are spread out
_AS_DRAWN = 0.5  # of those that are taken: a network that learns from ever more extremes gets the others wrong
_LEAST_SPREAD = 1e-3  # of the largest: a direction hardly ever loaded must not tell loads apart


def most_informative(surrogate: Surrogate, candidates: Iterable[Floats], wanted: int, known: Floats) -> Ints:
    """Places of the candidates that tell a network most.

    Of the loads whose predictions have the longest linear step to balance (`ErrorIndicators.step`; inverted ones count
    as infinitely far) those are taken that lie far from what is known and from each other in the network's
    coordinates (farthest-point sampling, Gonzalez 1985). Every second one is the next candidate as they come, so that
    what is learned keeps to how loads are drawn.

    Args:
        surrogate: trained on what is known; its card names the material.
        candidates: loads at growing sizes, nodal forces (r, n, 3) each, newtons; the worst size counts.
        wanted: how many to take.
        known: forces at the loaded nodes that were learned, (s, l, 3), newtons.

    Returns:
        Places among the candidates, (wanted,), the most telling first, with those as they come between them.

    Raises:
        CalibrationError: the card does not name a material that torch knows.
        ValueError: fewer candidates than are wanted.
    """
    reader = IndicatorReader(surrogate)
    steps, coordinates = [], []
    for ramp in candidates:
        found = [reader.read(forces, surrogate.solve(forces)).step for forces in ramp]
        worst = int(np.argmax(found))
        steps.append(found[worst])
        coordinates.append(surrogate.encoder_decoder.encoded(ramp[worst].ravel()[surrogate.rows]))
    if len(steps) < wanted:
        raise ValueError(f"most_telling.candidates: expected at least {wanted}, got {len(steps)}.")
    telling = wanted - int(_AS_DRAWN * wanted)
    short = np.argsort(-np.asarray(steps), kind="stable")[: _SHORT_LIST * telling]
    learned = surrogate.encoder_decoder.encoded(known.reshape(len(known), -1).T).T
    spread = np.sqrt((learned**2).mean(axis=0))
    spread = np.maximum(spread, _LEAST_SPREAD * spread.max())
    told = short[spread_out(np.stack(coordinates)[short] / spread, telling, learned / spread)]
    drawn = np.setdiff1d(np.arange(len(steps)), told)[: wanted - telling]
    taken = np.empty(wanted, dtype=np.int64)
    taken[::2], taken[1::2] = told, drawn
    return taken


def spread_out(points: Floats, wanted: int, taken: Floats) -> Ints:
    """Places of points that each lie farthest from all that were taken before them, (wanted,).

    Args:
        points: (m, d).
        wanted: how many to take.
        taken: (s, d), those to keep away from to begin with.
    """
    gaps = np.array([np.square(taken - point).sum(axis=1).min() for point in points])
    found = []
    for _ in range(wanted):
        place = int(np.argmax(gaps))
        found.append(place)
        gaps = np.minimum(gaps, np.square(points - points[place]).sum(axis=1))
        gaps[found] = -1.0
    return np.array(found)
