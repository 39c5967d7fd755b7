"""Clouds in tables and arrays of any program: which columns, which rows, which numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.io import ContentError, FileError, read_cloud, read_points

POINTS = np.array([[0.5, -1.25, 30.0], [2.0, 3.5, -0.125], [7.0, 8.0, 9.5], [1.0, 1.5, 2.0], [4.0, 0.25, 6.0]])
ROWS = [[str(value) for value in row] for row in POINTS.tolist()]


def text(separator: str, head: str = "", behind: tuple[str, ...] = (), before: tuple[str, ...] = ()) -> str:
    return head + "".join(separator.join([*before, *row, *behind]) + "\n" for row in ROWS)


TABLES = {
    "blanks": text(" "),
    "tabs": text("\t"),
    "commas and blanks": text(", "),
    "commas at the end": text(",").replace("\n", ",\n"),
    "semicolons, decimal commas": text(";").replace(".", ","),
    "blanks, decimal commas": text("  ").replace(".", ","),
    "colours behind": text(" ", behind=("200", "100", "50")),
    "a count": text(" ", "5\n"),
    "a comment and a count": text(" ", "// from a scanner\n5\n", ("1", "2", "3", "0.5")),
    "names": text(",", "X,Y,Z\n"),
    "names in a comment": text(" ", "# x y z intensity\n", ("7",)),
    "names of ParaView": text(",", '"Normals:0","Points:0","Points:1","Points:2"\n', before=("1",)),
    "names with units": text(";", "t [s];x [mm];y [mm];z (mm)\n", before=("0",)),
    "names in another order": "z,x,y\n" + "".join(f"{row[2]},{row[0]},{row[1]}\n" for row in ROWS),
    "rows that are counted": "".join(f"{k} {' '.join(row)}\n" for k, row in enumerate(ROWS, 1)),
    "CR LF": text(" ").replace("\n", "\r\n"),
    "a mark of UTF-8": "\ufeff" + text(",", "x,y,z\n"),
    "empty lines": text(" ").replace("\n", "\n\n"),
    "quotes": text(",").replace("0.5", '"0.5"'),
}


@pytest.mark.parametrize("way", TABLES)
def test_a_table_of_any_program(way: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.csv").write_bytes(TABLES[way].encode())
    assert np.array_equal(read_cloud(tmp_path / "cloud.csv", "mm"), POINTS / 1000)


@pytest.mark.parametrize("word", ["nan", "NaN", "-nan(ind)", "1.#QNAN", "", "null", "N/A"])
def test_what_stands_for_no_measurement(word: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.csv").write_text("x,y,z\n" + text(",").replace("-1.25", word))
    cloud = read_points(tmp_path / "cloud.csv", "mm")
    assert np.array_equal(cloud.points, POINTS[1:] / 1000) and "1 of 5 rows" in cloud.said[0]


def test_a_table_in_utf_16(tmp_path: Path) -> None:
    (tmp_path / "cloud.txt").write_text(text("\t", "x\ty\tz\n"), encoding="utf-16")
    assert np.array_equal(read_cloud(tmp_path / "cloud.txt", "mm"), POINTS / 1000)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (text(" ", "6\n"), "expected the 6 rows that it names, got 5"),
        (text(" ").replace("9.5", "9.5 1"), "line 3: expected 3 columns as in the lines before"),
        (text(" ").replace("9.5", "9.x"), "line 3: '9.x' is no number"),
        (text(",", "a,b,c,d\n", ("1",)), "expected columns named x, y and z among a, b, c, d"),
        (text(",", "x,y\n"), r"expected 2 columns \(x, y\), got 3"),
        ("1,5,2,5,3,5\n4,5,5,5,6,5\n", "are they decimal commas"),
        ("1 2\n3 4\n", r"expected a cloud of shape \(p, 3\), got \(2, 2\)"),
        ("\0\1\2", "it is no text"),
    ],
)
def test_a_table_that_is_not_one_is_refused(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.txt").write_text(content)
    with pytest.raises(FileError, match=said):
        read_cloud(tmp_path / "cloud.txt", "mm")


@pytest.mark.parametrize("shape", [(5, 3), (5, 1, 3), (1, 5, 3)])
@pytest.mark.parametrize("dtype", ["<f8", ">f4", "f2"])
def test_arrays_of_points_and_images_of_points(shape: tuple[int, ...], dtype: str, tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", POINTS.astype(dtype).reshape(shape))
    assert np.array_equal(read_cloud(tmp_path / "cloud.npy", "mm"), POINTS / 1000)


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.ones((48, 64)), "is it a depth image"),
        (np.ones(12), r"got \(12,\)"),
        (np.ones((4, 2)), r"got \(4, 2\)"),
        (np.array([["a", "b", "c"]]), "expected numbers"),
        (np.ones((3, 3), dtype=complex), "expected numbers"),
        (np.zeros(3, dtype=[("x", "f4"), ("y", "f4")]), "expected fields x, y, z, got x, y"),
    ],
)
def test_arrays_of_something_else_are_refused(array: np.ndarray, said: str, tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", array)
    with pytest.raises(FileError, match=said):
        read_cloud(tmp_path / "cloud.npy", "mm")


def test_coordinates_that_no_organ_has_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", np.array([[0.1, 0.2, 1e300], [0.1, 0.2, 0.3]]))
    with pytest.raises(ContentError, match=r"expected coordinates of an organ, got 1e\+300"):
        read_cloud(tmp_path / "cloud.npy", "mm")


def test_normals_are_found_behind_colours_and_colours_are_none(tmp_path: Path) -> None:
    normals = np.tile([0.0, 0.6, -0.8], (5, 1))
    np.savetxt(tmp_path / "cloud.txt", np.hstack([POINTS, np.full((5, 3), 200.0), normals]))
    assert np.array_equal(read_cloud(tmp_path / "cloud.txt", "mm", normals=True), np.hstack([POINTS / 1000, normals]))
    np.savetxt(tmp_path / "cloud.txt", np.hstack([POINTS, np.full((5, 3), 200.0)]))
    with pytest.raises(FileError, match="expected a normal for each point, got none"):
        read_cloud(tmp_path / "cloud.txt", "mm", normals=True)
    head = "nx,ny,nz,x,y,z\n"
    rows = "".join(",".join(map(str, [*n, *p])) + "\n" for n, p in zip(normals.tolist(), POINTS.tolist(), strict=True))
    (tmp_path / "cloud.csv").write_text(head + rows)
    assert np.array_equal(read_cloud(tmp_path / "cloud.csv", "mm", normals=True), np.hstack([POINTS / 1000, normals]))
