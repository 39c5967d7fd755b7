"""Large clouds brought down to the points that carry information: one for each occupied voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_SEARCHES = 12
_DRAWN = 200_000  # points that are looked at; of more, that many drawn evenly
_LOOKED_AT = 50_000  # points that the size of the voxels is found on


def thinned(cloud: Floats, most: int) -> Ints:
    """Numbers of points spread evenly over a cloud, at most so many, sorted.

    Points are kept as they are, not averaged, so that their noise stays what it was.

    Args:
        cloud: points, (p, 3), metres.
        most: most points wanted.

    Raises:
        ValueError: `most` is below 1.
    """
    if most < 1:
        raise ValueError(f"thinned.most: expected at least 1 point, got {most}.")
    if len(cloud) <= most:
        return np.arange(len(cloud))
    order = np.random.default_rng(0).permutation(len(cloud))[: max(_DRAWN, 4 * most)]
    sample = cloud[order[:_LOOKED_AT]]
    low, high = 0.0, float(np.ptp(cloud, axis=0).max()) + 1e-12
    for _ in range(_SEARCHES):
        middle = 0.5 * (low + high)
        if len(_representatives(sample, middle)) > most:
            low = middle
        else:
            high = middle
    kept = order[_representatives(cloud[order], high)]
    return np.sort(kept[:most])


def _representatives(cloud: Floats, spacing: float) -> Ints:
    """Number of the first point in each occupied voxel, in the order of the cloud."""
    voxels = np.floor((cloud - cloud.min(axis=0)) / spacing).astype(np.int64)
    sides = voxels.max(axis=0) + 1
    keys = (voxels[:, 0] * sides[1] + voxels[:, 1]) * sides[2] + voxels[:, 2]
    return np.sort(np.unique(keys, return_index=True)[1])
