"""Organ surfaces as strangers bring them, and worse, made solid with about 2,000 nodes.

The surfaces lie in ../shared/data/surfaces. Those of SOFA that are 7 across state no unit and are read as centimetres.

    python benchmarks/surfaces.py [--nodes 2000] [--only NAME]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.io import Unit, read_mesh
from softtwin.meshes.metrics import edge_lengths, scaled_jacobians
from softtwin.meshes.solidify import solidify

SURFACES = Path(__file__).parents[2] / "shared" / "data" / "surfaces"
FILES: dict[str, Unit] = {
    "sofa-liver.vtk": "mm",
    "sofa-liver-smooth.obj": "cm",
    "sofa-liver.msh": "cm",
    "sks-kidney.vtk": "mm",
    "sks-liver-sub.ply": "mm",
    "sks-tumour.ply": "mm",
}
DAMAGED = "sks-liver-sub.ply"
SEED = 7


def holes(surface: Surface) -> Surface:
    """Three holes, each a tenth of the surface's size across."""
    rng = np.random.default_rng(SEED)
    middles = surface.points[surface.triangles].mean(axis=1)
    size = np.linalg.norm(np.ptp(surface.points, axis=0))
    centres = middles[rng.choice(len(middles), 3)]
    kept = (np.linalg.norm(middles[:, None] - centres, axis=2) > 0.05 * size).all(axis=1)
    return Surface(surface.points, surface.triangles[kept])


def cut_off(surface: Surface) -> Surface:
    """Open at one end, as a scan ends."""
    middles = surface.points[surface.triangles].mean(axis=1)
    return Surface(surface.points, surface.triangles[middles[:, 0] < np.quantile(surface.points[:, 0], 0.93)])


def unshared(surface: Surface) -> Surface:
    """Every triangle with vertices of its own, rounded as single precision in a text file rounds."""
    points = surface.points[surface.triangles].reshape(-1, 3)
    return Surface(points.astype(np.float32).astype(np.float64), np.arange(len(points)).reshape(-1, 3))


def gaping(surface: Surface) -> Surface:
    """Unshared, and every vertex moved by up to 0.1 mm: gaps and overlaps everywhere."""
    torn = unshared(surface)
    return Surface(torn.points + np.random.default_rng(SEED).uniform(-1e-4, 1e-4, torn.points.shape), torn.triangles)


def inward(surface: Surface) -> Surface:
    """Inside out."""
    return Surface(surface.points, surface.triangles[:, ::-1])


def mixed(surface: Surface) -> Surface:
    """A third of the triangles turned."""
    triangles = surface.triangles.copy()
    chosen = np.random.default_rng(SEED).random(len(triangles)) < 1 / 3
    triangles[chosen] = triangles[chosen][:, ::-1]
    return Surface(surface.points, triangles)


def crumbs(surface: Surface) -> Surface:
    """Thirty small copies scattered around and inside."""
    rng = np.random.default_rng(SEED)
    low, extent = surface.points.min(axis=0), np.ptp(surface.points, axis=0)
    small = 0.02 * (surface.points - surface.points.mean(axis=0))
    parts = [surface.points, *(small + low + extent * rng.uniform(-0.2, 1.2, 3) for _ in range(30))]
    triangles = [surface.triangles + i * len(small) for i in range(len(parts))]
    return Surface(np.concatenate(parts), np.concatenate(triangles))


def crossing(surface: Surface) -> Surface:
    """Forty vertices pushed inward by a tenth of the size: spikes that cut the other side or each other."""
    rng = np.random.default_rng(SEED)
    points = surface.points.copy()
    chosen = rng.choice(len(points), 40, replace=False)
    inwards = points.mean(axis=0) - points[chosen]
    size = np.linalg.norm(np.ptp(points, axis=0))
    points[chosen] += 0.1 * size * inwards / np.linalg.norm(inwards, axis=1, keepdims=True)
    return Surface(points, surface.triangles)


def doubled(surface: Surface) -> Surface:
    """Every triangle there twice, once each way."""
    return Surface(surface.points, np.concatenate([surface.triangles, surface.triangles[:, ::-1]]))


_DAMAGES = (holes, cut_off, unshared, gaping, inward, mixed, crumbs, crossing, doubled)
DAMAGES: dict[str, Callable[[Surface], Surface]] = {each.__name__.replace("_", " "): each for each in _DAMAGES}


def surface_of(name: str) -> Surface:
    """A file's surface, damaged where the name says so after a comma; of a volume mesh its boundary."""
    file, _, damage = name.partition(", ")
    found = read_mesh(SURFACES / file, FILES[file])
    surface = found if isinstance(found, Surface) else Body(found.points, found.cells, {}).boundary_surface
    return DAMAGES[damage](surface) if damage else surface


def measure(surface: Surface, nodes: int) -> dict[str, Any]:
    """Figures of one surface made solid."""
    begin = time.perf_counter()
    solid = solidify(surface, node_count=nodes)
    seconds = time.perf_counter() - begin
    jacobians, edges = scaled_jacobians(solid.points, solid.cells), edge_lengths(solid.points, solid.cells)
    body, mending = Body(solid.points, solid.cells, {}), solid.mending
    _, counts = np.unique(np.sort(body.boundary[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    return {
        "triangles": len(surface.triangles),
        "open_edges": mending.defects.open_edges,
        "components": mending.defects.pieces,
        "nodes": len(body.points),
        "cells": len(body.cells),
        "seconds": seconds,
        "volume_before_m3": mending.volume_before,
        "volume_after_m3": mending.volume_after,
        "volume_ratio": (mending.volume_after + sum(mending.dropped)) / mending.volume_before,
        "dropped_m3": list(mending.dropped),
        "scaled_jacobian_min": jacobians.min(),
        "scaled_jacobian_median": np.median(jacobians),
        "edge_min_m": edges.min(),
        "edge_mean_m": edges.mean(),
        "hausdorff_m": mending.distance,
        "mean_distance_m": mending.mean_distance,
        "boundary_edges_not_of_two_triangles": int((counts != 2).sum()),
        "said": str(mending).splitlines(),
    }


def work(row: str, given: Given) -> dict[str, Any]:
    if not SURFACES.is_dir():
        raise SystemExit(f"skipped: no surfaces in {SURFACES}")
    return measure(surface_of(row), given.nodes)


BENCHMARK = Benchmark(
    name="surfaces",
    title="Organ surfaces as strangers bring them, and damaged ones, made solid",
    about=("meshes",),
    work=work,
    rows=(*FILES, *(f"{DAMAGED}, {name}" for name in DAMAGES)),
    columns=(
        Column("open edges; components", "", "{open_edges}; {components}"),
        Column("nodes; cells", "", "{nodes}; {cells}"),
        Column("time", "s", "{seconds:.1f}"),
        Column("volume after / before", "", "{volume_ratio:.4f}"),
        Column("scaled Jacobian: least; median", "", "{scaled_jacobian_min:.3f}; {scaled_jacobian_median:.3f}"),
        Column("mean edge", "mm", "{edge_mean_m*1000:.2f}"),
        Column("Hausdorff distance", "mm", "{hausdorff_m*1000:.2f}"),
    ),
    settings={"nodes": Setting(2000, "wanted")},
    seeds=(SEED,),
    under="surfaces",
    finish=lambda figures, given: {"nodes_wanted": given.nodes},
)


if __name__ == "__main__":
    run(BENCHMARK)
