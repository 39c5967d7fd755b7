"""How much less a cloud tells where neighbouring points err alike: the number of points that would tell as much.

Noise of a depth camera, a body that is meshed or stiffened wrongly: what they leave is shared by whole patches, and
fifty thousand points on a patch tell no more of it than one. The variance of a mean of correlated numbers is that of
n / tau independent ones (Bartlett 1946; in two dimensions Clifford, Richardson and Hemon 1989), with tau the sum of
their correlations, here found from the residuals themselves by distance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from .loss import REJECTED

Floats = NDArray[np.float64]
_ASKED = 100  # points whose correlation with all others is looked at
_RINGS = 24
_REACH = 0.5  # of the cloud's extent: farther apart, a fit leaves no correlation that could be told
_SURE = 2.0  # standard errors: a weaker correlation is none


def variance_inflation(closest_points: Floats, scaled: Floats, weights: Floats) -> float:
    """Factor by which the covariance of what a cloud tells is larger than for independent points, 1 or more.

    Args:
        closest_points: places of the points on the surface at rest, (p, 3), metres.
        scaled: residuals over their deviations, (p,).
        weights: of the points, (p,); those without weight are left out.
    """
    kept = weights > REJECTED
    places, values = closest_points[kept], scaled[kept]
    square = float((values**2).mean()) if len(values) else 0.0
    extrapolation_ratio = float(np.linalg.norm(np.ptp(places, axis=0))) if len(values) else 0.0
    if len(values) < _RINGS or square == 0.0 or extrapolation_ratio == 0.0:
        return 1.0
    asked = np.arange(0, len(values), max(1, len(values) // _ASKED))
    # Rings of equal area, so that each holds about as many points; the last is all that lies farther, or is itself.
    squares = cdist(places[asked], places, "sqeuclidean") * (_RINGS / (_REACH * extrapolation_ratio) ** 2)
    squares[np.arange(len(asked)), asked] = _RINGS
    ring = np.minimum(squares, _RINGS).astype(np.int64).ravel()
    pairs = np.bincount(ring, minlength=_RINGS + 1)[:_RINGS]
    products = np.outer(values[asked], values / square).ravel()
    sums = np.bincount(ring, products, minlength=_RINGS + 1)[:_RINGS]
    correlated = sums > _SURE * np.sqrt(pairs)
    last = int(np.argmin(correlated)) if not correlated.all() else _RINGS  # up to the first that shares nothing
    return max(1.0, square * (1.0 + float(sums[:last].sum()) / len(asked)))
