"""How far a load lies from those that were learned: in the network's coordinates, and among loads on the same nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.dataset import DataSet

from .model import Surrogate

Floats = NDArray[np.float64]
_LEAST_SPREAD = 1e-3  # of the largest: a direction hardly ever loaded must not make every load a far one
_LOAD_MODES, _A_MODE = 64, 4  # at most so many, and one for so many loads
_LEAST_REST = 1e-3  # of the mean square of a component


def with_domain(surrogate: Surrogate, data: DataSet) -> Surrogate:
    """The surrogate with the range of its training loads: the extrapolation ratio is 1 at the farthest of them.

    The measure is the root mean square of the network's coordinates, each in units of its spread over training. What
    the coordinates do not see is told by how the loads spread over the nodes (`LinearEncoderDecoder.load_modes`).

    Args:
        surrogate: the surrogate.
        data: the data set that it was trained on.
    """
    samples = data.samples("train")
    coordinates = surrogate.encoder_decoder.encoded(samples.forces.reshape(len(samples), -1).T).T
    spread = np.sqrt((coordinates**2).mean(axis=0))
    spread = np.maximum(spread, _LEAST_SPREAD * spread.max())
    reach = np.sqrt(((coordinates / spread) ** 2).mean(axis=1)).max()
    largest = np.linalg.norm(samples.displacements, axis=2).max()
    domain = {"reach": float(reach), "displacement_m": float(largest)}
    modes, rest = _load_modes(samples.forces.reshape(len(samples), -1))
    encoder_decoder = replace(surrogate.encoder_decoder, spread=spread, load_modes=modes, load_rest=rest)
    return Surrogate(surrogate.body, encoder_decoder, surrogate.network, {**surrogate.card, "domain": domain})


def _load_modes(loads: Floats) -> tuple[Floats, Floats]:
    """Leading directions of loads, (3l, q), and the mean square of a component that they leave out, (1,)."""
    _, sizes, directions = np.linalg.svd(loads / np.sqrt(len(loads)), full_matrices=False)
    count = min(_LOAD_MODES, max(1, len(loads) // _A_MODE))
    components = loads.shape[1]
    rest = max((sizes[count:] ** 2).sum(), _LEAST_REST * (sizes**2).sum()) / components
    return directions[:count].T * sizes[:count], np.array([rest])


def load_distance(surrogate: Surrogate, forces: Floats) -> tuple[float, int] | None:
    """Mahalanobis distance of a load among the training loads at the nodes that it acts on, and how many components.

    What it does not act on is left out: a small patch that is pulled three times as hard as any was lies far among
    loads on its nodes, and among all loads does not. None where the spread of the training loads was not measured.

    Args:
        surrogate: the surrogate.
        forces: (n, 3), newtons.
    """
    encoder_decoder = surrogate.encoder_decoder
    if encoder_decoder.load_modes is None or encoder_decoder.load_rest is None:
        return None
    load = forces.reshape(-1)[surrogate.rows]
    places = np.flatnonzero(load)
    if not len(places):
        return 0.0, 0
    own, modes, rest = load[places], encoder_decoder.load_modes[places], float(encoder_decoder.load_rest[0])
    along = modes.T @ own  # Woodbury: one small system, whatever the number of places
    inner = modes.T @ modes + rest * np.eye(modes.shape[1])
    square = (own @ own - along @ np.linalg.solve(inner, along)) / rest
    return float(np.sqrt(max(square, 0.0))), len(places)
