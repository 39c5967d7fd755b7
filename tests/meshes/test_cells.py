"""Cells of any kind that a file holds: all of their volume is in the body, or the file is refused by their name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.cells import CellError, one_kind
from softtwin.meshes.io import FileError, Volume, read_mesh, read_surface
from softtwin.meshes.shapes import beam

CASES = Path(__file__).parents[3] / "shared" / "data" / "cases"
Blocks = Mapping[str, NDArray[np.int64]]
WEDGES = ([0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7])
PYRAMIDS = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def mixed(kinds: tuple[str, ...], seed: int = 0, turned: bool = False) -> tuple[NDArray[np.float64], Blocks]:
    """A sheared bar of 4 x 2 x 2 mm whose hexahedra are split by chance into the given kinds, its nodes renumbered."""
    rng = np.random.default_rng(seed)
    body = beam((4, 3, 3), (0.04, 0.02, 0.02), "hexahedron")
    points, blocks = list(body.points), {"hexahedron": [], "wedge": [], "pyramid": [], "voxel": []}
    middles = np.round(1e6 * body.points[body.cells].mean(axis=1)).astype(int)
    columns = {(x, y): kinds[rng.integers(len(kinds))] for x, y, _ in middles.tolist()}
    for cell, (x, y, _) in zip(body.cells, middles.tolist(), strict=True):
        # The triangles of wedges look up and down: whole columns are split, or a quadrilateral would meet two of them.
        others = [kind for kind in kinds if kind != "wedge"] or ["wedge"]
        kind = "wedge" if columns[x, y] == "wedge" else others[rng.integers(len(others))]
        if kind == "wedge":
            blocks["wedge"] += [cell[wedge] for wedge in WEDGES]
        elif kind == "pyramid":
            blocks["pyramid"] += [[*cell[list(base)], len(points)] for base in PYRAMIDS]
            points.append(body.points[cell].mean(axis=0))
        else:
            blocks[kind].append(cell[[0, 1, 3, 2, 4, 5, 7, 6]] if kind == "voxel" else cell)
    numbers = rng.permutation(len(points))
    places = np.empty((len(points), 3))
    places[numbers] = np.array(points) @ (np.eye(3) if "voxel" in kinds else [[1, 0, 0], [0.2, 1, 0], [0.1, 0, 1]])
    found = {name: numbers[np.array(rng.permutation(block))] for name, block in blocks.items() if block}
    if turned and "wedge" in found:
        found["wedge"][::2] = found["wedge"][::2][:, [3, 4, 5, 0, 1, 2]]
    return places, found


def check(points: NDArray[np.float64], cells: NDArray[np.int64]) -> None:
    """The bar whole: its volume, and no face that is not shared whole."""
    body = Body(points, cells, {})
    assert body.volume == pytest.approx(0.04 * 0.02 * 0.02, rel=1e-9)
    faces = np.sort(cells[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    counts = np.unique(faces, axis=0, return_counts=True)[1]
    # Nothing is open inside: the faces of one cell alone are twice the outer quadrilaterals of 4 x 3 x 3 cells.
    assert counts.max() == 2 and (counts == 1).sum() == 2 * (2 * 9 + 4 * 12)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "kinds",
    [("hexahedron", "pyramid"), ("pyramid",), ("wedge",), ("hexahedron", "pyramid", "wedge"), ("voxel", "wedge")],
)
def test_a_mixture_becomes_tetrahedra_that_match(kinds: tuple[str, ...], seed: int, turned: bool) -> None:
    points, blocks = mixed(kinds, seed, turned)
    cells, said = one_kind(points, blocks)
    check(points, cells)
    assert len(said) == 1 and f"were split into {len(cells)} tetrahedra" in said[0]
    assert all(f"{len(block)} {name}" in said[0] for name, block in blocks.items() if name != "voxel")


def test_voxels_are_hexahedra() -> None:
    points, blocks = mixed(("voxel", "hexahedron"))
    cells, said = one_kind(points, blocks)
    assert cells.shape == (36, 8) and said == []
    assert Body(points, cells, {}).volume == pytest.approx(0.04 * 0.02 * 0.02, rel=1e-9)


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "msh"])
def test_it_is_so_in_every_format(suffix: str, tmp_path: Path) -> None:
    points, blocks = mixed(("hexahedron", "pyramid", "wedge"))
    options = {"file_format": "gmsh22"} if suffix == "msh" else {}
    meshio.Mesh(points, [*blocks.items()]).write(tmp_path / f"bar.{suffix}", **options)
    read = read_mesh(tmp_path / f"bar.{suffix}")
    assert isinstance(read, Volume)
    check(read.points, read.cells)


def test_an_msh_of_version_1_has_wedges_too(tmp_path: Path) -> None:
    points, blocks = mixed(("wedge",))
    nodes = [f"{i + 1} {x} {y} {z}" for i, (x, y, z) in enumerate(points.tolist())]
    cells = [f"{i + 1} 6 1 1 6 {' '.join(map(str, cell + 1))}" for i, cell in enumerate(blocks["wedge"])]
    lines = ["$NOD", str(len(nodes)), *nodes, "$ENDNOD", "$ELM", str(len(cells)), *cells, "$ENDELM"]
    (tmp_path / "bar.msh").write_text("\n".join(lines) + "\n")
    read = read_mesh(tmp_path / "bar.msh")
    assert isinstance(read, Volume)
    check(read.points, read.cells)


@pytest.mark.parametrize(
    ("number", "name", "nodes"),
    [
        *((25, "hexahedron20", 20), (26, "wedge15", 15), (27, "pyramid13", 13), (32, "wedge18", 18)),
        *((42, "polyhedron", 4), (71, r"polyhedron \(VTK type 71\)", 4), (15, r"polyhedron \(VTK type 15\)", 10)),
    ],
)
@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_cells_that_are_not_read_are_named(number: int, name: str, nodes: int, suffix: str, tmp_path: Path) -> None:
    points = 0.1 * np.random.default_rng(0).random((nodes, 3))
    corners = [4, 3, 0, 2, 1, 3, 0, 1, 3, 3, 0, 3, 2, 3, 1, 2, 3] if number == 42 else range(nodes)
    grid = pyvista.UnstructuredGrid(np.array([4, 0, 1, 2, 3, len(corners), *corners]), [10, number], points)
    grid.save(tmp_path / f"cells.{suffix}")
    with pytest.raises(FileError, match=f"got 1 {name}; save the mesh with first-order cells"):
        read_mesh(tmp_path / f"cells.{suffix}")


def test_linear_and_quadratic_cells_are_not_taken_together() -> None:
    with pytest.raises(CellError, match="of one order, got 1 tetra, 1 tetra10"):
        one_kind(np.eye(10, 3), {"tetra": np.arange(4)[None], "tetra10": np.arange(10)[None]})


def test_a_wedge_that_is_turned_in_part_is_refused() -> None:
    points, blocks = mixed(("wedge",))
    blocks["wedge"][3] = blocks["wedge"][3, [0, 1, 2, 3, 5, 4]]
    with pytest.raises(CellError, match="got 1 of 72 that are flat, empty or inside out in part, the first a wedge"):
        one_kind(points, blocks)


def test_a_quadrilateral_that_meets_two_triangles_is_refused() -> None:
    body = beam((1, 1, 2), (0.01, 0.01, 0.02), "hexahedron")
    assert len(body.cells) == 2
    low, high = body.cells
    with pytest.raises(CellError, match="share their faces whole, got 1 quadrilateral that meets triangles"):
        one_kind(body.points, {"hexahedron": low[None], "wedge": np.array([high[wedge] for wedge in WEDGES])})


def test_surface_cells_that_are_not_read_are_named(tmp_path: Path) -> None:
    blocks = [("triangle", np.array([[0, 1, 2]])), ("triangle6", np.arange(6)[None])]
    meshio.Mesh(0.1 * np.random.default_rng(0).random((6, 3)), blocks).write(tmp_path / "cells.vtu")
    with pytest.raises(FileError, match="a surface of triangles, got 6 points and cells: 1 triangle, 1 triangle6"):
        read_surface(tmp_path / "cells.vtu")


@pytest.mark.skipif(not CASES.exists(), reason="the files of other programs are not there (../shared/data/cases)")
@pytest.mark.parametrize(
    ("name", "volume_ml", "nodes", "left_out"),
    [
        ("vtu_wedges_inside/organ.vtu", 175.0, 288, 0),
        ("msh_wedges_inside/organ.msh", 175.0, 288, 0),
        ("vtu_voxel/organ.vtu", 72.0, 819, 0),
        ("msh_orphan/organ.msh", 298.72, 360, 2),
        ("msh_order2/organ.msh", 301.59, 2243, 2),
    ],
)
def test_files_of_other_programs(name: str, volume_ml: float, nodes: int, left_out: int) -> None:
    read = read_mesh(CASES / name, "mm")
    assert isinstance(read, Volume) and len(read.points) == nodes
    # The quadratic body's volume is that of its boundary's linear pieces, 0.2 % less than that of the curved cells.
    assert 1e6 * Body(read.points, read.cells, {}).volume == pytest.approx(volume_ml, rel=3e-3)
    assert [f"nodes: {left_out} of" in line for line in read.said if line.startswith("nodes")] == [True] * bool(
        left_out
    )
