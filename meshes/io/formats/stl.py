"""STL of any writer, text or binary: upper case, any header, bytes behind the end, decimal commas.

A reader of our own, since each at hand is wrong on some: trimesh 5.2 gives no triangle, and says nothing, where bytes
stand behind the last one; VTK's wants lower case; meshio's no blanks behind the end; none takes decimal commas.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...body import Floats, Ints
from .numbers import numbers

_HEADER, _FACET = 84, 50  # bytes
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(path: Path) -> tuple[Floats, Ints]:
    """Points (3 t, 3), each triangle with its own, and triangles (t, 3).

    Args:
        path: the file.

    Raises:
        ValueError: no STL, or cut off.
    """
    content = path.read_bytes()
    corners = _text_corners(content) if _is_text(content) else _binary_corners(content)
    return corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3)


def _is_text(content: bytes) -> bool:
    """What a file is cannot be told by its first word: binary files begin with `solid`, too."""
    if len(content) >= _HEADER and len(content) == _HEADER + _FACET * int.from_bytes(content[80:84], "little"):
        return False
    return content[:_HEADER].lstrip()[:5].lower() == b"solid" and b"\0" not in content


def _text_corners(content: bytes) -> Floats:
    body = content.lower()
    if not re.search(rb"\bendsolid\b", body[body.rfind(b"endfacet") + 1 :]):
        raise ValueError("the STL is truncated: expected 'endsolid' at its end")
    found = _VERTEX.findall(content)
    counts = {word: len(re.findall(rb"\b%s\b" % word, body)) for word in (b"endloop", b"endfacet")}
    for word, count in counts.items():
        if len(found) != 3 * count:
            raise ValueError(
                f"expected three vertices before each of {count} {word.decode()!r}, got {len(found)} vertices"
            )
    return numbers([word for vertex in found for word in vertex]).reshape(-1, 3)


def _binary_corners(content: bytes) -> Floats:
    if len(content) < _HEADER:
        raise ValueError(f"the STL is truncated or none: expected {_HEADER} bytes of a header, got {len(content)}")
    count, whole = int.from_bytes(content[80:84], "little"), (len(content) - _HEADER) // _FACET
    if count == 0 and len(content) == _HEADER + _FACET * whole:
        count = whole  # of programs that write while they do not know how many there will be
    if count > whole:
        raise ValueError(f"the STL is truncated or none: expected {_HEADER + _FACET * count} bytes for the {count} "
                         f"triangles that it names, got {len(content)}")  # fmt: skip
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    table = np.frombuffer(content, facet, count, _HEADER)
    return table["corners"].reshape(-1, 3).astype(np.float64)
