"""How far a deformed surface is from an observed cloud, one-sided, with its exact derivative."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, kron

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.curvature import mean_curvature
from softtwin.meshes.embedding import outer
from softtwin.meshes.triangle_tree import TriangleTree, signed_distances

from .policy import ACCURACY
from .surface_modes import SurfaceModes, surface_modes

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Distance = Literal["surface", "plane"]
_BESIDE = 1.0  # triangles: a point that lies further beside its own is measured to the surface all the same


@dataclass(frozen=True, eq=False)
class Correspondence:
    """A cloud matched to a deformed surface.

    Args:
        distances: signed along the directions, (p,), metres: positive where the surface is beyond the point.
        directions: unit vectors in which each distance grows, (p, 3).
        triangles: triangle that holds each closest point, (p,).
        weights: barycentric weights of the closest points, (p, 3).
        levers: those of the points that distances are measured to, (p, 3): the closest points, or the feet on the
            planes of their triangles.
    """

    distances: Floats
    directions: Floats
    triangles: Ints
    weights: Floats
    levers: Floats

    @property
    def rms(self) -> float:
        """Root mean square of the distances, metres."""
        return float(np.sqrt(np.mean(self.distances**2)))


class SurfaceDistance:
    """Distances from a cloud to the observed side of a body: what is not seen pulls nothing.

    Args:
        body: the body.
        triangles: the observed side as vertex numbers of the organ's own surface (which are node numbers where that
            is the boundary of the cells), (t, 3); all of it if not given.
        distance: to the `surface`, or to the `plane` of the triangle that holds the closest point: it slides along the
            surface freely (Chen and Medioni 1992), and at an edge of what is seen pulls nothing sideways.
    """

    def __init__(self, body: Body, triangles: ArrayLike | None = None, distance: Distance = "surface") -> None:
        self.body, self.distance = body, distance
        surface = outer(body)
        chosen = surface.rest.triangles if triangles is None else np.asarray(triangles, dtype=np.int64)
        vertices, local = np.unique(chosen, return_inverse=True)
        self.triangles = local.reshape(-1, 3)
        self.nodes = surface.nodes_of(vertices)
        self.rest: Floats = surface.rest.points[vertices]
        self._weights = None if surface.weights is None else surface.weights[vertices][:, self.nodes]
        self._tree = TriangleTree(self.rest, self.triangles)

    def carried(self, field: Floats) -> Floats:
        """A field of the nodes `nodes`, (m, ...), at the vertices of the observed side, (v, ...)."""
        return field if self._weights is None else self._weights @ field

    def at_points(self, match: Correspondence, field: Floats) -> Floats:
        """A number of each node of `nodes`, (m,), at the closest points of a match, (p,)."""
        corners = self.carried(field)[self.triangles[match.triangles]]
        found: Floats = np.einsum("pk,pk->p", match.weights, corners)
        return found

    def at_vertices(self, match: Correspondence, field: Floats) -> Floats:
        """A number of each vertex of the observed side, (v,), at the closest points of a match, (p,)."""
        found: Floats = np.einsum("pk,pk->p", match.weights, field[self.triangles[match.triangles]])
        return found

    def vectors_at(self, match: Correspondence, field: Floats) -> Floats:
        """A vector of each vertex of the observed side, (v, 3), at the closest points of a match, (p, 3)."""
        found: Floats = np.einsum("pk,pki->pi", match.weights, field[self.triangles[match.triangles]])
        return found

    @cached_property
    def modes(self) -> SurfaceModes:
        """The smoothest functions on the observed side at rest."""
        return surface_modes(self.rest, self.triangles, ACCURACY.surface_modes)

    def match(self, displacement: Floats, cloud: Floats, near: Correspondence | None = None) -> Correspondence:
        """A cloud (p, 3) matched to the surface moved by the displacement (m, 3) of the nodes `nodes`, metres.

        Args:
            displacement: of the nodes `nodes`, (m, 3), metres.
            cloud: points, (p, 3), metres.
            near: the same cloud on the surface where it was nearby, which makes the search shorter.
        """
        positions = self.rest + self.carried(displacement)
        triangles, weights = self._tree.closest(positions, cloud, None if near is None else near.triangles)
        vertices = self.triangles[triangles]
        distances, directions = signed_distances(positions, vertices, weights, cloud, 1e-12 * self.body.size)
        match = Correspondence(distances, directions, triangles, weights, weights)
        return match if self.distance == "surface" else _to_planes(match, positions[vertices], cloud)

    def facing(self, match: Correspondence, displacement: Floats) -> Floats:
        """Unit normals of the moved triangles that hold a match's closest points, (p, 3).

        Args:
            match: of a cloud.
            displacement: of the nodes `nodes`, (m, 3), metres.
        """
        return _normals((self.rest + self.carried(displacement))[self.triangles[match.triangles]])[0]

    def facing_rows(self, match: Correspondence, displacement: Floats, along: Floats) -> csr_array:
        """Derivative of these normals' components along vectors, (p q, 3m), by the displacement of the nodes.

        Exact while each closest point stays on its triangle, whose normal depends on its three corners alone.

        Args:
            match: of a cloud.
            displacement: of the nodes `nodes`, (m, 3), metres.
            along: q vectors for each point, (p, q, 3).
        """
        corners = (self.rest + self.carried(displacement))[self.triangles[match.triangles]]
        normals, doubled = _normals(corners)
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        # t . dn = q . (d first x second + first x d second) with q = (t - (t . n) n) / |first x second|
        tangent = along - np.einsum("pqi,pi->pq", along, normals)[:, :, None] * normals[:, None]
        tangent /= doubled[:, None, None]
        by_second = np.cross(second[:, None], tangent)
        by_third = np.cross(tangent, first[:, None])
        values = np.stack([-by_second - by_third, by_second, by_third], axis=2)  # (p, q, corner, axis)
        count = along.shape[0] * along.shape[1]
        columns = (3 * self.triangles[match.triangles][:, :, None] + np.arange(3)).reshape(-1, 1, 9)
        columns = np.broadcast_to(columns, (along.shape[0], along.shape[1], 9))
        indptr = np.arange(0, 9 * count + 1, 9)
        return self.by_nodes(csr_array((values.ravel(), columns.ravel(), indptr), shape=(count, 3 * len(self.rest))))

    def closest_points(self, match: Correspondence) -> Floats:
        """The closest points of a match on the surface at rest, (p, 3), metres."""
        found: Floats = np.einsum("pk,pki->pi", match.weights, self.rest[self.triangles[match.triangles]])
        return found

    def moved_closest_points(self, match: Correspondence, displacement: Floats) -> Floats:
        """Where the closest points of a match at rest are after a displacement of `nodes`, (m, 3): (p, 3), metres."""
        corners = (self.rest + self.carried(displacement))[self.triangles[match.triangles]]
        found: Floats = np.einsum("pk,pki->pi", match.weights, corners)
        return found

    def rows_by_axes(self, match: Correspondence) -> csr_array:
        """Derivative of the coordinates of a match's closest points by the displacement of the nodes, (3p, 3m)."""
        whole = csr_array(
            (
                np.repeat(match.weights, 3, axis=0).ravel(),
                (3 * self.triangles[match.triangles][:, None, :] + np.arange(3)[:, None]).ravel(),
                np.arange(0, 9 * len(match.weights) + 1, 3),
            ),
            shape=(3 * len(match.weights), 3 * len(self.rest)),
        )
        return self.by_nodes(whole)

    def rows(self, match: Correspondence) -> csr_array:
        """Derivative of the distances with respect to the displacement of the observed nodes, (p, 3m).

        Exact: by the envelope theorem the closest point, or the foot, may be held fixed on its triangle.
        """
        count = len(match.distances)
        columns = (3 * self.triangles[match.triangles][:, :, None] + np.arange(3)).reshape(count, 9)
        values = (match.levers[:, :, None] * match.directions[:, None, :]).reshape(count, 9)
        indptr = np.arange(0, 9 * count + 1, 9)
        return self.by_nodes(csr_array((values.ravel(), columns.ravel(), indptr), shape=(count, 3 * len(self.rest))))

    def by_nodes(self, rows: csr_array) -> csr_array:
        """Linear functions of the displacement of the nodes `nodes`, (q, 3m), from those of the vertices', (q, 3v)."""
        return rows if self._spread is None else rows @ self._spread

    @cached_property
    def _spread(self) -> csr_array | None:
        """Displacements of the vertices from those of the nodes, (3v, 3m); None where they are the same."""
        return None if self._weights is None else csr_array(kron(self._weights, np.eye(3), format="csr"))

    def curvature(self, match: Correspondence) -> Floats:
        """Mean curvature of the observed side at rest at the closest points of a match, (p,), 1/m."""
        return self.at_vertices(match, self.vertex_curvature)

    @cached_property
    def edge(self) -> float:
        """Mean length of the edges of the observed side at rest, metres."""
        corners = self.rest[self.triangles]
        return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())

    @cached_property
    def vertex_curvature(self) -> Floats:
        """Mean curvature of the observed side at rest at its vertices, (v,), 1/m."""
        return mean_curvature(Surface(self.rest, self.triangles))

    @cached_property
    def normals(self) -> tuple[Floats, Floats]:
        """Normal, (v, 3), and share of the observed side's area, (v,), of each vertex of it at rest."""
        corners = self.rest[self.triangles]
        areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sums, share = np.zeros_like(self.rest), np.zeros(len(self.rest))
        for corner in range(3):
            np.add.at(sums, self.triangles[:, corner], areas)
            np.add.at(share, self.triangles[:, corner], np.linalg.norm(areas, axis=1) / 3.0)
        lengths = np.maximum(np.linalg.norm(sums, axis=1), 1e-300)
        return sums / lengths[:, None], share / share.sum()


