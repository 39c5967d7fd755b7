"""A camera of 60 clouds a second on the quickstart's twin: age of the answers, drops, lateness, memory.

    softtwin quickstart --output FOLDER
    python benchmarks/stream.py FOLDER [--seconds 600] [--rate 60] [--budget 0.1] [--engine surrogate]
                                       [--searches thread]

The organ moves slowly between states under loads of its kind (solved by the reference beforehand); each cloud has
1,000 points and 0.5 mm of noise and is made before the stream begins. No zone is told, no files are written.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from harness import FOLDER, Benchmark, Given, Setting, run
from margins import truths_of
from numpy.typing import NDArray
from summaries import resident_mib

from softtwin.app.live import answers
from softtwin.app.quickstart import CAMERA, NOISE, POINTS
from softtwin.app.searching import searching
from softtwin.app.streams import fed
from softtwin.app.twin import Sequence, Twin
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.metrics import nodal_distances

Floats = NDArray[np.float64]
STATES, BETWEEN = 8, 60  # frames from one state to the next


def path_of(folder: Path) -> list[Floats]:
    """Displacements of the organ as it moves from state to state and back to the first."""
    states = [state for _, state in truths_of(folder, STATES)]
    shares = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, BETWEEN, endpoint=False))
    pairs = zip(states, states[1:] + states[:1], strict=True)
    return [(1.0 - share) * a + share * b for a, b in pairs for share in shares]


def clouds_of(twin: Twin, path: list[Floats]) -> list[Floats]:
    """What the camera sees of each state."""
    rng = np.random.default_rng(0)
    return [partial_view(twin.body, u, CAMERA, POINTS, NOISE, rng, surface="observed") for u in path]


def work(row: str, given: Given) -> dict[str, Any]:
    path = path_of(given.folder)
    with (
        Twin.open(given.folder, given.engine, pose="fixed") as twin,
        searching(twin) if given.searches == "process" else nullcontext() as search,
        closing(Sequence(twin, "", is_live=True, search=search)) as sequence,
    ):
        clouds = clouds_of(twin, path)
        sequence.register(clouds[0])  # everything is prepared
        while search is not None and not search.is_ready:
            time.sleep(0.1)
        begun: list[float] = []

        def camera() -> Iterator[Floats]:
            start = time.monotonic()
            for number in range(int(given.seconds * given.rate)):
                time.sleep(max(0.0, start + number / given.rate - time.monotonic()))
                begun.append(time.monotonic())
                yield clouds[number % len(clouds)]

        ages, dropped, verdicts, errors, memory = [], 0, [], [], []
        number = 0
        for answer in answers(sequence, fed(camera()), given.budget):
            number += 1 + answer.dropped
            ages.append(answer.age)
            dropped += answer.dropped
            verdicts.append(answer.frame.judgement.verdict.value)
            if answer.frame.registration is not None and len(ages) % 20 == 0:
                found = answer.frame.registration.displacement[None]
                errors.append(float(nodal_distances(found, path[(number - 1) % len(path)][None]).mean()))
            if len(ages) in (50, 500) or len(ages) % 2000 == 0:
                memory.append((len(ages), resident_mib()))
        memory.append((len(ages), resident_mib()))
    return {
        **{name: getattr(given, name) for name in ("seconds", "rate", "budget", "engine", "searches")},
        "clouds": len(begun),
        "answers": len(ages),
        "dropped": dropped,
        "age_ms": {
            name: 1e3 * float(np.quantile(ages, q)) for name, q in (("p50", 0.5), ("p95", 0.95), ("p999", 0.999))
        },
        "within_budget_and_10_ms": float(np.mean(np.array(ages) <= given.budget + 0.01)),
        "accepted": float(np.mean([verdict == "accepted" for verdict in verdicts])),
        "error_mm": {"mean": 1e3 * float(np.mean(errors)), "max": 1e3 * float(np.max(errors))},
        "resident_mib": memory,
    }


BENCHMARK = Benchmark(
    name="stream",
    title="A camera of 60 clouds a second on the quickstart's twin: age of the answers, drops, memory",
    about=("app", "registration", "surrogate"),
    work=work,
    settings={
        "folder": FOLDER,
        "seconds": Setting(600.0),
        "rate": Setting(60.0, "clouds a second"),
        "budget": Setting(0.1, "seconds"),
        "engine": Setting("surrogate"),
        "searches": Setting("process", "from rest, beside the frames", choices=("process", "thread")),
    },
    seeds=(0,),
    small={"seconds": 3.0},
)


if __name__ == "__main__":
    run(BENCHMARK)
