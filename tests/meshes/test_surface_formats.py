"""OBJ, STL and polygons as other programs write them, and what is no such file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.body import Surface
from softtwin.meshes.checks import put_in_order
from softtwin.meshes.io import FileError, read_surface
from softtwin.meshes.io.formats.polygons import stripped, triangulated

CUBE = np.array([(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)])
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
OUTLINE = [(2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0)]  # an L, from a corner whose fan leaves it
PRISM = np.array([(0.1 * x, 0.1 * y, z) for z in (0, 0.1) for x, y in OUTLINE])
PRISM_FACES = [(5, 4, 3, 2, 1, 0), tuple(range(6, 12)), *((i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6))]


def obj(points: np.ndarray, faces: list[tuple[int, ...]], corner: str = "{0}", behind: str = "") -> str:
    lines = [f"v {x} {y} {z}{behind}" for x, y, z in points.tolist()]
    return "\n".join([*lines, *("f " + " ".join(corner.format(i + 1, i - len(points)) for i in f) for f in faces), ""])


def solid(path: Path, volume: float, area: float) -> Surface:
    surface, defects = put_in_order(read_surface(path))
    assert surface.volume == pytest.approx(volume, rel=1e-9) and surface.area == pytest.approx(area, rel=1e-9)
    assert (defects.open_edges, defects.crowded_edges, defects.clashing_edges) == (0, 0, 0)
    return surface


WAYS = {
    "plain": obj(CUBE, QUADS),
    "normals": "vn 0 0 1\n" + obj(CUBE, QUADS, "{0}//1"),
    "more textures than vertices": "vt 0 0\n" * 99 + obj(CUBE, QUADS, "{0}/99/"),
    "from the end": obj(CUBE, QUADS, "{1}"),
    "colours": obj(CUBE, QUADS, behind=" 0.5 0.25 1"),
    "weight and colours": obj(CUBE, QUADS, behind=" 1.0 0.5 0.25 1"),
    "continued lines": obj(CUBE, QUADS, "\\\n{0}"),
    "groups, lines, points": "o a\nmtllib a.mtl\ng b\ns off\n" + obj(CUBE, QUADS) + "usemtl c\nl 1 2\np 3\n",
    "CR LF": obj(CUBE, QUADS).replace("\n", "\r\n"),
    "decimal commas": obj(CUBE, QUADS).replace(".", ","),
    "comments": "# a\n" + obj(CUBE, QUADS).replace("\nf", " # b\nf"),
}


@pytest.mark.parametrize("way", WAYS)
def test_an_obj_of_any_writer(way: str, tmp_path: Path) -> None:
    (tmp_path / "cube.OBJ").write_text(WAYS[way], newline="")
    solid(tmp_path / "cube.OBJ", 1e-3, 0.06)


def test_concave_polygons_cover_what_they_enclose_in_any_format(tmp_path: Path) -> None:
    (tmp_path / "l.obj").write_text(obj(PRISM, PRISM_FACES))
    faces = "\n".join(f"{len(face)} {' '.join(map(str, face))}" for face in PRISM_FACES)
    head = f"ply\nformat ascii 1.0\nelement vertex 12\nproperty double x\nproperty double y\nproperty double z\n" \
        f"element face {len(PRISM_FACES)}\nproperty list uchar int vertex_index\nend_header\n"  # fmt: skip
    (tmp_path / "l.ply").write_text(
        head + "\n".join(" ".join(map(str, p)) for p in PRISM.tolist()) + "\n" + faces + "\n"
    )
    points = "\n".join(" ".join(map(str, point)) for point in PRISM.tolist())
    size = sum(len(face) + 1 for face in PRISM_FACES)
    head = f"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 12 double\n{points}\n"
    (tmp_path / "l.vtk").write_text(f"{head}POLYGONS {len(PRISM_FACES)} {size}\n{faces}\n")
    for name in ("l.obj", "l.ply", "l.vtk"):
        solid(tmp_path / name, 3e-3, 0.14)


def test_a_concave_quadrilateral_and_a_strip() -> None:
    dart = np.array([[0.0, 0, 0], [2, 1, 0], [0, 2, 0], [0.5, 1, 0]])
    for first in range(4):
        triangles = triangulated(dart, np.roll(np.arange(4), -first)[None])
        a, b, c = (dart[triangles[:, i]] for i in range(3))
        assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert stripped([np.arange(5), np.arange(2)]).tolist() == [[0, 1, 2], [3, 2, 1], [2, 3, 4]]
    crossing = triangulated(np.array([[0.0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0]]), np.arange(4)[None])
    assert len(crossing) == 2  # no triangle is lost, whatever the polygon is


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "a face names vertex 4 of 3"),
        ("v 0 0 0\nf 0 1 1\n", "line 2: no vertex has the number 0"),
        ("v 0 0 0\nf -1 -2 -1\n", "line 2: no vertex has the number -2"),
        ("v 0 0\n", "line 1: expected 3, 4, 6 or 7 numbers of a vertex, got 2"),
        ("v 0 0 x\nv 0 0 1\nv 0 1 1\nf 1 2 3\n", "'x' is no number"),
        ("v 0 0 0\nf 1 1\n", "line 2: expected three vertices of a face or more, got 2"),
        ("cstype bezier\n", "line 1: 'cstype' belongs to a free-form surface"),
        ("v 0 0 0\nvx 1\n", "line 2: 'vx' is no statement of OBJ"),
    ],
)
def test_an_obj_that_is_none_is_refused_with_the_line(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(FileError, match="could not be read as obj") as error:
        read_surface(tmp_path / "a.obj")
    assert said in str(error.value)


def text_stl() -> str:
    triangles = triangulated(CUBE, np.array(QUADS))
    facets = ["facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in CUBE[t].tolist())
              + "endloop\nendfacet\n" for t in triangles]  # fmt: skip
    return "solid a\n" + "".join(facets) + "endsolid a\n"


def binary_stl(head: bytes = b"made by hand", count: int | None = None) -> bytes:
    triangles = triangulated(CUBE, np.array(QUADS))
    facets = [np.zeros(3, "<f4").tobytes() + CUBE[t].astype("<f4").tobytes() + b"\0\0" for t in triangles]
    return head.ljust(80, b" ") + (len(facets) if count is None else count).to_bytes(4, "little") + b"".join(facets)


STL = {
    "text": text_stl().encode(),
    "upper case": text_stl().upper().encode(),
    "blanks and lines behind": text_stl().encode() + b"\n\n" + b" " * 3000,
    "no name behind endsolid": text_stl().replace("endsolid a", "endsolid").encode(),
    "decimal commas": text_stl().replace(".", ",").encode(),
    "blanks before": b"\n  " + text_stl().encode(),
    "two solids": text_stl().replace("facet normal", "FACET normal", 1).encode().replace(
        b"endfacet\n", b"endfacet\nendsolid a\nsolid b\n", 1),
    "binary": binary_stl(),
    "binary that begins like text": binary_stl(b"solid cube facet normal"),
    "bytes behind": binary_stl() + bytes(50),
    "a count of 0": binary_stl(count=0),
}  # fmt: skip


@pytest.mark.parametrize("way", STL)
def test_an_stl_of_any_writer(way: str, tmp_path: Path) -> None:
    (tmp_path / "cube.stl").write_bytes(STL[way])
    surface = put_in_order(read_surface(tmp_path / "cube.stl"))[0]
    assert surface.volume == pytest.approx(1e-3, rel=1e-6) and len(surface.triangles) == 12


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (binary_stl()[:-1], "the STL is truncated or none: expected 684 bytes for the 12 triangles"),
        (binary_stl(count=13), "expected 734 bytes for the 13 triangles"),
        (b"x" * 50, "expected 84 bytes of a header"),
        (text_stl().replace("endsolid a", "").encode(), "expected 'endsolid' at its end"),
        (text_stl().replace("vertex", "vertx", 1).encode(), "expected three vertices before each of 12"),
        (text_stl().replace("endloop", "", 1).encode(), "expected three vertices before each of 11 'endloop'"),
        (text_stl().replace("0.1", "0.1.1", 1).encode(), "'0.1.1' is no number"),
    ],
)
def test_an_stl_that_lost_something_is_refused(content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(content)
    with pytest.raises(FileError) as error:
        read_surface(tmp_path / "a.stl")
    assert said in str(error.value)


def test_a_ply_whose_faces_have_another_name_is_refused(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "a.ply").write_text(head + "element face 1\nproperty list uchar int corners\nend_header\n"
                                    "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")  # fmt: skip
    with pytest.raises(FileError, match="expected faces with vertex_indices, got corners"):
        read_surface(tmp_path / "a.ply")
