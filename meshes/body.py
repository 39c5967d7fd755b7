"""The body: a mesh in metres with its fixed nodes, named sets, surfaces and embedded inner surfaces."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .elements import KINDS, Kind, quadratic_kind, split_facets

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Local faces of a cell, wound so that their normals point outward (VTK numbering).
TETRAHEDRON_FACES = np.array(KINDS[3, 4].facets)
HEXAHEDRON_FACES = np.array(KINDS[3, 8].facets)
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
    """A mesh that can be deformed: checked when it is built, never changed after.

    Args:
        points: node positions at rest, (n, 3), metres; (n, 2) for a section in plane strain.
        cells: node numbers in VTK order: (m, 4) or (m, 10) for tetrahedra, (m, 8) or (m, 27) for hexahedra; in the
            plane (m, 3) or (m, 6) for triangles, (m, 4) or (m, 9) for quadrilaterals.
        node_sets: named node numbers; `fixed` holds the nodes with zero displacement. A body without that name is
            held by what its problem says.
        surfaces: named sets of boundary triangles as node numbers, (t, 3), for instance `observed`; of boundary edges,
            (t, 2), in the plane; of the skin's triangles as its vertex numbers, where there is a skin.
        inner: named inner surfaces (vessels, tumours) that the volume carries along.
        fractions: filled share of each cell of a sparse grid, (m,), in (0, 1]: what is integrated over a cell counts
            so much; None where all cells are full.
        skin: the organ's own surface at rest where the cells do not end on it: they carry it (a sparse grid); what is
            seen and touched is there (see `embedding.outer`). None where the boundary of the cells is that surface.

    Raises:
        BodyError: shapes, index ranges, fractions out of range, inverted cells, stray nodes, several components,
            `fixed` too small, everything, or not on the boundary.
    """

    points: Floats
    cells: Ints
    node_sets: Mapping[str, Ints]
    surfaces: Mapping[str, Ints] = field(default_factory=dict)
    inner: Mapping[str, Surface] = field(default_factory=dict)
    fractions: Floats | None = None
    skin: Surface | None = None

    def __post_init__(self) -> None:
        points = _checked_points("Body.points", self.points, (2, 3))
        cells = _checked_indices("Body.cells", self.cells, len(points))
        if cells.ndim != 2 or (points.shape[1], cells.shape[1]) not in KINDS or len(cells) == 0:
            widths = " or ".join(f"(m, {nodes})" for dimension, nodes in sorted(KINDS) if dimension == points.shape[1])
            raise BodyError(f"Body.cells: expected shape {widths} with m >= 1, got {cells.shape}.")
        kind = KINDS[points.shape[1], cells.shape[1]]
        _check_cells(points, cells, kind)
        sets = {name: _checked_set(name, nodes, len(points)) for name, nodes in self.node_sets.items()}
        vertices = points if self.skin is None else self.skin.points
        surfaces = {name: _checked_facets(name, f, vertices) for name, f in self.surfaces.items()}
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "cells", _frozen(cells))
        object.__setattr__(self, "node_sets", MappingProxyType(sets))
        object.__setattr__(self, "surfaces", MappingProxyType(surfaces))
        object.__setattr__(self, "inner", MappingProxyType(dict(self.inner)))
        if self.fractions is not None:
            object.__setattr__(self, "fractions", _checked_fractions(self.fractions, len(cells)))
        self._check_fixed()

    def __reduce__(self) -> tuple[type[Body], tuple[Any, ...]]:
        """Bodies can be sent to other processes, where they are checked anew."""
        named = dict(self.node_sets), dict(self.surfaces), dict(self.inner)
        return Body, (self.points, self.cells, *named, self.fractions, self.skin)

    def _check_fixed(self) -> None:
        if "fixed" not in self.node_sets:
            return
        fixed, least = self.fixed, self.dimension
        if len(fixed) < least:
            raise BodyError(
                f"Body.node_sets['fixed']: expected at least {least} fixed nodes, got {len(fixed)}; "
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
    def kind(self) -> Kind:
        """Shape and degree of the cells."""
        return KINDS[self.points.shape[1], self.cells.shape[1]]

    @property
    def dimension(self) -> int:
        """3, or 2 for a section in plane strain."""
        return int(self.points.shape[1])

    @property
    def corner_cells(self) -> Ints:
        """The corners of the cells: (m, 4) or (m, 8); (m, 3) or (m, 4) in the plane."""
        return self.cells[:, : self.kind.corners]

    @cached_property
    def is_straight(self) -> bool:
        """True when all further nodes of quadratic cells lie half-way between their corners."""
        if self.kind.degree == 1:
            return True
        middles = _middles(self.points, self.cells, self.kind)
        return bool(np.abs(self.points[self.cells[:, self.kind.corners :]] - middles).max() <= 1e-12 * self.size)

    @property
    def fixed(self) -> Ints:
        """Numbers of the nodes with zero displacement, sorted."""
        return self.node_sets.get("fixed", np.empty(0, dtype=np.int64))

    @cached_property
    def free(self) -> Ints:
        """Numbers of the nodes that may move, sorted."""
        return _frozen(np.setdiff1d(np.arange(len(self.points)), self.fixed))

    @property
    def is_tetrahedral(self) -> bool:
        """True for tetrahedra."""
        return self.kind.shape == "tetrahedron"

    @cached_property
    def facets(self) -> Ints:
        """Facets of the boundary as node numbers, (f, k): corners first, wound outward."""
        local = np.array(self.kind.facets)
        facets = self.cells[:, local].reshape(-1, local.shape[1])
        _, first, count = np.unique(np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True)
        return _frozen(facets[np.sort(first[count == 1])])

    @cached_property
    def boundary(self) -> Ints:
        """Triangles of the boundary as node numbers, (t, 3), wound outward; edges, (t, 2), in the plane.

        Quadrilaterals and quadratic facets are split along their nodes.
        """
        return _frozen(split_facets(self.facets, self.kind.pieces))

    def facets_of(self, surface: str) -> Ints:
        """The facets of the boundary that make up a named surface, (f, k).

        Raises:
            BodyError: no such surface, or it holds a part of a facet, or what is no part of the boundary.
        """
        if surface not in self.surfaces:
            raise BodyError(f"Body.surfaces: expected one of {sorted(self.surfaces)}, got {surface!r}.")
        width = len(self.kind.pieces[0])
        wanted = _rows(self.surfaces[surface])
        inside = np.isin(_rows(self.boundary), wanted).reshape(len(self.facets), -1)
        if (
            inside.any(axis=1).sum() * inside.shape[1] != len(np.unique(wanted))
            or (inside.any(axis=1) != inside.all(axis=1)).any()
        ):
            raise BodyError(
                f"Body.surfaces[{surface!r}]: expected whole facets of the boundary "
                f"({inside.shape[1]} pieces of {width} nodes each), got {len(wanted)} pieces that do not make them up."
            )
        return self.facets[inside.all(axis=1)]

    @cached_property
    def boundary_nodes(self) -> Ints:
        """Numbers of the nodes on the boundary, sorted."""
        return _frozen(np.unique(self.facets))

    @cached_property
    def boundary_tree(self) -> cKDTree:
        """The boundary nodes, to be asked for the nearest ones."""
        return cKDTree(self.points[self.boundary_nodes])

    @property
    def boundary_surface(self) -> Surface:
        """The boundary as a surface of its own, with the body's node numbers kept."""
        return Surface(self.points, self.boundary)

    @property
    def volume(self) -> float:
        """Volume at rest, cubic metres; area, square metres, in the plane.

        Of a sparse grid the filled part, exact for its cells, whose edges are parallel.
        """
        if self.fractions is not None:
            return float(self.fractions @ (corner_jacobians(self.points, self.corner_cells).mean(axis=1) * self._share))
        centred = self.points - self.points.mean(axis=0)
        if self.dimension == 3:
            return Surface(centred, self.boundary).volume
        a, b = centred[self.boundary[:, 0]], centred[self.boundary[:, 1]]
        return float(0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())

    @property
    def _share(self) -> float:
        """Volume of a cell with parallel edges, relative to the triple product of its edges."""
        return {"triangle": 1 / 2, "tetrahedron": 1 / 6}.get(self.kind.shape, 1.0)

    @cached_property
    def size(self) -> float:
        """Diagonal of the bounding box, metres."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of points, cells, fixed nodes, fractions: two bodies with the same one have the same equilibria."""
        digest = hashlib.sha256()
        fractions = () if self.fractions is None else (self.fractions,)
        for array in (self.points, self.cells, self.fixed, *fractions):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def with_sets(self, **sets: ArrayLike) -> Body:
        """The same body with more named node sets (a name that is there already is replaced)."""
        checked = {name: _checked_set(name, np.asarray(nodes), len(self.points)) for name, nodes in sets.items()}
        other = self._alike(node_sets=MappingProxyType({**self.node_sets, **checked}))
        for name in ("free", "fingerprint"):
            other.__dict__.pop(name, None)
        if "fixed" in sets:
            other._check_fixed()
        return other

    def with_surfaces(self, **surfaces: ArrayLike) -> Body:
        """The same body with more named parts of its surface (a name that is there already is replaced)."""
        vertices = self.points if self.skin is None else self.skin.points
        checked = {name: _checked_facets(name, np.asarray(part), vertices) for name, part in surfaces.items()}
        return self._alike(surfaces=MappingProxyType({**self.surfaces, **checked}))

    def with_inner(self, **surfaces: Surface) -> Body:
        """The same body with more embedded inner surfaces."""
        return self._alike(inner=MappingProxyType({**self.inner, **surfaces}))

    def _alike(self, **changes: Any) -> Body:
        """The same cells with other names, which are checked already: what is known of the cells is not found anew."""
        other = object.__new__(Body)
        other.__dict__.update(self.__dict__)
        other.__dict__.update(changes)
        return other

    def quadratic(self) -> Body:
        """The same body with quadratic cells: the nodes that are there keep their numbers, further ones follow.

        A new node belongs to a named set when it lies on a facet of the boundary, or in a cell, whose corners all do.
        """
        if self.kind.degree == 2:
            return self
        kind = quadratic_kind(self.kind)
        cells, points = _quadratic_cells(self.points, self.cells, kind)
        local = np.array(kind.facets)
        by_corners = cells[:, local].reshape(-1, local.shape[1])
        width = self.facets.shape[1]
        outer = by_corners[np.isin(_rows(by_corners[:, :width]), _rows(self.facets))]
        groups = [(outer, width), (cells, kind.corners)]
        sets = {
            name: np.unique(np.concatenate([s, *(_whole(*g, s) for g in groups)])) for name, s in self.node_sets.items()
        }
        surfaces = {} if self.skin is None else dict(self.surfaces)
        for name in () if self.skin is not None else self.surfaces:
            chosen = np.isin(_rows(outer[:, :width]), _rows(self.facets_of(name)))
            surfaces[name] = split_facets(outer[chosen], kind.pieces)
        return Body(points, cells, sets, surfaces, self.inner, self.fractions, self.skin)


