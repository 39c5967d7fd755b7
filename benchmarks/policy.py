"""What happens at half and at twice each number that registration's policy has chosen.

    softtwin quickstart --output FOLDER
    python benchmarks/policy.py FOLDER [--cases 4] [--only shared_size ...]

A panel of clouds is registered with the surrogate of the quickstart's organ: right and wrong ones of `verdict.py`
without a zone, right ones with forces within 40 mm of where the organ has moved most, others with noise that
neighbours share, or seen from a pose that is unknown, and frames that follow each other. It is registered again with
one number halved, and doubled (of a chance its logarithm is; whole numbers are rounded). Errors are compared cloud by
cloud: the mean change of the right ones with its standard error, relative to the mean error. A number whose half and
twice change no error by more than that, no coverage and no verdict is one of `ACCURACY`; answers depend on the
others.
"""

from __future__ import annotations

import time
from contextlib import nullcontext, suppress
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import misspecified
import numpy as np
from columns import Column
from harness import FOLDER, Benchmark, Given, Setting, run
from numpy.typing import NDArray
from robustness import noisy
from verdict import BEYOND, KINDS, NOISE, changed, states, unit

from softtwin.app.quickstart import CAMERA, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError, partial_view
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.options import expected_force, options_for
from softtwin.registration.policy import ACCURACY, POLICY, varied
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import prepare
from softtwin.registration.result import Registration
from softtwin.registration.tracker import Tracker
from softtwin.registration.verdict import Verdict

Floats = NDArray[np.float64]
FACTORS = {"half": 0.5, "twice": 2.0}
ZONE, FRAMES, WITHIN = 0.04, 12, 0.9  # metres about the node that has moved most, frames, share
SHARED, POSED = "noise that neighbours share", "pose unknown"
IN_ZONE = ("noise 0.1 mm", "noise 1.0 mm", "noise 5.0 mm")
ROWS = tuple(each.name for table in (POLICY, ACCURACY) for each in fields(table))


def shared_noise(cloud: Floats, _body: Body, rng: np.random.Generator) -> Floats:
    """A millimetre that neighbours within 20 mm share, and little of each point's own."""
    return misspecified.noisy(cloud, "noise that neighbours share", rng)


def posed(cloud: Floats, body: Body, rng: np.random.Generator) -> Floats:
    """Seen from up to 2 degrees and 3 mm beside where the camera was expected."""
    twist = np.concatenate([np.deg2rad(2.0) * unit(rng), 3e-3 * unit(rng)])
    return Pose.identity().moved(rng.uniform() * twist, body.points.mean(axis=0)).apply(cloud)


@cache
def clouds(folder: Path, count: int) -> list[tuple[str, Floats | None, Floats]]:
    """Name, displacement and cloud of each case."""
    with Twin.open(folder, "surrogate", pose="fixed") as twin:
        body = twin.body
    found, kinds = [], {kind: dict(names) for kind, names in KINDS.items()}
    kinds["right"] |= {SHARED: changed(shared_noise), POSED: changed(noisy(NOISE), posed)}
    for kind, names in kinds.items():
        for name, made in names.items():
            rng = np.random.default_rng([5, *name.encode()])
            for state in states(folder, count):
                with suppress(NotConverged):
                    found.append((f"{kind}: {name}", *made(body, state, rng)))
    return found


def figures(found: Registration, truth: Floats | None) -> dict[str, Any]:
    """Error, coverage and verdict of a case."""
    verdict = found.judgement.verdict.value
    if truth is None:
        return {"verdict": verdict, "beyond": True}
    errors = np.linalg.norm(found.displacement - truth, axis=1)
    margin, within = found.uncertainty.margin(), found.uncertainty.margin(confidence=WITHIN)
    return {
        "verdict": verdict,
        "beyond": bool(errors.mean() > BEYOND * margin.mean()),
        "error_mm": 1e3 * float(errors.mean()),
        "covered": float((errors <= within).mean()),
    }


def panel(folder: Path, count: int, name: str = "", factor: float = 1.0) -> dict[str, dict[str, Any]]:
    """All cases with a number times a factor."""
    found: dict[str, dict[str, Any]] = {}
    with varied(name, factor) if name else nullcontext(), Twin.open(folder, "surrogate", pose="fixed") as twin:
        for number, (kind, truth, cloud) in enumerate(clouds(folder, count)):
            camera = twin.near(Pose.identity()) if kind.endswith(POSED) else None
            found[f"{kind}, {number}"] = timed(
                lambda cloud=cloud, camera=camera: twin.register(cloud, "", camera=camera), truth
            )
            if truth is not None and kind.removeprefix("right: ") in IN_ZONE:
                found[f"{kind}, {number}, zone"] = timed(
                    lambda cloud=cloud, truth=truth: in_zone(twin, truth, cloud), truth
                )
        tracker, registrar, (begin, end) = Tracker(), twin.registrar(""), states(folder, 2)
        rng = np.random.default_rng(7)
        for number, share in enumerate(np.linspace(0.0, 1.0, FRAMES)):
            truth = (1.0 - share) * begin + share * end
            cloud = partial_view(twin.body, truth, CAMERA, POINTS, 5e-4, rng, surface="observed")
            found[f"right: frame, {number}"] = timed(lambda cloud=cloud: tracker.take(cloud, registrar), truth)
    return found


