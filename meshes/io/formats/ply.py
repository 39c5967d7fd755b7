"""PLY files of any flavour: text or binary of either byte order, any properties, polygons and triangle strips."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...body import Floats, Ints
from .numbers import numbers
from .polygons import by_length, stripped, triangulated

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    **{"int64": "i8", "uint64": "u8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Property:
    name: str
    value: str  # numpy's letter and size
    count: str = ""  # of a list: the type of its length


@dataclass(frozen=True)
class _Element:
    name: str
    rows: int
    properties: tuple[_Property, ...]


Column = NDArray[np.generic] | list[NDArray[np.generic]]  # of a list whose lengths differ: one array a row


def read_ply(path: Path) -> tuple[Floats, Ints]:
    """Points (p, 3) and triangles (t, 3), none for a cloud; polygons and strips are split.

    Args:
        path: the file.

    Raises:
        ValueError: no PLY, cut off, or without coordinates.
    """
    columns = _columns(path)
    vertices = columns.get("vertex", {})
    if not {"x", "y", "z"} <= set(vertices):
        raise ValueError("expected vertices with x, y and z")
    points = np.column_stack([np.asarray(vertices[axis], dtype=np.float64) for axis in "xyz"])
    return points, _triangles(points, columns)


def read_ply_normals(path: Path) -> Floats | None:
    """The normals of a file's points, (p, 3); None where it has none.

    Args:
        path: the file.

    Raises:
        ValueError: no PLY, or cut off.
    """
    vertices = _columns(path).get("vertex", {})
    if not {"nx", "ny", "nz"} <= set(vertices):
        return None
    return np.column_stack([np.asarray(vertices[f"n{axis}"], dtype=np.float64) for axis in "xyz"])


def _columns(path: Path) -> dict[str, dict[str, Column]]:
    """All properties of all elements, by their names."""
    content = path.read_bytes()
    end = re.search(rb"\nend_header\s*?\n", content)
    if not content.startswith(b"ply") or end is None:
        raise ValueError("expected a header from 'ply' to 'end_header'")
    order, elements = _header(content[: end.start()].decode("latin-1").replace("\r", "\n").split("\n"))
    body = content[end.end() :]
    return _text_columns(body, elements) if not order else _binary_columns(body, elements, order)


def _header(lines: list[str]) -> tuple[str, list[_Element]]:
    order, elements = None, list[_Element]()
    for words in (line.split() for line in lines):
        match words:
            case ["format", form, *_]:
                order = _ORDERS[form]
            case ["element", name, rows]:
                elements.append(_Element(name, int(rows), ()))
            case ["property", "list", count, value, name]:
                elements[-1] = _with(elements[-1], _Property(name, _TYPES[value], _TYPES[count]))
            case ["property", value, name]:
                elements[-1] = _with(elements[-1], _Property(name, _TYPES[value]))
    if order is None:
        raise ValueError("expected a line that says the format")
    return order, elements


def _with(element: _Element, one: _Property) -> _Element:
    return _Element(element.name, element.rows, (*element.properties, one))


def _text_columns(body: bytes, elements: list[_Element]) -> dict[str, dict[str, Column]]:
    words, at, found = numbers(body.split()), 0, dict[str, dict[str, Column]]()
    for element in elements:
        rows: dict[str, list[NDArray[np.generic]]] = {one.name: [] for one in element.properties}
        if not any(one.count for one in element.properties):
            width = len(element.properties)
            table = words[at : at + width * element.rows].reshape(-1, width)
            at += width * element.rows
            found[element.name] = {one.name: table[:, i] for i, one in enumerate(element.properties)}
            _check_rows(element, len(table))
            continue
        for row in range(element.rows):
            for one in element.properties:
                if at >= len(words):
                    _check_rows(element, row)
                length = int(words[at]) if one.count else 1
                at += bool(one.count)
                rows[one.name].append(words[at : at + length])
                at += length
        if at > len(words):
            _check_rows(element, element.rows - 1)
        found[element.name] = dict(rows)
    return found


def _binary_columns(body: bytes, elements: list[_Element], order: str) -> dict[str, dict[str, Column]]:
    at, found = 0, dict[str, dict[str, Column]]()
    for element in elements:
        rows = _equal_rows(body, at, element, order)
        if rows is None:
            at, found[element.name] = _unequal_rows(body, at, element, order)
        else:
            at += rows.nbytes
            found[element.name] = {one.name: rows[one.name] for one in element.properties}
    return found


def _equal_rows(body: bytes, at: int, element: _Element, order: str) -> NDArray[np.void] | None:
    """The rows as one table, if their lists are as long as those of the first row; else None."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int, ...]]] = []
    place = at
    for one in element.properties:
        if one.count and element.rows:
            count = np.dtype(order + one.count)
            if place + count.itemsize > len(body):
                _check_rows(element, 0)
            length = int(np.frombuffer(body, count, 1, place)[0])
            fields += [(f"length of {one.name}", order + one.count), (one.name, order + one.value, (length,))]
            place += count.itemsize + length * np.dtype(one.value).itemsize
        else:
            fields.append((one.name, order + one.value))
            place += np.dtype(one.value).itemsize
    kind = np.dtype(fields)
    whole = (len(body) - at) // kind.itemsize if kind.itemsize else 0
    rows: NDArray[np.void] = np.frombuffer(body, kind, min(element.rows, whole), at)
    lists = [one.name for one in element.properties if one.count and element.rows]
    if not lists:
        _check_rows(element, len(rows))
    whole_rows = len(rows) == element.rows
    alike = all((rows[f"length of {name}"] == rows.dtype[name].shape[0]).all() for name in lists)
    return rows if whole_rows and alike else None


