"""Surfaces and time series out: STL, PLY and VTP in the coordinates that the files came in, PVD for ParaView."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkIOGeometry import vtkSTLWriter
from vtkmodules.vtkIOPLY import vtkPLYWriter
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

from .body import Floats, Surface
from .files import Axes, FileError, Unit

SURFACE_FORMATS = ("stl", "ply", "vtp")
_PER_METRE: Mapping[str, float] = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_TURN: Mapping[str, Floats] = {"lps": np.ones(3), "ras": np.array([-1.0, -1.0, 1.0])}


@dataclass(frozen=True)
class Coordinates:
    """The coordinates that files come in and go out in; inside they are metres and LPS.

    Args:
        unit: unit of length.
        axes: `lps` is kept, `ras` has x and y of the other sign.
    """

    unit: Unit = "m"
    axes: Axes = "lps"

    def __post_init__(self) -> None:
        if self.unit not in _PER_METRE or self.axes not in _TURN:
            raise ValueError(f"Coordinates: expected m, cm or mm and lps or ras, got {self.unit!r} and {self.axes!r}.")

    def lengths(self, vectors: ArrayLike) -> Floats:
        """Points or displacements in these coordinates, (..., 3), from metres and LPS."""
        return _PER_METRE[self.unit] * self.directions(vectors)

    def directions(self, vectors: ArrayLike) -> Floats:
        """Vectors of another unit (forces) on these axes, (..., 3)."""
        return _TURN[self.axes] * np.asarray(vectors, dtype=np.float64)

    def metres(self, lengths: ArrayLike) -> Floats:
        """Points or displacements in metres and LPS, (..., 3), from these coordinates."""
        return _TURN[self.axes] * np.asarray(lengths, dtype=np.float64) / _PER_METRE[self.unit]

    def motion(self, matrix: ArrayLike) -> Floats:
        """A rigid motion of metres and LPS as one of these axes, in metres, (4, 4); and back: it is its own inverse."""
        turn = np.append(_TURN[self.axes], 1.0)
        return turn[:, None] * np.asarray(matrix, dtype=np.float64) * turn


def write_surface(path: str | Path, surface: Surface, fields: Mapping[str, ArrayLike] | None = None) -> None:
    """Write a triangle surface; the file appears whole or not at all.

    Vertices that no triangle uses are left out.

    Args:
        path: file to write: `.stl` and `.ply` (binary, single precision) or `.vtp` (double precision).
        surface: the surface, in the coordinates that are to be written.
        fields: arrays with a row for each vertex, by name; VTP alone keeps them.

    Raises:
        FileError: another suffix, or the file could not be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    writers: Mapping[str, Any] = {".stl": vtkSTLWriter, ".ply": vtkPLYWriter, ".vtp": vtkXMLPolyDataWriter}
    if suffix not in writers:
        raise FileError(f"{path}: expected the suffix {', '.join(writers)}, got {path.suffix!r}.")
    partial = path.with_name(f".{path.name}.partial")
    writer = writers[suffix]()
    writer.SetFileName(str(partial))
    writer.SetInputData(_polygons(surface, fields or {} if suffix == ".vtp" else {}))
    if suffix == ".vtp":
        writer.SetDataModeToAppended()
        writer.EncodeAppendedDataOff()
    else:
        writer.SetFileTypeToBinary()
    if not path.parent.is_dir() or not writer.Write() or not partial.is_file():
        partial.unlink(missing_ok=True)
        raise FileError(f"{path}: could not be written; is the folder there, and is the disk full?")
    os.replace(partial, path)


def _polygons(surface: Surface, fields: Mapping[str, ArrayLike]) -> vtkPolyData:
    used, local = np.unique(surface.triangles, return_inverse=True)
    data, points, cells = vtkPolyData(), vtkPoints(), vtkCellArray()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(surface.points[used]), deep=True))
    offsets = np.arange(0, surface.triangles.size + 1, 3)
    cells.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(local.ravel().astype(np.int64), deep=True)
    )
    data.SetPoints(points)
    data.SetPolys(cells)
    for name, field in fields.items():
        array = numpy_to_vtk(np.ascontiguousarray(np.asarray(field)[used]), deep=True)
        array.SetName(name)
        data.GetPointData().AddArray(array)
    return data


def write_series(path: str | Path, files: Iterable[tuple[float, str, str]]) -> None:
    """Write a PVD that ParaView opens as a time series; the file appears whole or not at all.

    Args:
        path: file to write, `.pvd`.
        files: time, name of the part, and file (VTU or VTP, relative to the PVD) of each piece.
    """
    path = Path(path)
    pieces = list(files)
    numbers = {name: i for i, name in enumerate(dict.fromkeys(name for _, name, _ in pieces))}
    lines = [
        f'    <DataSet timestep="{time:g}" group="" part="{numbers[name]}" name={quoteattr(name)} '
        f"file={quoteattr(file)}/>"
        for time, name, file in pieces
    ]
    head = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">']
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text("\n".join([*head, "  <Collection>", *lines, "  </Collection>", "</VTKFile>", ""]))
    os.replace(partial, path)
