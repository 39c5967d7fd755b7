"""Bodies in VTU files: written so that they come back bit for bit, or deformed, for ParaView."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import ArrayLike, NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from ..body import Body, Surface
from ..elements import KINDS
from .common import FileError, discard, existing
from .formats.vtk import add_words, grid_blocks, read_vtk, unstructured_grid, vtk_messages

_FRACTIONS = "fraction"
_SKIN = ("skin_points", "skin_triangles")
_MARK = "softtwin body"
_PLAIN = " :()[]/,=+@"
_PREFIXES = ("node_set:", "surface:", "inner_points:", "inner_triangles:")
_FIELD = "field:"


def write_body(path: str | Path, body: Body, fields: Mapping[str, ArrayLike] | None = None) -> None:
    """Write a body to a VTU file that `read_body` reads back bit for bit, and that ParaView shows.

    The file appears whole or not at all.

    Args:
        path: file to write, `.vtu`.
        body: the body.
        fields: arrays that go with it, by name (eigenmodes for instance); those with a row for each node can be seen
            in ParaView.

    Raises:
        FileError: another suffix, or the file could not be written.
    """
    grid = unstructured_grid(body.points, body.cells)
    for name, field in (fields or {}).items():
        array = np.asarray(field)
        _add(grid.GetPointData() if len(array) == len(body.points) else grid.GetFieldData(), f"{_FIELD}{name}", array)
    for name, nodes in body.node_sets.items():
        mask = np.zeros(len(body.points), dtype=np.uint8)
        mask[nodes] = 1
        _add(grid.GetPointData(), name, mask)
        _add(grid.GetFieldData(), f"node_set:{name}", nodes)
    for name, triangles in body.surfaces.items():
        _add(grid.GetFieldData(), f"surface:{name}", triangles)
    for name, surface in body.inner.items():
        _add(grid.GetFieldData(), f"inner_points:{name}", surface.points)
        _add(grid.GetFieldData(), f"inner_triangles:{name}", surface.triangles)
    if body.fractions is not None:
        _add(grid.GetCellData(), _FRACTIONS, body.fractions)
    if body.skin is not None:
        _add(grid.GetFieldData(), _SKIN[0], body.skin.points)
        _add(grid.GetFieldData(), _SKIN[1], body.skin.triangles)
    _add(grid.GetFieldData(), _MARK, np.array([1]))
    _write(Path(path), grid)


def read_body(path: str | Path) -> Body:
    """The body that `write_body` wrote, bit for bit.

    Args:
        path: VTU file.

    Raises:
        FileError: missing or damaged file, or one that `write_body` did not write.
        BodyError: the file's content is no valid body.
    """
    path = existing(path)
    if path.suffix.lower() != ".vtu":
        raise FileError(f"{path}: expected a body as .vtu, got {path.suffix!r}.")
    grid = read_vtk(path)
    fields = grid.GetFieldData()
    arrays = {fields.GetArrayName(i): fields.GetArray(i) for i in range(fields.GetNumberOfArrays())}
    if _MARK not in arrays:
        raise FileError(f"{path}: not a body written by softtwin; read it as a mesh and say which nodes are fixed.")
    sets, surfaces, points, triangles = (_named(arrays, prefix) for prefix in _PREFIXES)
    blocks = grid_blocks(path, grid)
    inner = {name: Surface(points[name], triangles[name]) for name in points}
    kind = next(kind for kind in KINDS.values() if kind.name in blocks)
    positions = vtk_to_numpy(grid.GetPoints().GetData())[:, : kind.dimension]
    fractions = grid.GetCellData().GetArray(_FRACTIONS)
    whole = None if fractions is None else vtk_to_numpy(fractions)
    skin = Surface(*(vtk_to_numpy(arrays[name]) for name in _SKIN)) if _SKIN[0] in arrays else None
    return Body(positions, blocks[kind.name], sets, surfaces, inner, whole, skin)


def read_fields(path: str | Path) -> dict[str, NDArray[Any]]:
    """The arrays that `write_body` wrote with a body, by name.

    Args:
        path: VTU file.

    Raises:
        FileError: missing or damaged file.
    """
    grid = read_vtk(existing(path))
    found: dict[str, NDArray[Any]] = {}
    for data in (grid.GetFieldData(), grid.GetPointData()):
        arrays = {data.GetArrayName(i): data.GetArray(i) for i in range(data.GetNumberOfArrays())}
        found |= _named(arrays, _FIELD)
    return found


def write_deformed(
    path: str | Path,
    body: Body,
    displacement: ArrayLike,
    fields: Mapping[str, ArrayLike] | None = None,
    words: Mapping[str, str] | None = None,
) -> None:
    """Write the deformed body with its displacement and other fields to a VTU file for ParaView.

    Args:
        path: file to write, `.vtu`.
        body: the body at rest.
        displacement: nodal displacements, (n, 3), metres.
        fields: further fields by name, one row a node, or one row a cell.
        words: what the file states about itself, as text in its field data (see `Coordinates.words`).

    Raises:
        FileError: another suffix, or the file could not be written.
        ValueError: a field with another number of rows.
    """
    moved = np.asarray(displacement, dtype=np.float64)
    if moved.shape != body.points.shape:
        raise ValueError(f"displacement: expected shape {body.points.shape}, got {moved.shape}.")
    grid = unstructured_grid(body.points + moved, body.cells)
    if body.dimension == 2:
        moved = np.column_stack([moved, np.zeros(len(moved))])
    _add(grid.GetPointData(), "displacement", moved)
    for name, field in (fields or {}).items():
        array = np.asarray(field)
        if array.ndim not in (1, 2) or len(array) not in (len(body.points), len(body.cells)):
            raise ValueError(f"fields[{name!r}]: expected a row for each of {len(body.points)} nodes or "
                             f"{len(body.cells)} cells, got shape {array.shape}.")  # fmt: skip
        _add(grid.GetPointData() if len(array) == len(body.points) else grid.GetCellData(), name, array)
    add_words(grid, words or {})
    _write(Path(path), grid)


def _add(data: Any, name: str, array: NDArray[Any]) -> None:
    if array.dtype == bool:
        array = array.astype(np.uint8)
    converted = numpy_to_vtk(np.ascontiguousarray(array), deep=True)
    converted.SetName(quote(name, safe=_PLAIN))  # VTK writes names into XML as they are
    data.AddArray(converted)


def _named(arrays: Mapping[str, Any], prefix: str) -> dict[str, NDArray[Any]]:
    return {unquote(name[len(prefix) :]): vtk_to_numpy(a) for name, a in arrays.items() if name.startswith(prefix)}


def _write(path: Path, grid: vtkUnstructuredGrid) -> None:
    if path.suffix.lower() != ".vtu":
        raise FileError(f"{path}: expected the suffix .vtu, got {path.suffix!r}.")
    partial = path.with_name(f".{path.name}.partial")
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(partial))
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    with vtk_messages() as window:
        written = writer.Write()
        said = " ".join(window.GetOutput().split())
    if not written or said:
        discard(partial)
        raise FileError(f"{path}: could not be written; is the folder there, and is the disk full? ({said[:200]}).")
    os.replace(partial, path)
