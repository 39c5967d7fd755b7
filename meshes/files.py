"""Files in and out: surfaces, volumes, clouds and bodies, in any unit, always metres inside."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args
from urllib.parse import quote, unquote

import meshio
import numpy as np
from numpy.typing import ArrayLike, NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkPoints, vtkStringArray, vtkStringOutputWindow
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkGenericCell, vtkUnstructuredGrid
from vtkmodules.vtkFiltersCore import vtkTriangleFilter
from vtkmodules.vtkIOLegacy import vtkDataSetReader
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader, vtkXMLUnstructuredGridWriter

from .body import Body, Floats, Ints, Surface
from .cells import CellError, counted, dimension, one_kind, other_cell
from .elements import KINDS
from .ply import read_ply, read_ply_normals

Unit = Literal["m", "cm", "mm"]
Axes = Literal["lps", "ras"]
UNITS: tuple[str, ...] = get_args(Unit)
AXES: tuple[str, ...] = get_args(Axes)

_log = logging.getLogger(__name__)
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
LARGEST, SMALLEST = 2.0, 5e-3  # metres: an organ outside these was read in the wrong unit
_MESHIO = (".stl", ".obj", ".msh")
_VTK: Mapping[str, Any] = {".vtk": vtkDataSetReader, ".vtu": vtkXMLUnstructuredGridReader, ".vtp": vtkXMLPolyDataReader}
_FIRST_MSH = {
    1: "line",
    2: "triangle",
    3: "quad",
    4: "tetra",
    5: "hexahedron",
    6: "wedge",
    7: "pyramid",
    8: "line3",
    15: "vertex",
}  # gmsh's element types
_FIRST_MSH_SURFACES = (9, 10, 16)
_TEXT = (".txt", ".csv", ".xyz")
SEGMENTATIONS = (".nii", ".nii.gz", ".nrrd")
_PCD = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
_TURN = np.array([-1.0, -1.0, 1.0])  # from RAS to LPS and back
_VTK_NAMES = {kind.vtk: kind.name for kind in KINDS.values()} | {
    **{1: "vertex", 2: "vertex group", 3: "line", 4: "line string", 21: "line3"},
    **{6: "triangle strip", 7: "polygon", 8: "pixel", 23: "quad8"},
    **{11: "voxel", 13: "wedge", 14: "pyramid", 42: "polyhedron"},
    **{25: "hexahedron20", 26: "wedge15", 27: "pyramid13", 32: "wedge18", 33: "hexahedron24"},
}
_LAST_LINES = 100  # of a text cloud, to see how its numbers end
_HEAD = 2048  # bytes in which a file says what it is
_FRACTIONS = "fraction"
_SKIN = ("skin_points", "skin_triangles")
_MARK = "softtwin body"
_PLAIN = " :()[]/,=+@"
_PREFIXES = ("node_set:", "surface:", "inner_points:", "inner_triangles:")
_FIELD = "field:"


class FileError(ValueError):
    """A file that cannot be used: the message names it, what was expected and what came."""


class ContentError(FileError):
    """A file that is there and was read, but holds no points, or numbers that are not finite."""


class UnitWarning(UserWarning):
    """A file whose size fits no organ: it was probably read in the wrong unit."""


@dataclass(frozen=True)
class _Mesh:
    points: Floats
    cells: Mapping[str, Ints]

    @property
    def triangles(self) -> Ints:
        quads = self.cells.get("quad", np.empty((0, 4), np.int64))
        halves = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        return np.concatenate([self.cells.get("triangle", np.empty((0, 3), np.int64)), halves])

    @property
    def content(self) -> str:
        counts = counted({name: block for name, block in self.cells.items() if name != "vertex"})
        return f"{len(self.points)} points" + (f" and cells: {counts}" if counts else " and no cells")

    @property
    def is_solid(self) -> bool:
        return any(dimension(name) == 3 for name in self.cells)


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


def in_metres(lengths: ArrayLike, unit: Unit) -> Floats:
    """Lengths in metres.

    Args:
        lengths: numbers of any shape.
        unit: theirs.
    """
    # Dividing by a whole number rounds once; multiplying by 0.001 would round twice.
    return np.asarray(lengths, dtype=np.float64) / round(1 / _METRES[unit])


def is_labelmap(path: str | Path) -> bool:
    """Whether a file is one of segmented voxels, by its name (`labelmap.py` reads it).

    Args:
        path: the file.
    """
    return Path(path).name.lower().endswith(SEGMENTATIONS)


def is_segmentation(path: str | Path) -> bool:
    """Whether something may be a segmentation: a label map by its name, or a folder that holds some.

    Args:
        path: file or folder.
    """
    return bool(structure_files(path)) if Path(path).is_dir() else is_labelmap(path)


def is_companion(path: str | Path) -> bool:
    """Whether a file is what a system or an editor left beside another, and no data: hidden, a lock, of `__MACOSX`.

    Args:
        path: a file that was found in a folder.
    """
    path = Path(path)
    return path.name.startswith((".", "~$")) or "__MACOSX" in path.parts


def structure_files(folder: str | Path) -> list[Path]:
    """The label maps in a folder, in order.

    Args:
        folder: as TotalSegmentator writes it, with a file for each structure.
    """
    files = (path for path in Path(folder).iterdir() if path.is_file() and not is_companion(path))
    return sorted(path for path in files if is_labelmap(path))


def stated_axes(path: str | Path) -> Axes | None:
    """The axes that a file states about itself, as 3D Slicer writes and reads them; None for none.

    `SPACE=LPS` or `SPACE=RAS` in the head of STL, PLY, OBJ and VTK; a text `SPACE` in the field data of VTP and VTU
    (Slicer, Libs/MRML/Core/vtkMRMLModelStorageNode.cxx, WriteDataInternal and GetCoordinateSystemFromFieldData).

    Args:
        path: any file.

    Raises:
        FileError: missing, empty or damaged file.
    """
    word = _stated(_existing(path), "SPACE").lower()
    return word if word in AXES else None  # type: ignore[return-value]


def stated_unit(path: str | Path) -> Unit | None:
    """The unit of length that a file states about itself, as softtwin writes it (`UNIT=mm`); None for none.

    Args:
        path: any file.

    Raises:
        FileError: missing, empty or damaged file.
    """
    word = _stated(_existing(path), "UNIT")
    return word if word in UNITS else None  # type: ignore[return-value]


def _stated(path: Path, name: str) -> str:
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if path.suffix.lower() not in (".vtp", ".vtu"):
        found = re.search(rb"\b%s=(\w+)" % name.encode(), head)
        return found.group(1).decode("latin-1") if found else ""
    if f'Name="{name}"'.encode() not in head:  # field data stand first, and the whole file need not be read
        return ""
    array = _read_vtk(path).GetFieldData().GetAbstractArray(name)
    return str(array.GetValue(0)) if array and array.IsA("vtkStringArray") and array.GetNumberOfValues() else ""


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
    mesh = _read(path)
    if mesh.is_solid:
        return _volume(Path(path), mesh, *_known(path, unit, axes))
    return _surface(Path(path), mesh, *_known(path, unit, axes))


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
    return _surface(Path(path), _read(path), *_known(path, unit, axes))


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
    volume = _volume(Path(path), _read(path), *_known(path, unit, axes))
    for line in volume.said:
        _log.info("%s: %s", path, line)
    return volume.points, volume.cells


def read_cloud(path: str | Path, unit: Unit = "m", axes: Axes = "lps", normals: bool = False) -> Floats:
    """The points of a file, (p, 3), metres; with the normals measured there (p, 6).

    Args:
        path: text with three columns (TXT, CSV, XYZ), NPY, PCD (points without a measurement, NaN, are left out), or
            any mesh file whose points are taken.
        unit: the file's unit of length.
        axes: the file's axes: `lps` is kept, `ras` is turned to LPS (x and y change sign).
        normals: read them, too: columns 4 to 6 of a table, `nx`, `ny`, `nz` of a PLY, `normal_x` and so on of a PCD,
            the normals of a VTK file. NaN or zeros where none was measured.

    Raises:
        FileError: missing, empty, damaged or unknown file, or not three columns of finite numbers; no normals where
            they are asked for.
    """
    path = _existing(path)
    suffix = path.suffix.lower()
    if suffix in (*_TEXT, ".npy"):
        points = _read_table(path)
    elif suffix == ".pcd":
        points = _read_pcd(path, _PCD[: 6 if normals else 3])
    else:
        points = _read(path).points
    facing: Floats | None = None
    if normals:
        if suffix in (*_TEXT, ".npy", ".pcd"):
            is_table = points.ndim == 2 and points.shape[1] == 6
            points, facing = (points[:, :3], points[:, 3:]) if is_table else (points, None)
        else:
            facing = _vertex_normals(path)
        if facing is None or facing.shape != points.shape:
            got = "none" if facing is None else f"shape {facing.shape}"
            raise FileError(f"{path}: expected a normal for each point, got {got}; without --normals it can be used.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise FileError(f"{path}: expected a cloud of shape (p, 3), got {points.shape}.")
    if len(points) == 0:
        raise ContentError(f"{path}: expected a cloud with points, got none.")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise ContentError(
            f"{path}: expected finite coordinates, got NaN or infinity in {bad} of {len(points)} points; remove them."
        )
    placed = _placed(path, points, unit, axes, smallest=0.0)
    return placed if facing is None else np.hstack([placed, facing * (_TURN if axes == "ras" else 1.0)])


def _vertex_normals(path: Path) -> Floats | None:
    """Normals of the points of a mesh file, (p, 3), as they stand in it; None where it has none."""
    suffix, found = path.suffix.lower(), None
    if suffix == ".ply":
        found = read_ply_normals(path)
    elif suffix in _VTK:
        data = _read_vtk(path).GetPointData()
        names = [data.GetArrayName(i) for i in range(data.GetNumberOfArrays())]
        named = [name for name in names if name and name.lower() == "normals"]
        array = data.GetNormals() or (data.GetArray(named[0]) if named else None)
        found = None if array is None else vtk_to_numpy(array)
    return None if found is None else np.asarray(found, dtype=np.float64)


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
    path = _existing(path)
    if path.suffix.lower() != ".vtu":
        raise FileError(f"{path}: expected a body as .vtu, got {path.suffix!r}.")
    grid = _read_vtk(path)
    fields = grid.GetFieldData()
    arrays = {fields.GetArrayName(i): fields.GetArray(i) for i in range(fields.GetNumberOfArrays())}
    if _MARK not in arrays:
        raise FileError(f"{path}: not a body written by softtwin; read it as a mesh and say which nodes are fixed.")
    sets, surfaces, points, triangles = (_named(arrays, prefix) for prefix in _PREFIXES)
    blocks = _grid_blocks(grid)
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
    grid = _read_vtk(_existing(path))
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


def _known(path: str | Path, unit: Unit | None, axes: Axes | None) -> tuple[Unit, Axes]:
    return unit or stated_unit(path) or "m", axes or stated_axes(path) or "lps"


def discard(partial: Path) -> None:
    """Remove what was written of a file that could not be finished.

    Args:
        partial: it; it may not be there, nor its folder.
    """
    with contextlib.suppress(OSError):
        partial.unlink()


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise FileError(f"{path}: no such file." if not path.exists() else f"{path}: expected a file, got a folder.")
    if path.stat().st_size == 0:
        raise ContentError(f"{path}: the file is empty.")
    return path


def _read(path: str | Path) -> _Mesh:
    path = _existing(path)
    suffix = path.suffix.lower()
    if suffix in _VTK:
        mesh = _from_vtk(path)
    elif suffix == ".msh" and path.read_bytes()[:_HEAD].lstrip().startswith(b"$NOD"):
        mesh = _from_first_msh(path)
    elif suffix == ".ply":
        mesh = _from_ply(path)
    elif suffix in _MESHIO:
        if suffix == ".stl":
            _check_stl(path)
        mesh = _from_meshio(path)
    else:
        known = ", ".join((*_MESHIO, ".ply", *_VTK))
        raise FileError(f"{path}: expected a mesh file ({known}), got suffix {suffix!r}.")
    if len(mesh.points) == 0:
        raise ContentError(f"{path}: the file holds no points; it may be truncated or damaged.")
    if not np.isfinite(mesh.points).all():
        raise ContentError(f"{path}: expected finite coordinates, got NaN or infinity.")
    for name, block in mesh.cells.items():
        if block.min(initial=0) < 0 or block.max(initial=0) >= len(mesh.points):
            raise FileError(f"{path}: a {name} refers to a point that is not there; the file may be damaged.")
    return mesh


def _from_ply(path: Path) -> _Mesh:
    try:
        points, triangles = read_ply(path)
    except (ValueError, KeyError, IndexError) as error:
        raise FileError(f"{path}: could not be read as ply; the file may be truncated or damaged "
                        f"({type(error).__name__}: {error}).") from error  # fmt: skip
    return _Mesh(points, {"triangle": triangles} if len(triangles) else {})


def _check_stl(path: Path) -> None:
    """Refuse an STL that ends before it says that it does."""
    content = path.read_bytes()
    if content.lstrip()[:5] == b"solid" and b"facet" in content[:_HEAD]:
        if b"endsolid" not in content[-_HEAD:]:
            raise FileError(f"{path}: the STL is truncated: expected 'endsolid' at its end.")
        return
    count = int.from_bytes(content[80:84], "little")
    if len(content) < 84 + 50 * count or len(content) < 84:
        raise FileError(f"{path}: the STL is truncated or none: expected {84 + 50 * count} bytes for the {count} "
                        f"triangles that it names, got {len(content)}.")  # fmt: skip


def _from_first_msh(path: Path) -> _Mesh:
    """MSH 1, which meshio does not read: nodes `number x y z`, elements `number type region part count nodes...`."""
    words = path.read_text().split()
    try:
        nodes, elements = words.index("$NOD"), words.index("$ELM")
        words.index("$ENDELM")
        count = int(words[nodes + 1])
        table = np.array(words[nodes + 2 : nodes + 2 + 4 * count], dtype=np.float64).reshape(count, 4)
        cells, at = dict[str, list[list[int]]](), elements + 2
        for _ in range(int(words[elements + 1])):
            kind, size = int(words[at + 1]), int(words[at + 4])
            corners = [int(word) for word in words[at + 5 : at + 5 + size]]
            other = other_cell(2 if kind in _FIRST_MSH_SURFACES else 3, f"MSH type {kind}")
            cells.setdefault(_FIRST_MSH.get(kind, other), []).append(corners)
            at += 5 + size
        numbers = table[:, 0].astype(np.int64)
        order = np.argsort(numbers)
        places = {name: order[np.searchsorted(numbers[order], np.array(block))] for name, block in cells.items()}
        if any(not np.isin(block, numbers).all() for block in map(np.array, cells.values())):
            raise ValueError("an element names a node that is not there")
    except (ValueError, IndexError) as error:
        raise FileError(f"{path}: could not be read as MSH 1; the file may be truncated or damaged ({error}); else "
                        "save it as MSH 2 or 4.") from error  # fmt: skip
    return _Mesh(table[:, 1:], places)


def _from_meshio(path: Path) -> _Mesh:
    said = io.StringIO()
    try:
        # meshio prints its complaints and may end the process on a file that it cannot read.
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = meshio.read(path)
            points = np.asarray(mesh.points, dtype=np.float64)
            blocks: dict[str, list[Ints]] = {}
            for block in mesh.cells:
                blocks.setdefault(block.type, []).append(np.asarray(block.data, dtype=np.int64))
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{said.getvalue()} {error}".split())
        raise FileError(f"{path}: could not be read as {path.suffix[1:]}; the file may be truncated or damaged "
                        f"({type(error).__name__}: {reason[:200]}).") from error  # fmt: skip
    if points.ndim != 2 or points.shape[1] != 3:
        raise FileError(f"{path}: expected points with three coordinates, got shape {points.shape}.")
    cells = {name: np.concatenate(parts) for name, parts in blocks.items()}
    return _Mesh(points, cells)


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


def _read_vtk(path: Path) -> Any:
    reader = _VTK[path.suffix.lower()]()
    reader.SetFileName(str(path))
    with vtk_messages() as window:
        reader.Update()
        data = reader.GetOutput()
        said = " ".join(window.GetOutput().split())
    if said or data is None or reader.GetErrorCode():
        raise FileError(f"{path}: could not be read as {path.suffix[1:]}; the file may be truncated or damaged "
                        f"({said[:200] or 'VTK gave no reason'}).")  # fmt: skip
    return data


def _from_vtk(path: Path) -> _Mesh:
    data = _read_vtk(path)
    if data.IsA("vtkPolyData"):
        return _Mesh(_vtk_points(data), {k: v for k, v in _poly_blocks(data).items() if len(v)})
    if data.IsA("vtkUnstructuredGrid"):
        return _Mesh(_vtk_points(data), _grid_blocks(data))
    raise FileError(f"{path}: expected an unstructured grid or polygons, got {data.GetClassName()}.")


def _vtk_points(data: Any) -> Floats:
    if data.GetNumberOfPoints() == 0:
        return np.empty((0, 3))
    return vtk_to_numpy(data.GetPoints().GetData()).astype(np.float64)


def _poly_blocks(data: Any) -> dict[str, Ints]:
    # Any polygon and strip becomes triangles; point numbers stay.
    triangulate = vtkTriangleFilter()
    triangulate.PassVertsOff()
    triangulate.PassLinesOff()
    triangulate.SetInputData(data)
    triangulate.Update()
    polygons = triangulate.GetOutput().GetPolys()
    if polygons.GetNumberOfCells() == 0:
        return {}
    return {"triangle": vtk_to_numpy(polygons.GetConnectivityArray()).astype(np.int64).reshape(-1, 3)}


def _grid_blocks(grid: Any) -> dict[str, Ints]:
    if grid.GetNumberOfCells() == 0:
        return {}
    array = grid.GetCells()
    types = np.array([grid.GetCellType(i) for i in range(grid.GetNumberOfCells())])
    connectivity = vtk_to_numpy(array.GetConnectivityArray()).astype(np.int64)
    sizes = np.array([grid.GetCellSize(i) for i in range(len(types))])
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    blocks = {}
    for kind in np.unique(types):
        of_kind = types == kind
        name, nodes = _VTK_NAMES.get(int(kind), ""), int(sizes[of_kind].min())
        if not name:
            cell = vtkGenericCell()
            cell.SetCellType(int(kind))
            name = other_cell(cell.GetCellDimension(), f"VTK type {kind}")
        blocks[name] = connectivity[starts[of_kind][:, None] + np.arange(nodes)]
    return blocks


def _read_table(path: Path) -> Floats:
    try:
        if path.suffix.lower() == ".npy":
            return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
        text = path.read_text()
        lines = [line for line in text.replace(",", " ").replace(";", " ").splitlines() if line.strip()]
        if not text.endswith("\n") and _is_cut(lines):
            raise ValueError("its last number has fewer digits than all others in its column, and no line ends there")
        if lines and not _is_numeric(lines[0]):
            lines = lines[1:]  # column names, or a comment
        return np.array([line.split() for line in lines], dtype=np.float64).reshape(len(lines), -1 if lines else 3)
    except (ValueError, EOFError, OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path}: expected rows of three numbers; the file may be truncated or damaged "
                        f"({error}).") from error  # fmt: skip


def _is_cut(lines: list[str]) -> bool:
    """True where all last numbers but that of the last line end alike (digits after the point, exponent)."""
    ends = [re.sub(r"^[-+]?\d*", "", line.split()[-1]) for line in lines[-_LAST_LINES:]]
    shapes = {re.sub(r"\d", "0", end).replace("-", "+") for end in ends[:-1]}
    return len(ends) > 2 and len(shapes) == 1 and len(ends[-1]) < len(ends[0])


def _read_pcd(path: Path, fields: tuple[str, ...]) -> Floats:
    from pypcd4.pypcd4 import PointCloud  # drags pydantic's models in: only where a PCD comes

    try:
        cloud = PointCloud.from_path(path)
        if missing := [name for name in fields if name not in cloud.fields]:
            raise ValueError(f"expected the fields {', '.join(fields)}, and {missing[0]} is missing")
        points = np.asarray(cloud.numpy(fields), dtype=np.float64)
        if len(points) != cloud.points:
            raise ValueError(f"expected {cloud.points} points, got {len(points)}")
    except Exception as error:  # of pydantic, struct and lzf, each with its own
        raise FileError(f"{path}: could not be read as pcd; the file may be truncated or damaged "
                        f"({' '.join(str(error).split())[:200]}).") from error  # fmt: skip
    return points[~np.isnan(points[:, :3]).any(axis=1)]  # NaN stands for a pixel without a measurement


def _is_numeric(line: str) -> bool:
    try:
        return len([float(word) for word in line.split()]) > 0
    except ValueError:
        return False


def _surface(path: Path, mesh: _Mesh, unit: Unit, axes: Axes) -> Surface:
    triangles = mesh.triangles
    if len(triangles) == 0 or any(dimension(name) == 2 for name in set(mesh.cells) - {"triangle", "quad"}):
        raise FileError(f"{path}: expected a surface of triangles, got {mesh.content}.")
    points = mesh.points
    places, numbers = np.unique(points, axis=0, return_inverse=True)
    if len(places) < len(points):
        # An STL repeats every vertex in each of its triangles, and so do some programs in any format.
        points, triangles = places, numbers.ravel()[triangles]
    used, numbers = np.unique(triangles, return_inverse=True)
    points = _placed(path, points[used], unit, axes, smallest=SMALLEST)
    return Surface(points, numbers.reshape(-1, 3).astype(np.int64))


def _volume(path: Path, mesh: _Mesh, unit: Unit, axes: Axes) -> Volume:
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
    points = _placed(path, mesh.points[numbers], unit, axes, smallest=SMALLEST)
    return Volume(points, local.reshape(cells.shape).astype(np.int64), numbers, tuple(said))


def _placed(path: Path, points: Floats, unit: Unit, axes: Axes, smallest: float) -> Floats:
    if unit not in _METRES:
        raise ValueError(f"unit: expected 'm', 'cm' or 'mm', got {unit!r}.")
    if axes not in ("lps", "ras"):
        raise ValueError(f"axes: expected 'lps' or 'ras', got {axes!r}.")
    points = in_metres(points, unit)
    if axes == "ras":
        points = points * _TURN
    _warn_size(path, float(np.ptp(points, axis=0).max()), unit, smallest)
    return points


def _warn_size(path: Path, size: float, unit: Unit, smallest: float) -> None:
    if smallest <= size <= LARGEST or not np.isfinite(size):
        return
    fits = [u for u, m in _METRES.items() if smallest <= size * m / _METRES[unit] <= LARGEST]
    flag = f"--unit {fits[-1]}" if fits else "--unit"
    warnings.warn(
        f"{path} is {size:.3g} m across when read in {unit}, outside the {SMALLEST * 1e3:g} mm to {LARGEST:g} m of "
        f"an organ; if it is in another unit, say so with {flag}.",
        UnitWarning,
        stacklevel=4,
    )


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
