"""The body: a volume mesh in metres with its fixed nodes, named sets, surfaces and embedded inner surfaces."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Local faces of a cell, wound so that their normals point outward (VTK numbering).
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
HEXAHEDRON_FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
# The three neighbours of every corner of a hexahedron, right-handed: their triple product is the corner's Jacobian.
_HEXAHEDRON_CORNERS = np.array(
    [[0, 1, 3, 4], [1, 2, 0, 5], [2, 3, 1, 6], [3, 0, 2, 7], [4, 7, 5, 0], [5, 4, 6, 1], [6, 5, 7, 2], [7, 6, 4, 3]]
)


class BodyError(ValueError):
    """A mesh that cannot be a body: the message names the argument, what was expected and what came."""


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array = np.ascontiguousarray(array)
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle surface.

    Args:
        points: vertex positions, (n, 3), metres.
        triangles: vertex numbers, (t, 3).

    Raises:
        BodyError: wrong shapes, indices out of range, or numbers that are not finite.
    """

    points: Floats
    triangles: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _checked_points("Surface.points", self.points))
        triangles = _checked_indices("Surface.triangles", self.triangles, len(self.points))
        if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
            raise BodyError(f"Surface.triangles: expected shape (t, 3) with t >= 1, got {triangles.shape}.")
        object.__setattr__(self, "triangles", _frozen(triangles))

    @property
    def area(self) -> float:
        """Total area, square metres."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    @property
    def volume(self) -> float:
        """Signed enclosed volume, cubic metres: positive when the triangles wind outward."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


@dataclass(frozen=True, eq=False)
class Body:
    """A volume mesh that can be deformed: checked when it is built, never changed after.

    Args:
        points: node positions at rest, (n, 3), metres.
        cells: node numbers in VTK order, (m, 4) for tetrahedra or (m, 8) for hexahedra.
        node_sets: named node numbers; `fixed` is required and holds the nodes with zero displacement.
        surfaces: named sets of boundary triangles as node numbers, (t, 3), for instance `observed`.
        inner: named inner surfaces (vessels, tumours) that the volume carries along.

    Raises:
        BodyError: shapes, index ranges, inverted cells, stray nodes, several components, `fixed` empty,
            everything, or not on the boundary.
    """

    points: Floats
    cells: Ints
    node_sets: Mapping[str, Ints]
    surfaces: Mapping[str, Ints] = field(default_factory=dict)
    inner: Mapping[str, Surface] = field(default_factory=dict)

    def __post_init__(self) -> None:
        points = _checked_points("Body.points", self.points)
        cells = _checked_indices("Body.cells", self.cells, len(points))
        if cells.ndim != 2 or cells.shape[1] not in (4, 8) or len(cells) == 0:
            raise BodyError(f"Body.cells: expected shape (m, 4) or (m, 8) with m >= 1, got {cells.shape}.")
        _check_cells(points, cells)
        sets = {name: _checked_set(name, nodes, len(points)) for name, nodes in self.node_sets.items()}
        surfaces = {name: _checked_triangles(name, tris, len(points)) for name, tris in self.surfaces.items()}
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "cells", _frozen(cells))
        object.__setattr__(self, "node_sets", MappingProxyType(sets))
        object.__setattr__(self, "surfaces", MappingProxyType(surfaces))
        object.__setattr__(self, "inner", MappingProxyType(dict(self.inner)))
        self._check_fixed()

    def _check_fixed(self) -> None:
        fixed = self.node_sets.get("fixed", np.empty(0, dtype=np.int64))
        if len(fixed) < 3:
            raise BodyError(
                f"Body.node_sets['fixed']: expected at least 3 fixed nodes, got {len(fixed)}; "
                "without them the body can move rigidly and has no equilibrium."
            )
        if len(fixed) == len(self.points):
            raise BodyError("Body.node_sets['fixed']: every node is fixed, nothing can move.")
        if not np.isin(fixed, self.boundary_nodes).any():
            raise BodyError(
                f"Body.node_sets['fixed']: none of the {len(fixed)} fixed nodes lies on the boundary of the body; "
                "expected an attachment that touches its surface."
            )

    @property
    def fixed(self) -> Ints:
        """Numbers of the nodes with zero displacement, sorted."""
        return self.node_sets["fixed"]

    @cached_property
    def free(self) -> Ints:
        """Numbers of the nodes that may move, sorted."""
        return _frozen(np.setdiff1d(np.arange(len(self.points)), self.fixed))

    @property
    def is_tetrahedral(self) -> bool:
        """True for tetrahedra, False for hexahedra."""
        return self.cells.shape[1] == 4

    @cached_property
    def boundary(self) -> Ints:
        """Triangles of the boundary as node numbers, (t, 3), wound outward (quadrilaterals are split in two)."""
        local = TETRAHEDRON_FACES if self.is_tetrahedral else HEXAHEDRON_FACES
        faces = self.cells[:, local].reshape(-1, local.shape[1])
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        outer = faces[np.sort(first[count == 1])]
        if self.is_tetrahedral:
            return _frozen(outer)
        return _frozen(np.stack([outer[:, [0, 1, 2]], outer[:, [0, 2, 3]]], axis=1).reshape(-1, 3))

    @cached_property
    def boundary_nodes(self) -> Ints:
        """Numbers of the nodes on the boundary, sorted."""
        return _frozen(np.unique(self.boundary))

    @property
    def boundary_surface(self) -> Surface:
        """The boundary as a surface of its own, with the body's node numbers kept."""
        return Surface(self.points, self.boundary)

    @property
    def volume(self) -> float:
        """Volume at rest, cubic metres."""
        return Surface(self.points - self.points.mean(axis=0), self.boundary).volume

    @property
    def size(self) -> float:
        """Diagonal of the bounding box, metres."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of points, cells and fixed nodes: two bodies with the same one have the same equilibria."""
        digest = hashlib.sha256()
        for array in (self.points, self.cells, self.fixed):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def with_sets(self, **sets: ArrayLike) -> Body:
        """The same body with more named node sets (a name that is there already is replaced)."""
        return replace(self, node_sets={**self.node_sets, **{k: np.asarray(v) for k, v in sets.items()}})

    def with_inner(self, **surfaces: Surface) -> Body:
        """The same body with more embedded inner surfaces."""
        return replace(self, inner={**self.inner, **surfaces})


