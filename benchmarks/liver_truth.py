"""Is the stored truth of the real liver an equilibrium that is found from rest? With either reading of what is fixed.

python benchmarks/liver_truth.py
"""

from __future__ import annotations

import numpy as np
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, liver, sequence
from record import write

from softtwin.reference.equilibrium import Problem
from softtwin.reference.materials import NeoHookean

FRAMES = (0, 25, 49)


def main() -> None:
    listed = liver(attachment="listed")
    lone = np.setdiff1d(listed.fixed, liver().fixed)
    figures = {"lone_nodes": lone, "lone_movement_mm": {}, "largest_error_m": {}}
    for name in SEQUENCES:
        moved = np.linalg.norm(sequence(name).positions[0, lone] - listed.points[lone], axis=1)
        figures["lone_movement_mm"][name] = 1e3 * moved
    with Problem(liver(), NeoHookean(YOUNG_MODULUS, POISSON_RATIO)) as problem:
        for name in SEQUENCES:
            data = sequence(name)
            for frame in FRAMES:
                forces = np.zeros_like(problem.body.points)
                forces[data.tool] = data.net_forces[frame] / len(data.tool)
                state = problem.solve(forces)
                error = np.abs(problem.body.points + state.displacement - data.positions[frame]).max()
                figures["largest_error_m"][f"{name} {frame}"] = error
                found = f"{state.load_steps} load step, {state.negative_pivots} negative pivots"
                print(f"{name} {frame}: {error:.1e} m, {found}")
    print(figures["lone_nodes"], figures["lone_movement_mm"])
    write("liver_truth", figures)


if __name__ == "__main__":
    main()
