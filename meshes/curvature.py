"""How strongly triangle surfaces bend, by VTK."""

from __future__ import annotations

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersGeneral import vtkCurvatures

from .body import Floats, Surface
from .closest import polydata


def mean_curvature(surface: Surface) -> Floats:
    """Mean curvature at each vertex, (n,), 1/m: half the sum of the principal ones, positive where the normals spread.

    A sphere of radius r whose triangles wind outward has 1/r. Vertices at an open edge have what their inner edges say.

    Args:
        surface: triangle surface, metres.
    """
    curvatures = vtkCurvatures()
    curvatures.SetCurvatureTypeToMean()
    curvatures.SetInputData(polydata(surface))
    curvatures.Update()
    found = vtk_to_numpy(curvatures.GetOutput().GetPointData().GetArray("Mean_Curvature"))
    return np.array(found, dtype=np.float64)