def _unequal_rows(body: bytes, at: int, element: _Element, order: str) -> tuple[int, dict[str, Column]]:
    columns: dict[str, list[NDArray[np.generic]]] = {one.name: [] for one in element.properties}
    for row in range(element.rows):
        for one in element.properties:
            length = 1
            if one.count:
                count = np.dtype(order + one.count)
                if at + count.itemsize > len(body):
                    _check_rows(element, row)
                length = int(np.frombuffer(body, count, 1, at)[0])
                at += count.itemsize
            value = np.dtype(order + one.value)
            if at + length * value.itemsize > len(body):
                _check_rows(element, row)
            columns[one.name].append(np.frombuffer(body, value, length, at))
            at += length * value.itemsize
    return at, dict(columns)


def _check_rows(element: _Element, came: int) -> None:
    if came < element.rows:
        raise ValueError(f"the file is truncated: expected {element.rows} rows of {element.name}, got {came}")


def _triangles(points: Floats, columns: dict[str, dict[str, Column]]) -> Ints:
    faces = columns.get("face", {})
    named = [name for name in ("vertex_indices", "vertex_index") if name in faces]
    if not named and any(len(column) for column in faces.values()):
        raise ValueError(f"expected faces with vertex_indices, got {', '.join(faces)}")
    polygons: Column = faces[named[0]] if named else []
    parts = [triangulated(points, _numbers(polygon, len(points))) for polygon in _by_length(polygons)]
    for strip in columns.get("tristrips", {}).get("vertex_indices", []):
        parts.append(stripped(_numbers(run, len(points)) for run in _runs(np.asarray(strip, dtype=np.int64))))
    return np.concatenate([np.empty((0, 3), dtype=np.int64), *parts])


def _numbers(corners: NDArray[np.generic], count: int) -> Ints:
    whole = corners.astype(np.int64)
    if whole.min(initial=0) < 0 or whole.max(initial=0) >= count or not np.array_equal(whole, corners):
        raise ValueError(f"a face names a vertex that is not among the {count}")
    return whole


def _by_length(polygons: Column) -> list[NDArray[np.generic]]:
    """Polygons of one length together, (m, k) each."""
    if isinstance(polygons, np.ndarray):
        return [polygons] if len(polygons) else []  # a cloud may have an element `face` without rows
    return list(by_length(polygons))  # type: ignore[arg-type]


def _runs(strip: Ints) -> list[Ints]:
    return [run[run >= 0] for run in np.split(strip, np.flatnonzero(strip < 0))]
