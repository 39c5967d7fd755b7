"""Closest points of triangle surfaces, at rest and while their vertices move, by VTK's static cell locator."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import mutable, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkGenericCell, vtkPolyData, vtkStaticCellLocator

from .body import Floats, Ints, Surface

_LONGEST_WALK = 60  # triangles that a point may cross


def polydata(surface: Surface) -> vtkPolyData:
    """The surface for VTK.

    Args:
        surface: triangle surface, metres.
    """
    mesh, points, polygons = vtkPolyData(), vtkPoints(), vtkCellArray()
    points.SetData(numpy_to_vtk(surface.points, deep=True))
    offsets: Ints = np.arange(0, surface.triangles.size + 1, 3)
    polygons.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(surface.triangles.ravel(), deep=True)
    )
    mesh.SetPoints(points)
    mesh.SetPolys(polygons)
    return mesh


def cell_locator(surface: Surface) -> vtkStaticCellLocator:
    """A VTK locator of the surface's triangles, for closest points and intersections.

    Args:
        surface: triangle surface, metres.
    """
    locator = vtkStaticCellLocator()
    locator.SetDataSet(polydata(surface))
    locator.BuildLocator()
    return locator


def closest_points(surface: Surface, points: Floats) -> tuple[Floats, Ints]:
    """The points of a surface nearest to given ones, (p, 3), metres, and the numbers of their triangles, (p,).

    Args:
        surface: triangle surface, metres.
        points: positions, (p, 3), metres.
    """
    locator = cell_locator(surface)
    nearest, triangles = np.empty_like(points), np.empty(len(points), dtype=np.int64)
    found = [0.0, 0.0, 0.0]
    cell: Any = mutable(0)  # VTK writes its answers into these
    part: Any = mutable(0)
    square: Any = mutable(0.0)
    for i, point in enumerate(points):
        locator.FindClosestPoint(point.tolist(), found, cell, part, square)
        nearest[i], triangles[i] = found, int(cell)
    return nearest, triangles


def distances(surface: Surface, points: Floats) -> Floats:
    """Distances of points to a surface, (p,), metres.

    Args:
        surface: triangle surface, metres.
        points: positions, (p, 3), metres.
    """
    return np.linalg.norm(points - closest_points(surface, points)[0], axis=1)


class ClosestPoints:
    """Closest points on the triangles of a surface, wherever its vertices are, whole clouds at a time.

    Args:
        triangles: vertex numbers, (t, 3).
        vertices: number of vertices.
    """

    def __init__(self, triangles: Ints, vertices: int) -> None:
        self.triangles = np.ascontiguousarray(triangles, dtype=np.int64)
        self._stars, self._rings = _stars_and_rings(self.triangles, vertices)
        self._used = np.unique(self.triangles)
        self._points, cells = vtkPoints(), vtkCellArray()
        self._points.SetDataTypeToDouble()
        self._points.SetNumberOfPoints(vertices)
        offsets: Ints = np.arange(0, self.triangles.size + 1, 3)
        cells.SetData(
            numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(self.triangles.ravel(), deep=True)
        )
        self._surface = vtkPolyData()
        self._surface.SetPoints(self._points)
        self._surface.SetPolys(cells)

    def find(self, positions: Floats, cloud: Floats) -> tuple[Ints, Floats]:
        """Triangle, (p,), and barycentric weights, (p, 3), of the closest point on the surface for each of a cloud.

        Args:
            positions: where the vertices are now, (n, 3), metres.
            cloud: points, (p, 3), metres.
        """
        self._points.SetData(numpy_to_vtk(np.ascontiguousarray(positions), deep=True))
        self._points.Modified()
        locator = vtkStaticCellLocator()
        locator.SetDataSet(self._surface)
        locator.BuildLocator()
        cell = vtkGenericCell()
        number: Any = mutable(0)  # VTK writes its answers into these
        part: Any = mutable(0)
        squared: Any = mutable(0.0)
        place = [0.0, 0.0, 0.0]
        found = np.empty(len(cloud), dtype=np.int64)
        for i, point in enumerate(cloud.tolist()):
            locator.FindClosestPoint(point, place, cell, number, part, squared)
            found[i] = number.get()
        return found, closest_in_triangles(positions[self.triangles[found]], cloud)[0]

    def near(self, positions: Floats, cloud: Floats) -> tuple[Ints, Floats]:
        """The same by walking from the nearest vertex: a local minimum of the distance, found in half of the time.

        Args:
            positions: where the vertices are now, (n, 3), metres.
            cloud: points, (p, 3), metres.
        """
        tree = cKDTree(positions[self._used], balanced_tree=False, compact_nodes=False)  # asked once: built fast
        star = self._stars[self._used[tree.query(cloud)[1]]]
        return self.follow(positions, cloud, self._best(positions, cloud, star)[0])

    def _best(self, positions: Floats, cloud: Floats, choice: Ints) -> tuple[Ints, Floats]:
        """Of so many triangles for each point, (p, c), the closest, and its weights, (p, 3)."""
        corners = positions[self.triangles[choice.ravel()]]
        tried, squares = closest_in_triangles(corners, np.repeat(cloud, choice.shape[1], axis=0))
        best, rows = squares.reshape(choice.shape).argmin(axis=1), np.arange(len(cloud))
        return choice[rows, best], tried.reshape(*choice.shape, 3)[rows, best]

    def follow(self, positions: Floats, cloud: Floats, near: Ints) -> tuple[Ints, Floats]:
        """The same by walking from triangle to triangle: a local minimum of the distance, found in a tenth of the time.

        Args:
            positions: where the vertices are now, (n, 3), metres.
            cloud: points, (p, 3), metres.
            near: triangles to start from, (p,).
        """
        found = near.copy()
        weights, _ = closest_in_triangles(positions[self.triangles[found]], cloud)
        moving = np.flatnonzero((weights <= 0.0).any(axis=1))
        for _ in range(_LONGEST_WALK):
            if not len(moving):
                break
            chosen, weights[moving] = self._best(positions, cloud[moving], self._rings[found[moving]])
            changed = chosen != found[moving]
            found[moving] = chosen
            moving = moving[changed]
        return found, weights


def _stars_and_rings(triangles: Ints, vertices: int) -> tuple[Ints, Ints]:
    """The triangles at each vertex, (n, s), and at each triangle's vertices, (t, r), repeated to one length."""
    incidence = csr_array(
        (np.ones(triangles.size), triangles.ravel(), np.arange(0, triangles.size + 1, 3)),
        shape=(len(triangles), vertices),
    )
    return _padded(incidence.T.tocsr()), _padded((incidence @ incidence.T).tocsr())


