"""The quickstart's twin without a zone: cold and warm frames, the tumour's error, clouds of up to a million points.

    softtwin quickstart --output FOLDER
    python benchmarks/quickstart_cloud.py FOLDER [--draws 20]

The quickstart's own cloud, and others of the same hidden deformation with noise of their own. A warm frame starts from
the result of the cloud before it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from columns import Column
from harness import FOLDER, Benchmark, Given, Setting, run
from numpy.typing import NDArray

from softtwin.app.quickstart import CAMERA, NOISE, POINTS  # what its own cloud is made with
from softtwin.app.twin import Twin
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import target_points
from softtwin.registration.result import Registration

Floats = NDArray[np.float64]
SIZES = (1_000, 10_000, 100_000, 1_000_000)


def errors_mm(body: Body, result: Registration, truth: Floats) -> dict[str, float]:
    """Mean error of each inner structure and of all nodes, millimetres."""
    missed = result.displacement - truth
    inner = {name: points.displace(missed) for name, points in target_points(body).items()}
    return {name: 1e3 * float(np.linalg.norm(e, axis=1).mean()) for name, e in {**inner, "nodes": missed}.items()}


def row(kind: str, result: Registration, body: Body, truth: Floats) -> dict[str, Any]:
    """What is kept of one registration."""
    return {
        "start": kind,
        "seconds": result.seconds,
        "verdict": result.judgement.verdict.value,
        "noise_mm": 1e3 * result.noise,
        "iterations": len(result.trace),
        **errors_mm(body, result, truth),
    }


def work(row_name: str, given: Given) -> dict[str, Any]:
    truth, own = (np.load(given.folder / "demo" / f"{name}.npy") for name in ("truth", "cloud"))
    with Twin.open(given.folder, pose="fixed") as twin:

        def seen(count: int, seed: int) -> Floats:
            rng = np.random.default_rng(seed)
            return partial_view(twin.body, truth, CAMERA, count, NOISE, rng, surface="observed")

        clouds = [own, *(seen(POINTS, 100 + draw) for draw in range(given.draws))]
        twin.registrar("")  # prepared once
        rows = frames(twin, clouds, truth)
        sizes = {}
        for count in SIZES[: given.sizes]:
            cold = twin.register(seen(count, 7), "")
            sizes[count] = {**row("cold", cold, twin.body, truth), "points_used": cold.points}
    starts = {kind: summary([entry for entry in rows if entry["start"] == kind]) for kind in ("cold", "warm")}
    return {"own cloud": rows[0], "rows": rows, "sizes": sizes, "summary": starts}


def frames(twin: Twin, clouds: list[Floats], truth: Floats) -> list[dict[str, Any]]:
    """Each cloud from rest, and from the result of the cloud before it."""
    rows, last = [], None
    for cloud in clouds:
        cold = twin.register(cloud, "")
        last = twin.register(cloud, "", last or cold)
        rows += [row(kind, found, twin.body, truth) for kind, found in (("cold", cold), ("warm", last))]
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Over all clouds of one start."""
    return {
        "median_seconds": float(np.median([entry["seconds"] for entry in rows])),
        "longest_seconds": max(entry["seconds"] for entry in rows),
        "tumour_mm": float(np.mean([entry["tumour"] for entry in rows])),
        "tumour_worst_mm": max(entry["tumour"] for entry in rows),
        "nodes_mm": float(np.mean([entry["nodes"] for entry in rows])),
        "accepted": float(np.mean([entry["verdict"] == "accepted" for entry in rows])),
    }


BENCHMARK = Benchmark(
    name="quickstart_cloud",
    title="The quickstart's twin without a zone: cold and warm frames, the tumour's error, up to a million points",
    about=("registration", "surrogate"),
    work=work,
    columns=(
        Column("tumour (worst)", "mm", "{tumour_mm:.2f} ({tumour_worst_mm:.2f})"),
        Column("nodes", "mm", "{nodes_mm:.2f}"),
        Column("accepted", "%", "{accepted*100:.0f}"),
        Column("median (longest)", "s", "{median_seconds:.2f} ({longest_seconds:.2f})"),
    ),
    settings={
        "folder": FOLDER,
        "draws": Setting(20, "clouds beside the quickstart's own"),
        "sizes": Setting(len(SIZES), "of clouds, of those tried"),
    },
    seeds=(7, 100),
    small={"draws": 2, "sizes": 1},
    lines=lambda figures: figures["summary"].items(),
)


if __name__ == "__main__":
    run(BENCHMARK)
