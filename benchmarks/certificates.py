"""Bounds on errors that nobody has seen: how many keep them, how wide they are, what they cost, what is set aside.

    python benchmarks/certificates.py [--seconds 200] [--ranks 2] [--stepped 400] [--only modal ...]

The small beam under the loads of table 4.2 (`modal`) and under harder ones of all sizes (`ranges`): 2,500 loads to
calibrate with and 2,500 to test on in each of four ranges of size; the real liver (`liver-tetrahedra`) with 1,000 and
1,000 in all. What chance in drawing the two has to do with it is told by 20 other ways to split the same loads. Data
and networks are made under benchmarks/runs/ where they are not there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import made
import numpy as np
from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from networks import data_of as small_data
from networks_bodies import case, data_of
from record import RUNS

from softtwin.reference.data.dataset import DataSet, Split
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.generate import Plan, ramp_loads
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.calibration import calibrate, coverage, fitted_bounds, read_samples
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.error_bound import ERRORS, ErrorEstimator, bound, range_of
from softtwin.surrogate.error_indicators import IndicatorReader
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

FRESH = 1_000_000  # numbers of loads begin here: none of them is in a data set
FAR, TIMED, STEPPED = 1000, 100, 400  # loads three times too large; predictions that are timed; Newton's steps
POOLED: tuple[Split, ...] = ("calibration", "test")
SPLITS = 20  # ways to split the loads that calibrate from those that judge


def network_of(body: str, data: DataSet, seconds: float, ranks: int, stepped: int = STEPPED) -> Surrogate:
    """The reduced network of a body, trained once; that of the small beam under modal loads on table 4.2's samples."""
    folder = RUNS / f"certificates-{body}-{seconds:g}s"

    def learn() -> Surrogate:
        learned = data
        if body == "modal":
            learned = small_data("modal", {"train": 8192, "validation": 256, "test": 512}, ranks, jacobians=True)
        plan = TrainingPlan(Reduced(modes=case(body).modes), seconds=seconds)
        return with_domain(train(learned, plan), learned)

    return calibrate(made.network(folder, data.body, learn), data, stepped=stepped)


def set_aside(estimator: ErrorEstimator, data: DataSet, plan: Plan, problem: Problem) -> dict[str, Any]:
    """Share of loads that is said to be outside: at the largest that were learned, and at three times these.

    Those of three times that are not set aside are solved: how many of them keep their bounds all the same.
    """
    tops = [ramp_loads(data, plan, FRESH + i)[0] for i in range(FAR)]
    found: dict[str, Any] = {}
    for scale in (1.0, 3.0):
        given = [estimator.bound_error(scale * top) for top in tops]
        found[f"times_{scale:g}"] = float(np.mean([not each.is_inside for each in given]))
    inside = [(3.0 * top, each) for top, each in zip(tops, given, strict=True) if each.is_inside]
    kept = []
    for load, error_bound in inside:
        try:
            truth = problem.solve(load).displacement
        except NotConverged:
            kept.append(False)
            continue
        missed = estimator.reader.surrogate.solve(load).displacement - truth
        kept.append(bool(np.linalg.norm(missed, axis=1).mean() <= error_bound.mean))
    found["times_3_inside"] = {"loads": len(kept), "kept": float(np.mean(kept)) if kept else None}
    return found


def resplit(surrogate: Surrogate, data: DataSet, ways: int = SPLITS) -> dict[str, Any]:
    """Share of loads that keep their bounds, overall and in each range of size, over other splits of the same loads.

    Those that calibrate and those that judge are pooled and drawn apart anew, by load paths, as many to calibrate as
    there were. Signs and errors are read once; bounds are calibrated anew each time.

    Args:
        surrogate: a calibrated one.
        data: equilibria of its body.
        ways: to split.

    Returns:
        `kept` and `kept_in_range`, by kind of error: their `mean` and `spread` (standard deviation) over the ways.
    """
    confidence, reader = surrogate.card["certificate"]["confidence"], IndicatorReader(surrogate)
    before = read_samples(reader, data, data.samples("validation"))
    held = {split: data.samples(split) for split in POOLED}
    read = [read_samples(reader, data, samples) for samples in held.values()]
    shown = [signs for each, _ in read for signs in each]
    errors = {error: np.concatenate([each[error] for _, each in read]) for error in ERRORS}
    own, others = (data.load_paths(split, samples.draws) for split, samples in held.items())
    paths = np.concatenate([own, others + own.max() + 1])
    count = len(np.unique(own))
    kept: dict[str, list[list[float]]] = {error: [] for error in ERRORS}
    for way in range(ways):
        chosen = np.isin(paths, np.random.default_rng(way).permutation(np.unique(paths))[:count])
        apart = [signs for signs, is_one in zip(shown, chosen, strict=True) if is_one]
        known = fitted_bounds(
            before, (apart, {name: e[chosen] for name, e in errors.items()}), paths[chosen], confidence
        )
        judged = np.flatnonzero(~chosen)
        places = np.array([range_of(known, shown[i]) for i in judged])
        for error in ERRORS:
            is_kept = errors[error][judged] <= [bound(known, shown[i], error) for i in judged]
            by_size = [is_kept[places == place].mean() for place in range(len(known["edges"]) + 1)]
            kept[error].append([is_kept.mean(), *by_size])
    mean, spread = (
        {error: measure(rows, axis=0).tolist() for error, rows in kept.items()} for measure in (np.mean, _spread)
    )
    return {
        "ways": ways,
        "load_paths": [count, len(np.unique(paths)) - count],
        "kept": {error: {"mean": mean[error][0], "spread": spread[error][0]} for error in ERRORS},
        "kept_in_range": {error: {"mean": mean[error][1:], "spread": spread[error][1:]} for error in ERRORS},
    }


