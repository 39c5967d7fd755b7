"""What the reference solver is checked against, at full size, written as docs/archive/verification.md.

python benchmarks/verification.py [--only closed patch manufactured tangent taylor cook locking]
python benchmarks/verification.py page                  # the page alone, from the records
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from columns import markdown
from harness import Benchmark, Given, run
from record import recorded
from verification_cases import PLANE, QUADRATIC, SPACE, compressible, incompressible
from verification_derivatives import STEPS, frame, tangent, taylor, taylor_cases
from verification_published import LOAD, YOUNG_MODULUS, cook, cook_tables, cooks, locking, slender_limit
from verification_recorded import recorded_pages
from verification_solutions import (
    SHEAR,
    STRETCH,
    TWIST,
    inflation,
    manufactured,
    patch,
    patch_with_traction,
    simple_shear,
    small_torsion,
    torsion,
    uniaxial,
)

DOCS = Path(__file__).parents[1] / "docs"
DIVISIONS = {"tetra": (3, 6, 9), "hexahedron": (3, 6, 9), "tetra10": (2, 3, 4), "hexahedron27": (2, 3, 4)}
MEMBRANES = (2, 4, 8, 16, 32)
POISSON_RATIOS = (0.49, 0.4999)
SMALL, LARGE = 0.02, 1.0
Figures = dict[str, Any]

INTRODUCTION = """# Verification

What the reference solver (`reference/`) is checked against: closed forms, patch tests, manufactured solutions,
differences, figures that others publish. Every figure on this page was printed by

    python benchmarks/verification.py

which writes this page and `benchmarks/results/verification.json` (with machine and versions); the last three sections
are the records of scripts that they name.
`tests/reference/test_verification.py` calls the same functions at small sizes and asserts what stands here.
Statics only: dynamics is out of scope. Verification only: whether a material describes an organ is another question.

