"""One surrogate for many tissues: Poisson's ratio and a tumour's stiffness as inputs, over their whole ranges.

    softtwin quickstart --output FOLDER
    python benchmarks/varied.py FOLDER [--tissues 100]

The quickstart's organ and equilibria of one tissue (Poisson's ratio 0.45, a tumour as soft as the rest). Held-out
tissues are drawn evenly from 0.40 to 0.49 and, on a logarithmic scale, from 1 to 8 times the stiffness, each with one
of the quickstart's training loads beyond the first 32, which are all that the models are told of; states by torch's
solver. Errors are |u - u*| / |u*|. A model of one tissue is asked for its own (what a twin for one value reaches) and,
as it is, for the others.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from columns import Column
from harness import FOLDER, Benchmark, Given, Setting, run
from numpy.typing import NDArray
from summaries import relative_errors

from softtwin.meshes.signed import cells_inside
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.inputs import Inputs
from softtwin.reference.data.materials import NeoHookean
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.galerkin import Galerkin
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.train import train

Floats = NDArray[np.float64]
OWN = 32  # equilibria that a model is told of
RANGES = {"poisson-ratio": (0.40, 0.49), "young-modulus@tumour": (5e3, 4e4)}
MODELS: dict[str, dict[str, tuple[float, float]]] = {
    "one tissue": {},
    "Poisson's ratio": {"poisson-ratio": RANGES["poisson-ratio"]},
    "Poisson's ratio and tumour": RANGES,
}
Case = tuple[dict[str, Any], Floats, Floats]  # tissue, forces in newtons, displacement in metres, (n, 3) each


def cases_of(folder: Any, count: int, is_stiffer: bool) -> list[Case]:
    """Tissues with a load and its state, where torch finds one."""
    data = DataSet(folder / "data.zarr")
    inside, loads = cells_inside(data.body, "tumour"), data.samples("train").forces[OWN:]
    found: list[Case] = []
    for number in range(2 * count):
        rng = np.random.default_rng([41, number])
        ratio = float(rng.uniform(*RANGES["poisson-ratio"]))
        moduli = np.full(len(data.body.cells), RANGES["young-modulus@tumour"][0])
        if is_stiffer:
            moduli[inside] = float(np.exp(rng.uniform(*np.log(RANGES["young-modulus@tumour"]))))
        forces = data.response.spread(loads[number % len(loads)])
        state = Equilibria(data.body, NeoHookean(moduli, ratio)).solve(forces[None])
        if bool(state.is_converged[0] & state.is_stable[0]):
            tissue = {"poisson_ratio": ratio, "young_modulus": moduli}
            found.append((tissue, forces, state.displacement[0].numpy()))
        if len(found) == count:
            break
    return found


def own_cases(folder: Any, count: int) -> list[Case]:
    """States of the tissue that the data set is of."""
    data = DataSet(folder / "data.zarr")
    samples = data.samples("train")
    found: list[Case] = []
    for loads, displacement in list(zip(samples.forces, samples.displacements, strict=True))[OWN : OWN + count]:
        found.append(({}, data.response.spread(loads), displacement))
    return found


def work(row: str, given: Given) -> dict[str, Any]:
    data = DataSet(given.folder / "data.zarr")
    begin = time.perf_counter()
    surrogate = train(data, TrainingPlan(Galerkin(vary=MODELS[row]), samples=OWN))
    seconds = time.perf_counter() - begin
    groups = {
        "own": given.once(own_cases, given.folder, given.tissues),
        "ratio": given.once(cases_of, given.folder, given.tissues, False),
        "both": given.once(cases_of, given.folder, given.tissues, True),
    }
    found: dict[str, Any] = {"seconds": seconds, "modes": len(surrogate.network.at_rest)}
    for name, cases in groups.items():
        found[name] = relative_errors(
            (
                partial(surrogate.solve, forces, inputs=Inputs(parameters=tissue) if tissue and MODELS[row] else None),
                truth,
            )
            for tissue, forces, truth in cases
        )
    return found


BENCHMARK = Benchmark(
    name="varied",
    title="One surrogate for many tissues: Poisson's ratio and a tumour's stiffness as inputs",
    about=("surrogate",),
    work=work,
    rows=tuple(MODELS),
    columns=(
        Column("its own tissue: relative error, median; 95 %", "%", "{own.median:.2f}; {own.p95:.2f}"),
        Column("Poisson's ratio 0.40 to 0.49", "%", "{ratio.median:.2f}; {ratio.p95:.2f}"),
        Column("and a tumour up to 8 times as stiff", "%", "{both.median:.2f}; {both.p95:.2f}"),
        Column("modes", "", "{modes}"),
        Column("to make", "s", "{seconds:.1f}"),
        Column("a prediction", "ms", "{both.ms:.1f}"),
    ),
    settings={"folder": FOLDER, "tissues": Setting(100, "held out")},
    seeds=(41,),
    small={"tissues": 4},
)


if __name__ == "__main__":
    run(BENCHMARK)
