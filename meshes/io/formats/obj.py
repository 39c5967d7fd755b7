"""Wavefront OBJ of any writer: textures, normals and colours beside, n-gons, counting from the end, continued lines.

A reader of our own, since none at hand takes all of that and survives a damaged file: meshio fails on colours, on
negative indices and where textures outnumber vertices; trimesh 5.2 splits concave n-gons into fans that overlap; VTK's
ends the process (segmentation fault) on files with a few bytes changed.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...body import Floats, Ints
from .numbers import numbers
from .polygons import by_length, triangulated

# Statements of the specification (Wavefront, Advanced Visualizer, appendix B1) that are no surface of polygons.
_BESIDE = frozenset(
    {"vt", "vn", "vp", "g", "s", "o", "mg", "mtllib", "usemtl", "maplib", "usemap", "bevel", "c_interp", "d_interp"}
    | {"lod", "shadow_obj", "trace_obj", "l", "p", "call", "csh"}
)
_FREE_FORM = frozenset(
    {"cstype", "deg", "bmat", "step", "curv", "curv2", "surf", "parm", "trim", "hole", "scrv", "sp", "end", "con"}
    | {"ctech", "stech"}
)


def read_obj(path: Path) -> tuple[Floats, Ints]:
    """Points (p, 3) and triangles (t, 3); lines and points of the file are no surface and are left out.

    Args:
        path: the file.

    Raises:
        ValueError: a line that is no statement, a face that names a vertex that is not there, free-form surfaces.
    """
    text = re.sub(r"\\[ \t]*\r?\n", " ", path.read_bytes().decode("utf-8", "replace"))
    places: list[str] = []
    faces: list[Ints] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        tag = words[0].lower()
        if tag == "v":
            if len(words) not in (4, 5, 7, 8):  # with a weight, a colour, or both
                raise ValueError(f"line {number}: expected 3, 4, 6 or 7 numbers of a vertex, got {len(words) - 1}")
            places += words[1:4]
        elif tag in ("f", "fo"):
            faces.append(_corners(words[1:], len(places) // 3, number))
        elif tag in _FREE_FORM:
            raise ValueError(f"line {number}: {tag!r} belongs to a free-form surface; save it as polygons")
        elif tag not in _BESIDE:
            raise ValueError(f"line {number}: {words[0][:40]!r} is no statement of OBJ")
    points = numbers(places).reshape(-1, 3)
    groups = by_length(faces)
    if any(group.max(initial=0) >= len(points) for group in groups):
        raise ValueError(f"a face names vertex {1 + max(int(g.max()) for g in groups)} of {len(points)}")
    return points, np.concatenate([np.empty((0, 3), np.int64), *(triangulated(points, group) for group in groups)])


def _corners(words: list[str], so_far: int, line: int) -> Ints:
    try:
        found = np.array([int(word.partition("/")[0]) for word in words], dtype=np.int64)
    except ValueError:
        raise ValueError(f"line {line}: expected numbers of vertices, got {' '.join(words)[:60]!r}") from None
    if len(found) < 3:
        raise ValueError(f"line {line}: expected three vertices of a face or more, got {len(found)}")
    counted: Ints = np.where(found < 0, found + so_far, found - 1)
    if (found == 0).any() or (counted < 0).any():
        raise ValueError(f"line {line}: no vertex has the number {found[(found == 0) | (counted < 0)][0]}")
    return counted
