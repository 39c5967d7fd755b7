"""Equilibria a second on the real liver, by ranks: linear tetrahedra and the thesis's grid of hexahedra.

    python benchmarks/throughput.py [--only tetrahedra "grid, 2 ranks" ...] [--draws 1024]

Draws loads as table 4.3 does (1 to 5 patches, the largest scaled to 55 mm) and makes a data set from nothing under
mpirun, Jacobians left out. Every draw counts, rejected ones too; what comes before the first draw (modes, linear
response, pilot loads) is given apart. From a network: each solve starts where a reduced network says, which has learned
from the first 1,024 draws of `networks_bodies.py` for --seconds; both are made where they are not there, and are not in
the rate either. Wants an idle machine.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import made
import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run, started
from networks_bodies import data_of, liver, tetrahedral_liver
from record import RUNS

from softtwin.reference.data.dataset import SPLITS, DataSet
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.generate import Plan, generate, solve_block
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import load

HELD_OUT, WANTED = 16, 20480


FROM_NETWORK = "grid, from a network"
BODIES = {"tetrahedra": tetrahedral_liver, "grid": liver, FROM_NETWORK: liver}
NETWORK = RUNS / "throughput-network"


def trained(ranks: int, seconds: float) -> None:
    """The network that solves may start from; what is there is not made again."""
    plan = TrainingPlan(Reduced(), seconds=seconds, samples=1024)
    made.network(NETWORK, liver(), lambda: train(data_of("liver", ranks), plan))


@cache
def opened() -> Surrogate:
    """That network, once on each rank."""
    return load(NETWORK, liver())


def solve_from_network(path: str, block: int) -> int:
    """As `solve_block`, from where the network says."""
    return solve_block(path, block, opened())


def make(name: str, count: str, folder: str) -> None:
    """Make the data set, on all ranks that mpirun started; rank 0 writes how long all of it took."""
    draws, place = int(count), Path(folder)
    samples = {"train": draws - 2 * HELD_OUT, "validation": HELD_OUT, "test": HELD_OUT}
    plan = Plan("neo-hookean", 5000.0, 0.45, LoadPlan(patches=5, displacement=0.055), samples)
    began = time.time()
    task = solve_from_network if name == FROM_NETWORK else None
    data = generate(place / "data.zarr", BODIES[name](), plan, task=task)
    if data is not None:
        prepared = (data.path / "zarr.json").stat().st_mtime  # the header is written when all is prepared
        (place / "times.json").write_text(
            json.dumps({"prepare_s": prepared - began, "solve_s": time.time() - prepared})
        )


def measured(name: str, ranks: int, draws: int) -> dict[str, Any]:
    """One run in processes of its own."""
    with tempfile.TemporaryDirectory() as kept:
        started(__file__, "make", name, str(draws), kept, ranks=ranks, bind="core")
        times = json.loads((Path(kept) / "times.json").read_text())
        data = DataSet(Path(kept) / "data.zarr")
        figures = [data.figures(split) for split in SPLITS if len(data.split_draws(split))]
        rejected = dict(Counter(data.rejected().reasons))
        sizes = [np.linalg.norm(data.samples(split).displacements, axis=2).max(axis=1) for split in ("train", "test")]
    return {
        **times,
        "draws": draws,
        "rejected": rejected,
        "draws_a_second": draws / times["solve_s"],
        "hours_for_20480": WANTED / draws * times["solve_s"] / 3600.0,
        "iterations": float(np.concatenate([each["iterations"] for each in figures]).mean()),
        "largest_displacement_m": {
            "mean": float(np.concatenate(sizes).mean()),
            "max": float(np.concatenate(sizes).max()),
        },
    }


ROWS = {f"{name}, {ranks} {'rank' if ranks == 1 else 'ranks'}": (name, ranks) for name in BODIES for ranks in (1, 2)}


def work(row: str, given: Given) -> dict[str, Any]:
    name, ranks = ROWS[row]
    if name == FROM_NETWORK:
        trained(given.ranks, given.seconds)
    return measured(name, ranks, given.draws)


def lines(rows: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for each row, with its efficiency against one rank."""
    for key, found in rows.items():
        name, ranks = ROWS[key]
        alone = rows.get(f"{name}, 1 rank", {}).get("draws_a_second")
        more = {"efficiency": found["draws_a_second"] / alone / ranks} if alone else {}
        yield f"{key}, {found['draws']:,} draws", {**found, **more, "rejected": sum(found["rejected"].values())}


BENCHMARK = Benchmark(
    name="throughput",
    title="Equilibria a second on the real liver, by ranks: linear tetrahedra and the thesis's grid",
    about=("reference",),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column("draws a second", "", "{draws_a_second:.2f}"),
        Column("efficiency", "", "{efficiency:.2f}"),
        Column("20,480 at that rate", "h", "{hours_for_20480:.2f}"),
        Column("before the first draw", "s", "{prepare_s:.0f}"),
        Column("rejected", "", "{rejected}"),
    ),
    settings={
        "draws": Setting(1024, "of each row"),
        "seconds": Setting(300.0, "of the network's training"),
        "ranks": Setting(2, "that make the network's data", picks=True),
    },
    small={"draws": 48},
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"make": make})