Loads, stresses by hand, shape functions and quadrature of these studies are NumPy's
(`benchmarks/verification_cases.py`), not those that the solver assembles with. Lengths are of order one and Young's
modulus is 1 unless a section says otherwise; the order after a sequence of errors is that between its last two
meshes. "Own energy" is a user's `Energy`: Demiray's exponential one.
"""


# ---------------------------------------------------------------------- the studies


def closed() -> Figures:
    """Closed forms of every material."""
    found: Figures = {"bars": {}, "small_torsion": {}, "torsion": {}, "inflation": {}}
    nearly = incompressible(0.02)  # held all round, an incompressible body would leave its pressure's level open
    for name, material in (compressible() | incompressible()).items():
        kind = "hexahedron27" if material.is_mixed else "hexahedron"
        found["bars"][name] = uniaxial(material, kind) | {"shear": simple_shear(nearly.get(name, material), kind)}
        if name != "linear elastic" and not material.is_mixed:
            found["small_torsion"][name] = small_torsion(material)
    for name, material in incompressible().items():
        found["torsion"][name] = torsion(material, (1, 2, 3))
        for kind in ("triangle6", "quad9"):
            found["inflation"][f"tube, {name}, {kind}"] = inflation("tube", material, kind, (2, 4, 8))
        for kind in ("tetra10", "hexahedron27"):
            found["inflation"][f"sphere, {name}, {kind}"] = inflation("sphere", material, kind, (2, 3, 4))
    return found


def patches() -> Figures:
    """Patch tests of every element."""
    material, nearly = compressible()["Neo-Hookean"], incompressible(0.1)["incompressible Neo-Hookean"]
    full = incompressible()["incompressible Neo-Hookean"]
    found = {kind: patch(material, kind) for kind in PLANE + SPACE}
    found |= {f"{kind}, curved": patch(material, kind, are_curved=True) for kind in QUADRATIC}
    found |= {f"{kind}, mixed, k = 10": patch(nearly, kind) for kind in QUADRATIC}
    found |= {f"{kind}, curved, mixed, k = 10": patch(nearly, kind, are_curved=True) for kind in QUADRATIC}
    return found | {f"{kind}, mixed, J = 1, one side free": patch_with_traction(full, kind) for kind in QUADRATIC}


def manufactured_solutions() -> Figures:
    """Orders of every material on every element."""
    found = {}
    for name, material in (compressible() | incompressible()).items():
        for kind in QUADRATIC if material.is_mixed else PLANE + SPACE:
            found[f"{name}, {kind}"] = manufactured(material, kind, DIVISIONS.get(kind, (4, 8, 16)))
    return found


def tangents() -> Figures:
    """Tangent, its symmetry, and frame indifference of every material."""
    materials = {**compressible(), **incompressible()}
    kinds = {name: "tetra10" if material.is_mixed else "tetra" for name, material in materials.items()}
    return {name: tangent(m, kinds[name]) | frame(m, kinds[name]) for name, m in materials.items()}


def taylor_tests() -> Figures:
    """Taylor tests of every sensitivity, on a small and on a large deformation."""
    cases = taylor_cases(compressible())
    return {
        f"{name}, {label}": taylor(material, kind, size)
        for name, (material, kind) in cases.items()
        for label, size in (("small", SMALL), ("large", LARGE))
    }


def membranes() -> Figures:
    """Cook's membrane in its published versions, and the thesis's cantilever in its linear limit."""
    found: Figures = {"tables": {}, "limits": {}, "cantilever": slender_limit()}
    for key, case in cooks().items():
        found["tables"][key] = cook_tables(case, 20)
        row: Figures = {"title": case.title, "source": case.source, "published": case.published, "found": {}}
        for kind in ("triangle6", "quad9") if case.mixed else ():
            row["found"][f"{kind}, mixed"] = [cook(case, kind, n, is_mixed=True) for n in MEMBRANES]
        found["limits"][key] = row
    slab = cooks()["slab"]
    found["plane_strain"] = cook(slab, "hexahedron27", 8, both_faces=True)
    return found


def lockings() -> Figures:
    """Locking of linear and quadratic elements, and its cure."""
    return {str(nu): locking(nu, (1, 2, 3, 4), 5) for nu in POISSON_RATIOS}


# ---------------------------------------------------------------------- the page


def tiny(value: float) -> str:
    """A small number with two digits."""
    return f"{value:.1e}"


def errors(row: Figures, name: str) -> str:
    """Errors mesh by mesh, and the last order."""
    return ", ".join(tiny(x) for x in row[f"{name}_error"]) + f"; {row[f'{name}_orders'][-1]:.2f}"


def closed_page(found: Figures) -> str:
    """The section on closed forms."""
    bars = markdown(
        ["material", "lateral stretch", "its error", "stress", "its error", "shear stress", "its error", "universal"],
        (
            [
                name,
                f"{row['lateral_stretch']:.6f}",
                tiny(row["lateral_error"]),
                f"{row['stress']:.6f}",
                tiny(row["stress_error"]),
                f"{row['shear']['stress']:.6f}",
                tiny(max(row["shear"]["stress_error"], row["shear"]["all_error"])),
                tiny(row["shear"]["universal_error"]),
            ]
            for name, row in found["bars"].items()
        ),
    )
    small = markdown(
        ["material", "gap at 0.2, 0.1, 0.05", "order"],
        (
            [name, ", ".join(map(tiny, row["gaps"])), f"{row['orders'][-1]:.2f}"]
            for name, row in found["small_torsion"].items()
        ),
    )
    twist = markdown(
        ["material", "torque, finest", "its errors; order", "axial force's errors; order"],
        (
            [name, f"{row['torque'][-1]:.5f}", errors(row, "torque"), errors(row, "force")]
            for name, row in found["torsion"].items()
        ),
    )
    inflated = markdown(
        ["wall, material, element", "inner radius; order", "displacement, L2; order", "pressure, L2; order"],
        (
            [name, errors(row, "radius"), errors(row, "displacement"), errors(row, "pressure")]
            for name, row in found["inflation"].items()
        ),
    )
    return f"""## Closed forms

