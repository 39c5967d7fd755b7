"""How far a deformed surface is from an observed cloud, one-sided, with its exact derivative."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, kron

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.closest import ClosestPoints
from softtwin.meshes.curvature import mean_curvature
from softtwin.meshes.embedding import outer

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


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
    def rms(self) -> float:
        """Root mean square of the distances, metres."""
        return float(np.sqrt(np.mean(self.distances**2)))


class SurfaceDistance:
    """Distances from a cloud to the observed side of a body: what is not seen pulls nothing.

    Args:
        body: the body.
        triangles: the observed side as vertex numbers of the organ's own surface (which are node numbers where that
            is the boundary of the cells), (t, 3); all of it if not given.
    """

    def __init__(self, body: Body, triangles: ArrayLike | None = None) -> None:
        self.body = body
        surface = outer(body)
        chosen = surface.rest.triangles if triangles is None else np.asarray(triangles, dtype=np.int64)
        vertices, local = np.unique(chosen, return_inverse=True)
        self.triangles = local.reshape(-1, 3)
        self.nodes = surface.nodes_of(vertices)
        self.rest: Floats = surface.rest.points[vertices]
        self._weights = None if surface.weights is None else surface.weights[vertices][:, self.nodes]
        self._closest = ClosestPoints(self.triangles, len(vertices))

    def _carried(self, field: Floats) -> Floats:
        """A field of the nodes `nodes`, (m, ...), at the vertices of the observed side, (v, ...)."""
        return field if self._weights is None else self._weights @ field

    def at_points(self, match: Match, field: Floats) -> Floats:
        """A number of each node of `nodes`, (m,), at the closest points of a match, (p,)."""
        corners = self._carried(field)[self.triangles[match.triangles]]
        found: Floats = np.einsum("pk,pk->p", match.weights, corners)
        return found

    def match(self, displacement: Floats, cloud: Floats, near: Match | None = None) -> Match:
        """A cloud (p, 3) matched to the surface moved by the displacement (m, 3) of the nodes `nodes`, metres.

        Args:
            displacement: of the nodes `nodes`, (m, 3), metres.
            cloud: points, (p, 3), metres.
            near: a match of the same cloud to walk from, faster; the search starts anew if not given.
        """
        positions = self.rest + self._carried(displacement)
        if near is None:
            return self._matched(positions, cloud, *self._closest.find(positions, cloud))
        return self._matched(positions, cloud, *self._closest.follow(positions, cloud, near.triangles))

    def match_nearby(self, displacement: Floats, cloud: Floats) -> Match:
        """The same by a walk from each point's nearest vertex: faster than anew, in rare places not the closest.

        Args:
            displacement: of the nodes `nodes`, (m, 3), metres.
            cloud: points, (p, 3), metres.
        """
        positions = self.rest + self._carried(displacement)
        return self._matched(positions, cloud, *self._closest.near(positions, cloud))

    def match_beyond(self, displacement: Floats, cloud: Floats, near: Match, distance: float) -> Match:
        """A match found by walking, with the points that lie further than a distance from the surface searched anew.

        Args:
            displacement: of the nodes `nodes`, (m, 3), metres.
            cloud: points, (p, 3), metres.
            near: a match at this displacement.
            distance: metres; what is closer may lie closer still at another place, but no more than that.
        """
        far = np.flatnonzero(np.abs(near.distances) > distance) if distance > 0.0 else np.arange(len(cloud))
        if not len(far):
            return near
        positions = self.rest + self._carried(displacement)
        triangles, weights = near.triangles.copy(), near.weights.copy()
        triangles[far], weights[far] = self._closest.find(positions, cloud[far])
        return self._matched(positions, cloud, triangles, weights)

    def _matched(self, positions: Floats, cloud: Floats, triangles: Ints, weights: Floats) -> Match:
        corners = positions[self.triangles[triangles]]
        offsets = np.einsum("pk,pki->pi", weights, corners) - cloud
        lengths = np.sqrt(np.einsum("pi,pi->p", offsets, offsets))
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.sqrt(np.einsum("pi,pi->p", normals, normals))[:, None]
        # On the surface itself the offset has no direction: the normal is its limit.
        on_it = lengths < 1e-12 * self.body.size
        directions = np.where(on_it[:, None], normals, offsets / np.where(on_it, 1.0, lengths)[:, None])
        side = np.where(np.einsum("pi,pi->p", directions, normals) < 0.0, -1.0, 1.0)
        return Match(side * lengths, side[:, None] * directions, triangles, weights)

    def feet(self, match: Match) -> Floats:
        """The closest points of a match on the surface at rest, (p, 3), metres."""
        found: Floats = np.einsum("pk,pki->pi", match.weights, self.rest[self.triangles[match.triangles]])
        return found

    def moved_feet(self, match: Match, displacement: Floats) -> Floats:
        """Where the closest points of a match at rest are after a displacement of `nodes`, (m, 3): (p, 3), metres."""
        corners = (self.rest + self._carried(displacement))[self.triangles[match.triangles]]
        found: Floats = np.einsum("pk,pki->pi", match.weights, corners)
        return found

    def rows_by_axes(self, match: Match) -> csr_array:
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

    def rows(self, match: Match) -> csr_array:
        """Derivative of the distances with respect to the displacement of the observed nodes, (p, 3m).

        Exact: by the envelope theorem the closest point may be held fixed on its triangle.
        """
        count = len(match.distances)
        columns = (3 * self.triangles[match.triangles][:, :, None] + np.arange(3)).reshape(count, 9)
        values = (match.weights[:, :, None] * match.directions[:, None, :]).reshape(count, 9)
        indptr = np.arange(0, 9 * count + 1, 9)
        return self.by_nodes(csr_array((values.ravel(), columns.ravel(), indptr), shape=(count, 3 * len(self.rest))))

    def by_nodes(self, rows: csr_array) -> csr_array:
        """Linear functions of the displacement of the nodes `nodes`, (q, 3m), from those of the vertices', (q, 3v)."""
        return rows if self._spread is None else rows @ self._spread

    @cached_property
    def _spread(self) -> csr_array | None:
        """Displacements of the vertices from those of the nodes, (3v, 3m); None where they are the same."""
        return None if self._weights is None else csr_array(kron(self._weights, np.eye(3), format="csr"))

    def expected(self, match: Match, noise: float) -> Floats:
        """Mean of the signed distances of points that noise has moved from where they were matched, (p,), metres.

        Noise leaves more points outside a round surface than inside: by sigma^2 H where the mean curvature H is small
        (the second-order mean of the distance) and by sigma sqrt(8 / pi) about a tip, which has no inside. Noise is
        taken as the same in all directions, curvature as at rest.

        Args:
            match: of the cloud.
            noise: standard deviation of each coordinate of a point, metres.
        """
        bent = noise * np.einsum("pk,pk->p", match.weights, self._curvature[self.triangles[match.triangles]])
        mean: Floats = -noise * bent / (1.0 + np.sqrt(np.pi / 8.0) * np.abs(bent))
        return mean

    @cached_property
    def _curvature(self) -> Floats:
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
