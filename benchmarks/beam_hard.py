"""The thesis's test of its solver (Odot 2023, section 7.2.1): 1,000 random bending and torsion loads on the beam.

304 hexahedra, E = 4500 Pa, nu = 0.49, Neo-Hookean. The share that converges, iterations and times without a line
search, with PETSc's, with the energy search, and in load steps; all from rest, and with all that the reference does.

    python benchmarks/beam_hard.py [--loads 1000]
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.solve.problem import NewtonOptions, Problem

Floats = NDArray[np.float64]
YOUNG_MODULUS, POISSON_RATIO = 4500.0, 0.49
FORCE, TORQUE = 2.5, 0.25  # N and N m, the largest
COMPARED = 100  # loads that the slower ways are tried on


def draw(body: Body, rng: np.random.Generator) -> Floats:
    """A transverse force and a torque about the axis, on the last third of the beam or its tip, each up to its largest.

    Args:
        body: the beam along x.
        rng: source of chance.
    """
    x = body.points[:, 0]
    loaded = np.flatnonzero(x > x.max() - (1e-9 if rng.random() < 0.5 else 0.34))
    loaded = np.intersect1d(loaded, body.boundary_nodes)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    force = rng.uniform(0.0, FORCE) * np.array([0.0, np.cos(angle), np.sin(angle)])
    torque = rng.uniform(-TORQUE, TORQUE)
    arms = body.points[loaded] - body.points[loaded].mean(axis=0)
    turning = np.cross([1.0, 0.0, 0.0], arms)
    forces = np.zeros_like(body.points)
    forces[loaded] = force / len(loaded) + torque * turning / np.einsum("ni,ni->", turning, turning)
    return forces


def tried(problem: Problem, loads: list[Floats], **how: Any) -> dict[str, Any]:
    """Share converged, iterations and times of one way of solving."""
    rows, sizes = [], []
    for load in loads:
        begin = time.perf_counter()
        try:
            state = problem.solve(load, stability=False, **how)
        except NotConverged:
            continue
        rows.append((1e3 * (time.perf_counter() - begin), state.iterations, state.factorisations, state.load_steps))
        sizes.append(float(np.linalg.norm(state.displacement, axis=1).max()))
    if not rows:
        return {"loads": len(loads), "converged": 0}
    ms, iterations, factorisations, steps = np.array(rows).T
    return {
        "loads": len(loads),
        "converged": len(rows),
        "median_ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95)),
        "mean_iterations": float(iterations.mean()),
        "mean_factorisations": float(factorisations.mean()),
        "in_one_load_step": int((steps == 1).sum()),
        "median_largest_displacement_m": float(np.median(sizes)),
        "largest_displacement_m": float(np.max(sizes)),
    }


def loads_of(count: int) -> list[Floats]:
    """So many random loads."""
    body, rng = beam(), np.random.default_rng(0)
    return [draw(body, rng) for _ in range(count)]


# Options of Newton's method, whether it starts from rest with nothing to fall back on, whether few loads are tried.
WAYS: dict[str, tuple[dict[str, Any], bool, bool]] = {
    "softtwin": ({}, False, False),
    "full steps from rest": ({"search": "full", "chord": False}, True, True),
    "energy search from rest": ({"chord": False, "elimination": False}, True, False),
    "full steps in load steps": ({"search": "full", "chord": False, "first_step": 0.25}, False, True),
    **{f"PETSc {name} from rest": ({"search": name, "chord": False}, True, True) for name in ("bt", "l2", "cp")},
}


def work(row: str, given: Given) -> dict[str, Any]:
    options, is_cold, is_slow = WAYS[row]
    body, loads = beam(), given.once(loads_of, given.loads)
    how = {"guess": np.zeros_like(body.points), "fallback": False} if is_cold else {}
    with Problem(body, NeoHookean(YOUNG_MODULUS, POISSON_RATIO), NewtonOptions(**options)) as problem:
        problem.solve(loads[0], stability=False)  # compiles, and prepares the linear response
        return tried(problem, loads[: COMPARED if is_slow else None], **how)


BENCHMARK = Benchmark(
    name="beam_hard",
    title="Hard loads on the thesis's beam: how many are solved, by line search and load steps (section 7.2.1)",
    about=("reference",),
    work=work,
    rows=tuple(WAYS),
    columns=(
        Column("converged", "", "{converged} of {loads}"),
        Column("mean iterations", "", "{mean_iterations:.1f}"),
        Column("factorisations", "", "{mean_factorisations:.1f}"),
        Column("median", "ms", "{median_ms:.0f}"),
    ),
    settings={"loads": Setting(1000, "of chance")},
    seeds=(0,),
    small={"loads": 10},
)


if __name__ == "__main__":
    run(BENCHMARK)
