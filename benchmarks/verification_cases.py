"""Bodies, materials, textbook stresses and a quadrature for verification.py, independent of FEniCSx's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import ufl
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.elements import KINDS, Kind, linear_kind, split_facets
from softtwin.reference.data.materials import (
    Energy,
    IncompressibleMooneyRivlin,
    IncompressibleNeoHookean,
    IsochoricNeoHookean,
    LinearElastic,
    Material,
    MooneyRivlin,
    NeoHookean,
    SaintVenantKirchhoff,
    bulk,
    lame,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Map = Callable[[Floats], Floats]

PLANE = ("triangle", "triangle6", "quad", "quad9")
SPACE = ("tetra", "tetra10", "hexahedron", "hexahedron27")
QUADRATIC = ("triangle6", "quad9", "tetra10", "hexahedron27")
_KIND = {kind.name: kind for kind in KINDS.values()}
_CORNERS = {
    "line": [[0], [1]],
    "triangle": [[0, 0], [1, 0], [0, 1]],
    "quadrilateral": [[0, 0], [1, 0], [1, 1], [0, 1]],
    "tetrahedron": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "hexahedron": [[*xy, z] for z in (0, 1) for xy in ([0, 0], [1, 0], [1, 1], [0, 1])],
}
_CUBES = {2: _KIND["quad"], 3: _KIND["hexahedron"]}
# Simplices of a square and of a cube around a diagonal; copies side by side share their facets (Kuhn).
_SIMPLICES = {
    2: ((0, 1, 2), (0, 2, 3)),
    3: ((0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)),
}


# ---------------------------------------------------------------------- materials and their stresses


def demiray(F: Any, mu: Any, b: Any, k: Any) -> Any:
    """Demiray's exponential energy of soft tissue with the split, in UFL: the studies' energy of a user's own.

    psi = mu/(2 b) (exp(b (J_1 - 3)) - 1) + k/2 (J - 1)^2 (Demiray 1972, J. Biomech. 5).
    """
    J = ufl.det(F)
    return mu / (2 * b) * (ufl.exp(b * (J ** (-2 / 3) * ufl.inner(F, F) - 3)) - 1) + k / 2 * (J - 1) ** 2


def compressible(young_modulus: float = 1.0, poisson_ratio: float = 0.3) -> dict[str, Material]:
    """The materials without a pressure of their own, alike for small strains."""
    mu, _ = lame(young_modulus, poisson_ratio)
    k = bulk(young_modulus, poisson_ratio)
    return {
        "linear elastic": LinearElastic(young_modulus, poisson_ratio),
        "Saint-Venant-Kirchhoff": SaintVenantKirchhoff(young_modulus, poisson_ratio),
        "Neo-Hookean": NeoHookean(young_modulus, poisson_ratio),
        "isochoric Neo-Hookean": IsochoricNeoHookean(young_modulus, poisson_ratio),
        "Mooney-Rivlin": MooneyRivlin.from_elastic(young_modulus, poisson_ratio, share=0.6),
        "own energy (Demiray)": Energy(demiray, {"mu": mu, "b": 0.5, "k": k}),
    }


def incompressible(compressibility: float = 0.0) -> dict[str, Material]:
    """The mixed materials, both of shear modulus 0.4."""
    return {
        "incompressible Neo-Hookean": IncompressibleNeoHookean(0.4, compressibility),
        "incompressible Mooney-Rivlin": IncompressibleMooneyRivlin(0.12, 0.08, compressibility),
    }


def _transposed(tensor: NDArray[Any]) -> NDArray[Any]:
    return np.swapaxes(tensor, -1, -2)


def _invariants(F: NDArray[Any]) -> tuple[Any, ...]:
    """F^-T, J, C, I_1, I_2 with axes kept for products with tensors."""
    C = _transposed(F) @ F
    I1 = np.trace(C, axis1=-2, axis2=-1)[..., None, None]
    I2 = (I1**2 - np.trace(C @ C, axis1=-2, axis2=-1)[..., None, None]) / 2
    return _transposed(np.linalg.inv(F)), np.linalg.det(F)[..., None, None], C, I1, I2


def _isochoric(F: NDArray[Any], c1: Any, c2: Any) -> NDArray[Any]:
    """First Piola-Kirchhoff stress of c1 (J_1 - 3) + c2 (J_2 - 3)."""
    T, J, C, I1, I2 = _invariants(F)
    first = 2 * c1 * J ** (-2 / 3) * (F - I1 / 3 * T)
    return first + 2 * c2 * J ** (-4 / 3) * (I1 * F - F @ C - 2 * I2 / 3 * T)


def first_piola(material: Material, F: NDArray[Any], pressure: Any = 0.0) -> NDArray[Any]:
    """First Piola-Kirchhoff stress written out by hand (Holzapfel 2000, ch. 6), not by UFL; complex F are allowed.

    Args:
        material: one of the above.
        F: deformation gradients, (..., 3, 3).
        pressure: of an incompressible material, (...,), positive in compression.
    """
    p: Any = material.parameters
    T, J, C, I1, _ = _invariants(F)
    if isinstance(material, IncompressibleNeoHookean | IncompressibleMooneyRivlin):
        c1 = p["shear_modulus"] / 2 if "shear_modulus" in p else p["c1"]
        return _isochoric(F, c1, p.get("c2", 0.0)) - np.asarray(pressure)[..., None, None] * J * T
    if isinstance(material, MooneyRivlin):
        return _isochoric(F, p["c1"], p["c2"]) + p["bulk_modulus"] * J * (J - 1) * T
    if isinstance(material, Energy):
        stiffening = np.exp(p["b"] * (J ** (-2 / 3) * I1 - 3))
        return stiffening * _isochoric(F, p["mu"] / 2, 0.0) + p["k"] * J * (J - 1) * T
    mu, lmbda = lame(p["young_modulus"], p["poisson_ratio"])
    if isinstance(material, NeoHookean):
        return mu * (F - T) + lmbda * np.log(J) * T
    if isinstance(material, IsochoricNeoHookean):
        return _isochoric(F, mu / 2, 0.0) + bulk(p["young_modulus"], p["poisson_ratio"]) * J * (J - 1) * T
    identity = np.eye(3)
    e = (F + _transposed(F)) / 2 - identity if isinstance(material, LinearElastic) else (C - identity) / 2
    S = lmbda * np.trace(e, axis1=-2, axis2=-1)[..., None, None] * identity + 2 * mu * e
    return S if isinstance(material, LinearElastic) else F @ S


# ---------------------------------------------------------------------- bodies


def reference_nodes(kind: Kind) -> Floats:
    """Nodes of the reference cell in VTK's order, (k, d), coordinates 0, 1/2 and 1."""
    corners = np.array(_CORNERS[kind.shape], dtype=float)
    return np.array([*corners, *(corners[list(group)].mean(axis=0) for group in kind.parents)])


