"""VTK's own formats, by VTK's own readers; what they say is an error here, and never printed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkPoints, vtkStringArray, vtkStringOutputWindow
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkCellTypes, vtkGenericCell, vtkUnstructuredGrid
from vtkmodules.vtkIOLegacy import vtkDataSetReader
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

from ...body import Floats, Ints
from ...cells import other_cell
from ...elements import KINDS
from ..common import FileError
from .polygons import by_length, stripped, triangulated

READERS: Mapping[str, Any] = {
    ".vtk": vtkDataSetReader, ".vtu": vtkXMLUnstructuredGridReader, ".vtp": vtkXMLPolyDataReader,
}  # fmt: skip
_NO_CELLS = ("UnknownClass", "vtkEmptyCell")
_ANY_SIZE = ("vertex group", "line string", "polyhedron")
_NAMES = {kind.vtk: kind.name for kind in KINDS.values()} | {
    **{1: "vertex", 2: "vertex group", 3: "line", 4: "line string", 21: "line3"},
    **{6: "triangle strip", 7: "polygon", 8: "pixel", 23: "quad8"},
    **{11: "voxel", 13: "wedge", 14: "pyramid", 42: "polyhedron"},
    **{25: "hexahedron20", 26: "wedge15", 27: "pyramid13", 32: "wedge18", 33: "hexahedron24"},
}


@contextlib.contextmanager
def vtk_messages() -> Iterator[vtkStringOutputWindow]:
    """What VTK says meanwhile, which it would print."""
    window, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    loudness = vtkLogger.GetCurrentVerbosityCutoff()
    vtkOutputWindow.SetInstance(window)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield window
    finally:
        vtkLogger.SetStderrVerbosity(loudness)
        vtkOutputWindow.SetInstance(before)


def read_vtk(path: Path) -> Any:
    """The data set of a file.

    Args:
        path: the file.

    Raises:
        FileError: cut off, or damaged.
    """
    reader = READERS[path.suffix.lower()]()
    reader.SetFileName(str(path))
    with vtk_messages() as window:
        reader.Update()
        data = reader.GetOutput()
        output = window.GetOutput()
        said = " ".join((output.decode("latin-1") if isinstance(output, bytes) else output).split())
    if said or data is None or reader.GetErrorCode():
        raise FileError(f"{path}: could not be read as {path.suffix[1:]}; the file may be truncated or damaged "
                        f"({said[:200] or 'VTK gave no reason'}).")  # fmt: skip
    return data


def content(path: Path, data: Any) -> tuple[Floats, dict[str, Ints]]:
    """Points (p, 3) and cells by kind of a data set.

    Args:
        path: its file, for messages.
        data: the data set.

    Raises:
        FileError: damaged, or another kind of data set.
    """
    if data.IsA("vtkPolyData"):
        return _points(data), _poly_blocks(path, data)
    if data.IsA("vtkUnstructuredGrid"):
        return _points(data), grid_blocks(path, data)
    raise FileError(f"{path}: expected an unstructured grid or polygons, got {data.GetClassName()}.")


def _points(data: Any) -> Floats:
    if data.GetNumberOfPoints() == 0:
        return np.empty((0, 3))
    return vtk_to_numpy(data.GetPoints().GetData()).astype(np.float64)


def _poly_blocks(path: Path, data: Any) -> dict[str, Ints]:
    points = _points(data)
    polygons, strips = _lists(path, data.GetPolys(), len(points)), _lists(path, data.GetStrips(), len(points))
    parts = [triangulated(points, group) for group in by_length(polygons)] + ([stripped(strips)] if strips else [])
    return {"triangle": np.concatenate(parts)} if parts else {}


def _lists(path: Path, cells: Any, count: int) -> list[Ints]:
    """Point numbers of each cell, all of points that are there."""
    if cells is None or cells.GetNumberOfCells() == 0:
        return []
    offsets, corners = vtk_to_numpy(cells.GetOffsetsArray()), vtk_to_numpy(cells.GetConnectivityArray())
    if (np.diff(offsets) < 0).any() or offsets[0] < 0 or offsets[-1] > len(corners):
        raise FileError(f"{path}: the lists of its cells' points do not fit together; the file may be damaged.")
    if corners.min(initial=0) < 0 or corners.max(initial=0) >= count:
        raise FileError(f"{path}: a polygon refers to a point that is not there; the file may be damaged.")
    return np.split(corners.astype(np.int64), offsets[1:-1])


def grid_blocks(path: Path, grid: Any) -> dict[str, Ints]:
    """Cells of an unstructured grid by kind; polygons and strips become triangles.

    Args:
        path: its file, for messages.
        grid: of VTK.

    Raises:
        FileError: cells without points, or of points that are not there.
    """
    if grid.GetNumberOfCells() == 0:
        return {}
    lists = _lists(path, grid.GetCells(), grid.GetNumberOfPoints())
    types = np.array([grid.GetCellType(number) for number in range(len(lists))])
    sizes = np.array([len(corners) for corners in lists])
    blocks: dict[str, Ints] = {}
    for kind in np.unique(types):
        chosen = np.flatnonzero(types == kind)
        name, few, many = _NAMES.get(int(kind), ""), sizes[chosen].min(), sizes[chosen].max()
        if not name and vtkCellTypes.GetClassNameFromTypeId(int(kind)) in _NO_CELLS:
            raise FileError(
                f"{path}: {len(chosen)} cells are of no kind that VTK knows ({kind}); the file may be damaged."
            )
        if not name:
            cell = vtkGenericCell()
            cell.SetCellType(int(kind))
            name = other_cell(cell.GetCellDimension(), f"VTK type {kind}")
        if few == 0 or (few != many and name not in ("polygon", "triangle strip", *_ANY_SIZE)):
            raise FileError(f"{path}: a {name} has {few} points and another {many}; the file may be damaged.")
        parts = [lists[number] for number in chosen]
        if name == "polygon":
            triangles = [triangulated(_points(grid), group) for group in by_length(parts)]
        elif name == "triangle strip":
            triangles = [stripped(parts)]
        else:
            blocks[name] = np.stack([part[:few] for part in parts])
            continue
        blocks["triangle"] = np.concatenate([blocks.get("triangle", np.empty((0, 3), np.int64)), *triangles])
    return blocks


def unstructured_grid(points: Floats, cells: Ints) -> vtkUnstructuredGrid:
    """Cells of one kind for VTK.

    Args:
        points: (n, 3), or (n, 2) in the plane.
        cells: node numbers, as of a body.
    """
    grid, nodes, array = vtkUnstructuredGrid(), vtkPoints(), vtkCellArray()
    kind = KINDS[points.shape[1], cells.shape[1]]
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    nodes.SetData(numpy_to_vtk(points, deep=True))
    offsets = np.arange(0, cells.size + 1, cells.shape[1])
    array.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(cells.ravel(), deep=True))
    grid.SetPoints(nodes)
    grid.SetCells(kind.vtk, array)
    return grid


def add_words(data: Any, words: Mapping[str, str]) -> None:
    """Texts in the field data of a VTK data set, where 3D Slicer looks for the axes.

    Args:
        data: the data set.
        words: texts by name.
    """
    for name, word in words.items():
        array = vtkStringArray()
        array.SetName(name)
        array.InsertNextValue(word)
        data.GetFieldData().AddArray(array)
