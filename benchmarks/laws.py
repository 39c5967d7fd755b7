"""How far apart two laws bend the thesis's beam: Neo-Hookean with ln J (ours) and isochoric (Odot 2023, eq. 2.27).

python benchmarks/laws.py
"""

from __future__ import annotations

from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run

from softtwin.meshes.metrics import relative_error
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import MATERIALS
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.samplers import LoadPlan, draw_load
from softtwin.reference.modes import eigenmodes
from softtwin.reference.solve.problem import Problem

YOUNG_MODULUS, POISSON_RATIO, AMPLITUDE = 5000.0, 0.45, 0.03  # pascals; newtons: the loads of networks.py


def work(row: str, given: Given) -> dict[str, Any]:
    """Modal loads solved by both laws; the difference relative to ours."""
    ours, thesis = (MATERIALS[name](YOUNG_MODULUS, POISSON_RATIO) for name in ("neo-hookean", "isochoric-neo-hookean"))
    rng, apart, failed = np.random.default_rng(0), [], 0
    with Problem(beam(), ours) as one, Problem(beam(), thesis) as other:
        shapes = eigenmodes(one, 10).shapes
        for _ in range(given.loads):
            load = AMPLITUDE * draw_load(one.body, shapes, LoadPlan(radius=(0.055, 0.64)), rng)
            try:
                found, theirs = (each.solve(load, stability=False).displacement for each in (one, other))
            except NotConverged:
                failed += 1
                continue
            apart.append(float(relative_error(theirs[None], found[None])[0]))
    median, p95, largest = (float(np.quantile(apart, share)) for share in (0.5, 0.95, 1.0))
    return {
        "loads": given.loads,
        "failed": failed,
        "relative_difference": {"median": median, "p95": p95, "largest": largest},
    }


BENCHMARK = Benchmark(
    name="laws",
    title="How far apart the two Neo-Hookean laws bend the thesis's beam",
    about=("reference",),
    rows=("modal loads",),
    work=work,
    columns=(
        Column("apart, median", "%", "{relative_difference.median*100:.3f}"),
        Column("95 % of loads", "%", "{relative_difference.p95*100:.3f}"),
        Column("loads; failed", "", "{loads}; {failed}"),
    ),
    settings={"loads": Setting(200, "modal ones")},
    seeds=(0,),
    small={"loads": 5},
)


if __name__ == "__main__":
    run(BENCHMARK)