def _checked_points(name: str, points: ArrayLike, dimensions: tuple[int, ...] = (3,)) -> Floats:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in dimensions or len(array) == 0:
        shapes = " or ".join(f"(n, {dimension})" for dimension in dimensions[::-1])
        raise BodyError(f"{name}: expected shape {shapes} with n >= 1, got {array.shape}.")
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


def _checked_fractions(fractions: ArrayLike, count: int) -> Floats:
    array = np.asarray(fractions, dtype=np.float64)
    if array.shape != (count,):
        raise BodyError(f"Body.fractions: expected one number for each of the {count} cells, got shape {array.shape}.")
    if not ((array > 0.0) & (array <= 1.0)).all():
        raise BodyError(f"Body.fractions: expected numbers in (0, 1], got {array.min()} to {array.max()}.")
    return _frozen(array)


def _checked_set(name: str, nodes: ArrayLike, count: int) -> Ints:
    return _frozen(np.unique(_checked_indices(f"Body.node_sets[{name!r}]", nodes, count)))


def _checked_facets(name: str, facets: ArrayLike, points: Floats) -> Ints:
    array = _checked_indices(f"Body.surfaces[{name!r}]", facets, len(points))
    if array.ndim != 2 or array.shape[1] != points.shape[1]:
        raise BodyError(f"Body.surfaces[{name!r}]: expected shape (t, {points.shape[1]}), got {array.shape}.")
    return _frozen(array)


