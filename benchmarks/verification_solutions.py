"""Studies against what is known exactly: closed forms, patch tests, manufactured solutions. Used by verification.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from verification_cases import (
    Floats,
    box,
    cylinder,
    facet_samples,
    first_piola,
    pressure_kind,
    sample,
    shaken,
    shape_functions,
    sphere,
    tube,
    waved,
    whole,
)
from verification_cases import gauss as gauss_points

from softtwin.meshes.body import Body
from softtwin.reference.data.materials import Energy, LinearElastic, Material, MooneyRivlin, SaintVenantKirchhoff, lame
from softtwin.reference.solve.problem import Loading, NewtonOptions, Problem

TIGHT = NewtonOptions(tolerance=1e-12)
STRETCH, SHEAR, TWIST = 1.5, 0.6, 0.8
Row = dict[str, Any]


def orders(sizes: Sequence[float], errors: Sequence[float]) -> list[float]:
    """Observed order of convergence from each mesh to the next: log(error ratio) / log(size ratio)."""
    return [float(x) for x in np.diff(np.log(errors)) / np.diff(np.log(sizes))]


def _constants(material: Material) -> tuple[float, float]:
    """Mooney and Rivlin's c1 and c2 of an incompressible material."""
    p: Any = material.parameters
    return (p["shear_modulus"] / 2, 0.0) if "shear_modulus" in p else (p["c1"], p["c2"])


# ---------------------------------------------------------------------- uniform stretch and shear


def lateral_stretch(material: Material, stretch: float) -> float:
    """The stretch across a bar whose sides are free: closed, or where the lateral stress of the textbook vanishes."""
    if material.is_mixed:
        return stretch**-0.5
    if isinstance(material, LinearElastic):
        return 1 - material.poisson_ratio * (stretch - 1)
    if isinstance(material, SaintVenantKirchhoff):
        return float(np.sqrt(1 - material.poisson_ratio * (stretch**2 - 1)))
    return float(
        brentq(lambda s: first_piola(material, np.diag([stretch, s, s]))[1, 1], 0.3, 1.7, xtol=1e-15, rtol=1e-15)
    )


def bar_stress(material: Material, stretch: float) -> float:
    """Force per area at rest of a stretched bar (Holzapfel 2000, ch. 6; Odot 2023, 2.4)."""
    if material.is_mixed:
        c1, c2 = _constants(material)
        return 2 * (c1 + c2 / stretch) * (stretch - stretch**-2)
    if isinstance(material, LinearElastic):
        return material.young_modulus * (stretch - 1)
    if isinstance(material, SaintVenantKirchhoff):
        return material.young_modulus * stretch * (stretch**2 - 1) / 2
    across = lateral_stretch(material, stretch)
    return float(first_piola(material, np.diag([stretch, across, across]))[0, 0])


def uniaxial(material: Material, kind: str, stretch: float = STRETCH) -> Row:
    """Deviations of the lateral stretch and of the reaction of a bar from the closed form; the cells are distorted."""
    body = box(kind, 2, shaken)
    held = {"x0": "x", "y0": "y", "z0": "z", "x1": "x"}
    with Problem(body, material, TIGHT, held=held) as problem:
        state = problem.solve(Loading(displacement={"x1": (stretch - 1, 0, 0)}), stability=False)
        reaction = problem.internal_forces(state)[body.node_sets["x1"], 0].sum()
    across = 1 + state.displacement[body.node_sets["y1"], 1]
    expected, stress = lateral_stretch(material, stretch), bar_stress(material, stretch)
    return {
        "lateral_stretch": float(across.mean()),
        "lateral_error": float(np.abs(across - expected).max()),
        "stress": float(reaction),
        "stress_error": float(abs(reaction / stress - 1)),
    }


