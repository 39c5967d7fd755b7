"""Do margins hold in the coordinates in which positions are written, and in the camera's? By what is known of the pose.

    softtwin quickstart --output FOLDER
    python benchmarks/margin_frames.py FOLDER [--clouds 200] [--slow-clouds 40] [--only start ...]

Truths are drawn from the prior that the registration has: smooth forces in the zone of a tool, their size log-normal
about the one told, solved by the reference; none is in the network's data. Clouds are 1,000 points of one side with
0.3 mm of noise, in the coordinates of a camera that stands anywhere. What is known of the pose:

- `exact`: all of it;
- `as said`: nobody gives one; the clouds lie in the organ's coordinates but for an error drawn from the prior for that
  (1 degree, 2 mm), which counts as displacement: positions are written in the camera's coordinates;
- `start`: off by an error drawn from the prior that it is taken with (5 degrees, 10 mm);
- `landmarks`: a start from four landmarks of the organ at rest, found on the moved one to 2 mm, and no belief;
- `align`: a start that is looked for in the cloud, and no belief.

`modal loads, no zone` has forces of the kind that the twin has learned, anywhere on the organ: none of the prior's, and
sparse localisation in place of a zone. The prior's forces are rougher than those that the network has learned. The
model-error ensemble is left out, since truths are of the twin's own organ. Covered is the share of points within the
95 % margin, behind it the standard error of that over clouds: points of one cloud err alike. Fixed nodes are left out.
Refused frames are counted and left out; `mixed` is the share of the tumour's points, as they are written, that the
margin of the camera's coordinates would hold.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column, verdicts
from harness import FOLDER, Benchmark, Given, Setting, run
from margins import truths_of
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from summaries import counts

from softtwin.app.quickstart import CAMERA, POINTS, unseen_load
from softtwin.app.twin import MODEL_ERROR, Camera, Home, Twin, find_twin
from softtwin.meshes.clouds import CloudError, partial_view
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.solve.problem import Problem
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.pose import Pose, from_landmarks
from softtwin.registration.uncertainty import Uncertainty
from softtwin.registration.verdict import Verdict

Floats = NDArray[np.float64]
NOISE, MOVED, SPREAD = (
    3e-4,
    0.012,
    0.5,
)  # metres; metres in the median; of the logarithm of the forces' size, as believed
PLACES, SHAKEN, MARKS, MARKED = (
    np.array([0.0, 0.0, 0.3]),
    0.05,
    4,
    2e-3,
)  # of cameras; number and deviation of landmarks
POSES = ("exact", "as said", "start", "landmarks", "align")
ANYWHERE = "modal loads, no zone"
ROWS = (
    *(f"surrogate: {pose}" for pose in POSES),
    *(f"surrogate, {ANYWHERE}: {pose}" for pose in ("exact", "start")),
    *(f"reference: {pose}" for pose in ("exact", "start", "align")),
)
Truths = tuple[list[Floats], NDArray[np.int64], float]


def truths_from_prior(folder: Path, count: int) -> Truths:
    """Displacements, (n, 3) each, metres, the nodes that forces act on, and the size of a force told, newtons."""
    home = find_twin(folder)
    with home.twin("reference") as exact:
        _, zone = unseen_load(exact.body, exact.model, home.config.loads.displacement)
    body, found = home.body, list[Floats]()
    prior = nodal_forces(body, zone, LogNormalPrior(1.0, SPREAD), home.config.registration.smoothness)
    material = NeoHookean(home.config.material.young_modulus, home.config.material.poisson_ratio)
    with home.twin("surrogate") as fast, Problem(body, material) as problem:
        draws = prior.basis @ np.random.default_rng(1).standard_normal((prior.size, 50))
        moved = fast.predict(np.zeros_like(body.points)).jvp(draws).reshape(-1, 3, 50)
        size = MOVED / float(np.median(np.linalg.norm(moved, axis=1).max(axis=0)))
        number = 0
        while len(found) < count:
            rng = np.random.default_rng([13, number])
            number += 1
            drawn = size * np.exp(SPREAD * rng.standard_normal())
            forces = prior.forces(drawn * rng.standard_normal(prior.size))
            if (fast.predict(forces).extrapolation_ratio or 0.0) > 1.0:  # beyond what was learned
                continue
            try:
                state = problem.solve(forces)
            except NotConverged:
                continue
            if state.is_stable:
                found.append(state.displacement)
    return found, zone, size


@contextmanager
def opened(folder: Path, engine: str, truths: Truths | None) -> Iterator[Twin]:
    """The twin without its model-error ensemble, told zone and size of the forces where these are the prior's."""
    home = find_twin(folder)
    body, options = home.body, dict[str, Any]()
    if truths is not None:
        body, options = body.with_sets(tool=truths[1]), {"zone": "tool", "force_scale": truths[2]}
    with tempfile.TemporaryDirectory() as kept:
        place = Path(shutil.copytree(home.folder, Path(kept) / "twin"))
        (place / MODEL_ERROR).unlink(missing_ok=True)
        with Home(place, body, home.config).twin(engine, **options) as twin:
            yield twin


