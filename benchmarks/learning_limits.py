"""What limits the reduced network on a body: its modes, its samples, or what it makes of both.

    python benchmarks/learning_limits.py [--body beam] [--seconds 100]

Prints the error that no network of so many modes can be below, and errors on learned and on held-out samples for some
settings after equal wall time. The data are those of networks_bodies.py.
"""

from __future__ import annotations

from typing import Any

from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from networks_bodies import data_of

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


def work(row: str, given: Given) -> dict[str, Any]:
    data = given.once(data_of, given.body, given.ranks)
    if row == "floor":
        return {str(modes): floor(data, modes) for modes in (64, 128, 192)}
    surrogate = train(data, TrainingPlan(SETTINGS[row.rpartition(",")[0]], seconds=given.seconds))
    judged = {split: evaluate(surrogate, data, split, COUNT).as_dict() for split in ("train", "test")}
    return {"steps": surrogate.card["training"]["steps"], **judged}


BENCHMARK = Benchmark(
    name="learning_limits_{body}",
    title="What limits the reduced network on a body: its modes, its samples, or what it makes of both",
    about=("surrogate",),
    work=work,
    rows=lambda given: ["floor", *(f"{label}, {given.seconds:g} s" for label in SETTINGS)],
    columns=tuple(
        Column(
            f"{split}: mean nodal, mm; relative, %",
            "",
            f"{{{split}.nodal_error.mean*1000:.3f}}; {{{split}.relative_error.median*100:.3f}}",
        )
        for split in ("train", "test")
    ),
    settings={
        "body": Setting("beam", "a case of networks_bodies.py"),
        "seconds": Setting(100.0, "of training"),
        "ranks": RANKS,
    },
)


if __name__ == "__main__":
    run(BENCHMARK)