A bar of stretch {STRETCH} with free sides and simple shear of {SHEAR}, on distorted hexahedra (27 nodes where mixed):
reaction per area and lateral stretch from equilibrium, mean stress P_12 from the virial of the nodal forces. Expected:
E (l - 1) for linear elasticity, E l (l^2 - 1)/2 and 1 - nu (l^2 - 1) for Saint-Venant-Kirchhoff, 2 (c1 + c2/l)
(l - 1/l^2) where incompressible (Rivlin 1948), else the stress by hand (Holzapfel 2000, ch. 6) with the lateral stretch
at which its lateral component vanishes; mu g, 2 (c1 + c2) g and their like in shear. "Universal" is Rivlin's relation
sigma_11 - sigma_22 = g sigma_12, relative to sigma_12.

{bars}
Torsion by {TWIST} of an incompressible cylinder, radius and length 1, sides free, curved 27-node hexahedra with 1, 2
and 3 cells in each direction of five blocks. M = pi (c1 + c2) t R^4, N = -pi/2 (c1 + 2 c2) t^2 R^4 (Rivlin 1949).

{twist}
Compressible cylinders meet mu t pi R^4/2 as the twist t shrinks: the gap falls as t^2. The section's second moment is
taken from linear elasticity on the same hexahedra.

{small}
Inflation of a thick wall, radii 1 and 2, by a pressure that follows it, inner stretch 1.3 (tube, plane strain, a
quarter) and 1.25 (sphere, an octant). Tube: p = mu (ln(a B/(A b)) + (a^2 - A^2)/2 (1/a^2 - 1/b^2)) (Rivlin 1949);
sphere: p = g(a/A) - g(b/B), g(l) = -c1 (4/l + 1/l^4) + 4 c2 (l - 1/(2 l^2)) (Green and Shield 1950). Tubes have 2, 4
and 8 cells across, spheres 2, 3 and 4. Expected orders: 3 for the displacement, 2 for the pressure.

{inflated}"""


def patches_page(found: Figures) -> str:
    """The section on patch tests."""
    rows = (
        [
            name,
            row["inner_nodes"],
            tiny(row["displacement_error"]),
            tiny(row["force_error"]),
            tiny(row["pressure_error"]) if "pressure_error" in row else "",
        ]
        for name, row in found.items()
    )
    return f"""## Patch tests

A uniform deformation far from rest, prescribed on the boundary of a body with distorted cells, must be found inside,
and forces on inner nodes must vanish; "curved" cells have their inner mid-side nodes displaced too. Where J = 1 one
side is free and carries the exact traction. Neo-Hookean. Errors relative to the largest displacement, force and
pressure.

{markdown(["element", "inner nodes", "displacement", "inner forces", "pressure"], rows)}"""


def manufactured_page(found: Figures) -> str:
    """The section on manufactured solutions."""
    rows = (
        [
            name,
            ", ".join(map(str, row["divisions"])),
            errors(row, "L2"),
            errors(row, "H1"),
            errors(row, "pressure") if "pressure_error" in row else "",
        ]
        for name, row in found.items()
    )
    head = ["material, element", "cells along an axis", "L2; order", "H1; order", "pressure, L2; order"]
    return f"""## Manufactured solutions

A smooth displacement with gradients up to 0.25 is chosen, the body force b = -Div P is computed from the stress by hand
(its divergence by complex steps, exact to round-off) and made nodal forces by a quadrature of its own; the displacement
is prescribed on the whole boundary. For incompressible materials the displacement is made of shears (J = 1 exactly) and
comes with a pressure of its own, and one side is free under the exact traction. Cells are distorted by a smooth map.
Expected: order 2 in L2 and 1 in H1 for linear, 3 and 2 for quadratic cells, 2 for the pressure.