def _lattice(divisions: Sequence[int], degree: int) -> tuple[Floats, Ints]:
    """Nodes of a grid of the unit square or cube, and its cells in VTK's order."""
    counts = [degree * n + 1 for n in divisions]
    points = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in counts), indexing="ij"), -1)
    kind = KINDS[len(divisions), (degree + 1) ** len(divisions)]
    offsets = np.rint(degree * reference_nodes(kind)).astype(int)
    starts = degree * np.array(list(product(*map(range, divisions))))
    numbers = np.arange(np.prod(counts)).reshape(counts)
    return points.reshape(-1, len(divisions)), numbers[tuple((starts[:, None] + offsets[None]).transpose(2, 0, 1))]


def sides(body: Body) -> Body:
    """The body with node sets and surfaces x0, x1, y0, ... of its bounding box, and the set `boundary`."""
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    ends = {f"{'xyz'[i]}{j}": (i, (low, high)[j][i]) for i in range(body.dimension) for j in (0, 1)}
    on = {name: np.abs(body.points[:, i] - at) < 1e-9 * body.size for name, (i, at) in ends.items()}
    sets = {name: np.flatnonzero(mask) for name, mask in on.items()}
    surfaces = {
        name: split_facets(body.facets[mask[body.facets].all(axis=1)], body.kind.pieces)
        for name, mask in on.items()
        if mask[body.facets].all(axis=1).any()
    }
    return replace(body, node_sets={**sets, "boundary": body.boundary_nodes}, surfaces=surfaces)


