"""A twin that learns while it is used, on an operation that leaves what it was trained on.

    softtwin quickstart --output FOLDER
    python benchmarks/adaptation.py FOLDER [--frames 300] [--rate 2.5] [--only "surrogate, turning"]
    python benchmarks/adaptation.py FOLDER --name adaptation_galerkin    # trained with architecture = "galerkin"

Loads of the default kind that no data set holds grow to 1.5 times what the twin was trained for. Then one turns once
into another and back (turning: what comes is ever new), or another comes and goes beside a small quick one (to and fro:
a tool and breathing). A camera sees 1,000 points with 0.5 mm of noise of each state, at a steady rate, pose known. The
same clouds are registered twice: with learning and without.

The surrogate's error is that of its state under the forces that were registered, which is what it is asked for, against
their exact state (solved for afterwards), for the surrogate in force when the frame was answered, and for the one that
was built. Beside it stands the error under the true loads, which it never sees. Bounds are those that were said of each
frame; `learned_s` is when the first surrogate that has learned was in force.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column
from harness import FOLDER, Benchmark, Given, Setting, run
from numpy.typing import NDArray
from summaries import median_seconds

from softtwin.app.learning import BackgroundLearner
from softtwin.app.live import answers
from softtwin.app.quickstart import CAMERA, NOISE, POINTS
from softtwin.app.streams import fed
from softtwin.app.twin import Learner, Sequence, Twin
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.generate import plan_from_header, ramp_loads
from softtwin.surrogate.equilibria import Equilibria, NewtonSettings
from softtwin.surrogate.equilibria_model import EquilibriaModel
from softtwin.surrogate.error_bound import ErrorEstimator
from softtwin.surrogate.model import Surrogate

Floats = NDArray[np.float64]
FRESH, DRAWS = 1_000_000, (3, 7, 11)  # loads that no data set holds
BEYOND, GROWING = 1.5, 0.2  # of the loads trained for; share of the frames in which they grow
TOLERANCE = 1e-7  # of exact states, relative to the load
SETTLED = 60.0  # seconds after which frames to come are looked at
ROWS = tuple(f"{engine}, {way}" for way in ("turning", "to and fro") for engine in ("surrogate", "hybrid"))


def factors(way: str, frames: int) -> Floats:
    """How much of each of the three loads acts, (frames, 3)."""
    time_ = np.arange(frames) / frames
    size = BEYOND * np.minimum(1.0, (time_ + 1.0 / frames) / GROWING)
    if way == "turning":
        angle = 2.0 * np.pi * time_
        return size[:, None] * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * time_])
    tool, breath = 0.5 * np.sin(2.0 * np.pi * 5.0 * time_), 0.1 * np.sin(2.0 * np.pi * 30.0 * time_)
    return size[:, None] * np.column_stack([1.0 + 0.0 * time_, tool, breath])


def operation(folder: Path, way: str, frames: int) -> list[tuple[Floats, Floats]]:
    """Loads, newtons, and exact states, metres, (n, 3) each."""
    data = DataSet(folder / "data.zarr")
    plan = plan_from_header(data.header)
    basis = np.stack([ramp_loads(data, plan, FRESH + draw)[0] for draw in DRAWS])
    return solved(folder, list(np.einsum("fk,kni->fni", factors(way, frames), basis)))


def solved(folder: Path, loads: list[Floats]) -> list[tuple[Floats, Floats]]:
    """Loads with their exact states, each from the one before."""
    data, near, found = DataSet(folder / "data.zarr"), None, []
    exact = EquilibriaModel(Equilibria(data.body, data.material, settings=NewtonSettings(tolerance=TOLERANCE)))
    for load in loads:
        try:
            near = exact.solve(load, near)
        except NotConverged:  # a load that was registered, and that the organ does not bear
            found.append((load, np.full_like(load, np.nan)))
            continue
        found.append((load, near.displacement))
    return found


@dataclass(frozen=True, eq=False)
class Said:
    """What held when a frame was answered.

    Args:
        frame: its number.
        at: seconds since the first.
        age: of the answer, seconds.
        verdict: word.
        error: mean distance of nodes from where they are, metres.
        forces: found, (n, 3), newtons; None without a result.
        surrogate: that was in force.
        known: what its bounds were made of.
    """

    frame: int
    at: float
    age: float
    verdict: str
    error: float
    forces: Floats | None
    surrogate: Surrogate
    known: dict[str, Any] | None


def watched(twin: Twin, clouds: list[Floats], states: list[Floats], rate: float, learner: Learner | None) -> list[Said]:
    """The frames of a camera, answered."""
    sequence, found = Sequence(twin, "", is_live=True, learner=learner), []
    start = time.monotonic()

    def camera() -> Iterator[Floats]:
        for number, cloud in enumerate(clouds):
            time.sleep(max(0.0, start + number / rate - time.monotonic()))
            yield cloud

    number = -1
    for answer in answers(sequence, fed(camera())):
        number += 1 + answer.dropped
        registration = answer.frame.registration
        error, forces = np.inf, None
        if registration is not None:
            forces = registration.forces
            error = float(nodal_distances(registration.displacement[None], states[number][None]).mean())
        verdict = answer.frame.judgement.verdict.value
        found.append(
            Said(number, time.monotonic() - start, answer.age, verdict, error, forces, twin.network, twin.bounds)
        )
    sequence.close()
    return found


def errors_of(asked: list[Said], pairs: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats, Floats]:
    """Relative errors of the surrogate as it was built and as it was in force, and of its bounds whether they held.

    Args:
        asked: frames.
        pairs: a load and its exact state for each.

    Returns:
        (frames,), (frames,), and (frames, 2) for the mean and the largest error.
    """
    built, estimator = asked[0].surrogate, ErrorEstimator(asked[0].surrogate)
    before, now, held = [], [], []
    for each, (load, exact) in zip(asked, pairs, strict=True):
        before.append(relative(built, load, exact))
        now.append(relative(each.surrogate, load, exact))
        try:
            state = each.surrogate.solve(load)
        except NotConverged:
            held.append([False, False])
            continue
        bound = estimator.of(each.surrogate).with_known(each.known or {}).bound_error(load, state)
        apart = nodal_distances(state.displacement[None], exact[None])[0]
        held.append([apart.mean() <= bound.mean, apart.max() <= bound.largest])
    return np.array(before), np.array(now), np.array(held)


def relative(surrogate: Surrogate, load: Floats, exact: Floats) -> float:
    """Error of a surrogate's state, relative to the exact one; 1 where it finds none."""
    try:
        found = surrogate.solve(load).displacement
    except NotConverged:
        return 1.0
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def ages(said: list[Said]) -> dict[str, float]:
    """Of the answers, ms."""
    return {
        f"p{round(100 * share)}": 1e3 * float(np.quantile([e.age for e in said], share)) for share in (0.5, 0.95, 1.0)
    }


