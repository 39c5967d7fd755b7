"""Who is told when a result cannot be used: false alarms of the verdict on right clouds, its power on wrong ones.

    softtwin quickstart --output FOLDER
    python benchmarks/verdict.py FOLDER [--cases 125] [--only "right: all" ...]

States of the quickstart's organ under one pull at a patch of the side that is seen, by the reference; clouds of 1,000
points from the quickstart's camera, from rest, no zone told, the pose given as exact. `right`: noise of each point of
0.1 to 5 mm, a tenth of the points anywhere, half of the side, 300 points. Each doubtful or refused frame of these is a
false alarm. `wrong`: what the twin is not of, with 0.5 mm of noise. A frame is beyond where its mean error is more than
twice its mean margin of 95 %, and always where the cloud shows no state of the organ; accepted frames that are
beyond are missed. By which checks the others were told is counted.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column, verdicts
from foreign_patches import raised
from harness import FOLDER, Benchmark, Given, Setting, run
from liver import liver
from misspecified import MODULUS, RATIO, as_it_is, held_elsewhere, moved
from numpy.typing import NDArray
from robustness import half_side, noisy, part, towards_camera, with_outliers
from scipy.spatial.transform import Rotation
from summaries import counts
from tqdm import tqdm

from softtwin.app.quickstart import CAMERA, POINTS
from softtwin.app.twin import Twin, find_twin
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError, partial_view
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.pose import Pose
from softtwin.registration.verdict import Verdict

Floats = NDArray[np.float64]
Rng = np.random.Generator
# A displacement as the camera has it, (n, 3), metres, and the cloud; None where the cloud shows no state of the organ.
Shown = tuple[Floats | None, Floats]
Made = Callable[[Body, Floats, Rng], Shown]  # of the body, a state of it, and chance
NOISE, BEYOND = 0.5, 2.0  # mm; mean margins of 95 %


def seen(body: Body, displacement: Floats, rng: Rng) -> Floats:
    """What the camera sees of a state, without noise."""
    return partial_view(body, displacement, CAMERA, POINTS, 0.0, rng, surface="observed")


def changed(*changes: Callable[[Floats, Body, Rng], Floats]) -> Made:
    """The cloud of a state, changed one way after the other."""

    def shown(body: Body, state: Floats, rng: Rng) -> Shown:
        cloud = seen(body, state, rng)
        for change in changes:
            cloud = change(cloud, body, rng)
        return state, cloud

    return shown


def another_organ(body: Body, state: Floats, rng: Rng) -> Shown:
    """The side of the real liver that faces the camera, where the organ's is, turned by some way."""
    other = liver()
    turn = Rotation.from_rotvec(rng.uniform(0.0, 0.5) * unit(rng)).as_matrix()
    turned = (other.points - other.points.mean(axis=0)) @ turn.T
    cloud = partial_view(other, turned - other.points, CAMERA, POINTS, 0.0, rng)
    middle = body.points[np.unique(body.surfaces["observed"])].mean(axis=0)
    return None, noisy(NOISE)(cloud - cloud.mean(axis=0) + middle, body, rng)


def mirrored(body: Body, state: Floats, rng: Rng) -> Shown:
    _, cloud = changed(noisy(NOISE))(body, state, rng)
    middle = cloud.mean(axis=0)
    return None, middle + (cloud - middle) * [-1.0, 1.0, 1.0]


def drape(cloud: Floats, body: Body, rng: Rng) -> Floats:
    """Half of the points, in one piece, on a plane 5 mm above where they are in the mean."""
    away = np.linalg.norm(cloud - cloud[rng.integers(len(cloud))], axis=1)
    under = away <= np.median(away)
    middle = cloud[under].mean(axis=0)
    normal = np.linalg.svd(cloud[under] - middle, full_matrices=False)[2][2]
    covered = cloud.copy()
    covered[under] -= ((cloud[under] - middle) @ normal)[:, None] * normal
    covered[under] += 5e-3 * towards_camera(body)
    return covered


def other_support(body: Body, state: Floats, rng: Rng) -> Shown:
    displacement, _ = held_elsewhere(body, rng, 0.01, 0.03)
    return displacement, noisy(NOISE)(seen(body, displacement, rng), body, rng)


def hidden_load(body: Body, state: Floats, rng: Rng) -> Shown:
    """A pull at the side that is not seen, where no training load acted."""
    nodes = np.setdiff1d(body.boundary_nodes, np.unique(body.surfaces["observed"]))
    displacement, _ = moved(body, NeoHookean(MODULUS, RATIO), rng, nodes)
    return displacement, noisy(NOISE)(seen(body, displacement, rng), body, rng)


def scaled(cloud: Floats, body: Body, rng: Rng) -> Floats:
    """2 % larger or smaller about its middle."""
    middle = cloud.mean(axis=0)
    return middle + (cloud - middle) * (1.0 + rng.choice([-0.02, 0.02]))


def other_pose(body: Body, state: Floats, rng: Rng) -> Shown:
    """A camera up to 5 degrees and 10 mm beside where it was said to be."""
    _, cloud = changed(noisy(NOISE))(body, state, rng)
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(1.0, 5.0)) * unit(rng)).as_matrix()
    middle = body.points.mean(axis=0)
    pose = Pose(turn, middle - turn @ middle + rng.uniform(0.002, 0.01) * unit(rng))
    return pose.apply(body.points + state) - body.points, pose.apply(cloud)


