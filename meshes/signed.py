"""Signed distances to a closed surface, by VTK: what lies inside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkFiltersGeneral import vtkDistancePolyDataFilter

from .body import Body, Surface

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def cells_inside(body: Body, name: str) -> Ints:
    """Numbers of the cells whose middle lies inside a closed inner surface (a tumour), sorted.

    Args:
        body: the body.
        name: of the inner surface.

    Raises:
        ValueError: no such surface, or one that holds no cell's middle.
    """
    if name not in body.inner:
        raise ValueError(f"cells_inside.name: expected an inner surface among {sorted(body.inner)}, got {name!r}.")
    middles = body.points[body.corner_cells].mean(axis=1)
    found = np.flatnonzero(signed_distances(polydata(body.inner[name]), middles)[0] < 0.0)
    if not len(found):
        raise ValueError(
            f"cells_inside: expected a surface that holds the middle of at least one cell, got none in {name!r}; make "
            "the cells smaller."
        )
    return found


def signed_distances(surface: vtkPolyData, points: Floats) -> tuple[Floats, Floats]:
    """Distances to the surface, (k,), metres, negative inside, and unit vectors along them, (k, 3), of either sign.

    VTK takes the sign from angle-weighted normals, right for closed surfaces also where edges and corners are nearest
    (Baerentzen and Aanaes 2005).
    """
    probe, vertices = _cloud(points), vtkCellArray()
    vertices.SetData(1, numpy_to_vtkIdTypeArray(np.arange(len(points)), deep=True))
    probe.SetVerts(vertices)
    measure = vtkDistancePolyDataFilter()
    measure.SetInputData(0, probe)
    measure.SetInputData(1, surface)
    measure.ComputeSecondDistanceOff()
    measure.ComputeCellCenterDistanceOff()
    measure.ComputeDirectionOn()
    measure.Update()
    found = measure.GetOutput().GetPointData()
    return vtk_to_numpy(found.GetArray("Distance")), vtk_to_numpy(found.GetArray("Direction"))


def polydata(surface: Surface) -> vtkPolyData:
    """A surface as VTK has it."""
    mesh, triangles = _cloud(surface.points), vtkCellArray()
    triangles.SetData(3, numpy_to_vtkIdTypeArray(surface.triangles.ravel(), deep=True))
    mesh.SetPolys(triangles)
    return mesh


def _cloud(points: Floats) -> vtkPolyData:
    cloud, places = vtkPolyData(), vtkPoints()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=True))
    cloud.SetPoints(places)
    return cloud