def figures_of(said: list[Said], settled: float) -> dict[str, Any]:
    """Of the registrations, and of those after some seconds."""
    late = [each for each in said if each.at >= settled]
    errors = 1e3 * np.array([each.error for each in late])
    return {
        "age_ms": ages(said),
        "answers": len(said),
        "accepted_after": float(np.mean([each.verdict == "accepted" for each in late])),
        "refused": sum(each.verdict == "refused" for each in said),
        "error_after_mm": {"median": float(np.median(errors)), "p95": float(np.quantile(errors, 0.95))},
    }


def work(row: str, given: Given) -> dict[str, Any]:
    engine, way = row.split(", ")
    true = given.once(operation, given.folder, way, given.frames)
    states = [state for _, state in true]
    with Twin.open(given.folder, engine, pose="fixed") as twin:
        rng = np.random.default_rng(0)
        clouds = [partial_view(twin.body, u, CAMERA, POINTS, NOISE, rng, surface="observed") for u in states]
        twin.registrar("")
        alone = watched(twin, clouds, states, given.rate, None)
        with BackgroundLearner(twin) as learner:
            said = watched(twin, clouds, states, given.rate, learner)
            learned = learner.learned
    asked = [each for each in said if each.forces is not None][:: given.every]
    built, settled = said[0].surrogate, min(SETTLED, said[-1].at / 2)
    at, first = np.array([e.at for e in asked]), next((e.at for e in said if e.surrogate is not built), np.inf)
    after = at >= settled

    parts = {"all": at >= 0.0, "until_learned": at < first, "until_settled": (at >= first) & ~after, "after": after}
    pairs = {"registered": solved(given.folder, [e.forces for e in asked]), "true": [true[e.frame] for e in asked]}
    found = {}
    for name, every in pairs.items():
        known = np.array([bool(np.isfinite(exact).all()) for _, exact in every])
        before, now, held = errors_of(asked, every)
        late = after & known
        found[name] = {
            "relative_error": {"built": spread(before[late]), "learned": spread(now[late])},
            "times_lower": {
                "median": float(np.median(before[late]) / np.median(now[late])),
                "mean": float(before[late].mean() / now[late].mean()),
            },
            "within_bounds": {
                part: {
                    "mean": float(held[some, 0].mean()),
                    "largest": float(held[some, 1].mean()),
                    "of": int(some.sum()),
                }
                for part, chosen in parts.items()
                if (some := chosen & known).any()
            },
            "without_exact_state": int((~known).sum()),
        }
    load = true[said[-1].frame][0]
    return {
        "learned": {"frames": learned.frames, "adaptations": learned.adaptations, "refused": learned.refused},
        "learned_s": first if np.isfinite(first) else None,
        "largest_mm": 1e3 * max(float(np.linalg.norm(u, axis=1).max()) for u in states),
        **found,
        "prediction_ms": {
            "built": 1e3 * median_seconds(lambda: built.solve(load), 15),
            "learned": 1e3 * median_seconds(lambda: said[-1].surrogate.solve(load), 15),
        },
        "with_learning": figures_of(said, settled),
        "without": figures_of(alone, settled),
    }