{markdown(head, rows)}"""


def tangents_page(found: Figures) -> str:
    """The section on the tangent and on rotations."""
    rows = (
        [
            name,
            tiny(row["gaps"][-1]),
            f"{row['orders'][-1]:.3f}" if row["gaps"][0] > 1e-12 else "round-off",
            tiny(row["asymmetry"]),
            tiny(row["energy_change"]),
            tiny(row["force_change"]),
        ]
        for name, row in found.items()
    )
    head = ["material", "gap", "order", "asymmetry", "energy", "forces"]
    return f"""## Tangent and frame indifference

"Gap": the tangent times a random direction against central differences of the residual (pressures included) at a
strongly deformed state, relative, at the smallest step; its order as the step halves is to be 2 (linear elasticity
has none). "Asymmetry": the largest entry of K - K^T relative to K's. "Energy", "forces": their relative changes when
the deformed body is turned by 110 degrees, forces turned back. Linear elasticity knows small rotations only and
fails, as it must. Tetrahedra, of 10 nodes where mixed.

{markdown(head, rows)}"""


def taylor_page(found: Figures) -> str:
    """The section on Taylor tests."""

    def order(row: Figures, derivatives: str) -> str:
        values = row[f"orders_{derivatives}"]
        return f"{values[-1]:.2f}" if values else "round-off"

    def all_orders(row: Figures) -> str:
        return ", ".join(order(row, d) for d in "012" if f"orders_{d}" in row)

    def displacement(by_input: Figures) -> str:
        return f"{next(iter(by_input.values()))['largest_displacement']:.2g}"

    cases = [case.removesuffix(", small") for case in found if case.endswith(", small")]
    rows = (
        [
            f"{case} ({displacement(found[f'{case}, small'])}, {displacement(found[f'{case}, large'])})",
            name,
            all_orders(small),
            all_orders(found[f"{case}, large"][name]),
        ]
        for case in cases
        for name, small in found[f"{case}, small"].items()
    )
    head = ["case (largest displacements)", "input", "small", "large"]
    return f"""## Taylor tests of the sensitivities

J(u) = w . u + |u|^2/2 of the equilibrium under every sort of load at once, as one input moves by h = {STEPS[0]}, ...,
{STEPS[-1]} of up to a fifth of itself (nodes: a twentieth of a cell). The orders of the remainders without a
derivative, with the gradient, and with the Hessian product (by forces and by parameters) are to be 1, 2 and 3; the
order shown is that of the smallest steps whose remainders are above 1e-10 of J ("round-off": none is). The unit cube
or square in 2 cells along an axis, held at one side, whose nodes are displaced; traction on another, a following
pressure on a third, forces on all nodes, body force.

{markdown(head, rows)}"""


def membranes_page(found: Figures) -> str:
    """The section on what others publish."""
    meshes = markdown(
        ["version", "element", "cells along a side", "published, mm", "here, mm"],
        (
            [found["limits"][key]["title"], row["element"], row["n"], row["published"], f"{row['found']:.5f}"]
            for key, rows in found["tables"].items()
            for row in rows
        ),
    )
    limits = markdown(
        ["version", "published, mm", *(f"n = {n}" for n in MEMBRANES), "last against published"],
        (
            [
                f"{row['title']}, {kind}",
                row["published"],
                *(f"{x:.4f}" for x in values),
                f"{100 * (values[-1] / row['published'] - 1):+.2f} %",
            ]
            for row in found["limits"].values()
            for kind, values in row["found"].items()
        ),
    )
    sources = "\n".join(f"- {row['title']}: {row['source']}." for row in found["limits"].values())
    beam = found["cantilever"]
    return f"""## Cook's membrane and the cantilever

Corners (0, 0), (48, 44), (48, 60) and (0, 44) mm, clamped at the left, traction upward at the right; the upward
displacement of the upper right corner, of the middle of the right side for small strains. Sources:

{sources}

Mesh by mesh, where element and mesh are published too. The deal.II table is met by a slab 1 mm thick of which one
face keeps its plane, so that the thickness may change; plane strain, which its text names, gives
{found["plane_strain"]:.4f} mm (both faces held, `hexahedron27`, 8 x 8). OpenGeoSys's quadrilaterals are without
F-bar, and lock; the gap to them is 1e-4 on every mesh, and its cause was not found.

