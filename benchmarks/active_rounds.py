"""Draws that active rounds choose against random ones: error at the 95 % quantile by the number of training draws.

    python benchmarks/active_rounds.py [--only modal ...] [--seconds 120] [--epochs 24] [--ranks 2]

The small beam (304 hexahedra) under the loads of table 4.2 (`modal`) and under loads of all sizes up to 0.4 m
(`ranges`). Random: 4,096 training draws. Active: 512 random ones, then six rounds of 256 that are chosen from 16 times
as many candidates each; the rounds' networks are trained for a quarter of --seconds. The same network (reduced, as
many steps as --epochs of 4,096 draws are, whatever the machine does beside) is trained on the first so many draws of
each and judged on the random set's 2,000 held-out draws.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from made import beam_data
from networks import AMPLITUDES
from record import RUNS

from softtwin.meshes.metrics import nodal_distances, relative_error
from softtwin.reference.data.dataset import DataSet, existing
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

LOADS = {
    "modal": {"amplitude": AMPLITUDES["modal"], "patches": 1, "radius": (0.055, 0.64)},
    "ranges": {"displacement": 0.4, "patches": 1, "radius": (0.055, 0.64)},
}
FIRST, ROUNDS, CHOSEN, CANDIDATES = 512, 6, 256, 16
RANDOM, TEST = 4096, 2000


def data_of(loads: str, is_active: bool, seconds: float, ranks: int) -> DataSet:
    """The random or the active set; what is there is not made again."""
    folder = RUNS / f"rounds-{loads}-{'active' if is_active else 'random'}"
    made = existing(folder / "data.zarr")
    if made is not None and not made.missing_blocks():
        return made
    own = {"train": FIRST, "rounds": ROUNDS, "chosen": CHOSEN, "candidates": CANDIDATES, "test": 16}
    samples = own if is_active else {"train": RANDOM, "test": TEST}
    entries = {
        "loads": LOADS[loads],
        "samples": {**samples, "validation": 256, "block": 16, "ranks": ranks, "jacobians": False},
        "training": {"seconds": seconds},
    }
    return beam_data(folder, entries, ranks)


def judged(surrogate: Surrogate, data: DataSet) -> dict[str, Any]:
    """Errors on the held-out draws of a set: mean nodal distance of each in metres, and relative."""
    test = data.samples("test")
    predicted = np.stack([surrogate.solve(each).displacement for each in data.response.spread(test.forces)])
    nodal = nodal_distances(predicted, test.displacements).mean(axis=1)
    relative = relative_error(predicted, test.displacements)
    return {
        "tested": len(test),
        "nodal_error_m": {name: float(np.quantile(nodal, share)) for name, share in _SHARES.items()}
        | {"mean": float(nodal.mean())},
        "relative_error": {name: float(np.quantile(relative, share)) for name, share in _SHARES.items()},
    }


_SHARES = {"median": 0.5, "p95": 0.95, "p99": 0.99}


ROWS = {
    f"{loads}: {kind}, {count} draws": (loads, kind, count)
    for loads in LOADS
    for count in (512, 1024, 2048, RANDOM)
    for kind in ("random", "active")
    if kind == "random" or count < RANDOM
}


def work(row: str, given: Given) -> dict[str, Any]:
    loads, kind, count = ROWS[row]
    data, random = (
        given.once(data_of, loads, each == "active", given.seconds, given.ranks) for each in (kind, "random")
    )
    surrogate = train(data, TrainingPlan(Reduced(), epochs=given.epochs * RANDOM // count, samples=count))
    counts = surrogate.card["samples"]
    found = {"draws": count, "accepted": counts["train"], "rejected": counts["rejected"]}
    return {**found, "steps": surrogate.card["training"]["steps"], **judged(surrogate, random)}


BENCHMARK = Benchmark(
    name="active_rounds",
    title="Draws that active rounds choose against random ones, by the number of training draws",
    about=("surrogate", "reference", "app/stages"),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column(
            "mean; 95 %; 99 %",
            "mm",
            "{nodal_error_m.mean*1000:.3f}; {nodal_error_m.p95*1000:.3f}; {nodal_error_m.p99*1000:.3f}",
        ),
        Column("relative, median (95 %)", "%", "{relative_error.median*100:.3f} ({relative_error.p95*100:.2f})"),
    ),
    settings={
        "seconds": Setting(120.0, "four times those of a round's network"),
        "epochs": Setting(24, "of 4,096 draws; the steps are the same for fewer"),
        "ranks": RANKS,
    },
)


if __name__ == "__main__":
    run(BENCHMARK)
