"""Gmsh's MSH: version 1 by ourselves, 2 and 4 by meshio."""

from __future__ import annotations

import contextlib
import io
import warnings
from pathlib import Path

import meshio
import numpy as np

from ...body import Floats, Ints
from ...cells import other_cell

_FIRST = {1: "line", 2: "triangle", 3: "quad", 4: "tetra", 5: "hexahedron", 6: "wedge", 7: "pyramid", 8: "line3",
          15: "vertex"}  # fmt: skip
_FIRST_SURFACES = (9, 10, 16)


def is_first_msh(head: bytes) -> bool:
    """Whether a file is of version 1.

    Args:
        head: its first bytes.
    """
    return head.lstrip().startswith(b"$NOD")


def read_first_msh(path: Path) -> tuple[Floats, dict[str, Ints]]:
    """Points (p, 3) and cells by kind of MSH 1.

    Its nodes are lines `number x y z`, its elements `number type region part count nodes...`.

    Args:
        path: the file.

    Raises:
        ValueError: cut off, or damaged.
    """
    try:
        return _first(path.read_text().split())
    except (ValueError, IndexError) as error:
        raise ValueError(f"as MSH 1: {error}; else save it as MSH 2 or 4") from error


def _first(words: list[str]) -> tuple[Floats, dict[str, Ints]]:
    nodes, elements = words.index("$NOD"), words.index("$ELM")
    words.index("$ENDELM")
    count = int(words[nodes + 1])
    table = np.array(words[nodes + 2 : nodes + 2 + 4 * count], dtype=np.float64).reshape(count, 4)
    cells, at = dict[str, list[list[int]]](), elements + 2
    for _ in range(int(words[elements + 1])):
        kind, size = int(words[at + 1]), int(words[at + 4])
        corners = [int(word) for word in words[at + 5 : at + 5 + size]]
        other = other_cell(2 if kind in _FIRST_SURFACES else 3, f"MSH type {kind}")
        cells.setdefault(_FIRST.get(kind, other), []).append(corners)
        at += 5 + size
    numbers = table[:, 0].astype(np.int64)
    order = np.argsort(numbers)
    places = {name: order[np.searchsorted(numbers[order], np.array(block))] for name, block in cells.items()}
    if any(not np.isin(block, numbers).all() for block in map(np.array, cells.values())):
        raise ValueError("an element names a node that is not there")
    return table[:, 1:], places


def read_msh(path: Path) -> tuple[Floats, dict[str, Ints]]:
    """Points (p, 3) and cells by kind of MSH 2 and 4.

    Args:
        path: the file.

    Raises:
        ValueError: cut off, or damaged.
    """
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
        reason = " ".join(f"{said.getvalue()} {type(error).__name__} {error}".split())
        raise ValueError(reason[:200]) from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"expected points with three coordinates, got shape {points.shape}")
    return points, {name: np.concatenate(parts) for name, parts in blocks.items()}