def _spread(rows: list[list[float]], axis: int) -> np.ndarray:
    return np.std(rows, axis=axis, ddof=1)


def costs(estimator: ErrorEstimator, loads: list[np.ndarray], problem: Problem) -> dict[str, float]:
    """Median wall times of a prediction and of each tier, milliseconds."""
    surrogate = estimator.reader.surrogate
    names = ("prediction", "distance", "extent", "certificate", "newton", "solve")
    taken: dict[str, list[float]] = {name: [] for name in names}

    def timed(name: str, run: Callable[[], Any]) -> Any:
        began = time.perf_counter()
        found = run()
        taken[name].append(1e3 * (time.perf_counter() - began))
        return found

    for load in loads:
        state = timed("prediction", lambda load=load: surrogate.solve(load))
        timed("distance", lambda state=state: state.distance)
        timed("extent", lambda state=state: state.extrapolation_ratio)
        timed("certificate", lambda load=load, state=state: estimator.bound_error(load, state))
        timed("newton", lambda load=load, state=state: estimator.bound_error(load, state, newton=True))
        timed("solve", lambda load=load, state=state: problem.solve(load, proposal=state.displacement))
    return {name: float(np.median(values)) for name, values in taken.items()}


def measured(body: str, surrogate: Surrogate, data: DataSet, stepped: int) -> dict[str, Any]:
    """All figures of a body but those of other splits."""
    plan = case(body).plan
    held_out = coverage(surrogate, data)
    print(held_out, flush=True)
    estimator = ErrorEstimator(surrogate)
    tops = [ramp_loads(data, plan, FRESH + i)[0] for i in range(TIMED)]
    with Problem(data.body, plan.build_material()) as problem:
        return {
            "calibrated": surrogate.card["certificate"],
            "held_out": held_out.as_dict(),
            "outside": set_aside(estimator, data, plan, problem),
            "held_out_newton": coverage(surrogate, data, limit=stepped, newton=True).as_dict(),
            "ms": costs(estimator, tops, problem),
        }


def work(row: str, given: Given) -> dict[str, Any]:
    data = data_of(row, given.ranks, row != "modal")
    surrogate = network_of(row, data, given.seconds, given.ranks, given.stepped)
    return {**measured(row, surrogate, data, given.stepped), "resplit": resplit(surrogate, data)}


def lines(rows: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for each body and tier, and one for what a prediction, its distance and a solve cost."""
    for body, found in rows.items():
        ms, outside = found["ms"], found["outside"]
        for tier, held in {"certificate": found["held_out"], "newton": found["held_out_newton"]}.items():
            told = {"outside": {**outside, "kept_inside": _kept(outside)}} if tier == "certificate" else {}
            yield f"{body}, {tier}: {held['samples']} loads", {**held, **told, "ms": f"{ms[tier]:.2f}"}
        costs = f"{ms['prediction']:.2f}; {ms['distance']:.3f}; {ms['solve']:.1f}"
        yield f"{body}: prediction; distance; solve", {"ms": costs}


def _kept(outside: dict[str, Any]) -> str:
    inside = outside.get("times_3_inside")
    return "-" if not inside or inside["kept"] is None else f"{100 * inside['kept']:.0f} % of {inside['loads']}"


BENCHMARK = Benchmark(
    name="certificates",
    title="Bounds on errors that nobody has seen: how many keep them, their width, cost, what is set aside",
    about=("surrogate", "reference"),
    work=work,
    rows=("modal", "ranges", "liver-tetrahedra"),
    columns=(
        Column(
            "kept, mean error; by size",
            "%",
            lambda f: (
                f"{100 * f['kept']['mean']:.1f}; "
                + " / ".join(f"{100 * kept:.1f}" for kept in f["kept_in_range"]["mean"])
            ),
        ),
        Column("width / median error; by size", "", lambda f: " / ".join(f"{w:.2f}" for w in f["widths"]["mean"])),
        Column("rank of bound; of eta", "", "{rank_correlation.mean:.3f}; {step_correlation.mean:.3f}"),
        Column("outside: 1 x; 3 x", "%", "{outside.times_1*100:.1f}; {outside.times_3*100:.1f}"),
        Column("of 3 x inside kept", "", "{outside.kept_inside}"),
        Column("unstable", "", "{unstable} of {samples}"),
        Column("time", "ms", "{ms}"),
    ),
    settings={
        "seconds": Setting(200.0, "of training"),
        "stepped": Setting(STEPPED, "loads that are shown a step of Newton's method"),
        "ranks": RANKS,
    },
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK)
