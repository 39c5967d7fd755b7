"""Equilibria a second on the real liver, by ranks: linear tetrahedra and the thesis's grid of hexahedra.

    python benchmarks/throughput.py [--bodies tetrahedra grid "grid, from a network"] [--ranks 1 2] [--draws 1024]

Draws loads as table 4.3 does (1 to 5 patches, the largest scaled to 55 mm) and makes a data set from nothing under
mpirun, Jacobians left out. Every draw counts, rejected ones too; what comes before the first draw (modes, linear
response, pilot loads) is given apart. From a network: each solve starts where a reduced network says, which has learned
from the first 1,024 draws of `networks_bodies.py` for --seconds; both are made where they are not there, and are not in
the rate either. Wants an idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from networks import RUNS
from networks_bodies import data_of, liver, tetrahedral_liver
from record import recorded, write

from softtwin.reference.data.dataset import SPLITS, DataSet
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.generate import Plan, generate, solve_block
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import CARD, load, save

NAME = "throughput"
HELD_OUT, WANTED = 16, 20480


FROM_NETWORK = "grid, from a network"
BODIES = {"tetrahedra": tetrahedral_liver, "grid": liver, FROM_NETWORK: liver}
NETWORK = RUNS / "throughput-network"


def trained(ranks: int, seconds: float) -> None:
    """The network that solves may start from; what is there is not made again."""
    if not (NETWORK / CARD).exists():
        save(train(data_of("liver", ranks), TrainingPlan(Reduced(), seconds=seconds, samples=1024)), NETWORK)


@cache
def opened() -> Surrogate:
    """That network, once on each rank."""
    return load(NETWORK, liver())


def solve_from_network(path: str, block: int) -> int:
    """As `solve_block`, from where the network says."""
    return solve_block(path, block, opened())


def make(name: str, draws: int, folder: Path) -> None:
    """Make the data set, on all ranks that mpirun started; rank 0 writes how long all of it took."""
    samples = {"train": draws - 2 * HELD_OUT, "validation": HELD_OUT, "test": HELD_OUT}
    plan = Plan("neo-hookean", 5000.0, 0.45, LoadPlan(patches=5, displacement=0.055), samples)
    began = time.time()
    task = solve_from_network if name == FROM_NETWORK else None
    data = generate(folder / "data.zarr", BODIES[name](), plan, task=task)
    if data is not None:
        prepared = (data.path / "zarr.json").stat().st_mtime  # the header is written when all is prepared
        (folder / "times.json").write_text(
            json.dumps({"prepare_s": prepared - began, "solve_s": time.time() - prepared})
        )


def measured(name: str, ranks: int, draws: int) -> dict[str, Any]:
    """One run in processes of its own."""
    with tempfile.TemporaryDirectory() as kept:
        command = [sys.executable, __file__, "--make", name, "--draws", str(draws), "--folder", kept]
        if ranks > 1:
            command = ["mpirun", "--oversubscribe", "--bind-to", "core", "-n", str(ranks), *command]
        subprocess.run(command, check=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", nargs="+", default=list(BODIES), choices=list(BODIES))
    parser.add_argument("--ranks", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--draws", type=int, default=1024)
    parser.add_argument("--seconds", type=float, default=300.0, help="of the network's training")
    parser.add_argument("--name", default=NAME, help="of the record")
    parser.add_argument("--make", default="", help="make one data set alone, and end")
    parser.add_argument("--folder", type=Path, help="of that data set")
    arguments = parser.parse_args()
    if arguments.make:
        make(arguments.make, arguments.draws, arguments.folder)
        return
    found = recorded(arguments.name)
    for name in arguments.bodies:
        if name == FROM_NETWORK:
            trained(max(arguments.ranks), arguments.seconds)
        for ranks in arguments.ranks:
            key = f"{name}, {ranks} {'rank' if ranks == 1 else 'ranks'}"
            if key not in found:
                found[key] = measured(name, ranks, arguments.draws)
                write(arguments.name, found)
            row, alone = found[key], found.get(f"{name}, 1 rank", {}).get("draws_a_second")
            efficiency = f"{row['draws_a_second'] / alone / ranks:.2f}" if alone else "-"
            print(
                f"{key:22} {row['draws_a_second']:.2f} a second, efficiency {efficiency}; 20,480 in "
                f"{row['hours_for_20480']:.2f} h and {row['prepare_s']:.0f} s before; rejected: {row['rejected']}"
            )


if __name__ == "__main__":
    main()
