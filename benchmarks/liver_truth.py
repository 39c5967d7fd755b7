"""Is the stored truth of the real liver in balance, and found from rest? With either reading of what is fixed.

python benchmarks/liver_truth.py
"""

from __future__ import annotations

from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, run
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, Sequence, liver, sequence

from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Problem

MATERIAL = NeoHookean(YOUNG_MODULUS, POISSON_RATIO)
FRAMES = (0, 25, 49)


def imbalance(problem: Problem, data: Sequence) -> float:
    """Largest force that is left on a free node over all frames, newtons."""
    largest = 0.0
    for frame, positions in enumerate(data.positions):
        gap = problem.internal_forces(positions - problem.body.points) - data.nodal_forces(frame)
        largest = max(largest, float(np.linalg.norm(gap[problem.body.free], axis=1).max()))
    return largest


def attachments(data: Sequence) -> dict[str, Any]:
    """Frame 0 with all listed nodes fixed and with whole facets fixed, each from rest and from the stored state."""
    found = {}
    for name in ("listed", "facets"):
        body = liver(attachment=name)
        with Problem(body, MATERIAL) as problem:
            forces = data.nodal_forces(0)
            cold = problem.solve(forces)
            warm = problem.solve(forces, guess=data.positions[0] - body.points)
            found[name] = (cold, float(np.abs(cold.displacement - warm.displacement).max()))
    gap = np.linalg.norm(body.points + found["listed"][0].displacement - data.positions[0], axis=1)
    return {
        "energy_listed_J": found["listed"][0].energy,
        "energy_facets_J": found["facets"][0].energy,
        "two_starts_apart_m": max(found["listed"][1], found["facets"][1]),
        "largest_gap_mm": 1e3 * float(gap.max()),
        "at_node": int(gap.argmax()),
    }


def in_balance(row: str, given: Given) -> dict[str, Any]:
    """Of one sequence: what is left on its free nodes, what a solve from rest finds, both readings of what is fixed."""
    data, listed = sequence(row), given.once(liver, "default", "listed")
    problem = given.opened(Problem, given.once(liver), MATERIAL)
    lone = np.setdiff1d(listed.fixed, problem.body.fixed)
    errors = {}
    for frame in FRAMES:
        state = problem.solve(data.nodal_forces(frame))
        errors[f"{row} {frame}"] = np.abs(problem.body.points + state.displacement - data.positions[frame]).max()
        print(f"{row} {frame}: {state.load_steps} load step, {state.negative_pivots} negative pivots")
    return {
        "lone_nodes": lone,
        "lone_movement_mm": 1e3 * np.linalg.norm(data.positions[0, lone] - listed.points[lone], axis=1),
        "largest_imbalance_N": imbalance(problem, data),
        "largest_error_m": errors,
        "attachments": attachments(data),
    }


BENCHMARK = Benchmark(
    name="liver_truth",
    title="Whether the real liver's stored states are equilibria, and found from rest",
    about=("reference",),
    work=in_balance,
    rows=SEQUENCES,
    columns=(
        Column("largest force left on a free node", "N", "{largest_imbalance_N:.1e}"),
        Column("found from rest: largest error", "m", lambda f: f"{max(f['largest_error_m'].values()):.1e}"),
        Column("node 756 moves", "mm", "{lone_movement_mm.0:.2f}"),
        Column("with it fixed: largest gap", "mm", "{attachments.largest_gap_mm:.2f}"),
    ),
)


if __name__ == "__main__":
    run(BENCHMARK)
