"""The inner structures of a registered frame as points that 3D Slicer marks, each with its uncertainty margin."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Surface
from softtwin.meshes.embedding import Embedding
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import Axes, FileError, discard
from softtwin.registration.result import Registration
from softtwin.registration.verdict import Verdict

from .twin import Twin

Floats = NDArray[np.float64]
MARGIN = "uncertainty margin"
_CONFIDENCE = 0.95
_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
_UPRIGHT = {"lps": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0], "ras": np.eye(3).ravel().tolist()}
_NOTICE = "Research software: not a medical device."


@dataclass(frozen=True)
class Target:
    """A point of an inner structure after a registration.

    Args:
        label: its name; no two are alike.
        position: (3,), metres, in the coordinates of the body at rest.
        margin: distance within which it lies with 95 % in these coordinates, metres; of a centre, the largest on its
            structure, of the part inside the organ.
        remark: of what, and what else there is to say.
    """

    label: str
    position: Floats
    margin: float
    remark: str

    @property
    def description(self) -> str:
        """The margin in words."""
        said = f"{1e3 * self.margin:.1f} mm (95 %)" if math.isfinite(self.margin) else "unknown"
        return f"{MARGIN} {said}, {self.remark}"


def targets_of(twin: Twin, result: Registration, surface_points: int = 0) -> list[Target]:
    """The centre of each inner structure, and points spread over its surface, as a registration has found them.

    Each says so where the frame is not accepted, and where a part of the structure lies outside the organ: of that
    nothing is known, and no point stands for it.

    Args:
        twin: the twin.
        result: what was found.
        surface_points: of each structure, beside its centre.
    """
    return [
        target
        for name, surface in twin.body.inner.items()
        for target in _points_of(twin, name, surface, result, surface_points)
    ]


def _points_of(twin: Twin, name: str, rest: Surface, result: Registration, count: int) -> Iterator[Target]:
    carried, outside = twin.embeddings[name], twin.outside[name]
    known, moved = result.uncertainty, rest.points + carried.displace(result.displacement)
    margins = known.margin(carried, _CONFIDENCE)
    inside = Surface(rest.points, rest.triangles[~outside[rest.triangles].any(axis=1)])
    tracked = inside if len(inside.triangles) else rest
    weights = _shares(tracked)
    own = float(known.margin(_mean(carried, weights), _CONFIDENCE)[0])
    verdict, doubts = result.judgement.verdict, result.judgement.reasons
    warning = "" if verdict is Verdict.ACCEPTED else f"; FRAME {verdict.value.upper()}: {'; '.join(doubts)}"
    alone = f"; {1e3 * own:.1f} mm for its centre alone" if math.isfinite(own) else ""
    alone += _of_camera(twin, name, result)
    if outside.any():
        alone += (
            f"; {100 * outside.mean():.0f} % of it lies outside the organ and is carried along: NOT KNOWN, left out"
        )
    largest = twin.margin_inside(name, margins)
    yield Target(name, weights @ moved, largest, f"for each point of {name}{alone}{warning}")
    for number, vertex in enumerate(_spread(rest, ~outside, count), 1):
        yield Target(f"{name} {number}", moved[vertex], float(margins[vertex]), f"for this point of {name}{warning}")


def _of_camera(twin: Twin, name: str, result: Registration) -> str:
    """What is known of a structure where the camera sees it, in words; none where its coordinates are no others."""
    if not result.has_free_pose:
        return ""
    margins = result.camera_uncertainty.margin(twin.embeddings[name], _CONFIDENCE)
    margin = twin.margin_inside(name, margins)
    return f"; {1e3 * margin:.1f} mm in the camera's coordinates" if math.isfinite(margin) else ""


def _shares(surface: Surface) -> Floats:
    """Share of each vertex in the surface's area, (v,): with these its centre is the mean over the surface."""
    a, b, c = (surface.points[surface.triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    shares = np.bincount(surface.triangles.ravel(), np.repeat(areas, 3), len(surface.points))
    return shares / shares.sum()


def _mean(points: Embedding, weights: Floats) -> Embedding:
    """The weighted mean of points as one point that the body carries."""
    row = np.asarray(points.matrix.T @ weights)
    nodes = np.flatnonzero(row)
    return Embedding(points.cells[:1], nodes[None], row[nodes][None], np.zeros(1), points.node_count)


def _spread(surface: Surface, allowed: NDArray[np.bool_], count: int) -> list[int]:
    """Vertices in use that may be taken, each the farthest from those before it."""
    used = np.unique(surface.triangles)
    used = used[allowed[used]]
    chosen, far = list[int](), np.full(len(used), np.inf)
    for _ in range(min(count, len(used))):
        chosen.append(int(np.argmax(far)))
        far = np.minimum(far, np.linalg.norm(surface.points[used] - surface.points[used[chosen[-1]]], axis=1))
    return [int(used[i]) for i in chosen]


def write_targets(path: Path, targets: list[Target], axes: Axes) -> None:
    """Write points as 3D Slicer's markups, in millimetres; the file appears whole or not at all.

    Args:
        path: file to write, `.mrk.json`.
        targets: at least one.
        axes: that they are written on.

    Raises:
        FileError: the file could not be written.
    """
    place = Coordinates("mm", axes)
    points = [
        {
            "id": str(number),
            "label": target.label,
            "description": target.description,
            "associatedNodeID": "",
            "position": place.lengths(target.position).tolist(),
            "orientation": _UPRIGHT[axes],
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for number, target in enumerate(targets, 1)
    ]
    markup = {
        "type": "Fiducial",
        "name": path.name.removesuffix(".mrk.json"),
        "coordinateSystem": axes.upper(),
        "coordinateUnits": "mm",
        "locked": True,
        "fixedNumberOfControlPoints": True,
        "labelFormat": "%N-%d",
        "lastUsedControlPointNumber": len(points),
        "controlPoints": points,
        "measurements": _measurements(targets),
    }
    partial = path.with_name(f".partial.{path.name}")
    try:
        text = json.dumps({"@schema": _SCHEMA, "notice": _NOTICE, "markups": [markup]}, indent=1, allow_nan=False)
        partial.write_text(text + "\n")
        os.replace(partial, path)
    except OSError as error:
        discard(partial)
        raise FileError(f"{path}: could not be written ({error.strerror}).") from None


def _measurements(targets: list[Target]) -> list[dict[str, Any]]:
    """The margins as Slicer's table of measurements has them; none where one is unknown: it has no word for that."""
    margins = [1e3 * target.margin for target in targets]
    if not all(map(math.isfinite, margins)):
        return []
    return [
        {
            "name": MARGIN,
            "enabled": True,
            "value": max(margins),
            "units": "mm",
            "printFormat": "%.1f %s",
            "description": "distance within which each point lies with 95 %; the value is the largest",
            "controlPointValues": margins,
        }
    ]