def _checked_points(name: str, points: ArrayLike) -> Floats:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise BodyError(f"{name}: expected shape (n, 3) with n >= 1, got {array.shape}.")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array).all(axis=1)).sum())
        raise BodyError(f"{name}: expected finite coordinates, got {bad} rows with NaN or infinity.")
    return _frozen(array)


def _checked_indices(name: str, indices: ArrayLike, count: int) -> Ints:
    array = np.asarray(indices)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise BodyError(f"{name}: expected whole numbers, got {array.dtype}.")
    array = array.astype(np.int64)
    if array.size and (array.min() < 0 or array.max() >= count):
        raise BodyError(f"{name}: expected node numbers in 0..{count - 1}, got {array.min()}..{array.max()}.")
    return array


def _checked_set(name: str, nodes: ArrayLike, count: int) -> Ints:
    return _frozen(np.unique(_checked_indices(f"Body.node_sets[{name!r}]", nodes, count)))


def _checked_triangles(name: str, triangles: ArrayLike, count: int) -> Ints:
    array = _checked_indices(f"Body.surfaces[{name!r}]", triangles, count)
    if array.ndim != 2 or array.shape[1] != 3:
        raise BodyError(f"Body.surfaces[{name!r}]: expected shape (t, 3), got {array.shape}.")
    return _frozen(array)


def corner_jacobians(points: Floats, cells: Ints) -> Floats:
    """Triple products of the edges at the corners of each cell, (m, 1) for tetrahedra, (m, 8) for hexahedra, m^3."""
    corners = np.array([[0, 1, 2, 3]]) if cells.shape[1] == 4 else _HEXAHEDRON_CORNERS
    origin, x, y, z = (points[cells[:, corners[:, i]]] for i in range(4))
    return np.einsum("mci,mci->mc", x - origin, np.cross(y - origin, z - origin))


def _check_cells(points: Floats, cells: Ints) -> None:
    stray = np.setdiff1d(np.arange(len(points)), cells)
    if len(stray):
        raise BodyError(
            f"Body.points: expected every node to belong to a cell, got {len(stray)} stray nodes, first {stray[:5]}."
        )
    jacobians = corner_jacobians(points, cells).min(axis=1)
    bad = np.flatnonzero(jacobians <= 0.0)
    if len(bad):
        raise BodyError(
            f"Body.cells: expected cells of positive volume, got {len(bad)} inverted or flat ones of {len(cells)}, "
            f"first {bad[:5]}; a mesh whose cells are all inverted has another node order."
        )
    edges = coo_array(
        (np.ones(cells.size), (np.repeat(cells[:, 0], cells.shape[1]), cells.ravel())),
        shape=(len(points), len(points)),
    )
    count, labels = connected_components(edges, directed=False)
    if count > 1:
        sizes = np.sort(np.bincount(labels))[::-1]
        raise BodyError(
            f"Body.cells: expected one connected component, got {count} with {sizes[:5].tolist()} nodes; "
            "keep the largest or build one body each."
        )
