"""The organ before gravity: the stress-free body found again from the shape that its weight gives it.

    python benchmarks/unloaded.py [--only "real liver" ...]

A body of known stress-free shape hangs under its whole weight (1,060 kg/m^3) along each of six directions; what it
looks like then is the scan, and `unloaded` has to find the body again: by Newton's method on the inverse problem, and
by Sellier's fixed point on two of these scans (prone and supine). A body is found where its nodes are within 0.01 mm of
the true one. Another one is another stress-free shape that hangs, balanced and stable, exactly as the scan: the answer
is not unique there. From a scan prone (the weight along -z) to supine (+z): how far the nodes are from where the true
body's go, with the body found, and with the scan taken for stress-free and twice the weight put on it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from liver import liver
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam, liver_phantom
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.solve.problem import Problem
from softtwin.reference.unloaded import Method, moved_body, unloaded

Floats = NDArray[np.float64]
WEIGHT, RATIO, FOUND = 1060.0 * 9.81, 0.45, 0.01  # N/m^3; millimetres
DIRECTIONS = np.vstack([np.eye(3), -np.eye(3)])
SUPINE, PRONE = DIRECTIONS[2], DIRECTIONS[5]
MODULI = (3e3, 5e3, 1e4)
BODIES: dict[str, Callable[[], Body]] = {
    "beam of 1 m": beam,
    "beam of 0.12 m": lambda: beam((16, 4, 4), (0.12, 0.03, 0.03)),
    "phantom": liver_phantom,
    "real liver": liver,
}
ROWS = {f"{name}, {modulus / 1e3:.0f} kPa": (name, modulus) for name in BODIES for modulus in MODULI}


@cache
def body_of(name: str) -> Body:
    return BODIES[name]()


def hung(body: Body, material: NeoHookean, weight: Floats) -> Floats | None:
    """Displacement under a weight, (n, 3), metres; None where no equilibrium is found."""
    try:
        with Problem(body, material) as problem:
            return problem.solve(Loading(body_force=weight)).displacement
    except NotConverged:
        return None


def furthest(first: Floats, second: Floats) -> float:
    """Greatest distance of nodes, millimetres."""
    return 1e3 * float(np.linalg.norm(first - second, axis=1).max())


def tried(
    body: Body, scanned: Body, material: NeoHookean, weight: Floats, method: Method
) -> tuple[dict[str, Any], Any]:
    """What a method finds, and the body."""
    begun = time.perf_counter()
    try:
        found = unloaded(scanned, material, Loading(body_force=weight), method=method)
    except NotConverged as failure:
        return {"reached": failure.load_factor, "seconds": time.perf_counter() - begun}, None
    told = {
        "reached": 1.0,
        "seconds": time.perf_counter() - begun,
        "error_mm": furthest(found.body.points, body.points),
        "is_stable": found.is_stable,
        "iterations": found.iterations,
    }
    return told, found.body


def work(row: str, given: Given) -> dict[str, Any]:
    name, modulus = ROWS[row]
    body, material = body_of(name), NeoHookean(modulus, RATIO)
    directions = DIRECTIONS[[2, 5]] if given.few else DIRECTIONS
    sags, runs, positions = [], [], {}
    for direction in directions:
        weight = WEIGHT * direction
        moved = hung(body, material, weight)
        if moved is None:
            continue
        sags.append(furthest(moved, np.zeros_like(moved)))
        scanned = moved_body(body, moved)
        newton, found = tried(body, scanned, material, weight, "newton")
        runs.append({"newton": newton})
        if any(np.array_equal(direction, each) for each in (PRONE, SUPINE)):  # a failure takes minutes
            runs[-1]["fixed point"], _ = tried(body, scanned, material, weight, "fixed point")
        positions[tuple(direction)] = scanned.points, scanned, found
    return {
        "directions": len(directions),
        "hang": len(runs),
        "sag_mm": {"median": float(np.median(sags)), "worst": max(sags)} if sags else None,
        **{method: summary([run[method] for run in runs if method in run]) for method in ("newton", "fixed point")},
        "supine_mm": supine(material, positions.get(tuple(PRONE)), positions.get(tuple(SUPINE))),
    }


def supine(material: NeoHookean, prone: Any, truth: Any) -> dict[str, float | None] | None:
    """Greatest error of the nodes of a body turned from prone to supine, with the body found and without one."""
    if prone is None or truth is None:
        return None
    (_, scanned, found), (wanted, _, _) = prone, truth
    moved = None if found is None else hung(found, material, WEIGHT * SUPINE)
    without = hung(scanned, material, 2.0 * WEIGHT * SUPINE)
    return {
        "found": None if moved is None else furthest(found.points + moved, wanted),
        "scan": None if without is None else furthest(scanned.points + without, wanted),
    }


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """How many bodies a method found, and other ones, how near, and in what time."""
    errors = [run["error_mm"] for run in runs if "error_mm" in run]
    near, seconds = [error for error in errors if error <= FOUND], [run["seconds"] for run in runs]
    return {
        "found": len(near),
        "other": len(errors) - len(near),
        "none": len(runs) - len(errors),
        "worst_mm": max(near, default=None),
        "seconds": {"median": float(np.median(seconds)), "longest": max(seconds)} if seconds else None,
        "runs": runs,
    }


def columns_of(method: str) -> tuple[Column, ...]:
    """What a method found."""
    return (
        Column(
            f"{method}: found / another one / none", "", f"{{{method}.found}} / {{{method}.other}} / {{{method}.none}}"
        ),
        Column("greatest error", "mm", f"{{{method}.worst_mm:.1e}}"),
        Column("median / longest", "s", f"{{{method}.seconds.median:.1f}} / {{{method}.seconds.longest:.1f}}"),
    )


BENCHMARK = Benchmark(
    name="unloaded",
    title="The organ before gravity: the stress-free body found again from the shape that its weight gives it",
    about=("reference/unloaded.py", "reference/fem", "reference/solve"),
    work=work,
    rows=lambda given: list(ROWS),
    columns=(
        Column("hangs, of six directions", "", "{hang}"),
        Column("sag, median / worst", "mm", "{sag_mm.median:.0f} / {sag_mm.worst:.0f}"),
        *columns_of("newton"),
        *columns_of("fixed point"),
        Column("supine from prone, greatest error", "mm", "{supine_mm.found:.1e}"),
        Column("scan taken for stress-free", "mm", "{supine_mm.scan:.1f}"),
    ),
    settings={"few": Setting(False, "prone and supine alone")},
    small={"few": True},
)


if __name__ == "__main__":
    run(BENCHMARK)
