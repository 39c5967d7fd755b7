"""The kinds of cells: shapes, nodes in VTK's order, faces; and a body's linear cells made quadratic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Kind:
    """One kind of cell.

    Args:
        name: its name in meshio.
        vtk: its number in VTK.
        shape: `triangle`, `quadrilateral`, `tetrahedron` or `hexahedron`.
        dimension: of the space it fills.
        degree: of its shape functions.
        nodes: nodes of a cell.
        corners: those that are corners; they come first.
        facets: local nodes of each facet, outward, corners first then mid-side nodes (VTK's numbering).
        pieces: local nodes in a facet of the linear triangles (edges in the plane) that make it up.
        parents: corners whose mean is the rest position of each further node of a straight cell.
    """

    name: str
    vtk: int
    shape: str
    dimension: int
    degree: int
    nodes: int
    corners: int
    facets: tuple[tuple[int, ...], ...]
    pieces: tuple[tuple[int, ...], ...]
    parents: tuple[tuple[int, ...], ...] = ()


_TETRAHEDRON_EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
_HEXAHEDRON_EDGES = (
    *((0, 1), (1, 2), (2, 3), (3, 0)),
    *((4, 5), (5, 6), (6, 7), (7, 4)),
    *((0, 4), (1, 5), (2, 6), (3, 7)),
)
_TETRAHEDRON_FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
_HEXAHEDRON_FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
# VTK numbers the face centres of its 27-node hexahedron by the sides -x, +x, -y, +y, -z, +z.
_HEXAHEDRON_CENTRES = ((0, 3, 7, 4), (1, 2, 6, 5), (0, 1, 5, 4), (3, 2, 6, 7), (0, 1, 2, 3), (4, 5, 6, 7))


def _with_middles(
    facets: tuple[tuple[int, ...], ...], parents: tuple[tuple[int, ...], ...], corners: int
) -> tuple[tuple[int, ...], ...]:
    """Facets with their mid-side nodes (and centre, where the cell has one) after their corners."""
    node = {frozenset(group): corners + i for i, group in enumerate(parents)}
    whole = []
    for facet in facets:
        sides = [(facet[i], facet[(i + 1) % len(facet)]) for i in range(len(facet))] if len(facet) > 2 else [facet]
        middles = [node[frozenset(side)] for side in sides]
        centre = [node[frozenset(facet)]] if len(facet) > 2 and frozenset(facet) in node else []
        whole.append((*facet, *middles, *centre))
    return tuple(whole)


def _quadratic(
    name: str, vtk: int, linear: Kind, parents: tuple[tuple[int, ...], ...], pieces: tuple[tuple[int, ...], ...]
) -> Kind:
    return Kind(
        name,
        vtk,
        linear.shape,
        linear.dimension,
        2,
        linear.corners + len(parents),
        linear.corners,
        _with_middles(linear.facets, parents, linear.corners),
        pieces,
        parents,
    )


_TRIANGLE = Kind("triangle", 5, "triangle", 2, 1, 3, 3, ((0, 1), (1, 2), (2, 0)), ((0, 1),))
_QUADRILATERAL = Kind("quad", 9, "quadrilateral", 2, 1, 4, 4, ((0, 1), (1, 2), (2, 3), (3, 0)), ((0, 1),))
_TETRAHEDRON = Kind("tetra", 10, "tetrahedron", 3, 1, 4, 4, _TETRAHEDRON_FACES, ((0, 1, 2),))
_HEXAHEDRON = Kind("hexahedron", 12, "hexahedron", 3, 1, 8, 8, _HEXAHEDRON_FACES, ((0, 1, 2), (0, 2, 3)))
_SPLIT_EDGE = ((0, 2), (2, 1))
_SPLIT_TRIANGLE = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
_SPLIT_QUADRILATERAL = (
    *((0, 4, 8), (0, 8, 7), (4, 1, 5), (4, 5, 8)),
    *((8, 5, 2), (8, 2, 6), (7, 8, 6), (7, 6, 3)),
)
_LINEAR = (_TRIANGLE, _QUADRILATERAL, _TETRAHEDRON, _HEXAHEDRON)
_QUADRATIC = (
    _quadratic("triangle6", 22, _TRIANGLE, ((0, 1), (1, 2), (2, 0)), _SPLIT_EDGE),
    _quadratic("quad9", 28, _QUADRILATERAL, ((0, 1), (1, 2), (2, 3), (3, 0), (0, 1, 2, 3)), _SPLIT_EDGE),
    _quadratic("tetra10", 24, _TETRAHEDRON, _TETRAHEDRON_EDGES, _SPLIT_TRIANGLE),
    _quadratic(
        "hexahedron27",
        29,
        _HEXAHEDRON,
        (*_HEXAHEDRON_EDGES, *_HEXAHEDRON_CENTRES, (0, 1, 2, 3, 4, 5, 6, 7)),
        _SPLIT_QUADRILATERAL,
    ),
)
KINDS: dict[tuple[int, int], Kind] = {(kind.dimension, kind.nodes): kind for kind in (*_LINEAR, *_QUADRATIC)}


def linear_kind(kind: Kind) -> Kind:
    """The linear kind of the same shape."""
    return next(linear for linear in _LINEAR if linear.shape == kind.shape)


def quadratic_kind(kind: Kind) -> Kind:
    """The quadratic kind of the same shape."""
    return next(quadratic for quadratic in _QUADRATIC if quadratic.shape == kind.shape)


def split_facets(facets: Ints, pieces: tuple[tuple[int, ...], ...]) -> Ints:
    """The linear pieces of facets: (f, k) node numbers to (f * pieces, 3) triangles, or 2 for edges in the plane."""
    return facets[:, np.array(pieces)].reshape(-1, len(pieces[0]))
