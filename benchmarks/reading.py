"""What softtwin makes of a file: the same content, another one, or a refusal."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from written import CORNER, LANDMARKS, VOXEL, cloud, labels, pose, surface, volume
from written import _place as placed_voxels

from softtwin.meshes.checks import SurfaceError, put_in_order
from softtwin.meshes.io import FileError, Volume, is_labelmap, read_mesh, read_points, stated_unit
from softtwin.meshes.io.labels import read_labelmap
from softtwin.meshes.metrics import cell_volumes
from softtwin.registration.pose import read_landmarks, read_matrix

_CLOSE = 2e-6  # metres between places: single precision of coordinates of 300 mm


@dataclass(frozen=True)
class Read:
    """What came of a file.

    Args:
        content: numbers that say what it holds, by name; empty where it was refused.
        said: why it was refused, or what was said of it.
        is_refused: whether it was.
    """

    content: dict[str, Any]
    said: str = ""
    is_refused: bool = False


def read(content: str, path: Path) -> Read:
    """The content of a file, read as softtwin's commands read it, in millimetres where the file states no unit.

    Args:
        content: surface, volume, cloud, labels, landmarks or transform.
        path: the file.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found, said = _READERS[content](path)
        except (FileError, SurfaceError) as error:
            return Read({}, str(error), True)
    return Read(found, "; ".join([*said, *(str(one.message) for one in caught)]))


def _mesh(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    found = read_mesh(path, stated_unit(path) or "mm")
    if isinstance(found, Volume):
        corners = found.cells[:, : 4 if found.cells.shape[1] in (4, 10) else 8]
        size = float(cell_volumes(found.points, corners).sum())
        return {"kind": "volume", "points": found.points, "cells": len(found.cells), "volume": size}, found.said
    ordered, defects = put_in_order(found)
    said = (f"{defects.holes} holes closed",) if defects.open_edges else ()
    if defects.crowded_edges or defects.clashing_edges or defects.degenerate_triangles or defects.pieces > 1:
        said += ("defects",)
    return {"kind": "surface", "points": found.points, "cells": len(found.triangles), "volume": ordered.volume}, said


def _cloud(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    found = read_points(path, stated_unit(path) or "mm")
    return {"kind": "cloud", "points": found.points}, found.said


def _label(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    if not is_labelmap(path):
        raise FileError(f"{path}: expected a segmentation, got suffix {path.suffix!r}.")
    found = read_labelmap(path)
    return {"kind": "labels", "labels": found.labels[0], "place": found.to_lps}, found.notes


def _named(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    return {"kind": "landmarks", "points": read_landmarks(path, "mm", "lps")}, ()


def _motion(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    return {"kind": "transform", "matrix": read_matrix(path, "mm").matrix}, ()


_READERS = {
    "surface": _mesh,
    "volume": _mesh,
    "cloud": _cloud,
    "labels": _label,
    "landmarks": _named,
    "transform": _motion,
}


def difference(content: str, options: str, found: dict[str, Any]) -> str:
    """How what was read differs from what was written; empty where it does not.

    Args:
        content: of the writer.
        options: of the writer.
        found: what was read.
    """
    if found["kind"] != content:
        return f"read as {found['kind']}"
    if content == "surface":
        whole = [
            _not(np.isclose(found["volume"], 1e-9 * abs(surface().volume), rtol=1e-5), "volume"),
            _not(found["cells"] == len(surface().triangles), "triangles"),
            _same(found["points"], surface().points),
        ]
        return next(filter(None, whole), "")
    if content == "volume":
        points, cells = volume(options.split(",")[0])
        whole = [
            _not(np.isclose(found["volume"], 1e-9 * 80 * 60 * 40, rtol=1e-6), "volume"),
            _not(found["cells"] == len(cells), "cells"),
            _same(found["points"], points),
        ]
        return next(filter(None, whole), "")
    if content == "cloud":
        return _same(found["points"], cloud())
    if content == "landmarks":
        held = found["points"]
        places = [np.allclose(held[name], 1e-3 * np.array(place), atol=1e-7) for name, place in LANDMARKS.items()]
        return _not(set(held) == set(LANDMARKS), "names") or _not(all(places), "places")
    if content == "transform":
        wanted = pose()
        wanted[:3, 3] *= 1e-3
        return _not(np.allclose(found["matrix"], wanted, atol=1e-9), "matrix")
    place = placed_voxels(ras=False)
    if "straight axes" in options:
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = np.diag(VOXEL), CORNER
    place[:3] *= 1e-3
    return _not(np.array_equal(found["labels"], labels()), "labels") or _not(
        np.allclose(found["place"], place, atol=_CLOSE), "place")  # fmt: skip


def _same(found: np.ndarray, wanted: np.ndarray) -> str:
    if found.shape != wanted.shape:
        return f"{len(found)} points for {len(wanted)}"
    away = [cKDTree(x).query(y)[0].max() for x, y in ((found, 1e-3 * wanted), (1e-3 * wanted, found))]
    return _not(max(away) < _CLOSE, "places")


def _not(holds: Any, name: str) -> str:
    return "" if holds else name
