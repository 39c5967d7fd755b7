"""Shape functions of the kinds of cells, and the points and weights that integrate over them."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from .body import Body
from .elements import Kind

Floats = NDArray[np.float64]

# The least that is safe: one point in linear tetrahedra, 2 x 2 x 2 in linear and 3 x 3 x 3 in quadratic hexahedra.
# UFL's own estimate makes a Q1 Neo-Hookean tangent 66 to 127 times dearer.
_DEGREES = {("simplex", 1): 1, ("simplex", 2): 3, ("cube", 1): 3, ("cube", 2): 5}
_MIXED_DEGREES = {"simplex": 4, "cube": 5}
_CURVED_SIMPLEX = 4

# Keast (1986): 14 points, exact to degree 4; barycentric coordinate that three corners share, weight times 6.
_KEAST = ((0.1005267652252045, 0.0885898247429807), (0.3143728734931922, 0.1328387466855907))
# Dunavant (1985): 6 points, exact to degree 4; barycentric coordinate that two corners share, weight times 6.
_DUNAVANT = ((0.445948490915965, 0.670144769034033), (0.091576213509771, 0.329855230965967))
_KEAST_MIDDLES = 2.0 / 105.0


def quadrature_degree(body: Body, mixed: bool = False) -> int:
    """The degree of the quadrature that a body's cells are integrated with.

    Args:
        body: the body.
        mixed: with the pressure as an unknown.
    """
    family = "simplex" if body.kind.shape in ("triangle", "tetrahedron") else "cube"
    if family == "simplex" and not body.is_straight:
        return _CURVED_SIMPLEX
    return _MIXED_DEGREES[family] if mixed else _DEGREES[family, body.kind.degree]


def quadrature(kind: Kind, degree: int) -> tuple[Floats, Floats]:
    """Points in the reference cell, (q, d), and weights, (q,), that integrate polynomials of a degree exactly.

    Lines, quadrilaterals and hexahedra by Gauss and Legendre; triangles by three points (degree 2) or six (degree 4:
    Dunavant 1985); tetrahedra by one point (degree 1), five (degree 3:
    Zienkiewicz and Taylor 2000) or fourteen (degree 4: Keast 1986).

    Args:
        kind: of the cell; its reference cell has corners at 0 and 1.
        degree: of the polynomials.

    Raises:
        ValueError: no rule for the kind and degree.
    """
    if kind.shape in ("quadrilateral", "hexahedron"):
        at, weight = np.polynomial.legendre.leggauss((degree + 2) // 2)
        grid = np.array(list(product(0.5 * (at + 1.0), repeat=kind.dimension)))
        return grid, np.prod(list(product(0.5 * weight, repeat=kind.dimension)), axis=1)
    if kind.shape == "triangle" and degree <= 4:
        return _triangle(degree)
    if kind.shape != "tetrahedron" or degree > 4:
        raise ValueError(f"quadrature: no rule of degree {degree} for a {kind.shape}.")
    if degree <= 1:
        return np.full((1, 3), 0.25), np.full(1, 1.0 / 6.0)
    if degree <= 3:
        points = np.vstack([np.full((1, 3), 0.25), _alike(1.0 / 6.0)])
        return points, np.array([-2.0 / 15.0, *[3.0 / 40.0] * 4])
    middles = np.array([[0.5 * ((i in pair) and i > 0) for i in range(1, 4)] for pair in _PAIRS])
    points = np.vstack([middles, *(_alike(share) for share, _ in _KEAST)])
    return points, np.array([_KEAST_MIDDLES] * 6 + [w for _, w in _KEAST for _ in range(4)]) / 6.0


def _triangle(degree: int) -> tuple[Floats, Floats]:
    """Points and weights of a triangle, degree 4 at most."""
    shares = ((1.0 / 6.0, 1.0),) if degree <= 2 else _DUNAVANT
    points = [np.array([[a, a], [1.0 - 2.0 * a, a], [a, 1.0 - 2.0 * a]]) for a, _ in shares]
    return np.vstack(points), np.repeat([weight / 6.0 for _, weight in shares], 3)


_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def _alike(share: float) -> Floats:
    """The four points of a tetrahedron of which three barycentric coordinates are alike."""
    points = np.full((4, 3), share)
    points[np.arange(3), np.arange(3)] = 1.0 - 3.0 * share
    return points


def shape_functions(kind: Kind, points: Floats) -> tuple[Floats, Floats]:
    """Shape functions at points of the reference cell, (q, k), and their gradients there, (q, k, d), in VTK's order.

    Args:
        kind: of the cell.
        points: in the reference cell, (q, d).
    """
    powers, inverse = _nodal_basis(kind)
    values = np.prod(points[:, None, :] ** powers, axis=2)
    slopes = np.empty((len(points), len(powers), kind.dimension))
    for axis in range(kind.dimension):
        lower = powers.copy()
        lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
        slopes[:, :, axis] = powers[:, axis] * np.prod(points[:, None, :] ** lower, axis=2)
    return values @ inverse, np.einsum("qpd,pk->qkd", slopes, inverse)


@cache
def _nodal_basis(kind: Kind) -> tuple[NDArray[np.int64], Floats]:
    """Powers of the monomials, (k, d), and the matrix from monomials to shape functions, (k, k)."""
    every = list(product(range(kind.degree + 1), repeat=kind.dimension))
    is_simplex = kind.shape in ("triangle", "tetrahedron")
    powers = np.array([p for p in every if not is_simplex or sum(p) <= kind.degree])
    nodes = reference_nodes(kind)
    return powers, np.linalg.inv(np.prod(nodes[:, None, :] ** powers, axis=2))


def reference_nodes(kind: Kind) -> Floats:
    """Where the nodes of a kind are in its reference cell, (k, d), in VTK's order."""
    if kind.shape in ("triangle", "tetrahedron"):
        corners = np.vstack([np.zeros(kind.dimension), np.eye(kind.dimension)])
    else:
        flat = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        layers = [np.column_stack([flat, np.full(4, height)]) for height in (0.0, 1.0)]
        corners = flat if kind.dimension == 2 else np.vstack(layers)
    return np.vstack([corners, *(corners[list(group)].mean(axis=0) for group in kind.parents)])
