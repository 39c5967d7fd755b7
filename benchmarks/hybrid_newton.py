"""Newton's method from a network's prediction (thesis, table 5.3): shares, iterations, factorisations, times, states.

    python benchmarks/hybrid_newton.py [--bodies small large liver] [--seconds 300]

Half of the loads are drawn like those that were learned (and are none of them), half are up to twice as large. A
failure counts at the time it took. Every state found is compared with the one that 20 load steps lead to from rest,
each from the displacement before and with nothing else to fall back on; negative pivots of its tangent are counted
afterwards. Softtwin's own ways may take as many load steps as a configuration allows by default. All ways but the load
steps, which come first, solve each load in turn. Data and
networks are made under benchmarks/runs/ where they are not there.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import made
import numpy as np
import torch
from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from networks import data_of as small_data
from networks_bodies import case
from networks_bodies import data_of as body_data
from numpy.typing import NDArray
from record import RUNS

from softtwin.app.config import SolverSection
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.generate import Plan, plan_from_header, ramp_loads
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

Floats = NDArray[np.float64]
COUNTS = {"small": 1000, "large": 100, "liver": 100}
CASES = {"large": "beam-few", "liver": "liver-tetrahedra"}  # of networks_bodies.py
FRESH = 1_000_000  # numbers of loads begin here: none of them is in a data set
RANGES = ("in range", "up to twice")
STEPS, MOST = 20, 60
SAME = 1e-4  # of the largest displacement: a state that is farther away is another one


@dataclass(frozen=True, eq=False)
class Found:
    """What a way of solving made of one load.

    Args:
        displacement: None where it failed.
        seconds: that it took, or took to fail.
        iterations: of Newton's method.
        factorisations: tangents factored.
        picked: whether it went on from the prediction.
    """

    displacement: Floats | None
    seconds: float
    iterations: int = 0
    factorisations: int = 0
    picked: bool = False


Way = Callable[[Floats], Found]


def reference_way(problem: Problem, network: Surrogate | None) -> Way:
    """Softtwin's own solver, from a network or without."""
    model = ReferenceModel(problem, predictor=network)

    def solve(load: Floats) -> Found:
        began = time.perf_counter()
        try:
            state = model.solve(load).equilibrium
        except NotConverged as failure:
            return Found(None, time.perf_counter() - began, len(failure.trace))
        seconds = time.perf_counter() - began
        return Found(state.displacement, seconds, state.iterations, state.factorisations, state.start == "proposal")

    return solve


def printed_way(problem: Problem, network: Surrogate | None) -> Way:
    """Algorithm 5 as printed, but for its inverted condition to go on; without a network algorithm 4, full steps."""
    system = problem.system

    def solve(load: Floats) -> Found:
        began = time.perf_counter()
        wanted = system.load(load)[1]
        enough = problem.options.tolerance * float(np.linalg.norm(wanted.dead))
        unknowns, picked = np.zeros_like(wanted.dead), False

        def residual(at: Floats) -> Floats:
            gap = system.forms.residual(at, wanted)
            gap[system.space.fixed] = 0.0
            return np.asarray(gap)

        if network is not None:
            predicted = system.unknowns(network.solve(load).displacement)
            predicted[system.space.fixed] = 0.0
            size = np.linalg.norm(residual(predicted))
            if size < enough:
                return Found(system.space.field(predicted), time.perf_counter() - began, picked=True)
        gap = residual(unknowns)
        for iteration in range(1, MOST + 1):
            try:
                step = system.tangent.solve(unknowns, wanted, gap[None])[0]
            except RuntimeError:  # a singular tangent
                break
            unknowns = unknowns - step
            gap = residual(unknowns)
            if network is not None and iteration == 1 and not np.linalg.norm(gap) <= size:
                unknowns, gap, picked = predicted, residual(predicted), True
            norm = np.linalg.norm(gap)
            if not np.isfinite(norm):
                break
            if norm < enough:
                seconds = time.perf_counter() - began
                return Found(system.space.field(unknowns), seconds, iteration, iteration, picked)
        return Found(None, time.perf_counter() - began, iteration, iteration, picked)

    return solve