def shear_stress(material: Material, shear: float) -> float:
    """P_12 (and sigma_12) in simple shear (Rivlin 1948; Saint-Venant-Kirchhoff and Demiray by their S)."""
    p: Any = material.parameters
    if material.is_mixed:
        return 2 * sum(_constants(material)) * shear
    if isinstance(material, MooneyRivlin):
        return 2 * (p["c1"] + p["c2"]) * shear
    if isinstance(material, Energy):
        return p["mu"] * shear * float(np.exp(p["b"] * shear**2))
    mu, lmbda = lame(p["young_modulus"], p["poisson_ratio"])
    if isinstance(material, SaintVenantKirchhoff):
        return shear * (mu + (lmbda / 2 + mu) * shear**2)
    return mu * shear


def simple_shear(material: Material, kind: str, shear: float = SHEAR) -> Row:
    """Deviations of the mean stress in simple shear from the closed forms, and from sigma_11 - sigma_22 = g sigma_12.

    The mean stress is the virial of the nodal forces, sum f_i X_j = P_ij V; the last is Rivlin's universal relation of
    isotropic materials.
    """
    body = box(kind, 2, shaken)
    F = np.eye(3)
    F[0, 1] = shear
    u = body.points @ (F - np.eye(3)).T
    with Problem(body, material, TIGHT, held={"boundary": "xyz"}) as problem:
        state = problem.solve(Loading(displacement={"boundary": u[body.node_sets["boundary"]]}), stability=False)
        P = problem.internal_forces(state).T @ body.points
    sigma, expected = P @ F.T, shear_stress(material, shear)
    textbook = first_piola(material, F)
    return {
        "stress": float(P[0, 1]),
        "stress_error": float(abs(P[0, 1] / expected - 1)),
        "all_error": float(np.abs(P - textbook).max() / np.abs(textbook).max()),
        "universal_error": float(abs(sigma[0, 0] - sigma[1, 1] - shear * sigma[0, 1]) / abs(sigma[0, 1])),
    }


# ---------------------------------------------------------------------- torsion


def twisted(body: Body, material: Material, angle: float, is_finite: bool = True) -> tuple[float, float]:
    """Torque and axial force that twist a cylinder's far end by an angle per length, its length kept.

    Rotations are finite, or small as linear elasticity knows them.
    """
    end = body.node_sets["z1"]
    x, y, z = body.points[end].T
    turn = angle * z
    if is_finite:
        u = np.stack([x * np.cos(turn) - y * np.sin(turn) - x, x * np.sin(turn) + y * np.cos(turn) - y, 0 * z], -1)
    else:
        u = np.stack([-turn * y, turn * x, 0 * z], -1)
    with Problem(body, material, TIGHT, held={"z0": "xyz", "z1": "xyz"}) as problem:
        state = problem.solve(Loading(displacement={"z1": u}), stability=False)
        forces = problem.internal_forces(state)[end]
    arm = body.points[end] + (u if is_finite else 0.0)
    return float((arm[:, 0] * forces[:, 1] - arm[:, 1] * forces[:, 0]).sum()), float(forces[:, 2].sum())


def torsion(material: Material, divisions: Sequence[int], twist: float = TWIST) -> Row:
    """Torque and axial force of an incompressible cylinder of radius and length 1 on finer and finer curved meshes.

    M = pi (c1 + c2) t R^4 and N = -pi/2 (c1 + 2 c2) t^2 R^4 for the twist t per length (Rivlin 1949).
    """
    c1, c2 = _constants(material)
    moment, thrust = np.pi * (c1 + c2) * twist, -np.pi / 2 * (c1 + 2 * c2) * twist**2
    found = np.array([twisted(cylinder(n, 1.0, 1.0), material, twist) for n in divisions])
    errors = np.abs(found / [moment, thrust] - 1)
    sizes = [1 / n for n in divisions]
    return {
        "divisions": list(divisions),
        "torque": found[:, 0].tolist(),
        "torque_error": errors[:, 0].tolist(),
        "torque_orders": orders(sizes, errors[:, 0]),
        "force_error": errors[:, 1].tolist(),
        "force_orders": orders(sizes, errors[:, 1]),
    }


