"""How far a load lies from those that a surrogate has learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.dataset import DataSet

from .model import Surrogate

Floats = NDArray[np.float64]
_LEAST_SPREAD = 1e-3  # of the largest: a direction hardly ever loaded must not make every load a far one


def with_domain(surrogate: Surrogate, data: DataSet) -> Surrogate:
    """The surrogate with the extent of its training loads: `SurrogateState.extent` is 1 at the farthest of them.

    The measure is the root mean square of the network's coordinates, each in units of its spread over training. What
    the coordinates do not see is told by the largest force that each node has borne (`LinearMaps.largest_forces`).

    Args:
        surrogate: the surrogate.
        data: the data set that it was trained on.
    """
    samples = data.samples("train")
    coordinates = surrogate.maps.encoded(samples.forces.reshape(len(samples), -1).T).T
    spread = np.sqrt((coordinates**2).mean(axis=0))
    spread = np.maximum(spread, _LEAST_SPREAD * spread.max())
    reach = np.sqrt(((coordinates / spread) ** 2).mean(axis=1)).max()
    largest = np.linalg.norm(samples.displacements, axis=2).max()
    domain = {"reach": float(reach), "displacement_m": float(largest)}
    borne = np.linalg.norm(samples.forces, axis=2).max(axis=0)
    maps = replace(surrogate.maps, spread=spread, largest_forces=borne)
    return Surrogate(surrogate.body, maps, surrogate.network, {**surrogate.card, "domain": domain})
