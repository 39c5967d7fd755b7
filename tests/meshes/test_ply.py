"""PLY files as other programs write them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.io.formats.ply import read_ply

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.25]])
TRIANGLES = [[0, 1, 2], [0, 2, 3], [0, 1, 4]]
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def write(path: Path, form: str, vertex: str, faces: str, rows: list[bytes | str]) -> Path:
    header = f"ply\nformat {form} 1.0\ncomment by hand\nobj_info none\nelement vertex 5\n{vertex}{faces}end_header\n"
    path.write_bytes(header.encode() + b"".join(row if isinstance(row, bytes) else row.encode() for row in rows))
    return path


XYZ = "property {0} x\nproperty {0} y\nproperty {0} z\n"


@pytest.mark.parametrize("form", ["ascii", *ORDERS])
@pytest.mark.parametrize("number", ["float", "double", "float64", "short"])
@pytest.mark.parametrize("name", ["vertex_index", "vertex_indices"])
def test_names_numbers_and_byte_orders(form: str, number: str, name: str, tmp_path: Path) -> None:
    scale = 4 if number == "short" else 1  # whole numbers
    letter = {"float": "f", "double": "d", "float64": "d", "short": "h"}[number]
    faces = f"element face 3\nproperty uchar colour\nproperty list uchar int {name}\nproperty float quality\n"
    if form == "ascii":
        rows = [" ".join(f"{x:g}" for x in point) + " 7\n" for point in scale * POINTS]
        rows += [f"9 3 {a} {b} {c} 0.5\n" for a, b, c in TRIANGLES]
    else:
        values = (scale * POINTS).astype(int) if letter == "h" else POINTS
        rows = [struct.pack(f"{ORDERS[form]}3{letter}B", *point, 7) for point in values.tolist()]  # type: ignore[misc]
        rows += [struct.pack(f"{ORDERS[form]}BB3if", 9, 3, *corners, 0.5) for corners in TRIANGLES]  # type: ignore[misc]
    path = write(tmp_path / "a.ply", form, XYZ.format(number) + "property uchar red\n", faces, rows)  # type: ignore[arg-type]
    points, triangles = read_ply(path)
    assert np.array_equal(points, scale * POINTS) and triangles.tolist() == TRIANGLES
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(ValueError, match="truncated: expected 3 rows of face, got 2"):
        read_ply(path)


@pytest.mark.parametrize("form", ["ascii", *ORDERS])
def test_polygons_of_several_sizes_and_lists_beside_them(form: str, tmp_path: Path) -> None:
    faces = "element face 2\nproperty list uint8 int32 vertex_indices\nproperty list uchar float texcoord\n"
    polygons = [[0, 1, 2, 3], [0, 1, 4]]
    if form == "ascii":
        rows: list[bytes | str] = [" ".join(map(str, point)) + "\n" for point in POINTS.tolist()]
        rows += [f"{len(p)} {' '.join(map(str, p))} 2 0.5 0.5\n" for p in polygons]
    else:
        rows = [struct.pack(f"{ORDERS[form]}3f", *point) for point in POINTS.tolist()]
        rows += [struct.pack(f"{ORDERS[form]}B{len(p)}iB2f", len(p), *p, 2, 0.5, 0.5) for p in polygons]
    points, triangles = read_ply(write(tmp_path / "a.ply", form, XYZ.format("float32"), faces, rows))
    assert np.array_equal(points, POINTS)
    assert sorted(triangles.tolist()) == sorted([[0, 1, 2], [0, 2, 3], [0, 1, 4]])


def test_strips_faces_before_vertices_and_other_line_ends(tmp_path: Path) -> None:
    text = (
        "ply\r\nformat ascii 1.0\r\nelement tristrips 1\r\nproperty list int int vertex_indices\r\n"
        "element vertex 5\r\nproperty float x\r\nproperty float y\r\nproperty float z\r\nend_header\r\n"
        "8 0 1 2 3 -1 0 1 4\r\n" + "".join(f"{x} {y} {z}\r\n" for x, y, z in POINTS.tolist())
    )
    (tmp_path / "a.ply").write_bytes(text.encode())
    points, triangles = read_ply(tmp_path / "a.ply")
    assert np.array_equal(points, POINTS) and triangles.tolist() == [[0, 1, 2], [3, 2, 1], [0, 1, 4]]


def test_a_cloud_has_no_triangles_and_needs_coordinates(tmp_path: Path) -> None:
    rows = [struct.pack("<3f", *point) for point in POINTS.tolist()]
    points, triangles = read_ply(write(tmp_path / "a.ply", "binary_little_endian", XYZ.format("float"), "", rows))  # type: ignore[arg-type]
    assert np.array_equal(points, POINTS) and triangles.shape == (0, 3)
    with pytest.raises(ValueError, match="expected vertices with x, y and z"):
        read_ply(write(tmp_path / "b.ply", "ascii", "property float x\n", "", ["1\n"] * 5))