def small_torsion(material: Material, twists: Sequence[float] = (0.2, 0.1, 0.05)) -> Row:
    """How the torque of a compressible cylinder meets mu t pi R^4 / 2 as the twist shrinks, on one mesh of hexahedra.

    The second moment of the polygonal section is taken from linear elasticity on the same mesh.
    """
    body = _corners_only(cylinder(2, 1.0, 1.0))
    linear = LinearElastic(1.0, 0.3)
    stiffness = twisted(body, linear, 1.0, is_finite=False)[0]
    gaps = [abs(twisted(body, material, t)[0] / (stiffness * t) - 1) for t in twists]
    return {"twists": list(twists), "gaps": gaps, "orders": orders(twists, gaps)}


def _corners_only(body: Body) -> Body:
    used, cells = np.unique(body.corner_cells, return_inverse=True)
    where = np.full(len(body.points), -1)
    where[used] = np.arange(len(used))
    sets = {name: where[nodes][where[nodes] >= 0] for name, nodes in body.node_sets.items()}
    return Body(body.points[used], cells.reshape(body.corner_cells.shape), sets)


# ---------------------------------------------------------------------- inflation


@dataclass(frozen=True)
class Inflation:
    """A thick incompressible wall blown up by an inner pressure; `shape` is `tube` (plane strain) or `sphere`."""

    shape: str
    c1: float
    c2: float
    inner: float = 1.0
    outer: float = 2.0
    stretch: float = 1.3

    def radius(self, R: Floats) -> Floats:
        """Radius after the deformation: the enclosed volume grows alike everywhere."""
        power = 2 if self.shape == "tube" else 3
        return (R**power + self.inner**power * (self.stretch**power - 1)) ** (1 / power)

    def radial_stress(self, R: Any) -> Any:
        """sigma_rr; zero outside, minus the inner pressure inside (Rivlin 1949; Green and Shield 1950).

        Tube: -mu (ln(B r / (R b)) + K/2 (1/r^2 - 1/b^2)) with K = a^2 - A^2 and mu = 2 (c1 + c2). Sphere:
        g(outer stretch) - g(stretch) with g = -c1 (4/l + 1/l^4) + 4 c2 (l - 1/(2 l^2)).
        """
        r, b = self.radius(np.asarray(R)), self.radius(np.asarray(self.outer))
        if self.shape == "tube":
            K = self.inner**2 * (self.stretch**2 - 1)
            return -2 * (self.c1 + self.c2) * (np.log(self.outer * r / (R * b)) + K / 2 * (r**-2 - b**-2))

        def g(x: Any) -> Any:
            return -self.c1 * (4 / x + x**-4) + 4 * self.c2 * (x - x**-2 / 2)

        return g(b / self.outer) - g(r / R)

    def pressure(self, R: Floats) -> Floats:
        """The mean pressure that the mixed materials have as an unknown: p = dev(sigma)_rr - sigma_rr."""
        s = self.radius(R) / R
        b = np.stack([s**-2, s**2, np.ones_like(s)] if self.shape == "tube" else [s**-4, s**2, s**2])
        deviator = 2 * self.c1 * (b[0] - b.mean(axis=0)) - 2 * self.c2 * (1 / b[0] - (1 / b).mean(axis=0))
        return deviator - self.radial_stress(R)


def inflation(shape: str, material: Material, kind: str, divisions: Sequence[int]) -> Row:
    """Errors of radius, displacement (L2) and pressure (L2) of an inflated wall, mesh by mesh, with their orders.

    The load is the closed form's pressure, which follows the surface; the symmetry planes hold their normal.
    """
    wall = Inflation(shape, *_constants(material), stretch=1.3 if shape == "tube" else 1.25)
    rows = [_inflated(wall, material, kind, n) for n in divisions]
    sizes, errors = [1 / n for n in divisions], np.array(rows).T
    names = ("radius", "displacement", "pressure")
    found: Row = {"divisions": list(divisions), "inner_pressure": float(-wall.radial_stress(wall.inner))}
    for name, values in zip(names, errors, strict=True):
        found |= {f"{name}_error": values.tolist(), f"{name}_orders": orders(sizes, values)}
    return found


