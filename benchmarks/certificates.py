"""Bounds on errors that nobody has seen: how many keep them, how wide they are, what they cost, what is set aside.

    python benchmarks/certificates.py [--seconds 200] [--ranks 2] [--bodies modal ranges liver-tetrahedra]

The small beam under the loads of table 4.2 (`modal`) and under harder ones of all sizes (`ranges`): 2,500 loads to
calibrate with and 2,500 to test on in each of four ranges of size; the real liver (`liver-tetrahedra`) with 1,000 and
1,000 in all. Data and networks are made under benchmarks/runs/
where they are not there.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from networks import RUNS
from networks import data_of as small_data
from networks_bodies import case, data_of
from record import recorded, write
from threadpoolctl import threadpool_limits

from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.generate import Plan, ramp_loads
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.calibration import calibrate, coverage
from softtwin.surrogate.certificate import Certifier
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import load as load_twin
from softtwin.surrogate.twin import save

NAME = "certificates"
FRESH = 1_000_000  # numbers of loads begin here: none of them is in a data set
FAR, TIMED, STEPPED = 1000, 100, 400  # loads three times too large; predictions that are timed; Newton's steps


def network_of(body: str, data: DataSet, seconds: float, ranks: int) -> Surrogate:
    """The reduced network of a body, trained once; that of the small beam under modal loads on table 4.2's samples."""
    folder = RUNS / f"certificates-{body}-{seconds:g}s"
    if not (folder / "surrogate.json").exists():
        learned = data
        if body == "modal":
            learned = small_data("modal", {"train": 8192, "validation": 256, "test": 512}, ranks, jacobians=True)
        plan = TrainingPlan(Reduced(modes=case(body).modes), seconds=seconds)
        save(with_domain(train(learned, plan), learned), folder)
    return calibrate(load_twin(folder, data.body), data, stepped=STEPPED)


def set_aside(certifier: Certifier, data: DataSet, plan: Plan, problem: Problem) -> dict[str, Any]:
    """Share of loads that is said to be outside: at the largest that were learned, and at three times these.

    Those of three times that are not set aside are solved: how many of them keep their bounds all the same.
    """
    tops = [ramp_loads(data, plan, FRESH + i)[0] for i in range(FAR)]
    found: dict[str, Any] = {}
    for scale in (1.0, 3.0):
        given = [certifier.certify(scale * top) for top in tops]
        found[f"times_{scale:g}"] = float(np.mean([not each.is_inside for each in given]))
    inside = [(3.0 * top, each) for top, each in zip(tops, given, strict=True) if each.is_inside]
    kept = []
    for load, certificate in inside:
        try:
            truth = problem.solve(load).displacement
        except NotConverged:
            kept.append(False)
            continue
        missed = certifier.reader.surrogate.solve(load).displacement - truth
        kept.append(bool(np.linalg.norm(missed, axis=1).mean() <= certificate.mean))
    found["times_3_inside"] = {"loads": len(kept), "kept": float(np.mean(kept)) if kept else None}
    return found


def costs(certifier: Certifier, loads: list[np.ndarray], problem: Problem) -> dict[str, float]:
    """Median wall times of a prediction and of each tier, milliseconds."""
    surrogate = certifier.reader.surrogate
    taken: dict[str, list[float]] = {"prediction": [], "distance": [], "certificate": [], "newton": [], "solve": []}

    def timed(name: str, run: Callable[[], Any]) -> Any:
        began = time.perf_counter()
        found = run()
        taken[name].append(1e3 * (time.perf_counter() - began))
        return found

    for load in loads:
        state = timed("prediction", lambda load=load: surrogate.solve(load))
        timed("distance", lambda state=state: state.extent)
        timed("certificate", lambda load=load, state=state: certifier.certify(load, state))
        timed("newton", lambda load=load, state=state: certifier.certify(load, state, newton=True))
        timed("solve", lambda load=load, state=state: problem.solve(load, proposal=state.displacement))
    return {name: float(np.median(values)) for name, values in taken.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--bodies", nargs="+", default=["modal", "ranges", "liver-tetrahedra"], help="cases of networks_bodies.py"
    )
    parser.add_argument("--seconds", type=float, default=200.0, help="of training")
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--name", default=NAME, help="of the record")
    arguments = parser.parse_args()
    found = recorded(arguments.name)
    for body in arguments.bodies:
        if body in found:
            print(f"{body}: recorded before")
            continue
        data, plan = data_of(body, arguments.ranks, body != "modal"), case(body).plan
        surrogate = network_of(body, data, arguments.seconds, arguments.ranks)
        held_out = coverage(surrogate, data)
        print(held_out, flush=True)
        certifier = Certifier(surrogate)
        tops = [ramp_loads(data, plan, FRESH + i)[0] for i in range(TIMED)]
        with threadpool_limits(1), Problem(data.body, plan.build_material()) as problem:
            found[body] = {
                "calibrated": surrogate.card["certificate"],
                "held_out": held_out.as_dict(),
                "outside": set_aside(certifier, data, plan, problem),
                "held_out_newton": coverage(surrogate, data, limit=STEPPED, newton=True).as_dict(),
                "ms": costs(certifier, tops, problem),
            }
        print(json.dumps({name: value for name, value in found[body].items() if name != "held_out"}, indent=1))
        write(arguments.name, found)


if __name__ == "__main__":
    main()
