"""Surfaces: the triangles of a mesh file, in metres and LPS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..body import Surface
from ..cells import dimension
from .common import Axes, FileError, Unit, placed
from .raw import RawMesh, known, read_raw


def read_surface(path: str | Path, unit: Unit | None = None, axes: Axes | None = None) -> Surface:
    """The triangles of a file as a surface in metres; quadrilaterals are split, vertices at one place merged.

    Args:
        path: STL, PLY, OBJ, VTK, VTU, VTP or MSH file.
        unit: the file's unit of length; what the file states if not given, else metres.
        axes: the file's axes: `lps` is kept, `ras` is turned to LPS (x and y change sign); what the file states if not
            given, else LPS.

    Raises:
        FileError: missing, empty, damaged or unknown file, or no triangles in it.
    """
    return as_surface(Path(path), read_raw(path), *known(path, unit, axes))


def as_surface(path: Path, mesh: RawMesh, unit: Unit, axes: Axes) -> Surface:
    """The surface of what a file holds; see `read_surface`.

    Args:
        path: the file, for messages.
        mesh: what it holds.
        unit: its unit.
        axes: its axes.

    Raises:
        FileError: no triangles, or surface cells that are not read.
    """
    triangles = mesh.triangles
    if len(triangles) == 0 or any(dimension(name) == 2 for name in set(mesh.cells) - {"triangle", "quad"}):
        raise FileError(f"{path}: expected a surface of triangles, got {mesh.content}.")
    points = mesh.points
    places, numbers = np.unique(points, axis=0, return_inverse=True)
    if len(places) < len(points):
        # An STL repeats every vertex in each of its triangles, and so do some programs in any format.
        points, triangles = places, numbers.ravel()[triangles]
    used, numbers = np.unique(triangles, return_inverse=True)
    points = placed(path, points[used], unit, axes)
    return Surface(points, numbers.reshape(-1, 3).astype(np.int64))
