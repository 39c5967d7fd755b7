"""Surfaces and time series out: STL, PLY, OBJ and VTP that state their unit and axes, PVD for ParaView.

3D Slicer takes the axes of a model from what its file states, and reads the numbers as millimetres: `SPACE=LPS` in the
header of an STL, in a comment of a PLY, in the first comment of an OBJ, as a text in the field data of a VTP or VTU
(Slicer, Libs/MRML/Core/vtkMRMLModelStorageNode.cxx: ReadDataInternal, WriteDataInternal). `UNIT=mm` beside it is ours.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkIOGeometry import vtkSTLWriter
from vtkmodules.vtkIOPLY import vtkPLYWriter
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

from .body import Floats, Ints, Surface
from .io import Axes, FileError, Unit, add_words, discard, vtk_messages

SURFACE_FORMATS = ("stl", "ply", "obj", "vtp")
PER_METRE: Mapping[str, float] = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_MADE_BY = "softtwin output."
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
        if self.unit not in PER_METRE or self.axes not in _TURN:
            raise ValueError(f"Coordinates: expected m, cm or mm and lps or ras, got {self.unit!r} and {self.axes!r}.")

    @property
    def words(self) -> dict[str, str]:
        """What a file in these coordinates states about itself: `SPACE`, as 3D Slicer reads it, and `UNIT`."""
        return {"SPACE": self.axes.upper(), "UNIT": self.unit}

    def __str__(self) -> str:
        return " ".join(f"{name}={word}" for name, word in self.words.items())

    def lengths(self, vectors: ArrayLike) -> Floats:
        """Points or displacements in these coordinates, (..., 3), from metres and LPS."""
        return PER_METRE[self.unit] * self.directions(vectors)

    def distances(self, metres: ArrayLike) -> Floats:
        """Lengths that have no direction, in these units, from metres."""
        return np.asarray(PER_METRE[self.unit] * np.asarray(metres, dtype=np.float64))

    def directions(self, vectors: ArrayLike) -> Floats:
        """Vectors of another unit (forces) on these axes, (..., 3)."""
        return _TURN[self.axes] * np.asarray(vectors, dtype=np.float64)

    def metres(self, lengths: ArrayLike) -> Floats:
        """Points or displacements in metres and LPS, (..., 3), from these coordinates."""
        return _TURN[self.axes] * np.asarray(lengths, dtype=np.float64) / PER_METRE[self.unit]

    def motion(self, matrix: ArrayLike) -> Floats:
        """A rigid motion of metres and LPS as one of these axes, in metres, (4, 4); and back: it is its own inverse."""
        turn = np.append(_TURN[self.axes], 1.0)
        return turn[:, None] * np.asarray(matrix, dtype=np.float64) * turn


def write_surface(
    path: str | Path,
    surface: Surface,
    fields: Mapping[str, ArrayLike] | None = None,
    place: Coordinates | None = None,
) -> None:
    """Write a triangle surface; the file appears whole or not at all.

    Vertices that no triangle uses are left out.

    Args:
        path: file to write: `.stl` and `.ply` (binary, single precision), `.obj` (nine digits) or `.vtp` (double
            precision).
        surface: the surface, in the coordinates that are to be written.
        fields: arrays with a row for each vertex, by name; VTP alone keeps them.
        place: these coordinates, which the file then states; nothing is stated without.

    Raises:
        FileError: another suffix, or the file could not be written.
    """
    used, local = np.unique(surface.triangles, return_inverse=True)
    chosen = {name: np.asarray(field)[used] for name, field in (fields or {}).items()}
    _write(Path(path), _polygons(surface.points[used], local.reshape(-1, 3), chosen), place)


def write_points(
    path: str | Path,
    points: ArrayLike,
    fields: Mapping[str, ArrayLike] | None = None,
    place: Coordinates | None = None,
) -> None:
    """Write a cloud of points, (p, 3); otherwise as `write_surface`, of which STL and OBJ know no points.

    Args:
        path: file to write: `.ply` or `.vtp`.
        points: (p, 3), in the coordinates that are to be written.
        fields: arrays with a row for each point, by name; VTP alone keeps them.
        place: these coordinates, which the file then states; nothing is stated without.

    Raises:
        FileError: another suffix, or the file could not be written.
    """
    positions = np.asarray(points, dtype=np.float64)
    path = Path(path)
    if path.suffix.lower() in (".stl", ".obj"):
        raise FileError(f"{path}: expected the suffix .ply or .vtp, got {path.suffix!r}: it holds triangles alone.")
    _write(path, _polygons(positions, np.arange(len(positions))[:, None], fields or {}), place)


def _polygons(points: Floats, cells: Ints, fields: Mapping[str, ArrayLike]) -> vtkPolyData:
    """Triangles, (t, 3), or single points, (p, 1)."""
    data, places, array = vtkPolyData(), vtkPoints(), vtkCellArray()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=True))
    offsets = np.arange(0, cells.size + 1, cells.shape[1])
    numbers = cells.ravel().astype(np.int64)
    array.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(numbers, deep=True))
    data.SetPoints(places)
    if cells.shape[1] == 1:
        data.SetVerts(array)
    else:
        data.SetPolys(array)
    for name, field in fields.items():
        values = numpy_to_vtk(np.ascontiguousarray(field), deep=True)
        values.SetName(name)
        data.GetPointData().AddArray(values)
    return data


def _write(path: Path, data: vtkPolyData, place: Coordinates | None) -> None:
    suffix = path.suffix.lower()
    if suffix not in (suffixes := [f".{name}" for name in SURFACE_FORMATS]):
        raise FileError(f"{path}: expected the suffix {', '.join(suffixes)}, got {path.suffix!r}.")
    partial = path.with_name(f".partial.{path.name}")  # VTK's PLY writer adds a suffix to any name without its own
    try:
        written = path.parent.is_dir() and (_as_text if suffix == ".obj" else _by_vtk)(partial, data, place)
    except OSError:
        written = False
    if not written or not partial.is_file():
        discard(partial)
        raise FileError(f"{path}: could not be written; is the folder there, and is the disk full?")
    os.replace(partial, path)


def _by_vtk(path: Path, data: vtkPolyData, place: Coordinates | None) -> bool:
    writers: Mapping[str, Any] = {".stl": vtkSTLWriter, ".ply": vtkPLYWriter, ".vtp": vtkXMLPolyDataWriter}
    suffix = path.suffix.lower()
    writer = writers[suffix]()
    writer.SetFileName(str(path))
    if suffix == ".vtp":
        writer.SetDataModeToAppended()
        writer.EncodeAppendedDataOff()
        add_words(data, place.words if place else {})
    else:
        writer.SetFileTypeToBinary()
        for name in [data.GetPointData().GetArrayName(i) for i in range(data.GetPointData().GetNumberOfArrays())]:
            data.GetPointData().RemoveArray(name)
    if place and suffix == ".stl":
        writer.SetHeader(f"{_MADE_BY} {place}")
    if place and suffix == ".ply":
        for word in str(place).split():
            writer.AddComment(word)
    writer.SetInputData(data)
    with vtk_messages():
        return bool(writer.Write())


def _as_text(path: Path, data: vtkPolyData, place: Coordinates | None) -> bool:
    """An OBJ; VTK's own writer keeps six digits and has no place for a comment."""
    points = vtk_to_numpy(data.GetPoints().GetData())
    triangles = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).reshape(-1, 3) + 1
    with path.open("w", encoding="ascii") as file:
        file.write(f"# {_MADE_BY}{f' {place}' if place else ''}\n")
        np.savetxt(file, points, "v %.9g %.9g %.9g")
        np.savetxt(file, triangles, "f %d %d %d")
    return True


def write_series(path: str | Path, files: Iterable[tuple[float, str, str]], place: Coordinates | None = None) -> None:
    """Write a PVD that ParaView opens as a time series; the file appears whole or not at all.

    Args:
        path: file to write, `.pvd`.
        files: time, name of the part, and file (VTU or VTP, relative to the PVD) of each piece.
        place: coordinates of these files, which the series then states; nothing is stated without.
    """
    path = Path(path)
    pieces = list(files)
    numbers = {name: i for i, name in enumerate(dict.fromkeys(name for _, name, _ in pieces))}
    lines = [
        f'    <DataSet timestep="{time:g}" group="" part="{numbers[name]}" name={quoteattr(name)} '
        f"file={quoteattr(file)}/>"
        for time, name, file in pieces
    ]
    said = [f"<!-- {_MADE_BY} {place} -->"] if place else []
    head = ['<?xml version="1.0"?>', *said, '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">']
    partial = path.with_name(f".{path.name}.partial")
    text = "\n".join([*head, "  <Collection>", *lines, "  </Collection>", "</VTKFile>", ""])
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)
