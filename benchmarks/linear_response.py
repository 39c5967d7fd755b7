"""How far the linear response of 512 modes is from the whole one, with and without knowing the loads that are drawn.

    python benchmarks/linear_response.py [--only "loose corners" ...]

On the real liver's sparse grid and on the tetrahedra of the phantom: relative errors of the displacement at rest under
held-out drawn loads, smooth forces within 4 cm, and forces of random sign at every node. Then how many ranks the whole
response needs to within a share of its largest singular value, what the loose corners of nearly empty cells do, and
what a Jacobian of 64 modes costs beside its equilibrium (the beam of 304 hexahedra).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from harness import Benchmark, run
from networks_bodies import LIVER, liver
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import outer
from softtwin.meshes.grid import gridded
from softtwin.meshes.io import read_volume
from softtwin.meshes.shapes import beam, liver_phantom
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.samplers import LoadPlan, draw_load, loaded_nodes
from softtwin.reference.generate import linear_response
from softtwin.reference.modes import eigenmodes
from softtwin.reference.solve.problem import Problem

Floats = NDArray[np.float64]
PLANS = {"liver-grid": LoadPlan(patches=5), "phantom": LoadPlan(patches=2, radius=(0.15, 0.5))}
KNOWN, HELD_OUT = 512, 40
NEAR, SMOOTH = 0.04, 0.02  # metres: extent of a smooth force, correlation within it
NEARLY_EMPTY = (1e-3, 0.1)
PULL = 0.05  # newtons
SHARES = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)  # of the largest singular value


def smooth_forces(positions: Floats, rng: np.random.Generator) -> Floats:
    """Correlated forces at the loaded nodes within a ball about one of them, (l, 3)."""
    near = np.linalg.norm(positions - positions[rng.integers(len(positions))], axis=1) < NEAR
    squared = ((positions[near][:, None] - positions[near]) ** 2).sum(axis=2)
    root = np.linalg.cholesky(np.exp(-squared / (2 * SMOOTH**2)) + 1e-8 * np.eye(int(near.sum())))
    forces = np.zeros_like(positions)
    forces[near] = root @ rng.standard_normal((int(near.sum()), 3))
    return forces


def missed(body: Body, plan: LoadPlan) -> dict[str, Any]:
    """Errors of both responses under three kinds of load."""
    loaded, rng = loaded_nodes(body, plan), np.random.default_rng(0)
    with Problem(body, NeoHookean(5000.0, 0.45)) as problem:
        shapes = eigenmodes(problem, plan.modes).shapes
        draws = [draw_load(body, shapes, plan, np.random.default_rng([1, i]))[loaded] for i in range(KNOWN + HELD_OUT)]
        known, drawn = np.stack(draws[:KNOWN]), np.stack(draws[KNOWN:])
        responses = {"blind": linear_response(problem, loaded), "knows": linear_response(problem, loaded, known)}
        smooth = np.stack([smooth_forces(body.points[loaded], rng) for _ in range(HELD_OUT)])
        signs = rng.choice([-1.0, 1.0], (HELD_OUT, len(loaded), 3))
        found: dict[str, Any] = {"loaded_unknowns": 3 * len(loaded)}
        for kind, forces in {"drawn": drawn, "smooth": smooth, "any": signs}.items():
            columns = np.zeros((len(forces), *body.points.shape))
            columns[:, loaded] = forces
            exact = problem.apply_inverse(columns.reshape(len(forces), -1).T).T
            for name, response in responses.items():
                off = response.apply(forces).reshape(len(forces), -1) - exact
                relative = np.linalg.norm(off, axis=1) / np.linalg.norm(exact, axis=1)
                found[f"{kind}, {name}"] = {"median": float(np.median(relative)), "max": float(relative.max())}
    return found


def ranks(body: Body, plan: LoadPlan) -> dict[str, int]:
    """How many singular values of the whole response are larger than a share of the largest."""
    loaded = loaded_nodes(body, plan)
    unknowns = (3 * loaded[:, None] + np.arange(3)).ravel()
    columns = np.zeros((body.points.size, len(unknowns)))
    columns[unknowns, np.arange(len(unknowns))] = 1.0
    with Problem(body, NeoHookean(5000.0, 0.45)) as problem:
        values = np.linalg.svd(problem.apply_inverse(columns), compute_uv=False)
    counted = {f"{share:g}": int((values > share * values[0]).sum()) for share in SHARES}
    return {"loaded_unknowns": len(unknowns), **counted}


def loose_corners() -> dict[str, Any]:
    """Largest movement of a node and of the organ's surface under drawn loads, by the least fraction of a cell."""
    folder = LIVER / "mesh-default"
    whole = Body(*read_volume(folder / "liver.msh"), {"fixed": np.load(folder / "dirichlet-vertices.npy")})
    plan, found = PLANS["liver-grid"], {}
    for least in NEARLY_EMPTY:
        body = gridded(whole, cells_per_axis=(24, 21, 20), smallest=least)
        with Problem(body, NeoHookean(5000.0, 0.45)) as problem:
            shapes = eigenmodes(problem, plan.modes).shapes
            ratios = []
            for i in range(10):
                load = draw_load(body, shapes, plan, np.random.default_rng(i))
                load *= PULL / np.abs(load.sum(axis=0)).max()
                moved = problem.apply_inverse(load.ravel()).reshape(-1, 3)
                surface = np.linalg.norm(outer(body).carried(moved), axis=1).max()
                ratios.append(float(np.linalg.norm(moved, axis=1).max() / surface))
        found[f"{least:g}"] = {"cells": len(body.cells), "node_over_surface_median": float(np.median(ratios))}
    return found


def jacobian_cost() -> dict[str, float]:
    """Median seconds of an equilibrium of the beam from rest, and of K^-1 by 64 columns at it."""
    body, plan = beam(), LoadPlan()
    solve_s, jacobian_s = [], []
    with Problem(body, NeoHookean(4500.0, 0.49)) as problem:
        shapes = eigenmodes(problem, plan.modes).shapes
        columns = np.random.default_rng(0).standard_normal((body.points.size, 64))
        for i in range(20):
            load = draw_load(body, shapes, plan, np.random.default_rng(i))
            linear = problem.apply_inverse(load.ravel()).reshape(-1, 3)
            load *= 0.1 / np.linalg.norm(linear, axis=1).max()
            began = time.perf_counter()
            state = problem.solve(load)
            between = time.perf_counter()
            problem.apply_inverse(columns, state.displacement)
            solve_s.append(between - began)
            jacobian_s.append(time.perf_counter() - between)
    return {"equilibrium_s": float(np.median(solve_s)), "jacobian_s": float(np.median(jacobian_s))}


STUDIES: dict[str, Callable[[], dict[str, Any]]] = {
    "liver-grid": lambda: missed(liver(), PLANS["liver-grid"]),
    "phantom": lambda: missed(liver_phantom(), PLANS["phantom"]),
    "ranks": lambda: {"beam": ranks(beam(), LoadPlan()), "phantom": ranks(liver_phantom(), PLANS["phantom"])},
    "loose corners": loose_corners,
    "cost on the beam": jacobian_cost,
}
BENCHMARK = Benchmark(
    name="linear_response",
    title="How far a linear response of 512 modes is from the whole one, and what the whole one costs",
    about=("reference",),
    work=lambda row, given: STUDIES[row](),
    rows=tuple(STUDIES),
    seeds=(0, 1),
)


if __name__ == "__main__":
    run(BENCHMARK)
