"""How time and memory of a solve grow with the number of unknowns: MUMPS and multigrid, one rank and two.

Bending of the beam (1 x 0.25 x 0.25 m, linear hexahedra, Neo-Hookean, E = 5000 Pa, nu = 0.45) by 1 N at its tip, from
rest, each case in a process of its own.

python benchmarks/growth.py            all cases, about 40 minutes
python benchmarks/growth.py 30000      sizes up to that
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np
from mpi4py import MPI
from record import write

from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import NewtonOptions, Problem

SIZES = {"mumps": (1e3, 3e3, 1e4, 3e4, 1e5), "multigrid": (1e3, 3e3, 1e4, 3e4, 1e5, 3e5, 1e6)}
FITTED = 1e4  # unknowns from which on exponents are fitted
TIMEOUT_S = 3000


def one(wanted: float, method: Any) -> dict[str, Any]:
    """Time and memory of one size on the ranks of this run; memory is the sum over the ranks."""
    comm = MPI.COMM_WORLD
    across = max(1, round((wanted / 12) ** (1 / 3)))
    body = beam((4 * across, across, across), (1.0, 0.25, 0.25), "hexahedron")
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"], 2] = 1.0 / len(body.node_sets["tip"])
    comm.Barrier()
    begin = time.perf_counter()
    with Problem(body, NeoHookean(5000.0, 0.45), NewtonOptions(linear=method), comm=comm) as problem:
        made = time.perf_counter()
        state = problem.solve(forces, stability=False)
        solved = time.perf_counter()
    peak = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
    return {
        "unknowns": int(body.points.size),
        "method": method,
        "ranks": comm.size,
        "setup_s": made - begin,
        "solve_s": solved - made,
        "peak_GiB": peak,
        "iterations": state.iterations,
        "factorisations": state.factorisations,
        "load_steps": state.load_steps,
        "tip_m": float(state.displacement[body.node_sets["tip"], 2].mean()),
    }


def case(size: float, method: str, ranks: int) -> dict[str, Any]:
    """One case in processes of its own; what went wrong is part of the answer."""
    launch = [] if ranks == 1 else ["mpirun", "--bind-to", "none", "-n", str(ranks)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command = [*launch, sys.executable, __file__, "--one", str(size), method]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return {"wanted": size, "method": method, "ranks": ranks, "failed": f"more than {TIMEOUT_S} s"}
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        return {"wanted": size, "method": method, "ranks": ranks, "failed": done.stderr.strip()[-300:]}
    return dict(json.loads(lines[0]))


def exponent(rows: list[dict[str, Any]], quantity: str) -> float | None:
    """Least-squares slope of a quantity over the unknowns, both as logarithms."""
    large = [row for row in rows if row.get("unknowns", 0) >= 0.8 * FITTED]
    if len(large) < 2:
        return None
    return float(np.polyfit(*(np.log([row[key] for row in large]) for key in ("unknowns", quantity)), 1)[0])


def main(largest: float) -> None:
    rows = []
    for method, sizes in SIZES.items():
        for ranks in (1, 2):
            for size in sizes:
                if size > largest:
                    continue
                if size == sizes[0]:
                    case(size, method, ranks)  # compiles the forms
                rows.append(case(size, method, ranks))
                print(rows[-1], flush=True)
    fits = {
        f"{method}, {ranks} rank{'s' * (ranks > 1)}": {
            quantity: exponent([r for r in rows if (r["method"], r["ranks"]) == (method, ranks)], quantity)
            for quantity in ("solve_s", "peak_GiB")
        }
        for method in SIZES
        for ranks in (1, 2)
    }
    print(fits)
    write("growth", {"cases": rows, "exponents_from_1e4_unknowns": fits})


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        found = one(float(sys.argv[2]), sys.argv[3])
        if MPI.COMM_WORLD.rank == 0:
            print(json.dumps(found))
    else:
        main(float(sys.argv[1]) if len(sys.argv) > 1 else np.inf)
