"""Surfaces between two given ones, by their signed distances: organs between organs."""

from __future__ import annotations

import igl
import numpy as np

from .body import Floats, Surface
from .checks import checked_surface, compacted, piece_numbers
from .shapes import isosurface

_MARGIN = 2.0  # spacings of the grid around both


def blended(one: Surface, other: Surface, share: float, divisions: int = 48) -> Surface:
    """The closed surface between two: where the weighted sum of their signed distances is zero.

    The other is laid upon the first beforehand: middle on middle, axis of inertia on axis of inertia, the longer side
    of each on the longer side. Interpolated distances are the simplest metamorphosis of solids (Cohen-Or, Solomovici
    and Levin 1998): a ball to a ball is a ball of the radius between, at any share.

    Args:
        one: closed, metres; the result lies in its coordinates.
        other: closed, metres.
        share: of the other, 0 to 1.
        divisions: of the grid along the longest side of both.

    Raises:
        SurfaceError: a surface that is not closed.
        ValueError: a share that is none, too coarse a grid, or one that finds nothing inside what lies between.
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"blended.share: expected a number in [0, 1], got {share}.")
    if divisions < 8:
        raise ValueError(f"blended.divisions: expected at least 8, got {divisions}.")
    one, other = checked_surface(one), checked_surface(other)
    (middle, axes), (there, others) = _placed(one), _placed(other)
    laid = Surface((other.points - there) @ others @ axes.T + middle, other.triangles)
    both = np.concatenate([one.points, laid.points])
    low, high = both.min(axis=0), both.max(axis=0)
    spacing = float((high - low).max()) / divisions

    def between(places: Floats) -> Floats:
        flat = places.reshape(-1, 3)
        found = (1.0 - share) * _signed(one, flat) + share * _signed(laid, flat)
        if not found.min() < 0.0:
            raise ValueError(
                f"blended: expected something between the surfaces at {share:g}, got nothing on a grid of "
                f"{1e3 * spacing:.3g} mm; take more divisions."
            )
        return found.reshape(places.shape[:-1])

    margin = _MARGIN * spacing
    found = isosurface(between, low - margin, high + margin, spacing)
    pieces = piece_numbers(found)[found.triangles[:, 0]]
    return compacted(Surface(found.points, found.triangles[pieces == np.bincount(pieces).argmax()]))


def _signed(surface: Surface, places: Floats) -> Floats:
    """Distances to a closed surface, (p,), metres, negative inside: by the normals of faces, edges and corners."""
    sign = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    found: Floats = igl.signed_distance(places, surface.points, surface.triangles, sign)[0]
    return found


def _placed(surface: Surface) -> tuple[Floats, Floats]:
    """The middle of what a closed surface encloses, (3,), and its axes of inertia as columns, right-handed, (3, 3)."""
    corners = surface.points[surface.triangles]
    volumes = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    whole = volumes.sum()
    middle = volumes @ corners.sum(axis=1) / (4.0 * whole)
    arms = corners - middle  # tetrahedra from the middle to the triangles
    volumes = np.einsum("ti,ti->t", arms[:, 0], np.cross(arms[:, 1], arms[:, 2])) / 6.0
    sums = arms.sum(axis=1)
    second = np.einsum("t,tki,tkj->ij", volumes, arms, arms) + np.einsum("t,ti,tj->ij", volumes, sums, sums)
    axes = np.linalg.eigh(second / whole)[1][:, ::-1]
    along = (surface.points - middle) @ axes
    axes = axes * np.where(along.max(axis=0) >= -along.min(axis=0), 1.0, -1.0)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return middle, axes
