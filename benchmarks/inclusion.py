"""Material beside forces on the quickstart's phantom: force / E with Poisson's ratio; a stiff tumour and the rest.

    python benchmarks/inclusion.py [--count 20] [--only ROW ...]

A pull on a patch of the seen side, another one each case, moves the organ by up to 24 mm; for the tumour the patch lies
above it, as where a surgeon feels for one. The cloud is the quickstart camera's, 1,000 points with 0.5 mm of noise;
forces are looked for in a zone that reaches 2 cm beyond the patch. Moduli and ratio are drawn from what the
registration believes beforehand, but for the tumour: 2 to 8 times as stiff as the rest, where it is believed to be as
stiff (deviation of the logarithm 1). One cloud hardly tells so small a tumour: a row has ten, and the worst of their
verdicts. Reference engine, from rest. Refused frames are counted and are in the errors all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from columns import Column, verdicts
from harness import Benchmark, Given, Setting, run
from numpy.typing import NDArray
from summaries import counts

from softtwin.app.identify import together
from softtwin.app.quickstart import CAMERA, NOISE, POINTS, quickstart_config
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.shapes import liver_phantom
from softtwin.meshes.signed import cells_inside
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.registration.options import expected_force, options_for
from softtwin.registration.parameters.block import WITHIN_90, Estimate
from softtwin.registration.parameters.inputs import InputBlocks
from softtwin.registration.parameters.poisson_ratio import PoissonRatio
from softtwin.registration.parameters.young_modulus import YoungModulus
from softtwin.registration.registrar import prepare
from softtwin.registration.result import Registration

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
MODULUS, RATIO, MOVED = 5000.0, 0.45, 0.024  # pascals; metres that the largest node moves
KNOWN, STIFFER = 0.3, (2.0, 8.0)  # deviation of the logarithm of the rest's modulus; times as stiff as the rest
TOOL, ZONE, ABOVE = 0.03, 0.05, 0.01  # radii of the patch and of the zone, how far off the tumour it lies, metres
FURTHER = 1000  # between the numbers of a case's loads
SEARCH = NewtonOptions(tolerance=1e-5, max_iterations=15)  # as the app's reference engine


def pulled(body: Body, problem: Problem, rng: np.random.Generator, above: str = "") -> tuple[Floats, Ints, Floats]:
    """A pull on a patch of the seen side, newtons, the zone that it is looked for in, and the state, metres."""
    seen = np.setdiff1d(np.unique(body.surfaces["observed"]), body.fixed)
    held = np.linalg.norm(body.points[seen][:, None] - body.points[body.fixed][None], axis=2).min(axis=1)
    chosen = seen[held > np.median(held)]  # near what holds it, it would hardly move
    if above:
        deep = np.linalg.norm(body.points[seen] - body.inner[above].points.mean(axis=0), axis=1)
        chosen = seen[deep < deep.min() + ABOVE]
    centre = body.points[rng.choice(chosen)]
    away = np.linalg.norm(body.points[seen] - centre, axis=1)
    direction = np.array([0.0, -1.0, 0.0]) + 0.7 * rng.standard_normal(3)
    forces = np.zeros_like(body.points)
    forces[seen[away < TOOL]] = 0.2 * direction / np.linalg.norm(direction) / (away < TOOL).sum()
    for _ in range(4):
        state = problem.solve(forces).displacement
        forces *= MOVED / np.linalg.norm(state, axis=1).max()
    return forces, seen[away < ZONE], problem.solve(forces).displacement


def drawn(
    body: Body, moduli: float | Floats, ratio: float, seed: int, above: str = ""
) -> tuple[Floats, Ints, Floats, Floats]:
    """A pull on a body of some material with its zone, the true state, and the cloud of it."""
    rng = np.random.default_rng([seed, 1])
    with Problem(body, NeoHookean(moduli, ratio)) as problem:
        forces, zone, truth = pulled(body, problem, rng, above)
    return forces, zone, truth, partial_view(body, truth, CAMERA, POINTS, NOISE, rng, surface="observed")


def registered(
    body: Body, cloud: Floats, zone: Ints | None, input_blocks: InputBlocks, known: Floats | None = None
) -> Registration:
    """The cloud, with forces in a zone, or with all of them known."""
    with Problem(body, NeoHookean(**input_blocks.parameters), SEARCH) as problem:
        model = ReferenceModel(problem, patient=False, loading=Loading(forces=known))
        scale = expected_force(body, MODULUS)
        registrar = prepare(
            model, zone, body.surfaces["observed"], force_scale=scale, options=options_for(model, zone is not None),
            inputs=input_blocks,
        )  # fmt: skip
        return told(registrar.register(cloud))


def told(found: Registration) -> Registration:
    """The registration with all that is asked of it, while its problem is open."""
    _ = found.estimates, found.force_over_modulus
    return found


def figures(found: Registration, truth: Floats, true: dict[str, float]) -> dict[str, Any]:
    """Errors of a registration: of nodes, and of each unknown."""
    error = 1e3 * float(np.linalg.norm(found.displacement - truth, axis=1).mean())
    verdict = {"verdict": found.judgement.verdict.value, "reasons": list(found.judgement.reasons)}
    return {**verdict, "error_mm": error, "seconds": found.seconds, "unknowns": of_unknowns(found.estimates, true)}


def of_unknowns(estimates: Sequence[Estimate], true: dict[str, float]) -> dict[str, dict[str, float]]:
    """How far off each is (relative, of a ratio as it is), whether its 90 % interval holds the truth, what was told."""
    found = {}
    for estimate in estimates:
        value, (low, high) = true[estimate.name], estimate.interval
        off = abs(estimate.value - value) / (value if estimate.unit == "Pa" else 1.0)
        found[estimate.name] = {"off": off, "within": float(low <= value <= high), "told": estimate.variance_reduction}
    return found


def force_over_modulus(body: Body, seed: int) -> dict[str, Any]:
    """Forces, E and nu unknown: force / E against the truth's."""
    rng = np.random.default_rng([seed, 0])
    prior = YoungModulus(KNOWN), PoissonRatio(0.5)
    input_blocks = InputBlocks(body, {"young_modulus": MODULUS, "poisson_ratio": RATIO}, prior)
    material = input_blocks.inputs(rng.standard_normal(2)).parameters
    modulus, ratio = float(np.mean(material["young_modulus"])), float(np.mean(material["poisson_ratio"]))
    forces, zone, truth, cloud = drawn(body, modulus, ratio, seed)
    found = registered(body, cloud, zone, input_blocks)
    row = figures(found, truth, {"Young's modulus": modulus, "Poisson's ratio": ratio})
    assert found.force_over_modulus is not None
    for name, value, doubt, true in (
        ("force / E", *found.force_over_modulus, forces.sum(axis=0) / modulus),
        ("force", found.net_force, found.net_force_deviation, forces.sum(axis=0)),
    ):
        off = float(np.linalg.norm(value - true) / np.linalg.norm(true))
        within = float((np.abs(value - true) <= WITHIN_90 * doubt).mean())
        row["unknowns"][name] = {"off": off, "within": within}
    return row


