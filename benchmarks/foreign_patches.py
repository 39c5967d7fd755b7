"""Clouds of which a part is not where the organ is: an instrument over it, a patch that the camera has seen elsewhere.

    python benchmarks/foreign_patches.py [--twin TWIN] [--engines surrogate reference] [--draws 8]

Frames 5, 15, 25 and 40 of s1, s2 and s3 of the real liver, each from rest and told the zone. About a random point of
the cloud its nearest points, a share of all, are moved towards the camera: all as far (`raised`, as by a wrong stereo
match), or in the middle alone (`bump`, as something soft that lies on the organ), or a shaft of 10 mm hides what is
under it (`instrument`). Points that are not organ need not be found to be none: the state may be right all the same.
What counts is what is accepted, how far it is off, and whether margins of 95 % hold it. Told by the model's error are
frames that are doubtful for nothing but that they ask for more of it than was seen.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from liver import SEQUENCES, sequence
from networks import RUNS
from numpy.typing import NDArray
from record import recorded, stamp, write
from robustness import clean, forward_model, registrar_for, towards_camera
from threadpoolctl import threadpool_limits

from softtwin.meshes.body import Body
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.result import Registration

Floats = NDArray[np.float64]
Moved = Callable[[Floats, Body, np.random.Generator], Floats]
NAME, FRAMES = "foreign_patches", (5, 15, 25, 40)
_RADIUS, _REACH = 5e-3, 0.02  # of the shaft; how far it goes beyond the point it reaches for, metres


def raised(share: float, millimetres: float) -> Moved:
    """A patch, all of it moved as far."""

    def moved(cloud: Floats, body: Body, rng: np.random.Generator) -> Floats:
        away = np.linalg.norm(cloud - cloud[rng.integers(len(cloud))], axis=1)
        is_patch = away <= np.quantile(away, share)
        return cloud + 1e-3 * millimetres * is_patch[:, None] * towards_camera(body)

    return moved


def bump(share: float, millimetres: float) -> Moved:
    """A patch that is moved in its middle, and not at its edge."""

    def moved(cloud: Floats, body: Body, rng: np.random.Generator) -> Floats:
        away = np.linalg.norm(cloud - cloud[rng.integers(len(cloud))], axis=1)
        height = np.clip(1.0 - (away / np.quantile(away, share)) ** 2, 0.0, None) ** 2
        return cloud + 1e-3 * millimetres * height[:, None] * towards_camera(body)

    return moved


def instrument(cloud: Floats, body: Body, rng: np.random.Generator) -> Floats:
    """A shaft that comes from one side, 3 mm above the point it reaches for."""
    view, tip = towards_camera(body), cloud[rng.integers(len(cloud))]
    along = np.cross(view, rng.standard_normal(3))
    along /= np.linalg.norm(along)
    across = np.cross(view, along)
    aside, ahead = (cloud - tip) @ across, (cloud - tip) @ along
    hidden = (np.abs(aside) < _RADIUS) & (ahead < _REACH)
    height = 3e-3 + np.sqrt(_RADIUS**2 - aside[hidden] ** 2)
    seen = cloud.copy()
    seen[hidden] = tip + ahead[hidden, None] * along + aside[hidden, None] * across + height[:, None] * view
    return seen


ROWS: dict[str, Moved] = {
    "clean": clean,
    "instrument": instrument,
    "raised, 5 % by 10 mm": raised(0.05, 10.0),
    "raised, 15 % by 3 mm": raised(0.15, 3.0),
    "raised, 15 % by 10 mm": raised(0.15, 10.0),
    "raised, 30 % by 5 mm": raised(0.3, 5.0),
    "raised, 30 % by 10 mm": raised(0.3, 10.0),
    "bump, 15 % by 10 mm": bump(0.15, 10.0),
    "bump, 30 % by 10 mm": bump(0.3, 10.0),
}


def judged(result: Registration, rest: Floats, truth: Floats) -> dict[str, Any]:
    """Errors and doubt of one frame."""
    errors = np.linalg.norm(rest + result.displacement - truth, axis=1)
    reasons = result.judgement.reasons
    return {
        "verdict": result.judgement.verdict.value,
        "tre_mm": 1e3 * float(errors.mean()),
        "held": float((errors <= result.uncertainty.margin()).mean()),
        "model_doubt": result.discrepancy_scale,
        "outliers": result.outliers,
        "by_error": len(reasons) == 1 and "seen to get wrong" in reasons[0],
    }


def summary(rows: list[dict[str, Any]], failed: int) -> dict[str, Any]:
    """Over all frames, and over those that were accepted; frames without a state are counted alone."""
    found: dict[str, Any] = {"frames": len(rows) + failed, "failed": failed}
    verdicts = [row["verdict"] for row in rows]
    found["verdicts"] = {name: verdicts.count(name) for name in sorted(set(verdicts))}
    groups = {
        "all": rows,
        "accepted": [row for row in rows if row["verdict"] == "accepted"],
        "told by the model's error": [row for row in rows if row["by_error"]],
    }
    for name, used in groups.items():
        if used:
            errors = np.array([row["tre_mm"] for row in used])
            found[name] = {
                "frames": len(used),
                "tre_mm": float(errors.mean()),
                "tre_most_mm": float(errors.max()),
                "held": float(np.mean([row["held"] for row in used])),
                "model_doubt_most": max(row["model_doubt"] for row in used),
                "outliers": float(np.mean([row["outliers"] for row in used])),
            }
    return found


def row_of(name: str, registrars: dict[str, Any], body: Body, draws: int) -> dict[str, Any]:
    """All frames of one kind of cloud."""
    rows, failed = list[dict[str, Any]](), 0
    for s, registrar in registrars.items():
        data = sequence(s)
        for frame in FRAMES:
            for draw in range(draws if ROWS[name] is not clean else 1):
                cloud = ROWS[name](data.clouds[frame], body, np.random.default_rng([draw, frame]))
                try:
                    rows.append(judged(registrar.register(cloud), body.points, data.positions[frame]))
                except NotConverged:
                    failed += 1
    return summary(rows, failed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twin", type=Path, default=RUNS / "liver" / "twin")
    parser.add_argument("--engines", nargs="+", default=["surrogate", "reference"], choices=["surrogate", "reference"])
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--reference-draws", type=int, default=2)
    arguments = parser.parse_args()
    found = recorded(NAME)
    for engine in arguments.engines:
        draws = arguments.draws if engine == "surrogate" else arguments.reference_draws
        with threadpool_limits(1), forward_model(engine, arguments.twin) as model:
            registrars = {s: registrar_for(model, sequence(s).zone, True) for s in SEQUENCES}
            for name in ROWS:
                key = f"{engine}: {name}"
                if key not in found:
                    found[key] = {**row_of(name, registrars, model.body, draws), "made": stamp()}
                    write(NAME, found)
                print(key, found[key], flush=True)


if __name__ == "__main__":
    main()