def _padded(matrix: csr_array) -> Ints:
    """Column numbers of each row, the last repeated to one length; of no use where a row has none."""
    begin, end = matrix.indptr[:-1], matrix.indptr[1:]
    places = begin[:, None] + np.arange(np.diff(matrix.indptr).max(initial=1))
    return matrix.indices[np.clip(places, 0, np.maximum(end, 1)[:, None] - 1)].astype(np.int64)


def closest_in_triangles(corners: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Barycentric weights (p, 3) of the point of each triangle (p, 3, 3) closest to a point (p, 3), squared distance.

    The unconstrained minimum where it is inside, else the best of the three edges.
    """
    a = corners[:, 0]
    e, f, g = corners[:, 1] - a, corners[:, 2] - a, points - a
    ee, ef, ff = _dot(e, e), _dot(e, f), _dot(f, f)
    ge, gf, gg = _dot(g, e), _dot(g, f), _dot(g, g)
    tiny = 1e-300
    size = np.maximum(ee * ff - ef * ef, tiny)
    v, w = (ff * ge - ef * gf) / size, (ee * gf - ef * ge) / size
    outside = (v < 0.0) | (w < 0.0) | (v + w > 1.0)
    on_e = np.clip(ge / np.maximum(ee, tiny), 0.0, 1.0)
    on_f = np.clip(gf / np.maximum(ff, tiny), 0.0, 1.0)
    # Along the edge from b to c: b + t (c - b).
    opposite = np.maximum(ee - 2.0 * ef + ff, tiny)
    on_g = np.clip((gf - ge - ef + ee) / opposite, 0.0, 1.0)
    zero = np.zeros_like(v)
    choices_v = np.stack([on_e, zero, 1.0 - on_g])
    choices_w = np.stack([zero, on_f, on_g])
    squares = _square(choices_v, choices_w, ee, ef, ff, ge, gf, gg)
    best = squares.argmin(axis=0)
    rows = np.arange(len(points))
    v = np.where(outside, choices_v[best, rows], v)
    w = np.where(outside, choices_w[best, rows], w)
    return np.stack([1.0 - v - w, v, w], axis=1), np.maximum(_square(v, w, ee, ef, ff, ge, gf, gg), 0.0)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("pi,pi->p", a, b)


def _square(v: Floats, w: Floats, ee: Floats, ef: Floats, ff: Floats, ge: Floats, gf: Floats, gg: Floats) -> Floats:
    """|g - v e - w f|^2."""
    found: Floats = gg + v * (v * ee - 2.0 * ge) + w * (w * ff - 2.0 * gf) + 2.0 * v * w * ef
    return found