def _inflated(wall: Inflation, material: Material, kind: str, n: int) -> tuple[float, float, float]:
    body = (tube if wall.shape == "tube" else sphere)(n, wall.inner, wall.outer, kind)
    held = {f"{axis}0": axis for axis in "xyz"[: body.dimension]}
    with Problem(body, material, TIGHT, held=held) as problem:
        state = problem.solve(Loading(pressure={"inside": -float(wall.radial_stress(wall.inner))}), stability=False)
    assert state.pressure is not None

    def moved(X: Floats) -> Floats:
        R = np.linalg.norm(X, axis=-1, keepdims=True)
        return (wall.radius(R) / R - 1) * X

    inside = body.node_sets["inside"]
    radii = np.linalg.norm((body.points + state.displacement)[inside], axis=1)
    u_error, _ = field_errors(body, state.displacement, moved, None)
    p_error = pressure_error(body, state.pressure, lambda X: wall.pressure(np.linalg.norm(X, axis=-1)))
    return float(abs(radii.mean() / (wall.stretch * wall.inner) - 1)), u_error, p_error


# ---------------------------------------------------------------------- errors of fields


def field_errors(body: Body, u: Floats, exact: Callable[[Floats], Floats], gradient: Any) -> tuple[float, float]:
    """Norms of a displacement's error: L2, and the L2 norm of its gradient's (0 where `gradient` is None)."""
    at = sample(body, body.kind.degree + 2)
    nodal = u[body.cells]
    gap = np.einsum("qk,mki->mqi", at.values, nodal) - exact(at.points)
    first = float(np.sqrt((at.weights * (gap**2).sum(-1)).sum()))
    if gradient is None:
        return first, 0.0
    slope = np.einsum("mqkj,mki->mqij", at.gradients, nodal) - gradient(at.points)
    return first, float(np.sqrt((at.weights * (slope**2).sum((-1, -2))).sum()))


def pressure_error(body: Body, p: Floats, exact: Callable[[Floats], Floats]) -> float:
    """L2 norm of the error of a pressure that is linear between the corners."""
    at = sample(body, 4)
    N, _ = shape_functions(pressure_kind(body), gauss_points(body.kind.shape, 4)[0])
    gap = np.einsum("qk,mk->mq", N, p[body.corner_cells]) - exact(at.points)
    return float(np.sqrt((at.weights * gap**2).sum()))


# ---------------------------------------------------------------------- patch tests

PATCH = np.array([[1.25, 0.2, -0.1], [-0.15, 0.85, 0.1], [0.1, -0.05, 1.1]])


def _patch_gradient(dimension: int, isochoric: bool) -> Floats:
    """A deformation gradient far from the identity, in the body's dimension; of determinant 1 where asked."""
    F = PATCH[:dimension, :dimension]
    return F / np.linalg.det(F) ** (1 / dimension) if isochoric else F


def bent(body: Body, share: float = 0.04) -> Body:
    """The body with its inner mid-side nodes moved at random, so that cells are curved."""
    inner = np.setdiff1d(np.arange(len(body.points)), np.union1d(body.boundary_nodes, body.corner_cells))
    points = body.points.copy()
    points[inner] += share * np.random.default_rng(5).uniform(-1, 1, (len(inner), body.dimension))
    return replace(body, points=points)


