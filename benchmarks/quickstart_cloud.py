"""The quickstart's twin without a zone: cold and warm frames, the tumour's error, clouds of up to a million points.

    softtwin quickstart --output FOLDER
    python benchmarks/quickstart_cloud.py FOLDER [--draws 20]

The quickstart's own cloud, and others of the same hidden deformation with noise of their own. A warm frame starts from
the result of the cloud before it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from record import write
from threadpoolctl import threadpool_limits

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--draws", type=int, default=20)
    arguments = parser.parse_args()
    truth = np.load(arguments.folder / "demo" / "truth.npy")
    own = np.load(arguments.folder / "demo" / "cloud.npy")
    rows: list[dict[str, Any]] = []
    with threadpool_limits(1), Twin.open(arguments.folder, pose="fixed") as twin:
        body = twin.body

        def seen(count: int, seed: int) -> Floats:
            rng = np.random.default_rng(seed)
            return partial_view(body, truth, CAMERA, count, NOISE, rng, surface="observed")

        clouds = [own, *(seen(POINTS, 100 + draw) for draw in range(arguments.draws))]
        twin.registrar("")  # prepared once
        last: Registration | None = None
        for cloud in clouds:
            cold = twin.register(cloud, "")
            rows.append(row("cold", cold, body, truth))
            warm = twin.register(cloud, "", last or cold)
            rows.append(row("warm", warm, body, truth))
            last = warm
        sizes = {}
        for count in SIZES:
            cloud = seen(count, 7)
            cold = twin.register(cloud, "")
            sizes[count] = {**row("cold", cold, body, truth), "points_used": cold.points}
    figures = {"own cloud": rows[0], "rows": rows, "sizes": sizes, "summary": {}}
    for kind in ("cold", "warm"):
        some = [entry for entry in rows if entry["start"] == kind]
        figures["summary"][kind] = {
            "median_seconds": float(np.median([entry["seconds"] for entry in some])),
            "longest_seconds": max(entry["seconds"] for entry in some),
            "tumour_mm": float(np.mean([entry["tumour"] for entry in some])),
            "tumour_worst_mm": max(entry["tumour"] for entry in some),
            "nodes_mm": float(np.mean([entry["nodes"] for entry in some])),
            "accepted": float(np.mean([entry["verdict"] == "accepted" for entry in some])),
        }
        print(kind, figures["summary"][kind])
    for count, entry in sizes.items():
        print(f"{count:8d} points: {entry['seconds']:.2f} s, tumour {entry['tumour']:.2f} mm, {entry['verdict']}")
    write("quickstart_cloud", figures)


if __name__ == "__main__":
    main()