def box(kind: str, divisions: Sequence[int] | int, move: Map | None = None, side_sets: bool = True) -> Body:
    """The unit square or cube in cells of a kind.

    Args:
        kind: its name, `tetra10` for instance; further nodes of quadratic cells lie half-way.
        divisions: squares or cubes along each axis; each holds two triangles or six tetrahedra.
        move: where the corners go.
        side_sets: give it the sets and surfaces of `sides`.
    """
    wanted = _KIND[kind]
    each = (divisions,) * wanted.dimension if isinstance(divisions, int) else divisions
    points, cells = _lattice(each, 1)
    if wanted.shape in ("triangle", "tetrahedron"):
        cells = cells[:, np.array(_SIMPLICES[wanted.dimension])].reshape(-1, wanted.dimension + 1)
    body = Body(points if move is None else move(points), cells, {})
    body = body.quadratic() if wanted.degree == 2 else body
    return sides(body) if side_sets else body


def shaken(points: Floats, share: float = 0.12) -> Floats:
    """Inner nodes of a grid of the unit square or cube moved at random by up to a share of its spacing."""
    spacing = np.diff(np.unique(np.round(points[:, 0], 12))).min()
    inner = ((points > 1e-9) & (points < 1 - 1e-9)).all(axis=1)
    noise = np.random.default_rng(3).uniform(-share * spacing, share * spacing, points.shape)
    return points + np.where(inner[:, None], noise, 0.0)


def waved(points: Floats, height: float = 0.06) -> Floats:
    """The unit square or cube with inner points moved by a smooth map, so that refined cells are distorted alike."""
    bump = np.prod(np.sin(np.pi * points), axis=1)
    skew = np.sin(2 * np.pi * points[:, 0])
    return points + height * np.stack([bump * (1 + skew / 2), bump * (1 - skew / 2), bump], -1)[:, : points.shape[1]]


def curved(blocks: Sequence[Map], divisions: Sequence[int], kind: str) -> Body:
    """Blocks, each a map of the unit square or cube, in one body of curved quadratic cells.

    Args:
        blocks: maps; nodes that they put at the same place become one.
        divisions: cells along each axis of a block.
        kind: `quad9`, `hexahedron27`, or simplices that split them (`triangle6`, `tetra10`).
    """
    wanted = _KIND[kind]
    lattice, cells = _lattice(divisions, 2)
    points = np.concatenate([block(lattice) for block in blocks])
    cells = np.concatenate([cells + i * len(lattice) for i in range(len(blocks))])
    if wanted.shape in ("triangle", "tetrahedron"):
        cells = cells[:, _split_quadratic(wanted)].reshape(-1, wanted.nodes)
    _, first, number = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    used, cells = np.unique(number.ravel()[cells], return_inverse=True)
    return Body(points[first[used]], cells.reshape(-1, wanted.nodes), {})


def _split_quadratic(kind: Kind) -> Ints:
    """Local nodes of the quadratic simplices in a 9-node square or a 27-node cube."""
    cube = reference_nodes(KINDS[kind.dimension, 3**kind.dimension])
    found = []
    for corners in _SIMPLICES[kind.dimension]:
        nodes = [cube[list(corners)]] + [cube[[corners[i] for i in group]].mean(axis=0)[None] for group in kind.parents]
        found.append([int(np.abs(cube - x).sum(axis=1).argmin()) for x in np.concatenate(nodes)])
    return np.array(found)


