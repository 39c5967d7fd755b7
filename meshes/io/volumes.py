"""Volume meshes: cells of one kind, in metres and LPS."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..body import Floats, Ints, Surface
from ..cells import CellError, one_kind
from .common import Axes, FileError, Unit, placed
from .raw import RawMesh, known, read_raw
from .surfaces import as_surface

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Volume:
    """A volume mesh as a file holds it.

    Args:
        points: (n, 3), metres, LPS: the nodes of its cells.
        cells: (m, 4), (m, 8), (m, 10) or (m, 27) node numbers.
        numbers: (n,) the nodes' numbers in the file, from 0; nodes of no cell are left out.
        said: what was done to it, one line each.
    """

    points: Floats
    cells: Ints
    numbers: Ints
    said: tuple[str, ...] = ()


def read_mesh(path: str | Path, unit: Unit | None = None, axes: Axes | None = None) -> Surface | Volume:
    """What a mesh file holds: a volume where it has volume cells (surfaces beside them are ignored), else a surface.

    Args:
        path: STL, PLY, OBJ, VTK, VTU, VTP or MSH file.
        unit: the file's unit of length; what the file states if not given, else metres.
        axes: the file's axes: `lps` is kept, `ras` is turned to LPS (x and y change sign); what the file states if not
            given, else LPS.

    Raises:
        FileError: as `read_surface`.
    """
    mesh = read_raw(path)
    if mesh.is_solid:
        return _volume(Path(path), mesh, *known(path, unit, axes))
    return as_surface(Path(path), mesh, *known(path, unit, axes))


def read_volume(path: str | Path, unit: Unit | None = None, axes: Axes | None = None) -> tuple[Floats, Ints]:
    """Points (n, 3) in metres and cells of a volume mesh, all of one kind; nodes of no cell are left out.

    Args:
        path: VTK, VTU or MSH file with tetrahedra, hexahedra, voxels, wedges or pyramids (a mixture becomes
            tetrahedra), or tetra10 or hexahedron27 alone; triangles beside them are ignored.
        unit: the file's unit of length; what the file states if not given, else metres.
        axes: the file's axes: `lps` is kept, `ras` is turned to LPS (x and y change sign); what the file states if not
            given, else LPS.

    Raises:
        FileError: missing, empty, damaged or unknown file, a surface only, or cells that cannot be read.
    """
    volume = _volume(Path(path), read_raw(path), *known(path, unit, axes))
    for line in volume.said:
        _log.info("%s: %s", path, line)
    return volume.points, volume.cells


def _volume(path: Path, mesh: RawMesh, unit: Unit, axes: Axes) -> Volume:
    if not mesh.is_solid:
        advice = "; a surface must be made solid first (softtwin build does it)" if len(mesh.triangles) else ""
        raise FileError(f"{path}: expected a volume mesh of tetrahedra or hexahedra, got {mesh.content}{advice}.")
    try:
        cells, said = one_kind(mesh.points, mesh.cells)
    except CellError as error:
        raise FileError(f"{path}: {error}.") from error
    numbers, local = np.unique(cells, return_inverse=True)
    if left := len(mesh.points) - len(numbers):
        said.append(f"nodes: {left} of {len(mesh.points)} belong to no volume cell and were left out")
    points = placed(path, mesh.points[numbers], unit, axes)
    return Volume(points, local.reshape(cells.shape).astype(np.int64), numbers, tuple(said))
