"""What stands in a mesh file, whatever its format: points and cells in the file's own numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..body import Floats, Ints
from ..cells import counted, dimension
from ..elements import KINDS
from .common import AXES, HEAD, UNITS, Axes, ContentError, FileError, Unit, existing
from .formats.apart import read_apart
from .formats.msh import is_first_msh, read_first_msh, read_msh
from .formats.obj import read_obj
from .formats.ply import read_ply
from .formats.polygons import triangulated
from .formats.stl import read_stl
from .formats.vtk import READERS


@dataclass(frozen=True)
class RawMesh:
    """What a file holds.

    Args:
        points: (p, 3), in the file's own unit and axes.
        cells: point numbers by kind of cell, (m, nodes of one cell).
    """

    points: Floats
    cells: Mapping[str, Ints]

    @property
    def triangles(self) -> Ints:
        """Its triangles and the halves of its quadrilaterals, (t, 3)."""
        quads = self.cells.get("quad", np.empty((0, 4), np.int64))
        triangles = self.cells.get("triangle", np.empty((0, 3), np.int64))
        return np.concatenate([triangles, triangulated(self.points, quads)])

    @property
    def content(self) -> str:
        """What it holds, in words."""
        counts = counted({name: block for name, block in self.cells.items() if name != "vertex"})
        return f"{len(self.points)} points" + (f" and cells: {counts}" if counts else " and no cells")

    @property
    def is_solid(self) -> bool:
        """Whether it has volume cells."""
        return any(dimension(name) == 3 for name in self.cells)


def read_raw(path: str | Path) -> RawMesh:
    """What a mesh file holds, checked: finite points, and cells of points that are there.

    Args:
        path: STL, PLY, OBJ, VTK, VTU, VTP or MSH file.

    Raises:
        FileError: missing, empty, damaged or unknown file.
    """
    mesh = read_anyhow(path)
    if len(mesh.points) == 0:
        raise ContentError(f"{path}: the file holds no points; it may be truncated or damaged.")
    if not np.isfinite(mesh.points).all():
        raise ContentError(f"{path}: expected finite coordinates, got NaN or infinity.")
    if (far := float(np.abs(mesh.points).max())) > FARTHEST:
        raise ContentError(f"{path}: expected coordinates of an organ, got {far:.3g}; the file may be damaged.")
    for name, block in mesh.cells.items():
        if block.shape[1] != _NODES.get(name, block.shape[1]):
            raise FileError(f"{path}: a {name} has {block.shape[1]} nodes; the file may be damaged.")
        if block.min(initial=0) < 0 or block.max(initial=0) >= len(mesh.points):
            raise FileError(f"{path}: a {name} refers to a point that is not there; the file may be damaged.")
    return mesh


def read_anyhow(path: str | Path) -> RawMesh:
    """The same with points as they come: a depth camera writes NaN where it measured nothing.

    Args:
        path: as for `read_raw`.

    Raises:
        FileError: missing, empty, damaged or unknown file.
    """
    path = existing(path)
    suffix = path.suffix.lower()
    if suffix in READERS:
        found = read_apart(path)
        return RawMesh(found.points, found.cells)
    if suffix not in _OWN:
        raise FileError(f"{path}: expected a mesh file ({', '.join(SUFFIXES)}), got suffix {suffix!r}.")
    try:
        points, cells = _OWN[suffix](path)
    except (ValueError, KeyError, IndexError, OverflowError, MemoryError) as error:
        said = " ".join(str(error).split())[:200]
        raise FileError(
            f"{path}: could not be read as {suffix[1:]}; the file may be truncated or damaged ({said})."
        ) from error
    if isinstance(cells, np.ndarray):
        cells = {"triangle": cells} if len(cells) else {}
    return RawMesh(points, cells)


def _any_msh(path: Path) -> tuple[Floats, dict[str, Ints]]:
    return read_first_msh(path) if is_first_msh(path.read_bytes()[:HEAD]) else read_msh(path)


_NODES = {kind.name: kind.nodes for kind in KINDS.values()} | {
    "vertex": 1,
    "line": 2,
    "voxel": 8,
    "wedge": 6,
    "pyramid": 5,
}
FARTHEST = 1e12  # of any unit: beyond, squares of distances are no numbers of use
_OWN: Mapping[str, Callable[[Path], tuple[Floats, Any]]] = {
    ".stl": read_stl, ".obj": read_obj, ".msh": _any_msh, ".ply": read_ply,
}  # fmt: skip
SUFFIXES = (*_OWN, *READERS)  # of the mesh files that are read


def _stated(path: Path, name: str) -> str:
    with path.open("rb") as file:
        head = file.read(HEAD)
    if path.suffix.lower() not in (".vtp", ".vtu"):
        found = re.search(rb"\b%s=(\w+)" % name.encode(), head)
        return found.group(1).decode("latin-1") if found else ""
    if f'Name="{name}"'.encode() not in head:  # field data stand first, and the whole file need not be read
        return ""
    return read_apart(path).words.get(name, "")


def stated_axes(path: str | Path) -> Axes | None:
    """The axes that a file states about itself, as 3D Slicer writes and reads them; None for none.

    `SPACE=LPS` or `SPACE=RAS` in the head of STL, PLY, OBJ and VTK; a text `SPACE` in the field data of VTP and VTU
    (Slicer, Libs/MRML/Core/vtkMRMLModelStorageNode.cxx, WriteDataInternal and GetCoordinateSystemFromFieldData).

    Args:
        path: any file.

    Raises:
        FileError: missing, empty or damaged file.
    """
    word = _stated(existing(path), "SPACE").lower()
    return word if word in AXES else None  # type: ignore[return-value]


def stated_unit(path: str | Path) -> Unit | None:
    """The unit of length that a file states about itself, as softtwin writes it (`UNIT=mm`); None for none.

    Args:
        path: any file.

    Raises:
        FileError: missing, empty or damaged file.
    """
    word = _stated(existing(path), "UNIT")
    return word if word in UNITS else None  # type: ignore[return-value]


def known(path: str | Path, unit: Unit | None, axes: Axes | None) -> tuple[Unit, Axes]:
    """Unit and axes to read a file in: those given, else those it states, else metres and LPS.

    Args:
        path: the file.
        unit: given; None for none.
        axes: given; None for none.
    """
    return unit or stated_unit(path) or "m", axes or stated_axes(path) or "lps"
