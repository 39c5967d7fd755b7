"""Margins of where structures are: how often they cover the truth, and how well the predicted error tells the true one.

    softtwin quickstart --output FOLDER
    python benchmarks/margins.py FOLDER [--loads 200] [--engines surrogate hybrid]

States of the quickstart's organ under loads of its kind that no data set holds, solved by the reference; clouds of
1,000 points from the quickstart's camera, no zone told, from rest. One row has another Poisson's ratio than the twin.
Frames that are refused are counted and left out of the shares; doubtful ones stay in.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from record import recorded, stamp, write
from threadpoolctl import threadpool_limits

from softtwin.app.quickstart import CAMERA, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.clouds import partial_view
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.generate import plan_from_header, ramp_loads
from softtwin.reference.solve.problem import Problem
from softtwin.registration.verdict import Verdict

Floats = NDArray[np.float64]
NAME = "margins"
FRESH = 1_000_000  # numbers of loads begin here: none of them is in a data set
SHARES = (0.5, 0.9, 0.95)
# Noise in metres, and the Poisson's ratio that the truth has where it is not the twin's.
ROWS: dict[str, tuple[float, float | None]] = {
    "noise 0.5 mm": (5e-4, None),
    "noise 2 mm": (2e-3, None),
    "noise 0.5 mm, Poisson's ratio 0.40 for 0.45": (5e-4, 0.40),
}


def truths(data: DataSet, count: int, poisson_ratio: float | None = None) -> list[tuple[Floats, Floats]]:
    """Fresh loads, newtons, that have a stable state, and this, metres, (n, 3) each."""
    plan = plan_from_header(data.header)
    material = NeoHookean(plan.young_modulus, poisson_ratio or plan.poisson_ratio)
    found: list[tuple[Floats, Floats]] = []
    with Problem(data.body, material) as problem:
        for number in range(FRESH, FRESH + 2 * count):
            load, factors = ramp_loads(data, plan, number)
            try:
                state = problem.solve(factors[-1] * load)
            except NotConverged:
                continue
            if state.is_stable and len(found) < count:
                found.append((factors[-1] * load, state.displacement))
    return found


def one(twin: Twin, truth: Floats, noise: float, seed: int) -> dict[str, Any]:
    """Errors and margins of one registration."""
    rng = np.random.default_rng(seed)
    cloud = partial_view(twin.body, truth, CAMERA, POINTS, noise, rng, surface="observed")
    result = twin.register(cloud, "")
    kept: dict[str, Any] = {"verdict": result.judgement.verdict.value, "seconds": result.seconds, "structures": {}}
    missed, known = result.displacement - truth, result.uncertainty
    lengths = np.linalg.norm(missed, axis=1)
    kept["moved_mm"] = 1e3 * float(np.linalg.norm(truth, axis=1).max())
    kept["nodes"] = {
        "error_mm": 1e3 * float(lengths.mean()),
        "predicted_mm": 1e3 * float(np.sqrt(8.0 / (3.0 * np.pi)) * known.deviation.mean()),  # mean of a normal's length
        "covered": {share: float((lengths <= known.margin(None, share) + 1e-12).mean()) for share in SHARES},
    }
    bound = twin.bounded(result)
    if result.draft is not None and bound is not None:  # where both engines part, and whether the network had said so
        apart = np.linalg.norm(result.draft.displacement - result.displacement, axis=1)
        kept["draft"] = {
            "apart_mm": 1e3 * float(apart.mean()),
            "largest_mm": 1e3 * float(apart.max()),
            "bound_mm": 1e3 * bound.mean,
            "within_bound": bool(apart.mean() <= bound.mean),
            "inside": bound.is_inside,
        }
    for name, points in twin.embeddings.items():
        away = np.linalg.norm(points.displace(missed), axis=1)
        kept["structures"][name] = {
            "error_mm": 1e3 * float(away.mean()),
            "margin95_mm": 1e3 * float(known.margin(points).max()),
            "covered": {share: float((away <= known.margin(points, share)).mean()) for share in SHARES},
            "whole": bool((away <= known.margin(points).max()).all()),
        }
    return kept


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares and errors over all frames that were not refused."""
    used = [row for row in rows if row["verdict"] != Verdict.REFUSED.value]
    errors = np.array([row["nodes"]["error_mm"] for row in used])
    predicted = np.array([row["nodes"]["predicted_mm"] for row in used])
    found: dict[str, Any] = {
        "loads": len(rows),
        "refused": len(rows) - len(used),
        "accepted": float(np.mean([row["verdict"] == Verdict.ACCEPTED.value for row in rows])),
        "error_mm": float(errors.mean()),
        "predicted_mm": float(predicted.mean()),
        "correlation": float(np.corrcoef(errors, predicted)[0, 1]),
        "off_mm": float(np.abs(errors - predicted).mean()),
        "nodes_covered": {share: float(np.mean([row["nodes"]["covered"][share] for row in used])) for share in SHARES},
        "median_seconds": float(np.median([row["seconds"] for row in used])),
        "structures": {},
    }
    drafts = [row["draft"] for row in used if "draft" in row]
    if drafts:
        found["drafts"] = {
            name: float(np.mean([draft[name] for draft in drafts]))
            for name in ("apart_mm", "largest_mm", "within_bound", "inside")
        } | {"bound_mm": float(np.median([draft["bound_mm"] for draft in drafts])), "count": len(drafts)}
    for name in used[0]["structures"]:
        each = [row["structures"][name] for row in used]
        found["structures"][name] = {
            "error_mm": float(np.mean([one["error_mm"] for one in each])),
            "margin95_mm": float(np.median([one["margin95_mm"] for one in each])),
            "covered": {share: float(np.mean([one["covered"][share] for one in each])) for share in SHARES},
            "whole_within_margin": float(np.mean([one["whole"] for one in each])),
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--loads", type=int, default=200)
    parser.add_argument("--engines", nargs="+", default=["surrogate", "hybrid"])
    parser.add_argument("--name", default=NAME, help="of the record")
    arguments = parser.parse_args()
    found = recorded(arguments.name)
    data = DataSet(arguments.folder / "data.zarr")
    for label, (noise, poisson_ratio) in ROWS.items():
        states = [state for _, state in truths(data, arguments.loads, poisson_ratio)]
        for engine in arguments.engines:
            key = f"{engine}, {label}"
            if key not in found:
                with threadpool_limits(1), Twin.open(arguments.folder, engine) as twin:
                    rows = [one(twin, truth, noise, i) for i, truth in enumerate(states)]
                found[key] = {"summary": summary(rows), "made": stamp()}
                write(arguments.name, found)
            told = {name: value for name, value in found[key]["summary"].items() if name != "structures"}
            print(key, json.dumps(told), json.dumps(found[key]["summary"]["structures"]), sep="\n  ", flush=True)


if __name__ == "__main__":
    main()
