"""Closest points of triangle surfaces, by VTK's static cell locator."""

from __future__ import annotations

from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import mutable, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkStaticCellLocator

from .body import Floats, Ints, Surface


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