def unit(rng: Rng) -> Floats:
    """Any direction, (3,)."""
    drawn: Floats = rng.standard_normal(3)
    return drawn / np.linalg.norm(drawn)


KINDS: dict[str, dict[str, Made]] = {
    "right": {
        **{f"noise {mm} mm": changed(noisy(mm)) for mm in (0.1, 0.5, 1.0, 2.0, 5.0)},
        "outliers": changed(noisy(NOISE), with_outliers),
        "half of the side": changed(noisy(NOISE), half_side),
        "300 points": changed(noisy(NOISE), part(0.3)),
    },
    "wrong": {
        "another organ": another_organ,
        "mirrored": mirrored,
        "patch of 15 % by 5 mm": changed(noisy(NOISE), raised(0.15, 5.0)),
        "patch of 30 % by 10 mm": changed(noisy(NOISE), raised(0.3, 10.0)),
        "half under a drape": changed(noisy(NOISE), drape),
        "held 10 to 30 mm elsewhere": other_support,
        "pulled where it never learned": hidden_load,
        "2 % larger or smaller": changed(noisy(NOISE), scaled),
        "pose off and called exact": other_pose,
    },
}
ROWS = tuple(f"{kind}: {name}" for kind, names in KINDS.items() for name in (*names, "all"))


@cache
def states(folder: Path, count: int) -> list[Floats]:
    """Displacements of so many states, (n, 3), metres; what has no equilibrium is drawn again."""
    body, rng, found = find_twin(folder).body, np.random.default_rng(5), list[Floats]()
    while len(found) < count:
        with suppress(NotConverged):
            found.append(as_it_is(body, rng)[0])
    return found


def cases(folder: Path, kind: str, name: str, count: int) -> list[dict[str, Any]]:
    """A frame of each state in a row; one that has no equilibrium there is none."""
    body, rng, found = find_twin(folder).body, np.random.default_rng([5, *name.encode()]), list[dict[str, Any]]()
    with Twin.open(folder, "surrogate", pose="fixed") as twin:
        for state in tqdm(states(folder, count), desc=name):
            with suppress(NotConverged):
                truth, cloud = KINDS[kind][name](body, state, rng)
                found.append(one(twin, truth, cloud))
    return found


def one(twin: Twin, truth: Floats | None, cloud: Floats) -> dict[str, Any]:
    """Verdict, error over margin, and the checks that were not passed."""
    try:
        result = twin.register(cloud, "")
    except (CloudError, NotConverged) as error:
        return {"verdict": Verdict.REFUSED.value, "beyond": True, "told_by": [type(error).__name__], "error_mm": None}
    told_by = sorted({check.code.value for check in result.judgement.checks if not check.is_passed})
    figures = {"verdict": result.judgement.verdict.value, "told_by": told_by}
    if truth is None:
        return {**figures, "beyond": True, "error_mm": None}
    error = float(np.linalg.norm(result.displacement - truth, axis=1).mean())
    margin = float(result.uncertainty.margin().mean())
    return {**figures, "beyond": error > BEYOND * margin, "error_mm": 1e3 * error, "margin_mm": 1e3 * margin}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts, and means over the frames that were not refused and have a truth."""
    used = [row for row in rows if row["error_mm"] is not None and row["verdict"] != Verdict.REFUSED.value]
    accepted = [row for row in rows if row["verdict"] == Verdict.ACCEPTED.value]
    beyond = [row for row in rows if row["beyond"]]
    return {
        "cases": len(rows),
        "verdicts": counts(row["verdict"] for row in rows),
        "beyond": len(beyond),
        "missed": sum(row["beyond"] for row in accepted),
        "told_by": counts(code for row in rows for code in row["told_by"]),
        "error_mm": float(np.mean([row["error_mm"] for row in used])) if used else None,
        "margin_mm": float(np.mean([row["margin_mm"] for row in used])) if used else None,
    }


def work(row: str, given: Given) -> dict[str, Any]:
    kind, name = row.split(": ")
    names = list(KINDS[kind]) if name == "all" else [name]
    return summary([case for each in names for case in given.once(cases, given.folder, kind, each, given.cases)])


def told(found: dict[str, Any]) -> str:
    """The checks that told most often."""
    often = sorted(found["told_by"].items(), key=lambda entry: -entry[1])
    return ", ".join(f"{name} {count}" for name, count in often[:4]) or "none"


BENCHMARK = Benchmark(
    name="verdict",
    title="False alarms of the verdict on right clouds, and its power on wrong ones",
    about=("registration", "surrogate", "app"),
    work=work,
    rows=ROWS,
    columns=(
        Column("cases", "", "{cases}"),
        Column("accepted; doubtful; refused", "", verdicts),
        Column("error; margin", "mm", "{error_mm:.2f}; {margin_mm:.2f}"),
        Column("beyond twice the margin", "", "{beyond}"),
        Column("accepted of these", "", "{missed}"),
        Column("not passed most often", "", told),
    ),
    settings={"folder": FOLDER, "cases": Setting(125, "of each row")},
    small={"cases": 1},
    seeds=(5,),
)


if __name__ == "__main__":
    run(BENCHMARK)
