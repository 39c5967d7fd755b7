"""What solves of the reference cost: the 12,000-unknown beam, the real liver from rest, gradients, memory. One core.

python benchmarks/reference_solves.py
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from beam_hard import draw
from harness import Benchmark, run
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, liver, sequence
from numpy.typing import NDArray
from scipy.optimize import brentq
from summaries import median_seconds, resident_mib

from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean, SaintVenantKirchhoff
from softtwin.reference.derivatives.linearisation import Linearisation
from softtwin.reference.solve.problem import NewtonOptions, Problem

Floats = NDArray[np.float64]
FRAMES = (0, 10, 25, 40)


def large_beam() -> dict[str, Any]:
    """The beam of the thesis's Table 5.1: 12,000 unknowns, 100 m long, bent by 40 m (nu, not given there, is 0.3)."""
    body, material = beam((39, 9, 9), (100.0, 25.0, 25.0), "hexahedron"), SaintVenantKirchhoff(4500.0, 0.3)
    tip = body.node_sets["tip"]
    unit = np.zeros_like(body.points)
    unit[tip, 2] = 1.0 / len(tip)
    plain = NewtonOptions(chord=False)
    with Problem(body, material) as problem, Problem(body, material, plain) as newton:

        def excess(newtons: float) -> float:
            return float(problem.solve(newtons * unit, stability=False).displacement[tip, 2].mean() - 40.0)

        forces = brentq(excess, 1e4, 3e4, rtol=1e-3) * unit
        state = problem.solve(forces, stability=False)
        rest = np.zeros_like(body.points)
        each = newton.solve(forces, rest, stability=False)
        return {
            "unknowns": problem.size,
            "tip_m": float(state.displacement[tip, 2].mean()),
            "solve_s": median_seconds(lambda: problem.solve(forces, stability=False), 9),
            "iterations": state.iterations,
            "factorisations": state.factorisations,
            "newton_iteration_s": median_seconds(lambda: newton.solve(forces, rest, stability=False), 5)
            / each.iterations,
            "newton_iterations_from_rest": each.iterations,
        }


def real_liver() -> dict[str, Any]:
    """Cold start under the true load of four frames of each sequence: time, and distance from the stored truth."""
    body, figures = liver(), {}
    material, whole = NeoHookean(YOUNG_MODULUS, POISSON_RATIO), NewtonOptions(elimination=False)
    with Problem(body, material) as problem, Problem(body, material, whole) as without:
        for name in SEQUENCES:
            data = sequence(name)
            for frame in FRAMES:
                forces = data.nodal_forces(frame)
                state = problem.solve(forces)
                figures[f"{name} {frame}"] = {
                    "seconds": median_seconds(partial(problem.solve, forces, stability=False), 5),
                    "iterations": state.iterations,
                    "factorisations": state.factorisations,
                    "local_iterations": state.local_iterations,
                    "load_steps": state.load_steps,
                    "negative_pivots": state.negative_pivots,
                    "largest_error_m": float(np.abs(body.points + state.displacement - data.positions[frame]).max()),
                    "seconds_without_elimination": median_seconds(partial(without.solve, forces, stability=False), 3),
                    "factorisations_without_elimination": without.solve(forces, stability=False).factorisations,
                }
    figures["median_seconds"] = float(np.median([row["seconds"] for row in figures.values()]))
    return figures


def gradients() -> dict[str, Any]:
    """A gradient by all nodal forces against the solve that came before it: on the beam and on the liver."""
    bar = beam()
    cases = {"beam": (bar, draw(bar, np.random.default_rng(0))), "liver": (liver(), sequence("s2").nodal_forces(0))}
    figures = {}
    for name, (body, forces) in cases.items():
        cotangent = np.random.default_rng(0).standard_normal(body.points.shape)
        with Problem(body, NeoHookean(YOUNG_MODULUS, POISSON_RATIO)) as problem:
            problem.solve(forces)
            rows = []
            for stability in (True, False):
                for _ in range(7):
                    begin = time.perf_counter()
                    state = problem.solve(forces, stability=stability)
                    solved = time.perf_counter()
                    Linearisation(problem, forces, state).adjoint(cotangent)
                    rows.append((stability, solved - begin, time.perf_counter() - solved))
            for stability in (True, False):
                solve, gradient = np.median([row[1:] for row in rows if row[0] == stability], axis=0)
                key = "after_a_solve_with_stability" if stability else "after_a_solve_without"
                figures[f"{name}, {key}"] = {"solve_s": solve, "gradient_s": gradient, "ratio": gradient / solve}
            Linearisation(problem, forces, state).gradient(cotangent)  # compiles
            whole = partial(Linearisation(problem, forces, state).gradient, cotangent)
            figures[f"{name}, by forces and parameters"] = {"gradient_s": median_seconds(whole, 5)}
    return figures


def memory(count: int = 1000) -> dict[str, Any]:
    """Resident memory of one process after 50 solves and after all, MiB."""
    body = beam()
    rng = np.random.default_rng(1)
    seen = {}
    with Problem(body, NeoHookean(YOUNG_MODULUS, POISSON_RATIO)) as problem:
        for i in range(1, count + 1):
            problem.solve(draw(body, rng))
            if i in (50, count):
                seen[i] = resident_mib()
    return {
        "solves": count,
        "after_50_MiB": seen[50],
        "after_all_MiB": seen[count],
        "growth_MiB": seen[count] - seen[50],
    }


STUDIES = {study.__name__: study for study in (large_beam, real_liver, gradients, memory)}
BENCHMARK = Benchmark(
    name="reference_solves",
    title="What solves of the reference cost: a beam of 12,000 unknowns, the real liver, gradients, memory",
    about=("reference",),
    work=lambda row, given: STUDIES[row](),
    rows=tuple(STUDIES),
    seeds=(0, 1),
)


if __name__ == "__main__":
    run(BENCHMARK)
