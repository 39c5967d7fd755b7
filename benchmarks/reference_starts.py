"""The reference's steps on the real liver: cold, far from the state it starts at, released, and columns of push.

python benchmarks/reference_starts.py

Forces are those of frame 49 of s1, s2 and s3, and shares of them; tolerance and limits are those of registration.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, liver, sequence
from record import write

from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.derivatives.model import ReferenceModel, ReferenceState
from softtwin.reference.solve.problem import NewtonOptions, Problem

COLUMNS = (1, 20, 100)


def timed(name: str, solve: Callable[[], ReferenceState]) -> tuple[dict[str, Any], ReferenceState | None]:
    """One solve with its times and counts; one that is refused has no counts."""
    wall, cpu, state = time.perf_counter(), time.process_time(), None
    try:
        state = solve()
    except NotConverged as refused:
        print(f"  {refused}")
    row = {"step": name, "seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    if state is not None:
        found = state.equilibrium
        row |= {"iterations": found.iterations, "factorisations": found.factorisations, "load_steps": found.load_steps}
        row["largest_mm"] = 1e3 * float(np.linalg.norm(state.displacement, axis=1).max())
    print({key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()}, flush=True)
    return row, state


def steps(model: ReferenceModel, name: str) -> list[dict[str, Any]]:
    """The steps of one sequence."""
    data, body = sequence(name), model.body

    def forces(frame: int, share: float = 1.0) -> np.ndarray:
        field = np.zeros_like(body.points)
        field[data.tool] = share * data.net_forces[frame] / len(data.tool)
        return field

    row, pulled = timed("cold", lambda: model.solve(forces(49)))
    rows = [row]
    if pulled is None:
        return rows
    rest = model.solve(forces(49, 0.0))
    for label, wanted, near in (
        ("from rest", forces(49), rest),
        ("released", forces(49, 0.0), pulled),
        ("released to 1 %", forces(49, 0.01), pulled),
        ("to a half", forces(49, 0.5), pulled),
        ("to frame 48", forces(48), pulled),
        ("to frame 0", forces(0), pulled),
        ("reversed", forces(49, -1.0), pulled),
    ):
        rows.append(timed(label, lambda wanted=wanted, near=near: model.solve(wanted, near=near))[0])
    rng = np.random.default_rng(0)
    pulled.vjp(pulled.displacement)  # factors
    for count in COLUMNS:
        columns = rng.standard_normal((body.points.size, count))
        start = time.process_time()
        pulled.jvp(columns)
        rows.append({"step": f"push, {count} columns", "cpu_seconds_a_column": (time.process_time() - start) / count})
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    figures = {}
    newton = NewtonOptions(tolerance=1e-5, max_iterations=15)
    with Problem(liver(), NeoHookean(YOUNG_MODULUS, POISSON_RATIO), newton) as problem:
        for name in SEQUENCES:
            print(name)
            figures[name] = steps(ReferenceModel(problem, patient=False), name)
    write("reference_starts", {"tolerance": newton.tolerance, "sequences": figures})


if __name__ == "__main__":
    main()
