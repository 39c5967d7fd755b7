"""How far a deformed surface is from an observed cloud, one-sided, with its exact gradient."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import mutable, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkGenericCell, vtkPolyData, vtkStaticCellLocator

from softtwin.meshes.body import Body

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class ClosestPoints:
    """Closest points on a triangle surface whose vertices move.

    Args:
        triangles: vertex numbers, (t, 3).
        vertices: number of vertices.
    """

    def __init__(self, triangles: Ints, vertices: int) -> None:
        self.triangles = np.ascontiguousarray(triangles)
        self._points = vtkPoints()
        self._points.SetDataTypeToDouble()
        self._points.SetNumberOfPoints(vertices)
        cells = vtkCellArray()
        offsets = np.arange(0, 3 * len(triangles) + 1, 3)
        cells.SetData(
            numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(self.triangles.ravel(), deep=True)
        )
        self._surface = vtkPolyData()
        self._surface.SetPoints(self._points)
        self._surface.SetPolys(cells)

    def find(self, positions: Floats, cloud: Floats) -> tuple[Ints, Floats]:
        """Triangle (p,) and closest point on it (p, 3) for every point of a cloud (p, 3).

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
        # VTK writes its answers into these; its stubs know plain numbers only.
        number: Any
        part: Any
        squared: Any
        number, part, squared = mutable(0), mutable(0), mutable(0.0)
        triangles = np.empty(len(cloud), dtype=np.int64)
        closest = np.empty((len(cloud), 3))
        place = [0.0, 0.0, 0.0]
        for i, point in enumerate(cloud.tolist()):
            locator.FindClosestPoint(point, place, cell, number, part, squared)
            triangles[i] = number.get()
            closest[i] = place
        return triangles, closest


def barycentric(corners: Floats, points: Floats) -> Floats:
    """Barycentric weights, (p, 3), of points (p, 3) that lie in triangles with corners (p, 3, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    e, f, g = b - a, c - a, points - a
    ee, ef, ff = (np.einsum("pi,pi->p", x, y) for x, y in ((e, e), (e, f), (f, f)))
    ge, gf = (np.einsum("pi,pi->p", g, x) for x in (e, f))
    size = ee * ff - ef * ef
    v, w = (ff * ge - ef * gf) / size, (ee * gf - ef * ge) / size
    return np.stack([1.0 - v - w, v, w], axis=1)


@dataclass(frozen=True, eq=False)
class Match:
    """A cloud matched to a deformed surface.

    Args:
        distances: signed along the directions, (p,), metres: positive where the surface is beyond the point.
        directions: unit vectors in which each distance grows, (p, 3).
        triangles: triangle that holds each closest point, (p,).
        weights: barycentric weights of the closest points, (p, 3).
    """

    distances: Floats
    directions: Floats
    triangles: Ints
    weights: Floats

    @property
    def value(self) -> float:
        """J = 1/(2p) sum d^2, square metres (Odot 2023, eq. 6.2, the integral as a mean over the cloud)."""
        return 0.5 * float(np.mean(self.distances**2))


class CloudObjective:
    """Mean squared distance from a cloud to the observed side of a body: what is not seen pulls nothing.

    Args:
        body: the body.
        triangles: the observed side as node numbers, (t, 3); the whole boundary if not given.
    """

    def __init__(self, body: Body, triangles: ArrayLike | None = None) -> None:
        self.body = body
        chosen = body.boundary if triangles is None else np.asarray(triangles, dtype=np.int64)
        self.nodes, local = np.unique(chosen, return_inverse=True)
        self.triangles = local.reshape(-1, 3)
        self._closest = ClosestPoints(self.triangles, len(self.nodes))
        self._rest = body.points[self.nodes]

    def match(self, displacement: Floats, cloud: Floats) -> Match:
        """Match a cloud (p, 3) to the surface moved by the displacement (m, 3) of the nodes `nodes`, metres."""
        positions = self._rest + displacement
        triangles, closest = self._closest.find(positions, cloud)
        corners = positions[self.triangles[triangles]]
        offsets = closest - cloud
        lengths = np.linalg.norm(offsets, axis=1)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        # On the surface itself the offset has no direction: the normal is its limit.
        near = lengths < 1e-12 * self.body.size
        directions = np.where(near[:, None], normals, offsets / np.where(near, 1.0, lengths)[:, None])
        side = np.sign(np.einsum("pi,pi->p", directions, normals))
        side[side == 0.0] = 1.0
        return Match(side * lengths, side[:, None] * directions, triangles, barycentric(corners, closest))

    def jacobian(self, match: Match) -> csr_array:
        """Derivative of the distances with respect to the displacement of the observed nodes, (p, 3m).

        Exact: by the envelope theorem the closest point may be held fixed on its triangle.
        """
        count = len(match.distances)
        columns = (3 * self.triangles[match.triangles][:, :, None] + np.arange(3)).reshape(count, 9)
        values = (match.weights[:, :, None] * match.directions[:, None, :]).reshape(count, 9)
        indptr = np.arange(0, 9 * count + 1, 9)
        return csr_array((values.ravel(), columns.ravel(), indptr), shape=(count, 3 * len(self.nodes)))

    def gradient(self, match: Match) -> Floats:
        """Derivative of the value with respect to the whole displacement, (n, 3), metres."""
        full = np.zeros_like(self.body.points)
        pull = self.jacobian(match).T @ match.distances / len(match.distances)
        full[self.nodes] = pull.reshape(-1, 3)
        return full
