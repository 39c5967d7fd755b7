"""What a model gets wrong, as patterns over the body: the covariance of its errors on samples."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import outer_nodes

Floats = NDArray[np.float64]
_FOLDS = 4
_LEAST_MODE = 1e-9  # of the largest: smaller ones are round-off
_FORMAT = 1


class DiscrepancyError(ValueError):
    """A file of patterns that cannot be used."""


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """What a model gets wrong, as a normal law: u* - u = size (modes a + rest), size the largest displacement.

    Args:
        modes: for a of unit variance, (3n, m), dimensionless.
        rest: standard deviation of what they leave out in one component of each node, (n,), dimensionless.
        places: number of places on the boundary where that is independent: neighbours share it.
    """

    modes: Floats
    rest: Floats
    places: float

    def beside(self, other: Discrepancy) -> Discrepancy:
        """Both, independent of each other."""
        modes, rest = np.hstack([self.modes, other.modes]), np.hypot(self.rest, other.rest)
        own, others = (float(np.square(each.rest).sum()) for each in (self, other))
        shared = own / self.places + others / other.places
        return Discrepancy(modes, rest, (own + others) / shared if shared > 0.0 else self.places)


def discrepancy_of(errors: Floats, body: Body, maximum: int, bound: float = np.inf) -> tuple[Discrepancy, int]:
    """The patterns of errors on samples, and how many of the errors were bounded.

    What the patterns leave out is measured on samples that they were not made from. Errors far above the others may be
    counted as some times their median, as in spherical principal components (Locantore et al. 1999): patterns are then
    of what the errors look like, and how large they are is found anew in each registration.

    Args:
        errors: u* - u over the largest displacement, (s, 3n), dimensionless; neighbours in the list may be alike.
        body: the body.
        maximum: most patterns kept.
        bound: errors larger than so many times the median count as that.

    Raises:
        ValueError: fewer than four samples.
    """
    if len(errors) < _FOLDS:
        raise ValueError(f"discrepancy_of.errors: expected at least {_FOLDS} samples, got {len(errors)}.")
    missing, bounded = (errors, 0) if np.isinf(bound) else _bounded(errors, bound)
    left_out = np.zeros_like(missing)
    for fold in range(_FOLDS):
        held = np.arange(len(missing)) * _FOLDS // len(missing) == fold  # whole paths: their samples are alike
        modes = _modes(missing[~held], maximum)[0]
        left_out[held] = missing[held] - (missing[held] @ modes) @ modes.T
    modes, sizes = _modes(missing, maximum)
    rest = np.sqrt((left_out**2).mean(axis=0).reshape(-1, 3).mean(axis=1))
    seen = left_out.reshape(len(missing), -1, 3)[:, outer_nodes(body)]
    return Discrepancy(modes * sizes, rest, _places(seen)), bounded


def _bounded(missing: Floats, bound: float) -> tuple[Floats, int]:
    """The errors with no norm above so many times their median, and how many were."""
    sizes = np.linalg.norm(missing, axis=1)
    parts = np.minimum(1.0, bound * np.median(sizes) / np.maximum(sizes, 1e-300))
    return parts[:, None] * missing, int((parts < 1.0).sum())


def _places(fields: Floats) -> float:
    """Number of places at which fields (s, p, 3) are independent: tr(C)^2 / tr(C^2) of their correlation matrix C."""
    scaled = fields / np.maximum(np.sqrt((fields**2).mean(axis=(0, 2)))[None, :, None], 1e-300)
    scaled = np.concatenate(list(scaled.transpose(2, 0, 1)))  # each axis a sample of its own
    scaled /= np.maximum(np.linalg.norm(scaled, axis=1), 1e-300)[:, None]  # a few large errors must not speak for all
    gram = scaled @ scaled.T
    return max(1.0, float(np.trace(gram) ** 2 / max((gram**2).sum(), 1e-300)))


def _modes(missing: Floats, maximum: int) -> tuple[Floats, Floats]:
    """Orthonormal patterns, (3n, m), and the root mean square of the errors along each, (m,)."""
    _, values, patterns = np.linalg.svd(missing, full_matrices=False)
    kept = slice(0, min(maximum, int((values > _LEAST_MODE * values[0]).sum())))
    return np.ascontiguousarray(patterns[kept].T), values[kept] / np.sqrt(len(missing))


# ------------------------------------------------------------------ files


def write_discrepancy(path: Path | str, found: Discrepancy, body: Body, made_of: dict[str, Any]) -> None:
    """Write patterns to a file, which appears whole or not at all.

    Args:
        path: `.npz`.
        found: the patterns.
        body: that they are of.
        made_of: what they were made of, for whoever opens the file.
    """
    path = Path(path)
    card = {"format": _FORMAT, "body": body.fingerprint, "places": found.places, "made_of": made_of}
    partial = path.with_name(f".{path.stem}.partial.npz")
    np.savez(partial, modes=found.modes, rest=found.rest, card=np.array(json.dumps(card)))
    partial.replace(path)


def read_discrepancy(path: Path | str, body: Body) -> tuple[Discrepancy, dict[str, Any]]:
    """Patterns from a file, and what they were made of.

    Args:
        path: as `write_discrepancy` wrote it.
        body: that they have to be of.

    Raises:
        DiscrepancyError: the file is missing, truncated, of another format or of another body.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as held:
            card = json.loads(str(held["card"]))
            found = Discrepancy(held["modes"], held["rest"], float(card["places"]))
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise DiscrepancyError(
            f"{path} cannot be read ({error}); is it truncated? `softtwin model-error` makes it."
        ) from error
    if card.get("format") != _FORMAT:
        raise DiscrepancyError(f"{path}: expected format {_FORMAT}, got {card.get('format')}.")
    if card.get("body") != body.fingerprint:
        raise DiscrepancyError(
            f"{path} belongs to another body (fingerprint {str(card.get('body'))[:12]}..., got "
            f"{body.fingerprint[:12]}...); make it again with `softtwin model-error`."
        )
    return found, card["made_of"]