def alone(problem: Problem, solve: Way, load: Floats) -> Found:
    """What a way makes of a load when nothing of the way before it is left."""
    problem.system.tangent.assemble_at_rest()
    return solve(load)


def stepped_way(problem: Problem) -> Way:
    """As many equal load steps, each from the one before: the state that every other way is held against."""

    def solve(load: Floats) -> Found:
        began, reached, iterations, factorisations = time.perf_counter(), np.zeros_like(load), 0, 0
        try:
            for part in np.linspace(0.0, 1.0, STEPS + 1)[1:]:
                state = problem.solve(part * load, reached, stability=False, fallback=False)
                iterations, factorisations = iterations + state.iterations, factorisations + state.factorisations
                reached = state.displacement
        except NotConverged:
            return Found(None, time.perf_counter() - began, iterations, factorisations)
        return Found(reached, time.perf_counter() - began, iterations, factorisations)

    return solve


def without_training(network: Surrogate) -> Surrogate:
    """The same network with random weights of the same sizes."""
    generator = torch.Generator().manual_seed(0)
    other = Surrogate(network.body, network.encoder_decoder, copy.deepcopy(network.network), network.card)
    for weights in other.network.parameters():
        noise = torch.randn(weights.shape, generator=generator, dtype=weights.dtype)
        weights.data = weights.std(correction=0) * noise
    return other


def data_of(body: str, ranks: int) -> DataSet:
    """Equilibria with whole Jacobians to learn from."""
    if body == "small":
        return small_data("modal", {"train": 8192, "validation": 256, "test": 512}, ranks, jacobians=True)
    return body_data(CASES[body], ranks, jacobians=True)


def network_of(body: str, data: DataSet, seconds: float) -> Surrogate:
    """The reduced network of a body, trained once."""
    modes = Reduced().modes if body == "small" else case(CASES[body]).modes
    plan = TrainingPlan(Reduced(modes=modes), seconds=seconds)
    return made.network(RUNS / f"hybrid-{body}-{seconds:g}s", data.body, lambda: train(data, plan))