def expected_distance(curvature: Floats, noise: float) -> Floats:
    """Mean of the signed distances of points that noise has moved from where they were matched, (p,), metres.

    Noise leaves more points outside a round surface than inside: by sigma^2 H where the mean curvature H is small (the
    second-order mean of the distance) and by sigma sqrt(8 / pi) about a tip, which has no inside. Noise is taken as
    the same in all directions, curvature as at rest.

    Args:
        curvature: mean curvature H, (p,), 1/m.
        noise: standard deviation of each coordinate of a point, metres.
    """
    bent = noise * curvature
    mean: Floats = -noise * bent / (1.0 + np.sqrt(np.pi / 8.0) * np.abs(bent))
    return mean


def _normals(corners: Floats) -> tuple[Floats, Floats]:
    """Unit normals of triangles, (p, 3), and twice their areas, (p,)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.sqrt(np.einsum("pi,pi->p", normals, normals))
    return normals / doubled[:, None], doubled


def _to_planes(match: Correspondence, corners: Floats, cloud: Floats) -> Correspondence:
    """The same match with distances to the planes of the triangles, but of points far beside their own."""
    normals, doubled = _normals(corners)
    first, second, arm = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], cloud - corners[:, 0]
    closest_points = np.empty_like(match.weights)
    closest_points[:, 1] = np.einsum("pi,pi->p", np.cross(arm, second), normals) / doubled
    closest_points[:, 2] = np.einsum("pi,pi->p", np.cross(first, arm), normals) / doubled
    closest_points[:, 0] = 1.0 - closest_points[:, 1] - closest_points[:, 2]
    near = (closest_points > -_BESIDE).all(axis=1)
    return Correspondence(
        np.where(near, -np.einsum("pi,pi->p", arm, normals), match.distances),
        np.where(near[:, None], normals, match.directions),
        match.triangles,
        match.weights,
        np.where(near[:, None], closest_points, match.levers),
    )
