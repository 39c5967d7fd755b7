"""One surrogate for many supports: how stiff the bed is that an organ lies on, as an input, over its whole range.

    python benchmarks/varied_springs.py [--draws 100]

The quickstart's phantom, held at its hilum, whose lower side lies on springs. Held-out supports are drawn evenly in the
logarithm, from 0.3 to 3 times as stiff as expected, each with one of the test draws; states by torch's solver. Errors
are |u - u*| / |u*|. A model of one stiffness is asked for its own (what a twin for one value reaches) and for the
others, told their stiffness and not; it has no modes of them.
"""

from __future__ import annotations

import shutil
import time
from functools import partial
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from numpy.typing import NDArray
from record import RUNS
from summaries import relative_errors

from softtwin.meshes.shapes import liver_phantom
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.inputs import Inputs
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.springs import Springs
from softtwin.reference.generate import Plan, generate
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.galerkin import Galerkin
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.train import train

Floats = NDArray[np.float64]
BED, RANGE = Springs(normal=2e4, tangential=5e3), (0.3, 3.0)  # N/m^3; times as stiff
LOW = 0.02  # metres from the lowest point: what lies on the bed
MODELS: dict[str, dict[str, tuple[float, float]]] = {"one stiffness": {}, "a range of it": {"springs@bed": RANGE}}
Case = tuple[float, Floats, Floats]  # factor, forces in newtons, displacement in metres, (n, 3) each


def data_of(draws: int) -> DataSet:
    """Equilibria of the phantom on its bed as it is expected."""
    phantom = liver_phantom()
    heights = phantom.points[phantom.boundary][..., 2]
    bed = phantom.boundary[(heights < phantom.points[:, 2].min() + LOW).all(axis=1)]
    folder = RUNS / "varied-springs"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    samples = {"train": 32, "validation": 8, "test": draws}
    plan = Plan(loads=LoadPlan(modes=10, patches=2, displacement=0.03), samples=samples, block=8, springs={"bed": BED})
    made = generate(folder / "data.zarr", phantom.with_surfaces(bed=bed), plan)
    assert made is not None
    return made


def cases_of(data: DataSet) -> dict[str, list[Case]]:
    """The test draws as they are, and on other springs, where torch finds a state there."""
    solver, samples = Equilibria(data.body, data.material, springs=data.springs), data.samples("test")
    own, others = list[Case](), list[Case]()
    for number, (loads, displacement) in enumerate(zip(samples.forces, samples.displacements, strict=True)):
        forces = data.response.spread(loads)
        own.append((1.0, forces, displacement))
        factor = float(np.exp(np.random.default_rng([43, number]).uniform(*np.log(RANGE))))
        state = solver.with_springs({"bed": factor}).solve(forces[None])
        if bool(state.is_converged[0] & state.is_stable[0]):
            others.append((factor, forces, state.displacement[0].numpy()))
    return {"own": own, "others": others}


def work(row: str, given: Given) -> dict[str, Any]:
    data = given.once(data_of, given.draws)
    begin = time.perf_counter()
    surrogate = train(data, TrainingPlan(Galerkin(vary=MODELS[row])))
    found: dict[str, Any] = {"seconds": time.perf_counter() - begin, "modes": len(surrogate.network.at_rest)}
    cases = given.once(cases_of, data)
    for name, group, is_told in (
        ("own", cases["own"], False),
        ("others", cases["others"], True),
        ("untold", cases["others"], False),
    ):
        found[name] = relative_errors(
            (partial(surrogate.solve, forces, inputs=Inputs(springs={"bed": factor}) if is_told else None), truth)
            for factor, forces, truth in group
        )
    return found


BENCHMARK = Benchmark(
    name="varied_springs",
    title="One surrogate for many supports: the stiffness of an organ's bed as an input",
    about=("surrogate",),
    work=work,
    rows=tuple(MODELS),
    columns=(
        Column("as stiff as expected: relative error, median; 95 %", "%", "{own.median:.2f}; {own.p95:.2f}"),
        Column("0.3 to 3 times as stiff, told", "%", "{others.median:.2f}; {others.p95:.2f}"),
        Column("the same, not told", "%", "{untold.median:.2f}; {untold.p95:.2f}"),
        Column("modes", "", "{modes}"),
        Column("to make", "s", "{seconds:.1f}"),
        Column("a prediction", "ms", "{others.ms:.1f}"),
    ),
    settings={"draws": Setting(100, "held out")},
    seeds=(43,),
    small={"draws": 8},
)


if __name__ == "__main__":
    run(BENCHMARK)
