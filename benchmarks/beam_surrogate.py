"""Reduced network against the thesis's perceptron on the same data: the beam, 2,048 modal samples, held-out test.

    python benchmarks/beam_surrogate.py [--data FOLDER] [--ranks 2] [--seconds 200]

Makes the data set under benchmarks/runs/ where it is not there (under mpirun, a few minutes), then trains both.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from made import beam_data
from record import RUNS

from softtwin.reference.data.dataset import DataSet, Samples
from softtwin.reference.generate import plan_from_header
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.evaluate import evaluate, registration_cosines
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train


def make_data(folder: Path, ranks: int) -> DataSet:
    """The data set: modal loads of fixed amplitude as in the thesis; what is there is not made again."""
    samples = {"train": 2048, "validation": 256, "test": 512, "block": 16, "ranks": ranks}
    loads = {"amplitude": 0.03, "patches": 1, "radius": (0.055, 0.64)}
    return beam_data(folder, {"loads": loads, "samples": samples}, ranks)


KINDS = {"reduced": Reduced(), "mlp": Perceptron()}


def data_for(path: Path | None, ranks: int) -> DataSet:
    """The data set that is given, or the one that is made."""
    return DataSet(path) if path else make_data(RUNS / "beam", ranks)


@contextmanager
def problem_of(data: DataSet) -> Iterator[Problem]:
    """The problem that a data set is of."""
    plan = plan_from_header(data.header)
    with Problem(data.body, plan.build_material(), plan.newton) as problem:
        yield problem


def work(row: str, given: Given) -> dict[str, Any]:
    data = given.once(data_for, given.data, given.ranks)
    problem, test = given.opened(problem_of, data), data.samples("test")
    few = Samples(*(getattr(test, name)[:100] for name in ("draws", "forces", "displacements", "probes", "adjoints")))
    begin = time.perf_counter()
    surrogate = train(data, TrainingPlan(KINDS[row], seconds=given.seconds))
    seconds = time.perf_counter() - begin
    cosines = registration_cosines(surrogate, data, few, adjoint_of(problem))
    return {
        **evaluate(surrogate, data).as_dict(),
        "registration_cosine": {
            "mean": cosines.mean(),
            "median": np.median(cosines),
            "p5": np.quantile(cosines, 0.05),
        },
        "training_seconds": seconds,
        "weights": sum(weights.numel() for weights in surrogate.network.parameters()),
    }


def adjoint_of(problem: Problem):
    """The exact gradient K(u)^-1 g, (n, 3), at a state u for a cotangent g."""
    return lambda displacement, cotangent: problem.apply_inverse(cotangent.ravel(), displacement).reshape(-1, 3)


BENCHMARK = Benchmark(
    name="beam_surrogate",
    title="Reduced network against the thesis's perceptron on the same data: the beam, 2,048 modal samples",
    about=("surrogate",),
    work=work,
    rows=tuple(KINDS),
    columns=(
        Column("mean nodal", "mm", "{nodal_error.mean*1000:.3f}"),
        Column("relative, median (95 %)", "%", "{relative_error.median*100:.3f} ({relative_error.p95*100:.2f})"),
        Column("gradient cosine", "", "{gradient_cosine.mean:.5f}"),
        Column("that of a registration", "", "{registration_cosine.mean:.5f}"),
        Column("weights", "", "{weights:,}"),
        Column("training", "s", "{training_seconds:.0f}"),
    ),
    settings={
        "data": Setting(None, "a data set of the beam", Path, picks=True),
        "seconds": Setting(200.0, "of training"),
        "ranks": RANKS,
    },
    finish=lambda figures, given: {"rejected": list(given.once(data_for, given.data, given.ranks).rejected().reasons)},
    lines=lambda rows: ((name, rows[name]) for name in KINDS if name in rows),
)


if __name__ == "__main__":
    run(BENCHMARK)
