"""What a cloud does not tell of the unknowns beside the forces: one by itself, or several against each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_ALONE = 0.9  # of an unknown's variance beforehand lies in what is not told: it is one by itself
_NAMED = 0.3  # of the largest share: who has less is not what a combination is about


def uninformed(
    shares: Callable[[Floats], Floats], names: Sequence[str], covariance: Floats, variance_reduction: float
) -> tuple[list[str], list[str]]:
    """Unknowns that a cloud does not tell, and combinations of others that it does not tell either.

    Two unknowns that do the same to what is seen are told together and not apart: each keeps half of its variance
    beforehand, and what they differ by keeps all of it. Directions that keep most of theirs are eigenvectors of the
    covariance, since beforehand it is one.

    Args:
        shares: how far each unknown goes along a direction of the coefficients, (count,): see `InputBlocks.shares`.
        names: one for each coefficient.
        covariance: of the coefficients after the cloud, (count, count).
        variance_reduction: least part of a direction's variance that a cloud must take away.
    """
    if not np.isfinite(covariance).all():
        return [], []
    values, vectors = np.linalg.eigh(covariance)
    hidden = vectors[:, values > 1.0 - variance_reduction]
    is_alone = (hidden**2).sum(axis=1) >= _ALONE
    rest = np.flatnonzero(~is_alone)
    values, vectors = np.linalg.eigh(covariance[np.ix_(rest, rest)])
    alone, combined = [names[place] for place in np.flatnonzero(is_alone)], list[str]()
    for vector in vectors[:, values > 1.0 - variance_reduction].T:
        direction = np.zeros(len(covariance))
        direction[rest] = vector
        grown, shrunk = _sides(names, shares(direction))
        (combined if len(grown) + len(shrunk) > 1 else alone).append(_in_words(grown, shrunk))
    return alone, combined


def _sides(names: Sequence[str], shares: Floats) -> tuple[list[str], list[str]]:
    """Those with large shares, the largest first: what grows with it, and what shrinks."""
    order = np.argsort(-np.abs(shares), kind="stable")
    chosen = [place for place in order if abs(shares[place]) >= _NAMED * abs(shares[order[0]])]
    grown = [names[place] for place in chosen if shares[place] * shares[order[0]] > 0.0]
    return grown, [names[place] for place in chosen if shares[place] * shares[order[0]] < 0.0]


def _in_words(grown: Sequence[str], shrunk: Sequence[str]) -> str:
    return " against ".join(" with ".join(each) for each in (grown, shrunk) if each)