def inclusion(body: Body, seed: int, is_known: bool, clouds: int = 1) -> dict[str, Any]:
    """E of the tumour and of the rest, under loads that are known or not, from one cloud or several together."""
    rng, region = np.random.default_rng([seed, 0]), cells_inside(body, "tumour")
    rest, times = float(MODULUS * np.exp(KNOWN * rng.standard_normal())), float(np.exp(rng.uniform(*np.log(STIFFER))))
    moduli = np.full(len(body.cells), rest)
    moduli[region] *= times
    parameters = {"young_modulus": np.full(len(body.cells), MODULUS), "poisson_ratio": RATIO}
    input_blocks = InputBlocks(body, parameters, (YoungModulus(KNOWN), YoungModulus(1.0, region, "tumour")))
    true, rows, found = {"Young's modulus": rest, "Young's modulus of tumour": rest * times}, [], []
    for number in range(clouds):
        forces, zone, truth, cloud = drawn(body, moduli, RATIO, FURTHER * number + seed, "tumour")
        result = registered(body, cloud, None if is_known else zone, input_blocks, forces if is_known else None)
        found.append(result)
        rows.append(figures(result, truth, true))
    worst = max(rows, key=lambda row: ("accepted", "doubtful", "refused").index(row["verdict"]))
    means = {name: float(np.mean([row[name] for row in rows])) for name in ("error_mm", "seconds")}
    return {**worst, **means, "unknowns": of_unknowns(together(found), true), "times_as_stiff": times}


ROWS: dict[str, Callable[[Body, int], dict[str, Any]]] = {
    "forces, E and nu unknown": force_over_modulus,
    "tumour and rest, loads known": lambda body, seed: inclusion(body, seed, True),
    "tumour and rest, ten known loads together": lambda body, seed: inclusion(body, seed, True, 10),
    "tumour and rest, loads unknown": lambda body, seed: inclusion(body, seed, False),
}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all cases."""
    found: dict[str, Any] = {"verdicts": counts(row["verdict"] for row in rows)}
    for name in ("error_mm", "seconds"):
        found[name] = spread([row[name] for row in rows])
    for name in rows[0]["unknowns"]:
        each = [row["unknowns"][name] for row in rows]
        found[name] = {
            "off": spread([one["off"] for one in each]),
            "within_90": float(np.mean([one["within"] for one in each])),
        }
        if "told" in each[0]:
            found[name]["told"] = float(np.mean([one["told"] for one in each]))
    return found


def spread(values: list[float]) -> dict[str, float]:
    """Mean, median and largest."""
    return {"mean": float(np.mean(values)), "median": float(np.median(values)), "largest": float(np.max(values))}


def work(row: str, given: Given) -> dict[str, Any]:
    body = given.once(liver_phantom, quickstart_config(False).body.cell_size)
    cases = [ROWS[row](body, seed) for seed in range(given.count)]
    return {"count": given.count, "summary": summary(cases), "cases": cases}


BENCHMARK = Benchmark(
    name="inclusion",
    title="Material beside forces on the phantom: force / E with Poisson's ratio; a stiff tumour and the rest",
    about=("registration", "reference"),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column("accepted; doubtful; refused", "", verdicts),
        Column("mean nodal error", "mm", "{error_mm.mean:.2f}"),
        *(
            Column(f"{name}: off; within 90 %", "%", f"{{{name}.off.median*100:.0f}}; {{{name}.within_90*100:.0f}}")
            for name in ("force / E", "Young's modulus", "Young's modulus of tumour", "Poisson's ratio")
        ),
        Column("median", "s", "{seconds.median:.1f}"),
    ),
    settings={"count": Setting(20, "cases of each row")},
    small={"count": 1},
    lines=lambda rows: ((name, found["summary"]) for name, found in rows.items()),
)


if __name__ == "__main__":
    run(BENCHMARK)
