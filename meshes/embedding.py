"""Points and inner surfaces carried by a body: each point follows the shape functions of its cell."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from .body import Body, Floats, Ints, Surface
from .elements import linear_kind, split_facets
from .metrics import edge_lengths
from .quadrature import shape_functions

_NEWTON_STEPS = 20
_STEP_TOLERANCE = 1e-13
_NO_WEIGHT = 1e-9  # a node with less does not move a vertex
_ROUGH, _ROUGH_OF_EDGE = 3e-3, 0.1  # of the body's size and of its median edge: so far a mesh is from its surface
_TOLERANCE = 1e-9  # in local coordinates: how far outside a cell a point still counts as inside


@dataclass(frozen=True, eq=False)
class Embedding:
    """Points tied to a body: the position of a point is the weighted mean of the nodes of its cell.

    Args:
        cells: number of the cell that carries each point, (p,).
        nodes: node numbers of these cells, (p, k).
        weights: weight of each of these nodes, (p, k); they sum to 1.
        outside: distance of each point to the body, (p,), metres; 0 inside. A point outside moves with the
            nearest point of the boundary.
        node_count: number of nodes of the body.
    """

    cells: Ints
    nodes: Ints
    weights: Floats
    outside: Floats
    node_count: int

    @cached_property
    def matrix(self) -> csr_array:
        """Interpolation matrix, (p, n): nodal values to values at the points."""
        rows = np.arange(0, self.nodes.size + 1, self.nodes.shape[1])
        shape = (len(self.nodes), self.node_count)
        return csr_array((self.weights.ravel(), self.nodes.ravel(), rows), shape=shape)

    def displace(self, displacement: ArrayLike) -> Floats:
        """Displacements of the points, (p, 3), metres.

        Args:
            displacement: nodal displacements, (n, 3), metres.

        Raises:
            ValueError: another shape.
        """
        nodal = np.asarray(displacement, dtype=np.float64)
        if nodal.shape != (self.node_count, 3):
            raise ValueError(f"displacement: expected shape ({self.node_count}, 3), got {nodal.shape}.")
        return np.einsum("pk,pki->pi", self.weights, nodal[self.nodes])


def is_carried_along(body: Body, points: Embedding) -> NDArray[np.bool_]:
    """Which points lie outside a body, farther than its mesh is from its surface, (p,): where they go is not known.

    A mesh lies within 3 thousandths of the body's size, or a tenth of its edges, of the surface that it was made of
    (`solidify`).

    Args:
        body: that carries them.
        points: carried.
    """
    edge = float(np.median(edge_lengths(body.points, body.corner_cells)))
    return np.asarray(points.outside > max(_ROUGH * body.size, _ROUGH_OF_EDGE * edge))


def embed(body: Body, points: ArrayLike) -> Embedding:
    """The embedding of points in a body.

    Args:
        body: the body at rest.
        points: positions at rest, (p, 3), metres.

    Raises:
        ValueError: wrong shape, numbers that are not finite, or curved cells.
    """
    positions = np.asarray(points, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"points: expected shape (p, 3), got {positions.shape}.")
    if not np.isfinite(positions).all():
        raise ValueError("points: expected finite coordinates, got NaN or infinity.")
    positions = positions.copy()
    cells = _containing_cells(body, positions)
    outside = np.zeros(len(positions))
    lost = np.flatnonzero(cells < 0)
    if len(lost):
        cells[lost], positions[lost], outside[lost] = _nearest(body, positions[lost])
    if not body.is_straight:
        raise ValueError("body: expected straight cells, got curved ones; points are found in linear cells alone.")
    weights = shape_functions(body.kind, _local_coordinates(body, cells, positions))[0]
    return Embedding(cells, body.cells[cells], weights, outside, len(body.points))


@dataclass(frozen=True, eq=False)
class Outer:
    """The organ's own surface, and how the nodes move it.

    Args:
        rest: at rest: the boundary of the cells with the body's node numbers, or the skin that they carry.
        weights: of the nodes for each vertex of a skin, (v, n); None where the vertices are the nodes themselves.
    """

    rest: Surface
    weights: csr_array | None

    def carried(self, field: ArrayLike) -> Floats:
        """A nodal field, (n, k), at the vertices, (v, k)."""
        values = np.asarray(field, dtype=np.float64)
        return values if self.weights is None else self.weights @ values

    def spread(self, forces: Floats) -> Floats:
        """Nodal forces, (n, k), that do the same work as forces on the vertices, (v, k)."""
        return forces if self.weights is None else self.weights.T @ forces

    def along_normals(self, traction: Floats) -> Floats:
        """Nodal forces, (n, 3), newtons, of an outward traction along the normal at rest, linear in each triangle.

        Args:
            traction: at the vertices, (v,), pascals.
        """
        triangles = self.rest.triangles
        corners, values = self.rest.points[triangles], traction[triangles]
        areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        shares = (values + values.sum(axis=1, keepdims=True)) / 12.0
        forces = np.zeros_like(self.rest.points)
        np.add.at(forces, triangles.ravel(), (shares[:, :, None] * areas[:, None, :]).reshape(-1, 3))
        return self.spread(forces)

    def moved(self, displacement: ArrayLike) -> Surface:
        """The surface after the nodes have moved.

        Args:
            displacement: of the nodes, (n, 3), metres.
        """
        return Surface(self.rest.points + self.carried(displacement), self.rest.triangles)

    @cached_property
    def vertices(self) -> Ints:
        """Numbers of the vertices in use, sorted."""
        return np.unique(self.rest.triangles)

    def vertices_of(self, nodes: ArrayLike) -> Ints:
        """Numbers of the vertices that the given nodes alone move, sorted."""
        if self.weights is None:
            return np.intersect1d(nodes, self.vertices)
        others = np.ones(self.weights.shape[1])
        others[np.asarray(nodes)] = 0.0
        return np.flatnonzero(self.weights @ others <= _NO_WEIGHT)

    def nodes_of(self, vertices: ArrayLike) -> Ints:
        """Numbers of the nodes that move the given vertices, sorted."""
        chosen = np.asarray(vertices, dtype=np.int64)
        if self.weights is None:
            return np.unique(chosen)
        touched = np.zeros(self.weights.shape[0])
        touched[chosen] = 1.0
        return np.flatnonzero(self.weights.T @ touched > _NO_WEIGHT)


@lru_cache(maxsize=16)
def outer(body: Body) -> Outer:
    """The organ's own surface: the skin where the body has one, else the boundary of its cells; kept for each body.

    Args:
        body: the body at rest.
    """
    if body.skin is None:
        return Outer(body.boundary_surface, None)
    return Outer(body.skin, embed(body, body.skin.points).matrix)


def outer_nodes(body: Body) -> Ints:
    """Numbers of the nodes that move the organ's own surface, sorted.

    Args:
        body: the body.
    """
    return body.boundary_nodes if body.skin is None else outer(body).nodes_of(outer(body).vertices)


def carried(body: Body, displacement: ArrayLike) -> dict[str, Surface]:
    """The inner surfaces of a body after its nodes have moved.

    Args:
        body: the body at rest.
        displacement: nodal displacements, (n, 3), metres.

    Raises:
        ValueError: another shape.
    """
    return {
        name: Surface(surface.points + embed(body, surface.points).displace(displacement), surface.triangles)
        for name, surface in body.inner.items()
    }


def target_points(body: Body) -> dict[str, Embedding]:
    """Embeddings of the vertices of the inner surfaces, by name: what target errors are measured at."""
    return {name: embed(body, surface.points) for name, surface in body.inner.items()}


def _containing_cells(body: Body, points: Floats) -> Ints:
    """Number of the cell around each point, -1 where there is none."""
    cells, numbers = _candidates(body, points)
    depths = _depths(body, cells, points[numbers])
    # Of a point's candidates the one in which it lies deepest: sorted last, written last.
    order = np.argsort(depths, kind="stable")
    found, depth = np.full(len(points), -1), np.full(len(points), -np.inf)
    found[numbers[order]] = cells[order]
    depth[numbers[order]] = depths[order]
    return np.where(depth >= -_TOLERANCE, found, -1)


def _candidates(body: Body, points: Floats) -> tuple[Ints, Ints]:
    """Pairs of cell number and point number such that the point lies in the cell's bounding box."""
    corners = body.points[body.corner_cells]
    low, high = corners.min(axis=1), corners.max(axis=1)
    slack = _TOLERANCE * body.size
    near = cKDTree(points).query_ball_point((low + high) / 2, np.linalg.norm(high - low, axis=1) / 2 + slack)
    cells = np.repeat(np.arange(len(body.cells)), [len(found) for found in near])
    numbers = np.fromiter(chain.from_iterable(near), dtype=np.int64, count=len(cells))
    boxed = ((points[numbers] >= low[cells] - slack) & (points[numbers] <= high[cells] + slack)).all(axis=1)
    return cells[boxed], numbers[boxed]