def _rows(table: Ints) -> NDArray[np.void]:
    """Each row as one value, whatever the order of its nodes."""
    ordered = np.ascontiguousarray(np.sort(table, axis=1))
    return ordered.view(np.dtype((np.void, ordered.dtype.itemsize * ordered.shape[1]))).ravel()


def _whole(groups: Ints, corners: int, members: Ints) -> Ints:
    """All nodes of the groups whose corners are all members."""
    return groups[np.isin(groups[:, :corners], members).all(axis=1)].ravel()


def _middles(points: Floats, cells: Ints, kind: Kind) -> Floats:
    """Where the further nodes of straight cells lie, (m, k - corners, d)."""
    return np.stack([points[cells[:, list(group)]].mean(axis=1) for group in kind.parents], axis=1)


def _quadratic_cells(points: Floats, cells: Ints, kind: Kind) -> tuple[Ints, Floats]:
    """Cells with their further nodes numbered after the old ones, and all points."""
    parents = np.full((len(cells), len(kind.parents), 8), -1)
    for i, group in enumerate(kind.parents):
        parents[:, i, : len(group)] = np.sort(cells[:, list(group)], axis=1)
    _, first, number = np.unique(parents.reshape(-1, 8), axis=0, return_index=True, return_inverse=True)
    further = len(points) + number.reshape(len(cells), -1)
    whole = np.concatenate([cells, further], axis=1)
    return whole, np.concatenate([points, _middles(points, cells, kind).reshape(-1, points.shape[1])[first]])