def spread(errors: Floats) -> dict[str, float]:
    """Of relative errors."""
    return {"median": float(np.median(errors)), "p95": float(np.quantile(errors, 0.95))}


BENCHMARK = Benchmark(
    name="adaptation",
    title="A twin that learns while it is used, on an operation that leaves what it was trained on",
    about=("app", "registration", "surrogate"),
    work=work,
    rows=ROWS,
    also=("adaptation_galerkin",),
    columns=(
        Column(
            "error after 60 s, as built",
            "%",
            "{registered.relative_error.built.median*100:.2f} / {registered.relative_error.built.p95*100:.1f}",
        ),
        Column(
            "learned",
            "%",
            "{registered.relative_error.learned.median*100:.2f} / {registered.relative_error.learned.p95*100:.1f}",
        ),
        Column("times lower", "", "{registered.times_lower.median:.1f}"),
        Column("first learned", "s", "{learned_s:.0f}"),
        Column(
            "bounds held",
            "%",
            "{registered.within_bounds.all.mean*100:.0f} / {registered.within_bounds.all.largest*100:.0f}",
        ),
        Column("age of answers, learning", "ms", "{with_learning.age_ms.p50:.0f} / {with_learning.age_ms.p95:.0f}"),
        Column("without", "ms", "{without.age_ms.p50:.0f} / {without.age_ms.p95:.0f}"),
        Column("registered to, learning", "mm", "{with_learning.error_after_mm.median:.2f}"),
        Column("without", "mm", "{without.error_after_mm.median:.2f}"),
        Column("accepted, learning", "%", "{with_learning.accepted_after*100:.0f}"),
        Column("without", "%", "{without.accepted_after*100:.0f}"),
    ),
    settings={
        "folder": FOLDER,
        "frames": Setting(300),
        "rate": Setting(3.0, "clouds a second"),
        "every": Setting(2, "so many frames are looked at afterwards"),
    },
    seeds=(0,),
    small={"frames": 12},
)


if __name__ == "__main__":
    run(BENCHMARK)
