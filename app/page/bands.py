"""Bands of colour: what a surface shows, in which steps, and which triangles are in which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Colour = tuple[int, int, int]

UNINFORMED: Colour = (200, 160, 150)  # of an organ about which nothing is said
COLOURS: tuple[Colour, ...] = (
    (65, 171, 150),
    (250, 215, 110),
    (240, 120, 50),
    (175, 20, 60),
)  # told apart in grey, too


@dataclass(frozen=True)
class Scale:
    """What bands mean.

    Args:
        title: what is shown, for people, with its unit.
        edges: between the bands, metres.
    """

    title: str
    edges: tuple[float, float, float]

    def words(self) -> list[str]:
        """What each band holds, for the legend."""
        low = [f"{1e3 * edge:g}" for edge in self.edges]
        return [f"below {low[0]}", f"{low[0]} to {low[1]}", f"{low[1]} to {low[2]}", f"above {low[2]}"]


FINE = (1e-3, 2e-3, 4e-3)
COARSE = (5e-3, 10e-3, 20e-3)
SCALES = {
    "error": Scale("Error of the surface against the truth, mm", FINE),
    "margin": Scale("95 % margin of the surface, mm", FINE),
    "distance": Scale("Distance of the cloud to the surface, mm", FINE),
    "movement": Scale("Movement since the scan, mm", COARSE),
}


def banded(triangles: Ints, values: Floats | None, scale: Scale) -> list[Ints]:
    """The triangles of each band, those that nothing is told of first: five arrays, (t, 3).

    Args:
        triangles: of the surface, (t, 3).
        values: at its vertices, (v,), metres, NaN where nothing is told; None where that is nowhere.
        scale: the bands.
    """
    if values is None:
        return [triangles, *(triangles[:0] for _ in COLOURS)]
    mean = values[triangles].mean(axis=1)
    number = np.where(np.isnan(mean), 0, 1 + np.searchsorted(scale.edges, mean))
    return [triangles[number == band] for band in range(1 + len(COLOURS))]
