"""Polygons of surface files, made triangles that cover the same area, also where they are concave."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from vtkmodules.vtkCommonCore import vtkIdList
from vtkmodules.vtkCommonDataModel import vtkPolygon

from ...body import Floats, Ints


def triangulated(points: Floats, polygons: Ints) -> Ints:
    """Triangles (m (k - 2), 3) of polygons of equally many corners, in their order, wound like them.

    A fan from the first corner where it covers the polygon; else, where the polygon is concave, VTK's ear clipping.

    Args:
        points: (p, 3).
        polygons: (m, k) point numbers, all in 0..p-1; polygons of one or two corners have no area and give none.
    """
    corners = polygons.shape[1]
    if corners < 3:
        return np.empty((0, 3), dtype=np.int64)
    fans = np.stack([polygons[:, [0, i, i + 1]] for i in range(1, corners - 1)], axis=1)
    if corners > 3:
        normals = _normals(points, fans)
        whole = normals.sum(axis=1)  # twice the area of the polygon as a vector, whatever its fan looks like
        folded = (np.einsum("mkc,mc->mk", normals, whole) < 0.0).any(axis=1)
        for number in np.flatnonzero(folded):
            fans[number] = _clipped(points, polygons[number], fans[number])
    return fans.reshape(-1, 3).astype(np.int64)


def by_length(polygons: Sequence[Ints]) -> list[Ints]:
    """Polygons of any numbers of corners, those of one number together, (m, k) each.

    Args:
        polygons: point numbers of each.
    """
    lengths = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    return [np.stack([polygons[i] for i in np.flatnonzero(lengths == k)]) for k in np.unique(lengths)]


def stripped(runs: Iterable[Ints]) -> Ints:
    """Triangles of strips, every second one turned, so that all wind alike, (t, 3).

    Args:
        runs: point numbers of each strip.
    """
    found = [np.empty((0, 3), dtype=np.int64)]
    for run in runs:
        if len(run) >= 3:
            triangles = np.stack([run[:-2], run[1:-1], run[2:]], axis=1).astype(np.int64)
            triangles[1::2] = triangles[1::2, ::-1]
            found.append(triangles)
    return np.concatenate(found)


def _normals(points: Floats, triangles: Ints) -> Floats:
    a, b, c = (points[triangles[..., i]] for i in range(3))
    return np.cross(b - a, c - a)


def _clipped(points: Floats, polygon: Ints, fan: Ints) -> Ints:
    """The fan stays where VTK finds no triangles, as for a polygon that crosses itself: its volume is the same."""
    shape, found = vtkPolygon(), vtkIdList()
    shape.GetPoints().SetNumberOfPoints(len(polygon))
    shape.GetPointIds().SetNumberOfIds(len(polygon))
    for i, place in enumerate(points[polygon].tolist()):
        shape.GetPoints().SetPoint(i, place)
        shape.GetPointIds().SetId(i, i)
    done = shape.EarCutTriangulation(found, 0)
    if not done or found.GetNumberOfIds() != fan.size:
        return fan
    local = np.array([found.GetId(i) for i in range(found.GetNumberOfIds())]).reshape(-1, 3)
    clipped: Ints = polygon[local]
    same = (_normals(points, clipped).sum(axis=0) * _normals(points, fan).sum(axis=0)).sum() > 0
    return clipped if same else clipped[:, ::-1]