def _depths(body: Body, cells: Ints, points: Floats) -> Floats:
    """Smallest local coordinate of each point in its cell: not negative inside."""
    xi = _local_coordinates(body, cells, points)
    across = 1 - xi.sum(axis=1, keepdims=True) if body.is_tetrahedral else 1 - xi
    return np.minimum(xi, across).min(axis=1)


def _nearest(body: Body, points: Floats) -> tuple[Ints, Floats, Floats]:
    """Cells at the nearest points of the boundary, these points and their distances."""
    from .closest import closest_points  # VTK: training and prediction on a machine without it never come here

    nearest, triangles = closest_points(body.boundary_surface, points)
    distances = np.linalg.norm(points - nearest, axis=1)
    return _owners(body)[triangles], nearest, distances


def _owners(body: Body) -> Ints:
    """Number of the cell behind each triangle of the boundary."""
    local = np.array(body.kind.facets)
    pieces = split_facets(body.cells[:, local].reshape(-1, local.shape[1]), body.kind.pieces)
    per_cell = len(pieces) // len(body.cells)
    known = {tuple(corners): i // per_cell for i, corners in enumerate(pieces.tolist())}
    return np.array([known[tuple(corners)] for corners in body.boundary.tolist()])


def _local_coordinates(body: Body, cells: Ints, points: Floats) -> Floats:
    """Coordinates in the reference cell, (p, 3), of straight cells; in cubes by Newton's method on its map."""
    kind, corners = linear_kind(body.kind), body.points[body.corner_cells[cells]]
    if body.is_tetrahedral:
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        found: Floats = np.linalg.solve(edges, (points - corners[:, 0])[:, :, None])[:, :, 0]
        return found
    xi = np.full((len(points), 3), 0.5)
    for _ in range(_NEWTON_STEPS):
        values, slopes = shape_functions(kind, xi)
        gap = points - np.einsum("pk,pki->pi", values, corners)
        jacobian = np.einsum("pki,pkj->pij", corners, slopes)
        step = np.linalg.solve(jacobian, gap[:, :, None])[:, :, 0]
        xi = np.clip(xi + step, -0.25, 1.25)  # farther out the map may fold over
        if np.abs(step).max(initial=0.0) < _STEP_TOLERANCE:
            break
    return xi
