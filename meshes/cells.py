"""Cells as files hold them, made cells of one kind that a body can have: nothing of a volume is left out unsaid."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid
from vtkmodules.vtkFiltersGeneral import vtkDataSetTriangleFilter

from .body import Floats, Ints, corner_jacobians
from .elements import KINDS

_SOLID = ("tetra", "hexahedron", "wedge", "pyramid", "voxel", "polyhedron", "VTK_LAGRANGE_TETRA", "VTK_LAGRANGE_HEXA",
          "VTK_LAGRANGE_WEDGE")  # fmt: skip
_THIN = ("vertex", "line", "VTK_LAGRANGE_CURVE")
_VTK_NUMBERS = {"tetra": 10, "hexahedron": 12, "wedge": 13, "pyramid": 14}
_QUADRATIC = ("tetra10", "hexahedron27")
_VOXEL = [0, 1, 3, 2, 4, 5, 7, 6]  # nodes of VTK's voxel, which counts along the axes, as those of a hexahedron
_TURNED = {4: [0, 2, 1, 3], 8: [4, 5, 6, 7, 0, 1, 2, 3], 10: [0, 2, 1, 3, 6, 5, 4, 7, 9, 8]}
_TRIANGLES = {
    "tetra": KINDS[3, 4].facets,
    "wedge": ((0, 1, 2), (3, 5, 4)),
    "pyramid": ((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
_QUADRILATERALS = {
    "hexahedron": KINDS[3, 8].facets,
    "wedge": ((0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    "pyramid": ((0, 3, 2, 1),),
}
_SOURCE = "softtwin: number of the cell"


class CellError(ValueError):
    """Cells that no body can have: the message names them."""


def dimension(name: str) -> int:
    """Dimension of a kind of cell: 3 for a volume, 2 for a surface, 1 for lines and points.

    Args:
        name: as meshio names it; what `other_cell` made of a number.
    """
    if name.startswith(_SOLID):
        return 3
    return 1 if name.startswith(_THIN) else 2


def other_cell(dimension: int, number: str) -> str:
    """The name of a kind of cell that has no other.

    Args:
        dimension: its own.
        number: how its format calls it.
    """
    return f"{('line', 'line', 'surface cell', 'polyhedron')[dimension]} ({number})"


def counted(blocks: Mapping[str, Ints]) -> str:
    """How many cells of each kind there are, for messages.

    Args:
        blocks: node numbers by the name of the kind.
    """
    return ", ".join(f"{len(block)} {name}" for name, block in blocks.items())


def one_kind(points: Floats, blocks: Mapping[str, Ints]) -> tuple[Ints, list[str]]:
    """All volume cells of a file as cells of one kind, and what was done to them, one line each.

    Tetrahedra, hexahedra and their quadratic kinds stay what they are where they are alone, voxels are hexahedra, and
    every mixture becomes tetrahedra that match across faces: VTK's ordered triangulation splits a face by the numbers
    of its nodes, whichever cell it is seen from.

    Args:
        points: (n, 3).
        blocks: node numbers by the name of the kind (meshio's names and VTK's order of nodes); cells that are no volume
            are left out.

    Raises:
        CellError: a kind that cannot be read, linear and quadratic cells in one file, or a wedge, pyramid or mixed cell
            that is turned inside out in part.
    """
    solid = {name: block for name, block in blocks.items() if dimension(name) == 3 and len(block)}
    known = {*_VTK_NUMBERS, *_QUADRATIC, "voxel"}
    if unknown := {name: block for name, block in solid.items() if name not in known}:
        raise CellError(
            f"expected tetrahedra, hexahedra, voxels, wedges or pyramids (linear), tetra10 or hexahedron27, got "
            f"{counted(unknown)}; save the mesh with first-order cells"
        )
    if len(solid) > 1 and set(solid) & set(_QUADRATIC):
        raise CellError(f"expected cells of one order, got {counted(solid)}")
    if "voxel" in solid:
        voxels = solid.pop("voxel")[:, _VOXEL]
        solid["hexahedron"] = np.concatenate([solid.get("hexahedron", np.empty((0, 8), np.int64)), voxels])
    if len(solid) == 1 and not set(solid) & {"wedge", "pyramid"}:
        return _turned(points, next(iter(solid.values())))
    _check_faces(solid)
    cells = _split(points, solid)
    return cells, [f"cells: {counted(solid)} were split into {len(cells)} tetrahedra"]


def _turned(points: Floats, cells: Ints) -> tuple[Ints, list[str]]:
    """Cells that are all inside out the right way round; where some are, the body says which."""
    corners = cells[:, : KINDS[3, cells.shape[1]].corners]
    if cells.shape[1] not in _TURNED or (corner_jacobians(points, corners) >= 0).any():
        return cells, []
    return cells[:, _TURNED[cells.shape[1]]], [f"all {len(cells)} cells were inside out and have been turned"]


def _faces(solid: Mapping[str, Ints], corners: Mapping[str, tuple[tuple[int, ...], ...]], count: int) -> Ints:
    """The faces of that many corners that one cell alone has, with sorted nodes."""
    parts = [block[:, np.array(corners[name])].reshape(-1, count) for name, block in solid.items() if name in corners]
    faces, times = np.unique(
        np.sort(np.concatenate([np.empty((0, count), np.int64), *parts])), axis=0, return_counts=True
    )
    return faces[times == 1]


def _check_faces(solid: Mapping[str, Ints]) -> None:
    """Refuse a quadrilateral beside two triangles: its own halves may be the other two, and leave a crack."""
    quadrilaterals = _faces(solid, _QUADRILATERALS, 4)
    triangles = {tuple(face) for face in _faces(solid, _TRIANGLES, 3).tolist()}
    halves = quadrilaterals[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].tolist()
    if bad := sum(any(tuple(half) in triangles for half in of_one) for of_one in halves):
        meeting = "1 quadrilateral that meets triangles" if bad == 1 else f"{bad} quadrilaterals that meet triangles"
        raise CellError(f"expected cells that share their faces whole, got {meeting} of other cells")


def _split(points: Floats, solid: Mapping[str, Ints]) -> Ints:
    grid, nodes, array, splitting = vtkUnstructuredGrid(), vtkPoints(), vtkCellArray(), vtkDataSetTriangleFilter()
    sizes = np.concatenate([np.full(len(block), block.shape[1]) for block in solid.values()])
    kinds = np.concatenate([np.full(len(block), _VTK_NUMBERS[name]) for name, block in solid.items()])
    nodes.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=True))
    array.SetData(
        numpy_to_vtkIdTypeArray(np.concatenate([[0], np.cumsum(sizes)]), deep=True),
        numpy_to_vtkIdTypeArray(np.concatenate([block.ravel() for block in solid.values()]), deep=True),
    )
    grid.SetPoints(nodes)
    grid.SetCells(numpy_to_vtk(kinds.astype(np.uint8), deep=True), array)
    number = numpy_to_vtkIdTypeArray(np.arange(len(sizes)), deep=True)
    number.SetName(_SOURCE)
    grid.GetCellData().AddArray(number)
    splitting.SetInputData(grid)
    splitting.TetrahedraOnlyOn()
    splitting.Update()
    made = splitting.GetOutput()
    cells = vtk_to_numpy(made.GetCells().GetConnectivityArray()).reshape(-1, 4).astype(np.int64)
    source: NDArray[np.int64] = vtk_to_numpy(made.GetCellData().GetArray(_SOURCE)).astype(np.int64)
    # The first triangle of a wedge faces outward in some programs and inward in others: a whole cell may be turned.
    volumes = corner_jacobians(points, cells)[:, 0]
    is_in, is_out = (np.bincount(source, side, len(sizes)) > 0 for side in (volumes <= 0, volumes > 0))
    if (bad := np.flatnonzero(is_in == is_out)).size:
        names = np.repeat(list(solid), [len(block) for block in solid.values()])
        raise CellError(
            f"expected cells of positive volume, got {len(bad)} of {len(sizes)} that are flat, empty or inside out in "
            f"part, the first a {names[bad[0]]}"
        )
    cells[is_in[source]] = cells[is_in[source]][:, _TURNED[4]]
    return cells