def tube(n: int, inner: float, outer: float, kind: str = "quad9") -> Body:
    """A quarter of a ring, x and y not negative: sets x0 and y0, surface `inside`; n cells along and across."""

    def ring(s: Floats) -> Floats:
        r, angle = inner + (outer - inner) * s[:, 0], np.pi / 2 * s[:, 1]
        return np.stack([r * np.cos(angle), r * np.sin(angle)], -1)

    return _pressed(curved([ring], (n, n), kind), inner)


def sphere(n: int, inner: float, outer: float, kind: str = "hexahedron27") -> Body:
    """An octant of a hollow sphere in three blocks: sets x0, y0 and z0, surface `inside`; n cells along each axis."""
    axes = np.eye(3)

    def block(turn: int) -> Map:
        a, b, c = np.roll(axes, -turn, axis=0)
        corners = [a, (a + b) / np.sqrt(2), (a + b + c) / np.sqrt(3), (a + c) / np.sqrt(2)]

        def around(s: Floats) -> Floats:
            x, y = s[:, 1, None], s[:, 2, None]
            flat = (1 - x) * (1 - y) * corners[0] + x * (1 - y) * corners[1]
            flat = flat + x * y * corners[2] + (1 - x) * y * corners[3]
            return (inner + (outer - inner) * s[:, :1]) * flat / np.linalg.norm(flat, axis=1, keepdims=True)

        return around

    return _pressed(curved([block(turn) for turn in range(3)], (n, n, n), kind), inner)


def _pressed(body: Body, inner: float) -> Body:
    close = np.abs(np.linalg.norm(body.points, axis=1) - inner) < 1e-9
    facets = body.facets[close[body.facets].all(axis=1)]
    planes = {f"{'xyz'[i]}0": np.flatnonzero(np.abs(body.points[:, i]) < 1e-9) for i in range(body.dimension)}
    inside = {"inside": split_facets(facets, body.kind.pieces)}
    return replace(body, node_sets={**planes, "inside": np.flatnonzero(close)}, surfaces=inside)


def cylinder(n: int, radius: float, length: float, kind: str = "hexahedron27") -> Body:
    """A cylinder along z with a square of n x n cells at its core, n cells around it and n along; sets z0, z1."""
    core = radius / 2

    def middle(s: Floats) -> Floats:
        return np.column_stack([core * (2 * s[:, :2] - 1), length * s[:, 2]])

    def petal(turn: int) -> Map:
        c, d = np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)

        def around(s: Floats) -> Floats:
            angle = np.pi / 4 * (2 * s[:, 1] - 1)
            near = core * np.stack([np.ones(len(s)), 2 * s[:, 1] - 1], -1)
            far = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
            flat = (1 - s[:, :1]) * near + s[:, :1] * far
            return np.column_stack([flat @ np.array([[c, d], [-d, c]]), length * s[:, 2]])

        return around

    body = curved([middle, *(petal(turn) for turn in range(4))], (n, n, n), kind)
    ends = {f"z{j}": np.flatnonzero(np.abs(body.points[:, 2] - j * length) < 1e-9) for j in (0, 1)}
    return replace(body, node_sets=ends)


# ---------------------------------------------------------------------- quadrature of its own


def _exponents(shape: str, degree: int) -> Ints:
    dimension = len(_CORNERS[shape][0])
    every = np.array(list(product(range(degree + 1), repeat=dimension)))
    return every[every.sum(axis=1) <= degree] if shape in ("triangle", "tetrahedron") else every


