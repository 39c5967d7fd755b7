"""Closest points of triangle surfaces at rest, by libigl's tree of boxes; `triangle_tree` has those that move."""

from __future__ import annotations

import igl
import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkStaticCellLocator

from .body import Floats, Ints, Surface

NEEDLE = 1e-15  # of the product of two squared edges: a triangle with less has no area, but for rounding
_TINY = 1e-300  # a triangle without area divides by it


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


def closest_in_triangles(corners: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Barycentric weights (p, 3) of the point of each triangle (p, 3, 3) closest to a point (p, 3), squared distance.

    The unconstrained minimum where it is inside, else the best of the three edges.
    """
    a, b, c = np.ascontiguousarray(np.moveaxis(corners, 0, 2))  # components in rows: three times as fast
    e, f, g = b - a, c - a, points.T - a
    ee, ef, ff = _dot(e, e), _dot(e, f), _dot(f, f)
    ge, gf, gg = _dot(g, e), _dot(g, f), _dot(g, g)
    area = ee * ff - ef * ef
    size = np.maximum(area, _TINY)
    v, w = (ff * ge - ef * gf) / size, (ee * gf - ef * ge) / size
    outside = np.flatnonzero(~(area > NEEDLE * ee * ff) | (v < 0.0) | (w < 0.0) | (v + w > 1.0))
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
