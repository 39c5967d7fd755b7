"""Large clouds brought down to the points that carry information, dense places and thin ones alike; isolated points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import bdtrc, polygamma

from .loss import robust_deviation
from .policy import ACCURACY, POLICY

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def thinned(cloud: Floats, maximum: int) -> Ints:
    """Numbers of points spread evenly over a cloud, at most so many, sorted.

    Points are drawn with a probability that falls with the density about them, systematically in space (after Stevens
    and Olsen 2004). They are neither averaged nor chosen by where they lie across the surface, so that their noise
    stays what it was: one point a voxel would favour those that noise has thrown farthest. Where hardly any other point
    is near, an outlier is likelier than a part of the surface.

    Args:
        cloud: points, (p, 3), metres.
        maximum: most points wanted.

    Raises:
        ValueError: `maximum` is below 1.
    """
    if maximum < 1:
        raise ValueError(f"thinned.maximum: expected at least 1 point, got {maximum}.")
    if len(cloud) <= maximum:
        return np.arange(len(cloud))
    chance = np.random.default_rng(0)
    some = chance.permutation(len(cloud))[: ACCURACY.looked_at * maximum]
    seen = cloud[some]
    near = ACCURACY.dense_within * float(np.linalg.norm(np.ptp(seen, axis=0)))
    counts = 1 + cKDTree(seen[: ACCURACY.counted]).query_ball_point(seen, near, return_length=True)
    minimum = ACCURACY.sparse * np.quantile(counts, 0.25)
    shares = np.minimum(counts / minimum, minimum / counts)
    # Every k-th share in an order in which neighbours follow each other: as likely, and evenly spread.
    order = cKDTree(seen).indices
    ends = np.cumsum(shares[order])
    landmarks = (chance.uniform() + np.arange(maximum)) * ends[-1] / maximum
    return np.unique(some[order[np.searchsorted(ends, landmarks)]])


def is_isolated(cloud: Floats) -> NDArray[np.bool_]:
    """Which points lie by themselves, (p,); of no more points than neighbours are counted none does.

    What Rusu et al. (Robotics and Autonomous Systems 56 (2008)) do with the mean and the deviation of distances to
    neighbours, with figures that outliers do not spoil: where points lie anywhere on a surface, the area up to the k-th
    neighbour has a gamma law of order k. Places that are seen far less densely than most may be taken for such, too. So
    few as chance may put there are none.

    Args:
        cloud: points, (p, 3), metres.
    """
    near = ACCURACY.neighbours
    if len(cloud) <= near:
        return np.zeros(len(cloud), dtype=bool)
    far = np.log(np.maximum(cKDTree(cloud).query(cloud, near + 1)[0][:, -1], np.finfo(float).tiny))
    deviation = max(robust_deviation(far - np.median(far)), 0.5 * float(polygamma(1, near)) ** 0.5)
    isolated = far > np.median(far) + POLICY.deviations * deviation
    by_chance = float(bdtrc(isolated.sum() - 1, len(cloud), 0.5 * POLICY.unlikely)) if isolated.any() else 1.0
    return np.asarray(isolated & (by_chance < POLICY.unlikely))
