"""Studies against published figures, and of locking: Cook's membrane, the thesis's cantilever. For verification.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import ufl
from verification_cases import SPACE, Floats, box, sides
from verification_solutions import Row

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import (
    Energy,
    IncompressibleNeoHookean,
    IsochoricNeoHookean,
    Material,
    NeoHookean,
)
from softtwin.reference.solve.problem import Loading, Problem

SIZE, LOAD = (1.0, 0.25, 0.25), 8.0  # the cantilever, metres, and its tip traction, pascals
YOUNG_MODULUS = 5000.0
NAMES = {
    ("tetra", False): "P1",
    ("hexahedron", False): "Q1",
    ("tetra10", False): "P2",
    ("hexahedron27", False): "Q2",
    ("tetra10", True): "P2-P1",
    ("hexahedron27", True): "Q2-Q1",
}


# ---------------------------------------------------------------------- Cook's membrane


def membrane(kind: str, n: int) -> Body:
    """Cook's membrane, mm: corners (0, 0), (48, 44), (48, 60), (0, 44), n x n cells; sets and surfaces x0, x1, ...

    Cells of space give a slab, 1 mm and one cell thick.
    """

    def taper(s: Floats) -> Floats:
        x, y = s[:, 0], s[:, 1]
        return np.column_stack([48 * x, 44 * x + y * (44 - 28 * x), *s.T[2:]])

    return sides(box(kind, (n, n, 1) if kind in SPACE else n, taper, side_sets=False))


def split_with_logarithm(F: Any, mu: Any, k: Any) -> Any:
    """The energy of deal.II's step 44: mu/2 (J_1 - 3) + k/4 (J^2 - 1 - 2 ln J)."""
    J = ufl.det(F)
    return mu / 2 * (J ** (-2 / 3) * ufl.inner(F, F) - 3) + k / 4 * (J**2 - 1 - 2 * ufl.ln(J))


@dataclass(frozen=True, eq=False)
class Cook:
    """One published version of Cook's membrane; N and mm.

    Args:
        title: what it is.
        source: who publishes the figure.
        traction: upward on the right side, MPa.
        point: where the upward displacement is taken, mm.
        published: the displacement that meshes converge to.
        material: of the elements without a pressure of their own; None where there is none.
        mixed: of the elements with one; None where there is none.
        tables: published displacements of a kind of element by cells along a side.
        scale: of load and displacement, for small strains.
    """

    title: str
    source: str
    traction: float
    point: tuple[float, float]
    published: float
    material: Material | None = None
    mixed: Material | None = None
    tables: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    scale: float = 1.0


def cooks() -> dict[str, Cook]:
    """The versions whose displacement is published."""
    mu, nu = 0.4225, 0.3
    k = 2 * mu * (1 + nu) / (3 * (1 - 2 * nu))
    young, lmbda, G = 240.565, 0.75e4, 0.375
    return {
        "slab": Cook(
            "finite strain, nu = 0.3, slab",
            "deal.II code gallery (Pelteret and McBride 2016, doi 10.5281/zenodo.1228964)",
            1 / 16,
            (48, 60),
            14.33,
            Energy(split_with_logarithm, {"mu": mu, "k": k}),
            tables={
                "hexahedron": {1: 5.15, 2: 8.72, 4: 12.02, 8: 13.61, 16: 14.13},
                "hexahedron27": {1: 12.19, 2: 13.83, 4: 14.22, 8: 14.30},
            },
        ),
        "0.499": Cook(
            "finite strain, nu = 0.499, plane strain",
            "OpenGeoSys, benchmark CooksMembrane of large deformations; limit: 30 x 30 with F-bar, quad: without",
            6.25,
            (48, 60),
            6.8914,
            IsochoricNeoHookean(young, 0.499),
            IncompressibleNeoHookean.from_elastic(young, 0.499),
            tables={"quad": {4: 2.28672, 10: 2.84069, 15: 3.37458, 20: 3.88120}},
        ),
        "0.4999": Cook(
            "finite strain, nu = 0.4999, plane strain",
            "Elguedj et al. 2008, 128 x 128, as quoted in an example of FinEALE",
            6.25,
            (48, 60),
            6.9083,
            mixed=IncompressibleNeoHookean.from_elastic(young, 0.4999),
        ),
        "0.5": Cook(
            "finite strain, nu = 0.5, plane strain",
            "Müller 2015 (thesis, Duisburg-Essen), as quoted in a test case of Elmer FEM",
            0.05,
            (48, 60),
            4.7011,
            mixed=IncompressibleNeoHookean(1.0),
        ),
        "small": Cook(
            "small strain, nu = 0.499975, plane strain",
            "Krysl, FAESOR (extrapolated from six-node triangles)",
            1 / 16,
            (48, 52),
            16.4326,
            mixed=IncompressibleNeoHookean(G, 1 / (lmbda + 2 * G / 3)),
            scale=1e-5,
        ),
    }


