"""How time and memory of a solve grow with the number of unknowns: MUMPS and multigrid, one rank and two.

Bending of the beam (1 x 0.25 x 0.25 m, linear hexahedra, Neo-Hookean, E = 5000 Pa, nu = 0.45) by 1 N at its tip, from
rest, each case in a process of its own.

    python benchmarks/growth.py                      all cases, about 40 minutes
    python benchmarks/growth.py --largest 30000      sizes up to that
"""

from __future__ import annotations

import json
import resource
import subprocess
import time
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run, started
from mpi4py import MPI

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
    how = {"check": False, "capture_output": True, "timeout": TIMEOUT_S}
    try:
        done = started(__file__, "one", str(size), method, ranks=ranks, **how)
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


CASES = {
    f"{method}, {ranks} rank{'s' * (ranks > 1)}, {size:g}": (method, ranks, size)
    for method, sizes in SIZES.items()
    for ranks in (1, 2)
    for size in sizes
}


def work(row: str, given: Given) -> dict[str, Any]:
    method, ranks, _ = CASES[row]
    given.once(case, SIZES[method][0], method, ranks)  # compiles the forms
    return case(CASES[row][2], method, ranks)


def exponents(figures: dict[str, Any], given: Given) -> dict[str, Any]:
    """Of time and memory over the unknowns, by method and ranks."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row, found in figures["cases"].items():
        groups.setdefault(row.rpartition(", ")[0], []).append(found)
    return {
        "exponents_from_1e4_unknowns": {
            name: {quantity: exponent(rows, quantity) for quantity in ("solve_s", "peak_GiB")}
            for name, rows in groups.items()
        }
    }


def alone(size: str, method: str) -> None:
    """One case, on the ranks that mpirun has started."""
    found = one(float(size), method)
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(found))


BENCHMARK = Benchmark(
    name="growth",
    title="How time and memory of a solve grow with the unknowns: MUMPS and multigrid, one rank and two",
    about=("reference/fem", "reference/solve"),
    work=work,
    rows=lambda given: [row for row, (*_, size) in CASES.items() if size <= given.largest],
    columns=(
        Column("unknowns", "", "{unknowns:,}"),
        Column("set-up", "s", "{setup_s:.1f}"),
        Column("solve", "s", "{solve_s:.1f}"),
        Column("memory", "GiB", "{peak_GiB:.2f}"),
        Column("iterations; factorisations", "", "{iterations}; {factorisations}"),
    ),
    settings={"largest": Setting(1e6, "unknowns", picks=True)},
    small={"largest": 1e3},
    under="cases",
    finish=exponents,
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"one": alone})