def stands(twin: Twin, pose: str, moved: Floats, rng: np.random.Generator) -> tuple[Pose, Camera]:
    """Where a camera stands, and what is known of it.

    Args:
        twin: the twin.
        pose: one of `POSES`.
        moved: true positions of the nodes, (n, 3), metres.
        rng: source of random numbers.
    """
    said = Pose(
        Rotation.random(random_state=int(rng.integers(2**31))).as_matrix(), PLACES + SHAKEN * rng.normal(size=3)
    )
    if pose == "exact":
        return said, said
    if pose == "as said":
        assert twin.as_said is not None
        return twin.as_said.pose(rng.standard_normal(6)), None
    if pose == "start":
        near = twin.near(said)
        return near.pose(rng.standard_normal(6)), near
    if pose == "align":
        return said, "align"
    seen = np.setdiff1d(np.unique(twin.body.surfaces["observed"]), twin.body.fixed)
    chosen = [int(rng.choice(seen))]
    while len(chosen) < MARKS:  # each the farthest from those before
        away = np.linalg.norm(twin.body.points[seen][:, None] - twin.body.points[chosen], axis=2).min(axis=1)
        chosen.append(int(seen[away.argmax()]))
    found = said.apply(moved[chosen]) + MARKED * rng.standard_normal((MARKS, 3))
    rest = {str(node): twin.body.points[node] for node in chosen}
    return said, twin.fitted_prior(from_landmarks(rest, dict(zip(rest, found, strict=True))).pose)


def one(twin: Twin, pose: str, truth: Floats, seed: int) -> dict[str, Any]:
    """Errors and margins of one registration, in both frames."""
    rng, rest = np.random.default_rng([17, seed]), twin.body.points
    true, camera = stands(twin, pose, rest + truth, rng)
    cloud = true.apply(partial_view(twin.body, truth, CAMERA, POINTS, NOISE, rng, surface="observed"))
    try:
        found = twin.register(cloud, camera=camera)
    except (CloudError, NotConverged) as error:
        return {"verdict": Verdict.REFUSED.value, "failure": str(error)}
    there, told = true.apply(rest + truth), rest + found.displacement
    written = rest + truth if found.frame == "body" else found.pose.inverse().apply(there)
    frames = {"written": (told - written, found.uncertainty)}
    frames["camera"] = found.pose.apply(told) - there, found.camera_uncertainty
    tumour = twin.embeddings["tumour"].displace(told - written)
    mixed = np.linalg.norm(tumour, axis=1) <= found.camera_uncertainty.margin(twin.embeddings["tumour"])
    return {
        "verdict": found.judgement.verdict.value,
        "seconds": found.seconds,
        "mixed": float(mixed.mean()),
        **{name: both(twin, *frame) for name, frame in frames.items()},
    }


def both(twin: Twin, missed: Floats, known: Uncertainty) -> dict[str, Any]:
    """Errors, margins and the share of points within these, of the tumour and of the nodes that are not fixed."""
    free, inner = np.setdiff1d(np.arange(len(missed)), twin.body.fixed), twin.embeddings["tumour"]
    tumour = np.linalg.norm(inner.displace(missed), axis=1), known.margin(inner)
    nodes = np.linalg.norm(missed, axis=1)[free], known.margin()[free]
    return {
        name: {
            "error_mm": 1e3 * float(off.mean()),
            "margin_mm": 1e3 * float(margin.mean()),
            "covered": float((off <= margin).mean()),
        }
        for name, (off, margin) in (("tumour", tumour), ("nodes", nodes))
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over the frames that were not refused."""
    used = [row for row in rows if row["verdict"] != Verdict.REFUSED.value]
    found: dict[str, Any] = {"clouds": len(rows), "verdicts": counts(row["verdict"] for row in rows)}
    for frame in ("written", "camera"):
        for part in ("tumour", "nodes"):
            shares = np.array([row[frame][part]["covered"] for row in used])
            found[f"{part}_{frame}"] = {
                "covered": float(shares.mean()),
                "standard_error": float(shares.std(ddof=1) / np.sqrt(len(shares))),
                "error_mm": float(np.mean([row[frame][part]["error_mm"] for row in used])),
                "margin_mm": float(np.median([row[frame][part]["margin_mm"] for row in used])),
            }
    found["mixed"] = float(np.mean([row["mixed"] for row in used]))
    found["median_seconds"] = float(np.median([row["seconds"] for row in used]))
    return found


def work(row: str, given: Given) -> dict[str, Any]:
    engine, pose = row.split(": ")
    engine, _, kind = engine.partition(", ")
    truths = None if kind else given.once(truths_from_prior, given.folder, given.clouds)
    every = [moved for _, moved in truths_of(given.folder, given.clouds)] if truths is None else truths[0]
    chosen = every[: given.clouds if engine == "surrogate" else given.slow_clouds]
    with opened(given.folder, engine, truths) as twin:
        return summary([one(twin, pose, truth, seed) for seed, truth in enumerate(chosen)])


def covered(part: str, frame: str) -> Column:
    """A column of the share of a part's points within their margins in a frame, its error and the margin."""
    way = f"{part}_{frame}"
    words = "as written" if frame == "written" else "in the camera's coordinates"
    share, lengths = (
        f"{{{way}.covered*100:.1f}} +- {{{way}.standard_error*100:.1f}}",
        f"{{{way}.error_mm:.2f}}; {{{way}.margin_mm:.2f}}",
    )
    return Column(f"{part} {words}: within the 95 % margin (error; margin, mm)", "%", f"{share} ({lengths})")


BENCHMARK = Benchmark(
    name="margin_frames",
    title="Whether margins hold in the coordinates in which positions are written, and in the camera's",
    about=("registration", "surrogate", "reference"),
    work=work,
    rows=ROWS,
    columns=(
        Column("accepted; doubtful; refused", "", verdicts),
        *(covered(part, frame) for part in ("tumour", "nodes") for frame in ("written", "camera")),
        Column("mixed", "%", "{mixed*100:.0f}"),
        Column("median", "s", "{median_seconds:.2f}"),
    ),
    settings={
        "folder": FOLDER,
        "clouds": Setting(200, "of each row of the surrogate"),
        "slow_clouds": Setting(40, "of each row of the reference"),
    },
    seeds=(13, 17),
    small={"clouds": 3, "slow_clouds": 2},
)


if __name__ == "__main__":
    run(BENCHMARK)