def corner_jacobians(points: Floats, cells: Ints) -> Floats:
    """Triple products of the edges at the corners of each linear cell, m^3 (cross products, m^2, in the plane).

    The shape is (m, 1) for triangles and tetrahedra, (m, 4) for quadrilaterals, (m, 8) for hexahedra.
    """
    if points.shape[1] == 2:
        count = cells.shape[1]
        last = [[i, (i + 1) % count, (i - 1) % count] for i in range(1 if count == 3 else count)]
        origin, x, y = (points[cells[:, np.array(last)[:, i]]] for i in range(3))
        return (x - origin)[..., 0] * (y - origin)[..., 1] - (x - origin)[..., 1] * (y - origin)[..., 0]
    corners = np.array([[0, 1, 2, 3]]) if cells.shape[1] == 4 else _HEXAHEDRON_CORNERS
    origin, x, y, z = (points[cells[:, corners[:, i]]] for i in range(4))
    return np.einsum("mci,mci->mc", x - origin, np.cross(y - origin, z - origin))


def _check_cells(points: Floats, cells: Ints, kind: Kind) -> None:
    stray = np.setdiff1d(np.arange(len(points)), cells)
    if len(stray):
        raise BodyError(
            f"Body.points: expected every node to belong to a cell, got {len(stray)} stray nodes, first {stray[:5]}."
        )
    jacobians = corner_jacobians(points, cells[:, : kind.corners]).min(axis=1)
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
            "keep one (of a file: --component 1 is the largest) or build one body each."
        )
