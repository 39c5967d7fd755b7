"""Margins of where structures are: how often they cover the truth, and how well the predicted error tells the true one.

    softtwin quickstart --output FOLDER
    python benchmarks/margins.py FOLDER [--loads 200] [--only surrogate ...]
    python benchmarks/margins.py FOLDER --name margins_galerkin    # a folder trained with architecture = "galerkin"

States of the quickstart's organ under loads of its kind that no data set holds, solved by the reference; clouds of
1,000 points from the quickstart's camera, no zone told, from rest. One row has another Poisson's ratio than the twin.
The pose is known exactly, but for the rows that say otherwise: there it is known to 2 mm and 1 degree, as a user's is.
Frames that are refused are counted and left out of the shares; doubtful ones stay in.

Beside the correlation of predicted and true mean errors stands the one that predictions would have if all that they say
were true: with errors drawn from each frame's own posterior. No better one can be expected of these frames.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from columns import Column, shares
from harness import FOLDER, Benchmark, Given, Setting, run
from numpy.typing import NDArray
from summaries import predicted_mm

from softtwin.app.quickstart import CAMERA, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.clouds import partial_view
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.generate import plan_from_header, ramp_loads
from softtwin.reference.solve.problem import Problem
from softtwin.registration.uncertainty import Uncertainty
from softtwin.registration.verdict import Verdict

Floats = NDArray[np.float64]
FRESH = 1_000_000  # numbers of loads begin here: none of them is in a data set
SHARES = (0.5, 0.9, 0.95)
# Noise in metres, the Poisson's ratio that the truth has where it is not the twin's, and whether the pose is exact.
ROWS: dict[str, tuple[float, float | None, bool]] = {
    "noise 0.5 mm": (5e-4, None, True),
    "noise 2 mm": (2e-3, None, True),
    "noise 0.5 mm, Poisson's ratio 0.40 for 0.45": (5e-4, 0.40, True),
    "noise 0.5 mm, pose to 2 mm and 1 degree": (5e-4, None, False),
    "noise 2 mm, pose to 2 mm and 1 degree": (2e-3, None, False),
}
DRAWN = 20  # errors of each posterior


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
        "predicted_mm": predicted_mm(known),
        "covered": {share: float((lengths <= known.margin(None, share) + 1e-12).mean()) for share in SHARES},
        "drawn_mm": (1e3 * drawn(known, rng)).tolist(),
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


def drawn(known: Uncertainty, rng: np.random.Generator) -> Floats:
    """Mean lengths over the nodes of errors as a posterior has them, (DRAWN,), metres."""
    errors = (known.factor @ rng.standard_normal((known.factor.shape[1], DRAWN))).reshape(-1, 3, DRAWN)
    errors += known.rest[:, None, None] * rng.standard_normal(errors.shape)
    lengths: Floats = np.linalg.norm(errors, axis=1).mean(axis=0)
    return lengths


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares and errors over all frames that were not refused."""
    used = [row for row in rows if row["verdict"] != Verdict.REFUSED.value]
    errors = np.array([row["nodes"]["error_mm"] for row in used])
    predicted = np.array([row["nodes"]["predicted_mm"] for row in used])
    every = np.array([row["nodes"]["drawn_mm"] for row in used])
    found: dict[str, Any] = {
        "loads": len(rows),
        "refused": len(rows) - len(used),
        "accepted": float(np.mean([row["verdict"] == Verdict.ACCEPTED.value for row in rows])),
        "error_mm": float(errors.mean()),
        "predicted_mm": float(predicted.mean()),
        "correlation": float(np.corrcoef(errors, predicted)[0, 1]),
        "correlation_at_best": float(np.mean([np.corrcoef(each, predicted)[0, 1] for each in every.T])),
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


def truths_of(folder: Path, count: int, poisson_ratio: float | None = None) -> list[tuple[Floats, Floats]]:
    """Loads and states of a quickstart's data set that are not in it."""
    return truths(DataSet(folder / "data.zarr"), count, poisson_ratio)


def work(row: str, given: Given) -> dict[str, Any]:
    engine, label = row.split(", ", 1)
    noise, poisson_ratio, is_exact = ROWS[label]
    pairs = given.once(truths_of, given.folder, given.loads, poisson_ratio)
    with Twin.open(given.folder, engine, **({"pose": "fixed"} if is_exact else {})) as twin:
        return {"summary": summary([one(twin, truth, noise, i) for i, (_, truth) in enumerate(pairs)])}


BENCHMARK = Benchmark(
    name="margins",
    title="How often margins cover the truth, and how well the predicted error tells the true one",
    about=("registration", "surrogate", "reference"),
    work=work,
    rows=tuple(f"{engine}, {label}" for label in ROWS for engine in ("surrogate", "hybrid")),
    also=("margins_galerkin",),
    columns=(
        Column("error; predicted", "mm", "{error_mm:.2f}; {predicted_mm:.2f}"),
        Column("r; at best", "", "{correlation:.2f}; {correlation_at_best:.2f}"),
        Column("nodes covered by 50 / 90 / 95 % margins", "%", lambda f: shares(f["nodes_covered"])),
        Column("tumour", "%", lambda f: shares(f["structures"]["tumour"]["covered"])),
        Column("its 95 % margin", "mm", "{structures.tumour.margin95_mm:.2f}"),
        Column("median", "s", "{median_seconds:.2f}"),
    ),
    settings={"folder": FOLDER, "loads": Setting(200, "that no data set holds")},
    small={"loads": 2},
    lines=lambda rows: ((name, found["summary"]) for name, found in rows.items()),
)


if __name__ == "__main__":
    run(BENCHMARK)
