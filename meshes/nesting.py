"""Closed surfaces inside others: which of them are cavities. Nesting decides, since windings are often wrong.

A closed component inside an odd number of others bounds a cavity, one inside an even number a solid: what lies in the
cavity of a bladder's wall is urine, whichever way its triangles wind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .body import Floats, Ints, Surface

Flags = NDArray[np.bool_]
_SPECK = 1e-4  # of the largest component's volume: smaller ones keep their winding, nothing depends on it
_SAMPLES = 7  # vertices of a component that all have to lie inside another one for it to lie there
_INSIDE = 0.5  # winding number above which a point is inside: 1 there, 0 outside, between the two near a gap


@dataclass(frozen=True)
class Nesting:
    """Components of a surface and how they lie in each other.

    Args:
        depths: number of components that each one lies in, (c,); 0 for one that is no closed surface.
        volumes: that each encloses, of either winding, (c,), cubic metres.
        is_inward: whether its triangles wind inward, (c,).
        holders: the outermost component that each one lies in, itself where there is none, (c,).
        is_known: whether it was looked at: closed, and no speck, (c,).
    """

    depths: Ints
    volumes: Floats
    is_inward: Flags
    holders: Ints
    is_known: Flags

    @property
    def is_cavity(self) -> Flags:
        """Whether a component bounds a cavity, (c,)."""
        return self.depths % 2 == 1


def nesting(surface: Surface, pieces: Ints, is_closed: Flags) -> Nesting:
    """How the components of a surface lie in each other.

    Args:
        surface: triangles, metres; the components need not be closed, nor apart.
        pieces: number of each triangle's component, (t,).
        is_closed: whether a component has no open edges, (c,).
    """
    count = len(is_closed)
    corners = (surface.points - surface.points.mean(axis=0))[surface.triangles]
    six = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volumes = np.bincount(pieces, six, count) / 6
    sizes = np.abs(volumes)
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    np.minimum.at(low, pieces, surface.points[surface.triangles].min(axis=1))
    np.maximum.at(high, pieces, surface.points[surface.triangles].max(axis=1))
    large = np.flatnonzero(is_closed & (sizes > _SPECK * sizes.max(initial=0.0)))
    depths, holders = np.zeros(count, dtype=np.int64), np.arange(count)
    for inner in large:
        mine = np.unique(surface.triangles[pieces == inner])
        probes = surface.points[mine[np.linspace(0, len(mine) - 1, _SAMPLES).astype(int)]]
        for outer in large:
            fits = (low[outer] <= low[inner]).all() and (high[inner] <= high[outer]).all() and outer != inner
            if fits and encloses(surface, surface.triangles[pieces == outer], probes).all():
                depths[inner] += 1
                holders[inner] = max(outer, holders[inner], key=lambda one: sizes[one])
    return Nesting(depths, sizes, volumes < 0, holders, np.isin(np.arange(count), large))


def encloses(surface: Surface, triangles: Ints, points: Floats) -> Flags:
    """Which points lie inside what some triangles of a surface enclose, (p,).

    Args:
        surface: that has them, metres.
        triangles: (t, 3) of its vertices.
        points: (p, 3), metres.
    """
    return winding_numbers(surface, triangles, points) > _INSIDE


def winding_numbers(surface: Surface, triangles: Ints, points: Floats) -> Floats:
    """How often triangles go around points, without sign: 1 inside a closed surface, 0 outside, (p,).

    The solid angles of the triangles (van Oosterom and Strackee 1983, IEEE Trans. Biomed. Eng. 30) over 4 pi.

    Args:
        surface: that has them, metres.
        triangles: (t, 3) of its vertices.
        points: (p, 3), metres.
    """
    found = np.empty(len(points))
    for number, point in enumerate(points):
        a, b, c = (surface.points[triangles[:, i]] - point for i in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        volume = np.einsum("ti,ti->t", a, np.cross(b, c))
        dots = [np.einsum("ti,ti->t", x, y) for x, y in ((a, b), (b, c), (c, a))]
        found[number] = np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb).sum() / (
            2 * np.pi
        )
    return np.abs(found)