def loads_of(data: DataSet, plan: Plan, count: int) -> dict[str, Floats]:
    """Fresh loads, (count, n, 3), newtons: half in the range of those learned, half up to twice."""
    chance = np.random.default_rng([plan.seed, 5])
    tops = np.stack([ramp_loads(data, replace(plan, ramp=1), FRESH + i)[0] for i in range(count)])
    inside = np.ones(count // 2) if plan.loads.amplitude is not None else chance.uniform(0.0, 1.0, count // 2)
    sizes = inside, chance.uniform(1.0, 2.0, count - count // 2)
    parts = tops[: count // 2], tops[count // 2 :]
    return {name: part * size[:, None, None] for name, part, size in zip(RANGES, parts, sizes, strict=True)}


def figures_of(problem: Problem, found: list[Found], truth: list[Floats | None]) -> dict[str, Any]:
    """Of one way over the loads of one range; times are of all loads, failures at the time they took.

    Iterations and factorisations are means over the loads that were solved.
    """
    milliseconds = 1e3 * np.array([each.seconds for each in found])
    converged = [each for each in found if each.displacement is not None]
    compared = [(a.displacement, b) for a, b in zip(found, truth, strict=True) if b is not None]
    same = sum(a is not None and bool(np.abs(a - b).max() <= SAME * np.abs(b).max()) for a, b in compared)
    alone = sum(a.displacement is not None and b is None for a, b in zip(found, truth, strict=True))
    pivots = [problem.negative_pivots(each.displacement) for each in converged]
    return {
        "unstable": sum(bool(count) for count in pivots),
        "loads": len(found),
        "converged": len(converged),
        "same_state": same,
        "compared": len(compared),
        "where_load_steps_failed": alone,
        "picked": sum(each.picked for each in found),
        "iterations": float(np.mean([each.iterations for each in converged])) if converged else None,
        "factorisations": float(np.mean([each.factorisations for each in converged])) if converged else None,
        "median_ms": float(np.median(milliseconds)),
        "mean_ms": float(milliseconds.mean()),
        "p95_ms": float(np.percentile(milliseconds, 95)),
    }


def truth_of(body: str, problem: Problem, loads: dict[str, Floats]) -> tuple[dict[str, list[Any]], Any]:
    """States that load steps lead to, kept from run to run, and the figures of that way."""
    limit = f"{problem.options.tolerance:g}-{problem.options.max_iterations}"  # what a careful step may take
    path = RUNS / f"hybrid-{body}-truth-{sum(map(len, loads.values()))}-{limit}.npz"
    kept = path.with_suffix(".json")
    if not kept.exists():
        solve, states, figures = stepped_way(problem), {}, {}
        for name, part in loads.items():
            found = [solve(load) for load in part]
            empty = np.full_like(part[0], np.nan)
            states[name] = np.stack([empty if each.displacement is None else each.displacement for each in found])
            figures[name] = figures_of(problem, found, [each.displacement for each in found])
        np.savez(path, **states)
        kept.write_text(json.dumps(figures))
    with np.load(path) as stored:
        truth = {name: [None if np.isnan(each).any() else each for each in stored[name]] for name in loads}
    return truth, json.loads(kept.read_text())


ROWS = {f"{body}, {name}": (body, name) for body in COUNTS for name in RANGES}


@dataclass(frozen=True, eq=False)
class Prepared:
    """A body's loads by range, its problem and network, and the states that load steps lead to."""

    loads: dict[str, Floats]
    problem: Problem
    network: Surrogate
    truth: dict[str, list[Any]]
    stepped: dict[str, Any]


@contextmanager
def prepared(body: str, ranks: int, count: int | None, seconds: float) -> Iterator[Prepared]:
    """All of it; data and networks are made where they are not there."""
    data = data_of(body, ranks)
    plan = plan_from_header(data.header)
    loads = loads_of(data, plan, count or COUNTS[body])
    patient = replace(plan.newton, max_load_steps=SolverSection().max_load_steps)
    with Problem(data.body, plan.build_material(), patient) as problem:
        yield Prepared(loads, problem, network_of(body, data, seconds), *truth_of(body, problem, loads))


def work(row: str, given: Given) -> dict[str, Any]:
    """All ways on the loads of one range; they solve each load in turn, so that a busy machine is busy for all."""
    body, name = ROWS[row]
    known: Prepared = given.opened(prepared, body, given.ranks, given.count, given.seconds)
    problem, loads = known.problem, known.loads[name]
    ways = {
        "full steps from rest (algorithm 4)": printed_way(problem, None),
        "algorithm 5 as printed": printed_way(problem, known.network),
        "cold": reference_way(problem, None),
        "ours": reference_way(problem, known.network),
        "ours, random weights": reference_way(problem, without_training(known.network)),
    }
    for solve in ways.values():
        solve(loads[0])  # what is factored once
    taken = [{label: alone(problem, solve, load) for label, solve in ways.items()} for load in loads]
    found = {label: figures_of(problem, [each[label] for each in taken], known.truth[name]) for label in ways}
    return {f"{STEPS} load steps": known.stepped[name], **found}


def each_way(rows: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for each way."""
    return ((f"{row}: {way}", found) for row, ways in rows.items() for way, found in ways.items())


BENCHMARK = Benchmark(
    name="hybrid_newton",
    title="Newton's method from a network's prediction (table 5.3): states, iterations, factorisations, times",
    about=("reference", "surrogate"),
    work=work,
    rows=lambda given: [row for row, (body, _) in ROWS.items() if body in given.bodies],
    columns=(
        Column("same state", "", "{same_state} of {compared}"),
        Column("converged; unstable", "", "{converged} of {loads}; {unstable}"),
        Column("prediction picked", "", lambda f: f"{100 * f['picked'] / f['loads']:.0f} %"),
        Column("where solved: iterations; factorisations", "", "{iterations:.1f}; {factorisations:.2f}"),
        Column("median; mean; 95 %", "ms", "{median_ms:.1f}; {mean_ms:.1f}; {p95_ms:.0f}"),
    ),
    settings={
        "bodies": Setting(("small", "large"), choices=tuple(COUNTS), picks=True),
        "seconds": Setting(300.0, "of training"),
        "count": Setting(None, "of loads, in place of 1,000, 100 and 100", kind=int),
        "ranks": RANKS,
    },
    seeds=(0, 5),
    lines=each_way,
)


if __name__ == "__main__":
    run(BENCHMARK)
