"""One network in one table: errors, Jacobian, bounds by size of load, and solves that start from it beside those not.

    python benchmarks/checked_network.py [--only modal] [--seconds 200] [--count 1000]

The network is that of certificates.py (the small beam under the loads of table 4.2, or under those of all sizes,
`ranges`); errors and Jacobians are those of held-out samples, bounds those of its calibration. Fresh loads, half in the
range of those learned and half up to twice as large, are solved in turn by 20 load steps, from rest and from the
network's prediction: one clock and one core for all, a failure at the time it took. Data and networks are made under
benchmarks/runs/ where they are not there.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from certificates import network_of
from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from hybrid_newton import RANGES, STEPS, Way, alone, figures_of, loads_of, reference_way, stepped_way
from networks import data_of as small_data
from networks import judged
from networks_bodies import case, data_of

from softtwin.reference.data.dataset import DataSet
from softtwin.reference.generate import Plan
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.calibration import coverage
from softtwin.surrogate.model import Surrogate

JUDGED = {"train": 8192, "validation": 256, "test": 512}  # of table 4.2, whose Jacobians are there


def solved(data: DataSet, plan: Plan, network: Surrogate, problem: Problem, count: int) -> dict[str, Any]:
    """Figures of each way of solving, by range of load."""
    ways: dict[str, Way] = {
        f"{STEPS} load steps": stepped_way(problem),
        "from rest": reference_way(problem, None),
        "from the network": reference_way(problem, network),
    }
    found: dict[str, Any] = {}
    for name, loads in loads_of(data, plan, count).items():
        for way in ways.values():
            way(loads[0])  # what is factored once
        taken = [{label: alone(problem, way, load) for label, way in ways.items()} for load in loads]
        truth = [each[f"{STEPS} load steps"].displacement for each in taken]
        found[name] = {label: figures_of(problem, [each[label] for each in taken], truth) for label in ways}
        print(name, found[name], flush=True)
    assert list(found) == list(RANGES)
    return found


def work(row: str, given: Given) -> dict[str, Any]:
    data, plan = data_of(row, given.ranks, row != "modal"), case(row).plan
    network = network_of(row, data, given.seconds, given.ranks)
    held_out = small_data("modal", JUDGED, given.ranks, jacobians=True) if row == "modal" else data
    with Problem(data.body, plan.build_material(), plan.newton) as problem:
        return {
            "training": network.card["training"],
            "learned": network.card["samples"],
            "errors": judged(network, held_out, problem),
            "bounds": coverage(network, data).as_dict(),
            "solved": solved(data, plan, network, problem, given.count),
        }


def lines(rows: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for the network, and one for each range and way of solving."""
    for body, found in rows.items():
        yield f"{body}: the network", found
        for name, ways in found["solved"].items():
            yield from ((f"{body}, {name}: {way}", told) for way, told in ways.items())


BENCHMARK = Benchmark(
    name="checked_network",
    title="One network in one table: errors, Jacobian, bounds by size, and solves that start from it",
    about=("surrogate", "reference"),
    work=work,
    rows=("modal", "ranges"),
    columns=(
        Column("mean error", "mm", "{errors.nodal_error.mean*1000:.3f}"),
        Column("relative (95 %)", "%", "{errors.relative_error.median*100:.3f} ({errors.relative_error.p95*100:.2f})"),
        Column("cosine; Jacobian, %", "", "{errors.gradient_cosine.mean:.5f}; {errors.jacobian_error.mean*100:.2f}"),
        Column(
            "bounds kept; by size",
            "%",
            lambda f: (
                f"{100 * f['bounds']['kept']['mean']:.1f}; "
                + " / ".join(f"{100 * kept:.1f}" for kept in f["bounds"]["kept_in_range"]["mean"])
            ),
        ),
        Column("same state", "", "{same_state} of {loads}"),
        Column("iterations; factorisations", "", "{iterations:.1f}; {factorisations:.2f}"),
        Column("median; mean", "ms", "{median_ms:.1f}; {mean_ms:.1f}"),
    ),
    settings={
        "seconds": Setting(200.0, "of training"),
        "count": Setting(1000, "of fresh loads that are solved"),
        "ranks": RANKS,
    },
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK)