def shape_functions(kind: Kind, at: Floats) -> tuple[Floats, Floats]:
    """Lagrange functions of a reference cell at points (q, d), and their derivatives: (q, k), (q, k, d)."""
    powers = _exponents(kind.shape, kind.degree)

    def monomials(x: Floats) -> Floats:
        return np.prod(x[:, None] ** powers, axis=2)

    weights = np.linalg.inv(monomials(reference_nodes(kind)))
    slopes = []
    for i in range(at.shape[1]):
        lower = powers.copy()
        lower[:, i] = np.maximum(lower[:, i] - 1, 0)
        slopes.append(powers[:, i] * np.prod(at[:, None] ** lower, axis=2) @ weights)
    return monomials(at) @ weights, np.stack(slopes, -1)


def gauss(shape: str, count: int) -> tuple[Floats, Floats]:
    """Points and weights of a reference cell, exact to degree 2 count - 3 at least; simplices as collapsed cubes."""
    x, w = np.polynomial.legendre.leggauss(count)
    dimension = len(_CORNERS[shape][0])
    points = np.array(list(product((x + 1) / 2, repeat=dimension)))
    weights = np.prod(np.array(list(product(w / 2, repeat=dimension))), axis=1)
    if shape in ("triangle", "tetrahedron"):
        left = np.cumprod(np.column_stack([np.ones(len(points)), 1 - points[:, :-1]]), axis=1)
        weights = weights * np.prod(left[:, 1:], axis=1)
        points = points * left
    return points, weights


@dataclass(frozen=True, eq=False)
class Samples:
    """A body's cells at quadrature points.

    Args:
        points: (m, q, d).
        weights: volumes, (m, q).
        values: shape functions, (q, k).
        gradients: their derivatives in space, (m, q, k, d).
    """

    points: Floats
    weights: Floats
    values: Floats
    gradients: Floats


def sample(body: Body, count: int) -> Samples:
    """A body's cells at `count` Gauss points along each axis."""
    at, w = gauss(body.kind.shape, count)
    N, dN = shape_functions(body.kind, at)
    corners = body.points[body.cells]
    jacobians = np.einsum("mki,qkj->mqij", corners, dN)
    return Samples(
        np.einsum("qk,mki->mqi", N, corners),
        w * np.linalg.det(jacobians),
        N,
        np.einsum("qkj,mqji->mqki", dN, np.linalg.inv(jacobians)),
    )


def facet_samples(body: Body, surface: str, count: int) -> tuple[Floats, Floats, Floats, Ints]:
    """Points (f, q, d), outward area vectors (f, q, d), shape functions (q, k) and nodes (f, k) of a surface."""
    facets = body.facets_of(surface)
    kind = _facet_kind(body.kind)
    at, w = gauss(kind.shape, count)
    N, dN = shape_functions(kind, at)
    corners = body.points[facets]
    tangents = np.einsum("fki,qkj->fqij", corners, dN)
    if body.dimension == 3:
        normal = np.cross(tangents[..., 0], tangents[..., 1])
    else:
        normal = np.stack([tangents[..., 1, 0], -tangents[..., 0, 0]], -1)
    return np.einsum("qk,fki->fqi", N, corners), w[:, None] * normal, N, facets


def _facet_kind(kind: Kind) -> Kind:
    if kind.dimension == 3:
        return next(k for k in _KIND.values() if k.dimension == 2 and k.nodes == len(kind.facets[0]))
    parents = ((0, 1),) if kind.degree == 2 else ()
    return replace(kind, name="line", shape="line", dimension=1, nodes=kind.degree + 1, corners=2, parents=parents)


def whole(gradient: Floats) -> Floats:
    """Displacement gradients (..., d, d) as deformation gradients (..., 3, 3); the plane keeps its thickness."""
    d = gradient.shape[-1]
    F = np.zeros((*gradient.shape[:-2], 3, 3), dtype=gradient.dtype)
    F[..., :d, :d] = gradient
    return F + np.eye(3)


def pressure_kind(body: Body) -> Kind:
    """The linear kind that a mixed body's pressure is interpolated with."""
    return linear_kind(body.kind)
