"""One network in one table: errors, Jacobian, bounds by size of load, and solves that start from it beside those not.

    python benchmarks/checked_network.py [--bodies modal] [--seconds 200] [--count 1000]

The network is that of certificates.py (the small beam under the loads of table 4.2, or under those of all sizes,
`ranges`); errors and Jacobians are those of held-out samples, bounds those of its calibration. Fresh loads, half in the
range of those learned and half up to twice as large, are solved in turn by 20 load steps, from rest and from the
network's prediction: one clock and one core for all, a failure at the time it took. Data and networks are made under
benchmarks/runs/ where they are not there.
"""

from __future__ import annotations

import argparse
from typing import Any

from certificates import network_of
from hybrid_newton import RANGES, STEPS, Way, alone, figures_of, loads_of, reference_way, stepped_way
from networks import data_of as small_data
from networks import judged
from networks_bodies import case, data_of
from record import recorded, write
from threadpoolctl import threadpool_limits

from softtwin.reference.data.dataset import DataSet
from softtwin.reference.generate import Plan
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.calibration import coverage
from softtwin.surrogate.model import Surrogate

NAME = "checked_network"
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
        found[name] = {label: figures_of([each[label] for each in taken], truth) for label in ways}
        print(name, found[name], flush=True)
    assert list(found) == list(RANGES)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", nargs="+", default=["modal"], choices=["modal", "ranges"])
    parser.add_argument("--seconds", type=float, default=200.0, help="of training")
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--count", type=int, default=1000, help="of fresh loads that are solved")
    parser.add_argument("--name", default=NAME, help="of the record")
    arguments = parser.parse_args()
    found = recorded(arguments.name)
    for body in arguments.bodies:
        if body in found:
            print(f"{body}: recorded before")
            continue
        data, plan = data_of(body, arguments.ranks, body != "modal"), case(body).plan
        network = network_of(body, data, arguments.seconds, arguments.ranks)
        held_out = small_data("modal", JUDGED, arguments.ranks, jacobians=True) if body == "modal" else data
        with threadpool_limits(1), Problem(data.body, plan.build_material(), plan.newton) as problem:
            found[body] = {
                "training": network.card["training"],
                "learned": network.card["samples"],
                "errors": judged(network, held_out, problem),
                "bounds": coverage(network, data).as_dict(),
                "solved": solved(data, plan, network, problem, arguments.count),
            }
        write(arguments.name, found)


if __name__ == "__main__":
    main()
