"""Closest points of triangle surfaces, at rest and while their vertices move, by libigl's tree of boxes."""

from __future__ import annotations

import igl
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkStaticCellLocator

from .body import Floats, Ints, Surface

_LONGEST_WALK = 60  # triangles that a point may cross
_FEW = 2_500  # triangles: for so many a tree is built and asked as fast as points walk
_TINY = 1e-300  # a triangle without area divides by it
_ROUNDING = 1e-15  # of a squared distance, relative to the square of the surface's extent


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
    """A VTK locator of the surface's triangles, for intersections.

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
    _, triangles, nearest = igl.point_mesh_squared_distance(_plain(points), _plain(surface.points), surface.triangles)
    return nearest, np.asarray(triangles, dtype=np.int64)


def _plain(points: Floats) -> Floats:
    """As libigl takes them."""
    return np.ascontiguousarray(points, dtype=np.float64)


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

    def find(self, positions: Floats, cloud: Floats) -> tuple[Ints, Floats]:
        """Triangle, (p,), and barycentric weights, (p, 3), of the closest point on the surface for each of a cloud.

        Args:
            positions: where the vertices are now, (n, 3), metres.
            cloud: points, (p, 3), metres.
        """
        found = igl.point_mesh_squared_distance(_plain(cloud), _plain(positions), self.triangles)[1]
        found = np.asarray(found, dtype=np.int64)
        return found, closest_in_triangles(positions[self.triangles[found]], cloud)[0]

    @property
    def is_small(self) -> bool:
        """Whether all points are searched for anew each time: no walk is faster."""
        return len(self.triangles) <= _FEW

    def near(self, positions: Floats, cloud: Floats) -> tuple[Ints, Floats]:
        """The same, on a large surface by walking from the nearest vertex: a local minimum of the distance.

        Args:
            positions: where the vertices are now, (n, 3), metres.
            cloud: points, (p, 3), metres.
        """
        if self.is_small:
            return self.find(positions, cloud)
        tree = cKDTree(positions[self._used], balanced_tree=False, compact_nodes=False)  # asked once: built fast
        star = self._stars[self._used[tree.query(cloud)[1]]]
        return self._walked(positions, cloud, *self._best(positions, cloud, star))

    def _best(self, positions: Floats, cloud: Floats, choice: Ints) -> tuple[Ints, Floats, Floats]:
        """Of up to c triangles for each point, (p, c), the closest, its weights, (p, 3), and its squared distance."""
        asked = choice >= 0
        points = np.nonzero(asked)[0]
        tried, found = closest_in_triangles(positions[self.triangles[choice[asked]]], cloud[points])
        squares, place = np.full(choice.shape, np.inf), np.zeros(choice.shape, dtype=np.int64)
        squares[asked], place[asked] = found, np.arange(len(found))
        best, rows = squares.argmin(axis=1), np.arange(len(cloud))
        return choice[rows, best], tried[place[rows, best]], squares[rows, best]

    def follow(self, positions: Floats, cloud: Floats, near: Ints) -> tuple[Ints, Floats]:
        """The same of a large surface by walking from triangle to triangle: a local minimum of the distance.

        Args:
            positions: where the vertices are now, (n, 3), metres.
            cloud: points, (p, 3), metres.
            near: triangles to start from, (p,).
        """
        if self.is_small:
            return self.find(positions, cloud)
        weights, squares = closest_in_triangles(positions[self.triangles[near]], cloud)
        return self._walked(positions, cloud, near.copy(), weights, squares)

    def _walked(
        self, positions: Floats, cloud: Floats, found: Ints, weights: Floats, squares: Floats
    ) -> tuple[Ints, Floats]:
        """To where no neighbour is closer by more than rounding: between two that share an edge a point stays."""
        rounding = _ROUNDING * float((np.ptp(positions, axis=0) ** 2).sum())
        moving = np.flatnonzero((weights <= 0.0).any(axis=1))
        for _ in range(_LONGEST_WALK):
            if not len(moving):
                break
            chosen, at, square = self._best(positions, cloud[moving], self._rings[found[moving]])
            closer = square < squares[moving] - rounding
            moving = moving[closer]
            found[moving], weights[moving], squares[moving] = chosen[closer], at[closer], square[closer]
        return found, weights


def _stars_and_rings(triangles: Ints, vertices: int) -> tuple[Ints, Ints]:
    """The triangles at each vertex, (n, s), and at each triangle's vertices, (t, r), -1 where there are fewer."""
    incidence = csr_array(
        (np.ones(triangles.size), triangles.ravel(), np.arange(0, triangles.size + 1, 3)),
        shape=(len(triangles), vertices),
    )
    return _padded(incidence.T.tocsr()), _padded((incidence @ incidence.T).tocsr())