{meshes}
Meshes of mixed elements, against the published figures. These are second-hand, those of F-bar are not converged to all
their digits (6.8731 at 25 x 25, 6.8914 at 30 x 30), and corners are singular: two or three digits are to be expected.

{limits}
The thesis's cantilever (1 x 0.25 x 0.25 m, E = {YOUNG_MODULUS:.0f} Pa, nu = 0.3, Odot 2023) under a small end
traction bends by {1e3 * beam["deflection"]:.3f} mm; Timoshenko's beam, without the clamp's hindrance of the section,
by {1e3 * beam["beam"]:.3f} mm ({100 * (beam["deflection"] / beam["beam"] - 1):+.1f} %).
"""


def lockings_page(found: Figures) -> str:
    """The section on locking."""
    rows = (
        [f"nu = {nu}", name, *(f"{100 * x:.1f} %" for x in values)]
        for nu, row in found.items()
        for name, values in row["relative"].items()
    )
    first = next(iter(found.values()))
    best = " and ".join(f"{row['deflection']:.5f} m (nu = {nu})" for nu, row in found.items())
    return f"""## Locking

The cantilever under an end traction of {LOAD:.0f} Pa, isochoric Neo-Hookean: the end's mean deflection relative to
the finest mixed solution (Q2-Q1, {first["finest"]} cells across): {best}.
P1 and Q1 lock, at 0.4999 beyond use; P2 and Q2 are slower than their mixed forms, which do not feel Poisson's ratio.

{markdown(["", "element", *(f"{n} across" for n in first["divisions"])], rows)}
![Deflection of each element by mesh](../verification-locking.png)
"""


def draw_locking(found: Figures, path: Path) -> None:
    """Deflection of each element against the mesh, on a background that suits light and dark pages."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    styles = {"P1": ("C0", "--"), "Q1": ("C1", "--"), "P2": ("C0", "-."), "Q2": ("C1", "-.")}
    styles |= {"P2-P1": ("C0", "-"), "Q2-Q1": ("C1", "-")}
    figure, axes = plt.subplots(1, len(found), figsize=(7.2, 2.9), sharey=True, facecolor="white")
    for axis, (nu, row) in zip(axes, found.items(), strict=True):
        for name, values in row["relative"].items():
            colour, line = styles[name]
            axis.plot(row["divisions"], values, line, color=colour, marker="o", markersize=3.5, label=name)
        axis.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
        axis.set(title=f"Poisson's ratio {nu}", xlabel="cells across", xticks=row["divisions"], ylim=(0, 1.08))
    axes[0].set_ylabel("deflection / finest mixed")
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


STUDIES: dict[str, tuple[Callable[[], Figures], Callable[[Figures], str]]] = {
    "closed": (closed, closed_page),
    "patch": (patches, patches_page),
    "manufactured": (manufactured_solutions, manufactured_page),
    "tangent": (tangents, tangents_page),
    "taylor": (taylor_tests, taylor_page),
    "cook": (membranes, membranes_page),
    "locking": (lockings, lockings_page),
}


def work(row: str, given: Given) -> Figures:
    study, page = STUDIES[row]
    found = study()
    print(page(found))
    return found


def pages() -> None:
    """Write the page from the records, solving nothing."""
    found = recorded("verification")
    draw_locking(found["locking"], DOCS / "verification-locking.png")
    sections = [INTRODUCTION, *(page(found[name]) for name, (_, page) in STUDIES.items()), *recorded_pages()]
    (DOCS / "archive" / "verification.md").write_text("\n".join(sections))


BENCHMARK = Benchmark(
    name="verification",
    title="What the reference solver is checked against: closed forms, patch tests, orders, Taylor tests, locking",
    about=("reference",),
    work=work,
    rows=tuple(STUDIES),
)


if __name__ == "__main__":
    made = run(BENCHMARK, parts={"page": pages})
    if "--dry" not in sys.argv and set(made) == set(STUDIES) and made == recorded("verification"):
        pages()