def patch(material: Material, kind: str, are_curved: bool = False) -> Row:
    """A uniform deformation prescribed on the boundary: how far the inside is from it, and its forces from zero."""
    body = box(kind, 2 if kind in ("tetra10", "hexahedron27") else 3, shaken)
    body = bent(body) if are_curved else body
    F = _patch_gradient(body.dimension, isochoric=False)
    u = body.points @ (F - np.eye(body.dimension)).T
    edge = body.node_sets["boundary"]
    with Problem(body, material, TIGHT, held={"boundary": "xyz"[: body.dimension]}) as problem:
        state = problem.solve(Loading(displacement={"boundary": u[edge]}), stability=False)
        forces = problem.internal_forces(state)
    row = _patch_row(body, state, u, forces, edge)
    if state.pressure is None:
        return row
    pressure = (1 - np.linalg.det(F)) / material.parameters["compressibility"]
    return row | {"pressure_error": float(np.abs(state.pressure / pressure - 1).max())}


def _patch_row(body: Body, state: Any, u: Floats, forces: Floats, outer: Any) -> Row:
    inner = np.setdiff1d(np.arange(len(body.points)), outer)
    return {
        "inner_nodes": len(inner),
        "displacement_error": float(np.abs(state.displacement - u).max() / np.abs(u).max()),
        "force_error": float(np.abs(forces[inner]).max() / np.abs(forces).max()),
    }


def patch_with_traction(material: Material, kind: str, pressure: float = 0.3) -> Row:
    """A uniform deformation of an incompressible body, held at all sides but one, where the exact traction acts."""
    body = box(kind, 2, shaken)
    walls = np.unique(
        np.concatenate([nodes for name, nodes in body.node_sets.items() if name[0] in "xyz" and name != "x1"])
    )
    body = body.with_sets(walls=walls)
    F = _patch_gradient(body.dimension, isochoric=True)
    u = body.points @ (F - np.eye(body.dimension)).T
    P = first_piola(material, whole(F - np.eye(body.dimension)), pressure)
    load = Loading(displacement={"walls": u[walls]}, traction={"x1": P[: body.dimension, 0]})
    with Problem(body, material, TIGHT, held={"walls": "xyz"[: body.dimension]}) as problem:
        state = problem.solve(load, stability=False)
        forces = problem.internal_forces(state)
    row = _patch_row(body, state, u, forces, body.node_sets["boundary"])
    return row | {"pressure_error": float(np.abs(state.pressure / pressure - 1).max())}


# ---------------------------------------------------------------------- manufactured solutions


@dataclass(frozen=True, eq=False)
class Waves:
    """u_i = A sin(k_i . X + c_i): a smooth displacement, moderately large; complex positions are allowed."""

    dimension: int
    height: float = 0.12
    _waves = np.array([[1.7, 1.1, -0.6], [-0.9, 1.5, 0.8], [0.7, -1.2, 1.6]])
    _phases = np.array([0.3, 1.1, -0.4])

    def _angles(self, X: NDArray[Any]) -> NDArray[Any]:
        d = self.dimension
        return X @ self._waves[:d, :d].T + self._phases[:d]

    def displacement(self, X: NDArray[Any]) -> NDArray[Any]:
        """(..., d)."""
        return self.height * np.sin(self._angles(X))

    def gradient(self, X: NDArray[Any]) -> NDArray[Any]:
        """(..., d, d)."""
        return self.height * np.cos(self._angles(X))[..., None] * self._waves[: self.dimension, : self.dimension]

    def pressure(self, X: NDArray[Any]) -> NDArray[Any]:
        """No unknown here."""
        return 0.0 * X[..., 0]


