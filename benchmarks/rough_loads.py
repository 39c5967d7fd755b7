"""Which branch a cold solve ends on: rough loads on the real liver, against careful load steps.

The tool's mean force of a frame plus normal noise from node to node, up to 2.5 times as strong: some cells then have
several states of balance, and the body several stable equilibria. Careful steps of a twentieth of the load, without
elimination, are the yardstick. Time is one cold solve each, with its stability.
"""

from __future__ import annotations

import time
from itertools import cycle, islice
from typing import Any
from unittest import mock

import numpy as np
from harness import Benchmark, Given, Setting, run
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, liver, sequence

from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import Equilibrium, NotConverged
from softtwin.reference.solve import newton
from softtwin.reference.solve.problem import NewtonOptions, Problem

NOISES = (1.0, 1.5, 2.0, 2.5, 1.7)
SAME_M = 1e-6
WAYS: dict[str, tuple[NewtonOptions, int]] = {
    "softtwin": (NewtonOptions(), newton._MOST_ELIMINATIONS),
    "elimination without a limit": (NewtonOptions(), 1000),
    "no elimination": (NewtonOptions(elimination=False), 0),
}


def loads(count: int) -> list[np.ndarray]:
    """Nodal forces, (n, 3), one sequence after the other, frames 5, 15, 25 and so on."""
    points, rng, found = liver().points, np.random.default_rng(1), []
    for k, (name, noise) in enumerate(islice(zip(cycle(SEQUENCES), cycle(NOISES), strict=False), count)):
        data = sequence(name)
        mean = data.net_forces[(5 + 10 * (k // len(SEQUENCES))) % len(data.net_forces)]
        forces = np.zeros_like(points)
        rough = rng.standard_normal((len(data.tool), 3))
        forces[data.tool] = (mean + noise * np.linalg.norm(mean) * rough) / len(data.tool)
        found.append(forces)
    return found


def timed(problem: Problem, forces: np.ndarray) -> tuple[Equilibrium | None, float]:
    begin = time.perf_counter()
    try:
        return problem.solve(forces), time.perf_counter() - begin
    except NotConverged:
        return None, time.perf_counter() - begin


def study(count: int) -> dict[str, Any]:
    body, material, drawn = liver(), NeoHookean(YOUNG_MODULUS, POISSON_RATIO), loads(count)
    with Problem(body, material, NewtonOptions(elimination=False, first_step=0.05)) as careful:
        yardstick = [timed(careful, forces) for forces in drawn]
    figures: dict[str, Any] = {
        "loads": count,
        "careful steps": {"seconds": [seconds for _, seconds in yardstick]},
    }
    for way, (options, limit) in WAYS.items():
        with mock.patch.object(newton, "_MOST_ELIMINATIONS", limit), Problem(body, material, options) as problem:
            states = [timed(problem, forces) for forces in drawn]
        gaps = [
            float(np.abs(found.displacement - followed.displacement).max()) if found and followed else None
            for (found, _), (followed, _) in zip(states, yardstick, strict=True)
        ]
        figures[way] = {
            "seconds": [seconds for _, seconds in states],
            "largest_gap_m": gaps,
            "same": sum(gap is not None and gap < SAME_M for gap in gaps),
        }
        times = figures[way]["seconds"]
        print(f"{way:28s} same state in {figures[way]['same']} of {count}, median {np.median(times):.1f} s", flush=True)
    print(f"careful steps: median {np.median(figures['careful steps']['seconds']):.1f} s")
    return figures


def work(row: str, given: Given) -> dict[str, Any]:
    return study(given.loads)


BENCHMARK = Benchmark(
    name="rough_loads",
    title="Which branch a cold solve ends on: loads that differ from node to node on the real liver",
    about=("reference",),
    work=work,
    settings={"loads": Setting(12, "one sequence after the other")},
    seeds=(1,),
    small={"loads": 1},
)


if __name__ == "__main__":
    run(BENCHMARK)