def _padded(matrix: csr_array) -> Ints:
    """Column numbers of each row, with -1 behind them to one length."""
    counts = np.diff(matrix.indptr)
    found = np.full((matrix.shape[0], counts.max(initial=1)), -1, dtype=np.int64)
    found[np.arange(found.shape[1]) < counts[:, None]] = matrix.indices
    return found


def closest_in_triangles(corners: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Barycentric weights (p, 3) of the point of each triangle (p, 3, 3) closest to a point (p, 3), squared distance.

    The unconstrained minimum where it is inside, else the best of the three edges.
    """
    a, b, c = np.ascontiguousarray(np.moveaxis(corners, 0, 2))  # components in rows: three times as fast
    e, f, g = b - a, c - a, points.T - a
    ee, ef, ff = _dot(e, e), _dot(e, f), _dot(f, f)
    ge, gf, gg = _dot(g, e), _dot(g, f), _dot(g, g)
    size = np.maximum(ee * ff - ef * ef, _TINY)
    v, w = (ff * ge - ef * gf) / size, (ee * gf - ef * ge) / size
    outside = np.flatnonzero((v < 0.0) | (w < 0.0) | (v + w > 1.0))
    v[outside], w[outside] = _on_edges(ee[outside], ef[outside], ff[outside], ge[outside], gf[outside])
    return np.stack([1.0 - v - w, v, w], axis=1), np.maximum(gg + _beyond(v, w, ee, ef, ff, ge, gf), 0.0)


def _on_edges(ee: Floats, ef: Floats, ff: Floats, ge: Floats, gf: Floats) -> tuple[Floats, Floats]:
    """Weights v, w of the closest point on the three edges of each triangle, (p,)."""
    zero = np.zeros_like(ee)
    on_e = np.clip(ge / np.maximum(ee, _TINY), 0.0, 1.0)
    on_f = np.clip(gf / np.maximum(ff, _TINY), 0.0, 1.0)
    # Along the edge from b to c: b + t (c - b).
    on_g = np.clip((gf - ge - ef + ee) / np.maximum(ee - 2.0 * ef + ff, _TINY), 0.0, 1.0)
    v, w = on_e, zero
    square = _beyond(v, w, ee, ef, ff, ge, gf)
    for other_v, other_w in ((zero, on_f), (1.0 - on_g, on_g)):
        tried = _beyond(other_v, other_w, ee, ef, ff, ge, gf)
        closer = tried < square
        v, w = np.where(closer, other_v, v), np.where(closer, other_w, w)
        square = np.minimum(tried, square)
    return v, w


def _dot(a: Floats, b: Floats) -> Floats:
    found: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return found


def _beyond(v: Floats, w: Floats, ee: Floats, ef: Floats, ff: Floats, ge: Floats, gf: Floats) -> Floats:
    """|g - v e - w f|^2 less |g|^2."""
    found: Floats = v * (v * ee - 2.0 * ge) + w * (w * ff - 2.0 * gf) + 2.0 * v * w * ef
    return found
