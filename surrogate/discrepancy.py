"""What a surrogate gets wrong, as patterns: the covariance of its errors on samples that it was not fitted to.

Under forces as registration expects them, which are rougher than modal loads, a surrogate is farther off for the same
movement: where a data set has smooth draws, they count beside the validation draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.dataset import DataSet, Samples
from softtwin.reference.data.discrepancy import Discrepancy, discrepancy_of

from .model import Surrogate

Floats = NDArray[np.float64]
_BOUND = 10.0  # times the median of the errors' norms
_LEAST = 4  # samples that something is learned of


def relative_errors(surrogate: Surrogate, data: DataSet, samples: Samples) -> Floats:
    """What is missing in the surrogate's displacement, in units of the largest displacement, (s, 3n).

    Args:
        surrogate: the surrogate.
        data: the data set that the samples are of.
        samples: loads and displacements.
    """
    missing, every = np.empty((len(samples), data.body.points.size)), data.response.spread(samples.forces)
    for i, (forces, displacement) in enumerate(zip(every, samples.displacements, strict=True)):
        size = np.linalg.norm(displacement, axis=1).max()
        missing[i] = (displacement - surrogate.solve(forces).displacement).ravel() / max(size, 1e-12)
    return missing


def with_discrepancy(surrogate: Surrogate, data: DataSet, maximum: int = 32) -> Surrogate:
    """The surrogate with the patterns of its errors on validation and smooth samples: see `discrepancy_of`.

    Of fewer than four samples nothing is learned: the surrogate stays as it is. Smooth loads beyond its domain are left
    out: a registration that ends there says so.

    Args:
        surrogate: the surrogate.
        data: the data set that it was trained on.
        maximum: most patterns kept.
    """
    smooth = smooth_errors(surrogate, data)
    errors = np.concatenate([relative_errors(surrogate, data, data.samples("validation")), smooth])
    if len(errors) < _LEAST:
        return surrogate
    found, bounded = discrepancy_of(errors, data.body, maximum, _BOUND)
    entry = {"samples": len(errors), "smooth": len(smooth), "bounded": bounded}
    return _with(surrogate, found, entry)


def smooth_errors(surrogate: Surrogate, data: DataSet) -> Floats:
    """`relative_errors` on the smooth samples within the surrogate's domain, (s, 3n); none where there are none."""
    if not data.header["samples"].get("smooth"):
        return np.zeros((0, data.body.points.size))
    samples = data.samples("smooth")
    inside = np.zeros(len(samples), dtype=np.bool_)
    for i, forces in enumerate(data.response.spread(samples.forces)):
        inside[i] = (surrogate.solve(forces).extrapolation_ratio or 0.0) <= 1.0
    return relative_errors(surrogate, data, samples)[inside]


def beside(surrogate: Surrogate, further: Discrepancy) -> Surrogate:
    """The surrogate that may be wrong by other patterns, too: of what the reference itself does not know.

    Args:
        surrogate: the surrogate.
        further: the patterns.
    """
    own = surrogate.discrepancy
    return _with(surrogate, further if own is None else own.beside(further), surrogate.card.get("discrepancy", {}))


def _with(surrogate: Surrogate, found: Discrepancy, entry: Mapping[str, float]) -> Surrogate:
    encoder_decoder = replace(surrogate.encoder_decoder, error_modes=found.modes, error_rest=found.rest)
    card = {**surrogate.card, "discrepancy": {**entry, "places": found.places}}
    return Surrogate(surrogate.body, encoder_decoder, surrogate.network, card)
