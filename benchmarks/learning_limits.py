"""What limits the reduced network on a body: its modes, its samples, or what it makes of both.

    python benchmarks/learning_limits.py [--body beam] [--seconds 100]

Prints the error that no network of so many modes can be below, and errors on learned and on held-out samples for some
settings after equal wall time. The data are those of networks_bodies.py.
"""

from __future__ import annotations

import argparse
from typing import Any

from networks_bodies import data_of
from record import recorded, write

from softtwin.meshes.metrics import relative_error
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.evaluate import evaluate, spread
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.pod import learned_basis
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

COUNT = 100  # samples of each split that are judged
SETTINGS = {
    "as it is": Reduced(),
    "160 modes": Reduced(modes=160),
    "no Sobolev term": Reduced(sobolev=0.0),
    "twice as wide": Reduced(width=512),
}


def floor(data: DataSet, modes: int) -> dict[str, Any]:
    """Errors of the linear response with the best correction in so many modes, on held-out samples."""
    basis = learned_basis(data, data.samples("train", 2048), modes, True).modes
    test = data.samples("test", COUNT)
    linear = data.response.apply(test.forces)
    missing = (test.displacements - linear).reshape(len(test), -1)
    best = linear + ((missing @ basis) @ basis.T).reshape(linear.shape)
    return vars(spread(relative_error(best, test.displacements)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body", default="beam", help="a case of networks_bodies.py")
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--ranks", type=int, default=2)
    arguments = parser.parse_args()
    name = f"learning_limits_{arguments.body}"
    found = recorded(name)
    data = data_of(arguments.body, arguments.ranks)
    found["floor"] = {str(modes): floor(data, modes) for modes in (64, 128, 192)}
    for modes, values in found["floor"].items():
        print(f"{modes} modes could be {100 * values['median']:.4f} (95 % {100 * values['p95']:.3f}) % off", flush=True)
    for label, settings in SETTINGS.items():
        key = f"{label}, {arguments.seconds:g} s"
        if key not in found:
            surrogate = train(data, TrainingPlan(settings, seconds=arguments.seconds))
            found[key] = {"steps": surrogate.card["training"]["steps"]}
            for split in ("train", "test"):
                found[key][split] = evaluate(surrogate, data, split, COUNT).as_dict()
            write(name, found)
        for split in ("train", "test"):
            error, relative = (found[key][split][word] for word in ("nodal_error", "relative_error"))
            print(f"{key}, {split}: e {1e3 * error['mean']:.4g} mm, {100 * relative['median']:.3f} % off", flush=True)


if __name__ == "__main__":
    main()
