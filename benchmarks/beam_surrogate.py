"""Reduced network against the thesis's perceptron on the same data: the beam, 2,048 modal samples, held-out test.

    python benchmarks/beam_surrogate.py [--data FOLDER] [--ranks 2] [--reduced-seconds 200] [--mlp-seconds 200]

Makes the data set under benchmarks/runs/ where it is not there (under mpirun, a few minutes), then trains both.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from record import write

from softtwin.app.chain import prepare
from softtwin.app.config import Config
from softtwin.app.launch import generate_in_parallel
from softtwin.app.stages.mesh import mesh_stage
from softtwin.reference.data.dataset import DataSet, Samples
from softtwin.reference.generate import plan_from_header
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.evaluate import evaluate, registration_cosines, table
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

RUNS = Path(__file__).parent / "runs"


def make_data(folder: Path, ranks: int) -> DataSet:
    """The data set: modal loads of fixed amplitude as in the thesis; what is there is not made again."""
    samples = {"train": 2048, "validation": 256, "test": 512, "block": 16, "ranks": ranks}
    loads = {"amplitude": 0.03, "patches": 1, "radius": (0.055, 0.64)}
    config = Config.model_validate({"folder": ".", "body": {"source": "beam"}, "loads": loads, "samples": samples})
    space = prepare(config, folder)
    mesh_stage(space)
    generate_in_parallel(folder / "organ.toml", ranks)
    return DataSet(space.data)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--reduced-seconds", type=float, default=200.0)
    parser.add_argument("--mlp-seconds", type=float, default=200.0)
    arguments = parser.parse_args()
    data = DataSet(arguments.data) if arguments.data else make_data(RUNS / "beam", arguments.ranks)
    plans = {
        "reduced": TrainingPlan(Reduced(), seconds=arguments.reduced_seconds),
        "mlp": TrainingPlan(Perceptron(), seconds=arguments.mlp_seconds),
    }
    figures, evaluations = {"rejected": list(data.rejected().reasons)}, {}
    plan = plan_from_header(data.header)
    with Problem(data.body, plan.build_material(), plan.newton) as problem:
        test = data.samples("test")
        few = Samples(
            *(getattr(test, name)[:100] for name in ("draws", "forces", "displacements", "probes", "adjoints"))
        )
        adjoint = adjoint_of(problem)
        for name, training in plans.items():
            begin = time.perf_counter()
            surrogate = train(data, training)
            seconds = time.perf_counter() - begin
            evaluations[name] = evaluate(surrogate, data)
            cosines = registration_cosines(surrogate, data, few, adjoint)
            figures[name] = {
                **evaluations[name].as_dict(),
                "registration_cosine": {
                    "mean": cosines.mean(),
                    "median": np.median(cosines),
                    "p5": np.quantile(cosines, 0.05),
                },
                "training_seconds": seconds,
                "weights": sum(weights.numel() for weights in surrogate.network.parameters()),
            }
    print(table(evaluations))
    for name in plans:
        print(
            name, "weights", figures[name]["weights"], "registration-like cosine", figures[name]["registration_cosine"]
        )
    write("beam_surrogate", figures)


def adjoint_of(problem: Problem):
    """The exact gradient K(u)^-1 g, (n, 3), at a state u for a cotangent g."""
    return lambda displacement, cotangent: problem.apply_inverse(cotangent.ravel(), displacement).reshape(-1, 3)


if __name__ == "__main__":
    main()
