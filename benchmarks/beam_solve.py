"""One equilibrium of the thesis's beam: 304 hexahedra, tip deflection 0.3 m; and 100 modal loads.

python benchmarks/beam_solve.py
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from harness import Benchmark, Given, Setting, run
from numpy.typing import NDArray
from scipy.optimize import brentq
from summaries import median_seconds

from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.samplers import LoadPlan, draw_load
from softtwin.reference.modes import eigenmodes
from softtwin.reference.solve.problem import Problem

YOUNG_MODULUS, POISSON_RATIO, AMPLITUDE = 5000.0, 0.45, 0.03
WANTED = 0.3


def tip_load(problem: Problem, newtons: float) -> NDArray[np.float64]:
    """A transverse force spread evenly over the nodes of the tip."""
    forces = np.zeros_like(problem.body.points)
    tip = problem.body.node_sets["tip"]
    forces[tip, 2] = newtons / len(tip)
    return forces


def deflection(problem: Problem, newtons: float) -> float:
    """How far the centre of the tip moves, metres."""
    tip = problem.body.node_sets["tip"]
    return float(np.linalg.norm(problem.solve(tip_load(problem, newtons)).displacement[tip].mean(axis=0)))


def work(row: str, given: Given) -> dict[str, Any]:
    with Problem(beam(), NeoHookean(YOUNG_MODULUS, POISSON_RATIO)) as problem:
        newtons = brentq(lambda f: deflection(problem, f) - WANTED, 0.5, 3.0, xtol=1e-4)
        forces = tip_load(problem, newtons)
        state = problem.solve(forces)
        return {
            "tip_force_N": newtons,
            "tip_deflection_m": deflection(problem, newtons),
            "iterations": state.iterations,
            "factorisations": state.factorisations,
            "median_ms": 1e3 * median_seconds(partial(problem.solve, forces, stability=False), given.repeats),
            "median_with_stability_ms": 1e3
            * median_seconds(partial(problem.solve, forces, stability=True), given.repeats),
            "modal_loads": modal_loads(problem, given.loads),
        }


def modal_loads(problem: Problem, count: int) -> dict[str, float]:
    """Times and counts of so many loads as data sets have them."""
    shapes, rng, rows = eigenmodes(problem, 10).shapes, np.random.default_rng(0), []
    for _ in range(count):
        load = AMPLITUDE * draw_load(problem.body, shapes, LoadPlan(radius=(0.055, 0.64)), rng)
        begin = time.perf_counter()
        state = problem.solve(load, stability=False)
        rows.append((1e3 * (time.perf_counter() - begin), state.iterations, state.factorisations, state.load_steps))
    milliseconds, iterations, factorisations, steps = np.array(rows).T
    return {
        "count": len(rows),
        "in_one_load_step": int((steps == 1).sum()),
        "median_ms": float(np.median(milliseconds)),
        "mean_ms": float(milliseconds.mean()),
        "mean_iterations": float(iterations.mean()),
        "mean_factorisations": float(factorisations.mean()),
    }


BENCHMARK = Benchmark(
    name="beam_solve",
    title="One equilibrium of the thesis's beam, bent by 0.3 m, and a hundred under modal loads",
    about=("reference",),
    work=work,
    settings={"repeats": Setting(50, "of the timed solve"), "loads": Setting(100, "modal ones")},
    seeds=(0,),
    small={"repeats": 3, "loads": 5},
)


if __name__ == "__main__":
    run(BENCHMARK)
