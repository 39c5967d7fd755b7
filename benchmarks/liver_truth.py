"""Is the stored truth of the real liver in balance, and found from rest? With either reading of what is fixed.

python benchmarks/liver_truth.py
"""

from __future__ import annotations

from typing import Any

import numpy as np
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, Sequence, liver, sequence
from numpy.typing import NDArray
from record import write
from threadpoolctl import threadpool_limits

from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Problem

MATERIAL = NeoHookean(YOUNG_MODULUS, POISSON_RATIO)
FRAMES = (0, 25, 49)


def tool_forces(data: Sequence, frame: int) -> NDArray[np.float64]:
    """The true nodal forces of a frame, (n, 3)."""
    forces = np.zeros_like(data.positions[0])
    forces[data.tool] = data.net_forces[frame] / len(data.tool)
    return forces


def imbalance(problem: Problem, data: Sequence) -> float:
    """Largest force that is left on a free node over all frames, newtons."""
    largest = 0.0
    for frame, positions in enumerate(data.positions):
        gap = problem.internal_forces(positions - problem.body.points) - tool_forces(data, frame)
        largest = max(largest, float(np.linalg.norm(gap[problem.body.free], axis=1).max()))
    return largest


def attachments(data: Sequence) -> dict[str, Any]:
    """Frame 0 with all listed nodes fixed and with whole facets fixed, each from rest and from the stored state."""
    found = {}
    for name in ("listed", "facets"):
        body = liver(attachment=name)
        with Problem(body, MATERIAL) as problem:
            forces = tool_forces(data, 0)
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


def main() -> None:
    listed = liver(attachment="listed")
    lone = np.setdiff1d(listed.fixed, liver().fixed)
    figures: dict[str, Any] = {
        "lone_nodes": lone,
        "lone_movement_mm": {},
        "largest_imbalance_N": {},
        "largest_error_m": {},
        "attachments": {},
    }
    with threadpool_limits(1), Problem(liver(), MATERIAL) as problem:
        for name in SEQUENCES:
            data = sequence(name)
            moved = np.linalg.norm(data.positions[0, lone] - listed.points[lone], axis=1)
            figures["lone_movement_mm"][name] = 1e3 * moved
            figures["largest_imbalance_N"][name] = imbalance(problem, data)
            for frame in FRAMES:
                state = problem.solve(tool_forces(data, frame))
                error = np.abs(problem.body.points + state.displacement - data.positions[frame]).max()
                figures["largest_error_m"][f"{name} {frame}"] = error
                found = f"{state.load_steps} load step, {state.negative_pivots} negative pivots"
                print(f"{name} {frame}: {error:.1e} m, {found}")
            figures["attachments"][name] = attachments(data)
            print(
                name, {key: value[name] for key, value in figures.items() if isinstance(value, dict) and name in value}
            )
    write("liver_truth", figures)


if __name__ == "__main__":
    main()