def timed(register: Any, truth: Floats | None) -> dict[str, Any]:
    """A case's figures, and its seconds."""
    begin = time.process_time()
    try:
        found = register()
    except (CloudError, NotConverged):
        return {"verdict": Verdict.REFUSED.value, "beyond": True, "seconds": time.process_time() - begin}
    return {"seconds": time.process_time() - begin, **figures(found, truth)}


def in_zone(twin: Twin, truth: Floats, cloud: Floats) -> Registration:
    """Registered with forces near where the organ has moved most."""
    body, seen = twin.body, np.setdiff1d(np.unique(twin.body.surfaces["observed"]), twin.body.fixed)
    middle = body.points[seen[np.linalg.norm(truth[seen], axis=1).argmax()]]
    nodes = seen[np.linalg.norm(body.points[seen] - middle, axis=1) < ZONE]
    size = expected_force(body, twin.config.material.young_modulus)
    options = options_for(twin.model, has_zone=True)
    return prepare(twin.model, nodes, body.surfaces["observed"], force_scale=size, options=options).register(cloud)


def compared(base: dict[str, dict[str, Any]], other: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What has changed."""
    right = [
        name for name in base if name.startswith("right") and "error_mm" in base[name] and "error_mm" in other[name]
    ]
    before, after = (np.array([each[name]["error_mm"] for name in right]) for each in (base, other))
    change = (after - before) / before.mean()
    covered = [np.mean([each[name]["covered"] for name in right]) for each in (base, other)]

    def told(each: dict[str, dict[str, Any]]) -> int:
        return sum(row["verdict"] != "accepted" for name, row in each.items() if name.startswith("right"))

    def missed(each: dict[str, dict[str, Any]]) -> int:
        return sum(row["verdict"] == "accepted" and row["beyond"] for row in each.values())

    return {
        "error_percent": 100.0 * float(change.mean()),
        "error_percent_deviation": 100.0 * float(change.std(ddof=1) / np.sqrt(len(change))),
        "covered_points": 100.0 * float(covered[1] - covered[0]),
        "right_told": told(other) - told(base),
        "missed": missed(other) - missed(base),
        "seconds_ratio": sum(row["seconds"] for row in other.values()) / sum(row["seconds"] for row in base.values()),
        "verdicts_changed": sum(base[name]["verdict"] != other[name]["verdict"] for name in base),
    }


def work(row: str, given: Given) -> dict[str, Any]:
    base = given.once(panel, given.folder, given.cases)
    found = {name: compared(base, panel(given.folder, given.cases, row, factor)) for name, factor in FACTORS.items()}
    table = next(table for table in (POLICY, ACCURACY) if hasattr(table, row))
    about = next(each.metadata for each in fields(table) if each.name == row)
    return {
        "table": type(table).__name__,
        "value": getattr(table, row),
        "unit": about["unit"],
        "clouds": len(base),
        "base_error_mm": float(np.mean([each["error_mm"] for name, each in base.items() if "error_mm" in each])),
        **found,
    }


def of(factor: str) -> tuple[Column, ...]:
    """The columns of a factor."""
    return (
        Column(
            f"{factor}: error",
            "%",
            f"{{{factor}.error_percent:+.1f}} +- {{{factor}.error_percent_deviation:.1f}}",
        ),
        Column("nodes in 0.9", "points", f"{{{factor}.covered_points:+.1f}}"),
        Column("right told; wrong accepted", "", f"{{{factor}.right_told:+d}}; {{{factor}.missed:+d}}"),
        Column("time", "of the usual", f"{{{factor}.seconds_ratio:.2f}}"),
    )


BENCHMARK = Benchmark(
    name="policy",
    title="What happens at half and at twice each number that registration's policy has chosen",
    about=("registration", "surrogate"),
    work=work,
    rows=ROWS,
    columns=(Column("table", "", "{table}"), Column("value", "", "{value} {unit}"), *of("half"), *of("twice")),
    settings={"folder": FOLDER, "cases": Setting(4, "states of each kind of cloud")},
    small={"cases": 2},
    seeds=(5, 7),
)


if __name__ == "__main__":
    run(BENCHMARK)