@dataclass(frozen=True, eq=False)
class Shears:
    """Shears one after another, each along an axis by a sine of the others: J = 1 exactly, with a smooth pressure."""

    dimension: int
    height: float = 0.15
    _waves = np.array([[0.0, 1.6, 0.7], [1.8, 0.0, -0.8], [1.1, 0.9, 0.0]])

    def _steps(self, X: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        d = self.dimension
        x, F = X + 0.0, np.broadcast_to(np.eye(d), (*X.shape, d)) + 0.0 * X[..., None]
        for i in range(d):
            wave = self._waves[i, :d]
            angle = x @ wave + 0.4
            F[..., i, :] += self.height * np.cos(angle)[..., None] * np.einsum("j,...jk->...k", wave, F)
            x[..., i] += self.height * np.sin(angle)
        return x, F

    def displacement(self, X: NDArray[Any]) -> NDArray[Any]:
        """(..., d)."""
        return self._steps(X)[0] - X

    def gradient(self, X: NDArray[Any]) -> NDArray[Any]:
        """(..., d, d)."""
        return self._steps(X)[1] - np.eye(self.dimension)

    def pressure(self, X: NDArray[Any]) -> NDArray[Any]:
        """Positive in compression."""
        return 0.2 * np.cos(X @ np.array([1.3, 2.1, -0.9])[: self.dimension])


def exact_stress(material: Material, field: Any, X: NDArray[Any]) -> NDArray[Any]:
    """First Piola-Kirchhoff stress of a field at points (..., d), in the body's dimension."""
    P = first_piola(material, whole(field.gradient(X)), field.pressure(X))
    return P[..., : X.shape[-1], : X.shape[-1]]


def body_force(material: Material, field: Any, X: Floats) -> Floats:
    """The body force -Div P, exact to round-off: columns by complex steps (Squire and Trapp 1998)."""
    step = 1e-30
    total = np.zeros(X.shape)
    for j in range(X.shape[-1]):
        shifted = X.astype(complex)
        shifted[..., j] += 1j * step
        total -= exact_stress(material, field, shifted)[..., j].imag / step
    return total


def consistent_forces(body: Body, material: Material, field: Any, free_side: str | None) -> Floats:
    """Nodal forces of the varying body force, and of the exact traction on a side that is free."""
    at = sample(body, body.kind.degree + 2)
    shares = np.einsum("mq,mqi,qk->mki", at.weights, body_force(material, field, at.points), at.values)
    forces = np.zeros_like(body.points)
    np.add.at(forces, body.cells, shares)
    if free_side is not None:
        X, area, N, facets = facet_samples(body, free_side, body.kind.degree + 2)
        traction = np.einsum("fqij,fqj->fqi", exact_stress(material, field, X), area)
        np.add.at(forces, facets, np.einsum("fqi,qk->fki", traction, N))
    return forces


def manufactured(material: Material, kind: str, divisions: Sequence[int]) -> Row:
    """Errors of a manufactured solution mesh by mesh with their orders; for mixed materials also of the pressure.

    Displacements are prescribed on the whole boundary; an incompressible body, whose boundary could not keep its volume
    exactly, is free at the side x1, where it carries the exact traction.
    """
    rows = np.array([_manufactured(material, kind, n) for n in divisions]).T
    sizes = [1 / n for n in divisions]
    names = ("L2", "H1", "pressure") if material.is_mixed else ("L2", "H1")
    found: Row = {"divisions": list(divisions)}
    for name, values in zip(names, rows, strict=False):
        found |= {f"{name}_error": values.tolist(), f"{name}_orders": orders(sizes, values)}
    return found


def _manufactured(material: Material, kind: str, n: int) -> tuple[float, float, float]:
    body = box(kind, n, waved)
    field: Any = (Shears if material.is_mixed else Waves)(body.dimension)
    free_side = "x1" if material.is_mixed else None
    outside = body.node_sets["boundary"]
    if free_side is not None:
        outside = np.unique(np.concatenate([body.node_sets[s] for s in body.surfaces if s != free_side]))
    body = body.with_sets(outside=outside)
    forces = consistent_forces(body, material, field, free_side)
    forces[outside] = 0.0
    u = field.displacement(body.points)
    with Problem(body, material, NewtonOptions(tolerance=1e-10), held={"outside": "xyz"[: body.dimension]}) as problem:
        state = problem.solve(Loading(forces=forces, displacement={"outside": u[outside]}), stability=False)
    first, second = field_errors(body, state.displacement, field.displacement, field.gradient)
    if state.pressure is None:
        return first, second, 0.0
    return first, second, pressure_error(body, state.pressure, field.pressure)
