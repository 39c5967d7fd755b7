"""A camera of 60 clouds a second on the quickstart's twin: age of the answers, drops, lateness, memory.

    softtwin quickstart --output FOLDER
    python benchmarks/stream.py FOLDER [--seconds 600] [--rate 60] [--budget 0.1] [--engine surrogate]

The organ moves slowly between states under loads of its kind (solved by the reference beforehand); each cloud has
1,000 points and 0.5 mm of noise and is made before the stream begins. No zone is told, no files are written.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from margins import truths
from numpy.typing import NDArray
from record import write
from threadpoolctl import threadpool_limits

from softtwin.app.live import answers
from softtwin.app.quickstart import CAMERA, NOISE, POINTS
from softtwin.app.streams import fed
from softtwin.app.twin import Sequence, Twin
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.dataset import DataSet

Floats = NDArray[np.float64]
STATES, BETWEEN = 8, 60  # frames from one state to the next


def resident_mib() -> float:
    """Memory that this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rate", type=float, default=60.0, help="clouds a second")
    parser.add_argument("--budget", type=float, default=0.1, help="seconds")
    parser.add_argument("--engine", default="surrogate")
    arguments = parser.parse_args()
    data = DataSet(arguments.folder / "data.zarr")
    states = [state for _, state in truths(data, STATES)]
    shares = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, BETWEEN, endpoint=False))
    path = [
        (1.0 - share) * a + share * b for a, b in zip(states, states[1:] + states[:1], strict=True) for share in shares
    ]
    rng = np.random.default_rng(0)
    with threadpool_limits(1), Twin.open(arguments.folder, arguments.engine, pose="fixed") as twin:
        clouds = [partial_view(twin.body, u, CAMERA, POINTS, NOISE, rng, surface="observed") for u in path]
        sequence = Sequence(twin, "")
        sequence.register(clouds[0])  # everything is prepared
        begun: list[float] = []

        def camera() -> Iterator[Floats]:
            start = time.monotonic()
            for number in range(int(arguments.seconds * arguments.rate)):
                time.sleep(max(0.0, start + number / arguments.rate - time.monotonic()))
                begun.append(time.monotonic())
                yield clouds[number % len(clouds)]

        ages, dropped, verdicts, errors, memory = [], 0, [], [], []
        number = 0
        for answer in answers(sequence, fed(camera()), arguments.budget):
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
    figures = {
        **{name: getattr(arguments, name) for name in ("seconds", "rate", "budget", "engine")},
        "clouds": len(begun),
        "answers": len(ages),
        "dropped": dropped,
        "age_ms": {
            name: 1e3 * float(np.quantile(ages, q)) for name, q in (("p50", 0.5), ("p95", 0.95), ("p999", 0.999))
        },
        "within_budget_and_10_ms": float(np.mean(np.array(ages) <= arguments.budget + 0.01)),
        "accepted": float(np.mean([verdict == "accepted" for verdict in verdicts])),
        "error_mm": {"mean": 1e3 * float(np.mean(errors)), "max": 1e3 * float(np.max(errors))},
        "resident_mib": memory,
    }
    print(figures)
    write("stream", figures)


if __name__ == "__main__":
    main()