def cook(case: Cook, kind: str, n: int, is_mixed: bool = False, both_faces: bool = False) -> float:
    """Upward displacement of the case's point, mm.

    Args:
        case: the version.
        kind: of cells.
        n: cells along each side.
        is_mixed: with the pressure as an unknown.
        both_faces: of a slab keep their plane, which is plane strain; else one does, and the thickness may change.
    """
    material = case.mixed if is_mixed else case.material
    assert material is not None
    body = membrane(kind, n)
    held = {"x0": "xyz", "z0": "z", **({"z1": "z"} if both_faces else {})} if body.dimension == 3 else {"x0": "xy"}
    traction = np.zeros(body.dimension)
    traction[1] = case.scale * case.traction
    with Problem(body, material, held=held) as problem:
        state = problem.solve(Loading(traction={"x1": traction}), stability=False)
    at = np.linalg.norm(body.points - [*case.point, 0][: body.dimension], axis=1)
    assert at.min() < 1e-9
    return float(state.displacement[at.argmin(), 1] / case.scale)


def cook_tables(case: Cook, largest: int) -> list[Row]:
    """Published displacements of single meshes beside this code's, up to a number of cells along a side."""
    return [
        {"element": kind, "n": n, "published": published, "found": cook(case, kind, n)}
        for kind, table in case.tables.items()
        for n, published in table.items()
        if n <= largest
    ]


# ---------------------------------------------------------------------- the cantilever, and locking


def cantilever(kind: str, n: int) -> Body:
    """The thesis's beam, 1 x 0.25 x 0.25 m, with n cells across and 4 n along (Odot 2023, 5.3); surface `end`."""
    body = beam((4 * n, n, n), SIZE, "tetrahedron" if kind.startswith("tetra") else "hexahedron")
    at_end = np.isin(body.boundary, body.node_sets["tip"]).all(axis=1)
    body = replace(body, surfaces={"end": body.boundary[at_end]})
    return body.quadratic() if kind in ("tetra10", "hexahedron27") else body


def tip_deflection(kind: str, is_mixed: bool, poisson_ratio: float, n: int) -> float:
    """Mean downward displacement of the end under a downward traction, metres; Neo-Hookean with the split."""
    body = cantilever(kind, n)
    material: Material = IsochoricNeoHookean(YOUNG_MODULUS, poisson_ratio)
    if is_mixed:
        material = IncompressibleNeoHookean.from_elastic(YOUNG_MODULUS, poisson_ratio)
    with Problem(body, material) as problem:
        state = problem.solve(Loading(traction={"end": (0, 0, -LOAD)}), stability=False)
        weights = problem.external_forces(Loading(traction={"end": (0, 0, 1.0)}))[:, 2]
    return float(-(weights @ state.displacement[:, 2]) / weights.sum())


def locking(poisson_ratio: float, divisions: Sequence[int], finest: int) -> Row:
    """Tip deflection of each element by cells across, relative to the finest mixed solution (Q2-Q1)."""
    best = tip_deflection("hexahedron27", True, poisson_ratio, finest)
    found: Row = {"divisions": list(divisions), "finest": finest, "deflection": best, "relative": {}}
    for (kind, is_mixed), name in NAMES.items():
        found["relative"][name] = [tip_deflection(kind, is_mixed, poisson_ratio, n) / best for n in divisions]
    return found


def slender_limit(traction: float = 0.5, n: int = 3) -> Row:
    """The cantilever under a small load against Timoshenko's beam (Cowper 1966).

    F l^3 / (3 E I) + F l / (k G A) with k = 10 (1 + nu) / (12 + 11 nu). The clamp, which hinders the section's
    change of shape, makes the body a little stiffer than the beam.
    """
    nu = 0.3
    length, height, _ = SIZE
    force = traction * height**2
    body = cantilever("hexahedron27", n)
    with Problem(body, NeoHookean(YOUNG_MODULUS, nu)) as problem:
        state = problem.solve(Loading(traction={"end": (0, 0, -traction)}), stability=False)
    found = -float(state.displacement[body.node_sets["tip"], 2].mean())
    bending = force * length**3 / (3 * YOUNG_MODULUS * height**4 / 12)
    shear = force * length * 2 * (1 + nu) / (YOUNG_MODULUS * height**2) * (12 + 11 * nu) / (10 * (1 + nu))
    return {"deflection": found, "beam": bending + shear, "error": abs(found / (bending + shear) - 1)}
