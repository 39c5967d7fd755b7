"""What a surrogate gets wrong, as patterns: the covariance of its errors on samples that it was not fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.embedding import outer_nodes
from softtwin.reference.data.dataset import DataSet, Samples

from .model import Surrogate

Floats = NDArray[np.float64]
_FOLDS = 4
_MOST = 10.0  # times the median of the errors' norms


def relative_errors(surrogate: Surrogate, data: DataSet, samples: Samples) -> Floats:
    """What is missing in the surrogate's displacement, in units of the largest displacement, (s, 3n).

    Args:
        surrogate: the surrogate.
        data: the data set that the samples are of.
        samples: loads and displacements.
    """
    forces = np.zeros_like(data.body.points)
    missing = np.empty((len(samples), data.body.points.size))
    for i, (loads, displacement) in enumerate(zip(samples.forces, samples.displacements, strict=True)):
        forces[data.response.loaded] = loads
        size = np.linalg.norm(displacement, axis=1).max()
        missing[i] = (displacement - surrogate.solve(forces).displacement).ravel() / max(size, 1e-12)
    return missing


def with_discrepancy(surrogate: Surrogate, data: DataSet, most: int = 32) -> Surrogate:
    """The surrogate with the patterns of its errors on the validation samples: see `Discrepancy`.

    What the patterns leave out is measured on samples that they were not made from. Errors far above the others count
    as some times their median, as in spherical principal components (Locantore et al. 1999): patterns are of what the
    errors look like, and how large they are is found anew in each registration. Of fewer than four samples nothing is
    learned: the surrogate stays as it is.

    Args:
        surrogate: the surrogate.
        data: the data set that it was trained on.
        most: most patterns kept.
    """
    samples = data.samples("validation")
    if len(samples) < _FOLDS:
        return surrogate
    missing, bounded = _bounded(relative_errors(surrogate, data, samples))
    left_out = np.zeros_like(missing)
    for fold in range(_FOLDS):
        held = np.arange(len(missing)) * _FOLDS // len(missing) == fold  # whole paths: their samples are alike
        modes = _modes(missing[~held], most)[0]
        left_out[held] = missing[held] - (missing[held] @ modes) @ modes.T
    modes, sizes = _modes(missing, most)
    rest = np.sqrt((left_out**2).mean(axis=0).reshape(-1, 3).mean(axis=1))
    maps = replace(surrogate.maps, error_modes=modes * sizes, error_rest=rest)
    seen = left_out.reshape(len(missing), -1, 3)[:, outer_nodes(data.body)]
    card = {**surrogate.card, "discrepancy": {"samples": len(missing), "bounded": bounded, "places": _places(seen)}}
    return Surrogate(surrogate.body, maps, surrogate.network, card)


def _bounded(missing: Floats) -> tuple[Floats, int]:
    """The errors with no norm above so many times their median, and how many were."""
    sizes = np.linalg.norm(missing, axis=1)
    parts = np.minimum(1.0, _MOST * np.median(sizes) / np.maximum(sizes, 1e-300))
    return parts[:, None] * missing, int((parts < 1.0).sum())


def _places(fields: Floats) -> float:
    """Number of places at which fields (s, p, 3) are independent: tr(C)^2 / tr(C^2) of their correlation matrix C."""
    scaled = fields / np.maximum(np.sqrt((fields**2).mean(axis=(0, 2)))[None, :, None], 1e-300)
    scaled = np.concatenate(list(scaled.transpose(2, 0, 1)))  # each axis a sample of its own
    scaled /= np.maximum(np.linalg.norm(scaled, axis=1), 1e-300)[:, None]  # a few large errors must not speak for all
    gram = scaled @ scaled.T
    return max(1.0, float(np.trace(gram) ** 2 / max((gram**2).sum(), 1e-300)))


def _modes(missing: Floats, most: int) -> tuple[Floats, Floats]:
    """Orthonormal patterns, (3n, m), and the root mean square of the errors along each, (m,)."""
    _, values, patterns = np.linalg.svd(missing, full_matrices=False)
    kept = slice(0, most)
    return np.ascontiguousarray(patterns[kept].T), values[kept] / np.sqrt(len(missing))
