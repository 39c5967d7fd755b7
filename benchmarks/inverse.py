"""The thesis's differentiable engine (section 7.2) on its beam: exactness; force, stiffness and ratio as controls.

    python benchmarks/inverse.py [--tables exactness force stiffness ratio sensitivity both]

1 x 0.25 x 0.25 m, 304 hexahedra, Neo-Hookean, 4500 Pa, 0.49; modal loads on one patch of 5.5 to 35 cm. Distances are
given as mean over the nodes, mean square, and norm over the number of nodes, for the thesis does not say which its are.
Every case counts: one that ends elsewhere or not at all is a failure of its row.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from columns import Column
from harness import Benchmark, Given, Setting, run
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from summaries import counts

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.inputs import Inputs
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.derivatives.layer import EquilibriumLayer
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.generate import Plan, generate, ramp_loads
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.registration.forward import reduce_model
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.loss import Square
from softtwin.registration.options import expected_force, noise_prior
from softtwin.registration.parameters.input_block import InputBlock
from softtwin.registration.parameters.inputs import InputBlocks
from softtwin.registration.parameters.nodal_forces import known_forces, nodal_forces
from softtwin.registration.parameters.poisson_ratio import PoissonRatio
from softtwin.registration.parameters.young_modulus import YoungModulus
from softtwin.registration.problem import Problem as Search
from softtwin.registration.registrar import prepare
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Verdict
from softtwin.surrogate.residual import ElasticBody

Floats = NDArray[np.float64]
MODULUS, RATIO, AMPLITUDE = 4500.0, 0.49, 0.03
TIGHT = NewtonOptions(tolerance=1e-12)
EXACT = LogNormalPrior(1e-9, 0.0, minimum=1e-9)  # metres: clouds without noise
SOLVER = GaussNewton((Square(),), max_iterations=100, settled=1e-3, minimum_step=1e-14, graduation=0.0)
RESTED, STEPS = 100, 5  # loads that the independent minimiser goes to from rest, and in how many steps
POINTS, _LEFT = 2000, 5e-5  # metres that a search may leave of a cloud without noise
SMOOTH = 0.1  # metres: neighbouring forces are alike where a search begins again at rest; afterwards each is its own


def loads(body: Body, count: int) -> Iterator[tuple[int, Floats]]:
    """Modal loads on one patch, those under which the beam has a stable state, with their numbers."""
    plan = Plan(
        "neo-hookean",
        MODULUS,
        RATIO,
        LoadPlan(amplitude=AMPLITUDE, patches=1, radius=(0.055, 0.35)),
        {"train": 16, "validation": 16, "test": 16},
    )
    with tempfile.TemporaryDirectory() as folder:
        data = generate(Path(folder) / "data.zarr", body, plan)
        assert data is not None
        for number in range(10_000, 10_000 + count):
            load, factors = ramp_loads(data, plan, number)
            yield number, factors[-1] * load


def distances(found: Floats, truth: Floats) -> dict[str, float]:
    """A distance between two displacements, as everybody may have meant it, metres and square metres."""
    away = np.linalg.norm(found - truth, axis=1)
    return {
        "mean": float(away.mean()),
        "largest": float(away.max()),
        "deviation": float(away.std()),
        "mean_square": float((away**2).mean()),
        "norm": float(np.linalg.norm(away)),
        "norm_over_nodes": float(np.linalg.norm(away) / len(away)),
    }


def together(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Mean, deviation and largest of each figure."""
    return {
        name: {
            "mean": float(np.mean([row[name] for row in rows])),
            "deviation": float(np.std([row[name] for row in rows])),
            "largest": float(np.max([row[name] for row in rows])),
        }
        for name in rows[0]
    }


def minimised(elastic: ElasticBody, forces: Floats, start: Floats, free: NDArray[np.bool_]) -> Floats | None:
    """The state of least potential near a start, by torch's energy, forces and stiffness alone (Newton, SuperLU).

    A stiffness serves as long as steps shrink to a fifth; where one is indefinite and its step leads uphill, that at
    rest takes its place. None where nothing is left that lowers the potential short of balance.
    """
    u, b = torch.from_numpy(start.copy())[None], torch.from_numpy(forces)[None]
    value, factor, last = float(elastic.potential(u, b)), None, np.inf

    def factored(displacement: torch.Tensor) -> Any:
        return splu(elastic.stiffness(displacement).tocsc()[free][:, free].tocsc())

    def downhill(solver: Any) -> tuple[torch.Tensor, float, float] | None:
        gap = (elastic.internal_forces(u) - b)[0].detach().numpy().ravel()
        step = np.zeros_like(start).ravel()
        step[free] = -solver.solve(gap[free])
        length, way, largest = 1.0, torch.from_numpy(step.reshape(1, -1, 3)), float(np.abs(step).max())
        while length > 1e-6:
            tried = float(elastic.potential(u + length * way, b))
            if tried <= value + 1e-12 * abs(value) or largest < 1e-9:  # NaN where a cell is inside out
                return length * way, tried, largest
            length *= 0.5
        return None

    for _ in range(500):
        factor = factor or factored(u[0])
        found = downhill(factor) or downhill(factored(torch.zeros_like(u[0])))
        if found is None:
            return None
        way, value, largest = found
        u = u + way
        if largest < 1e-13:
            return u[0].numpy()
        factor, last = (None if largest > 0.2 * last else factor), largest
    return None


def exactness(body: Body, count: int) -> dict[str, Any]:
    """Table of figure 7.21: the layer against an independent minimiser that starts from nine tenths of its state.

    So that it is not the start that chooses the state, it also goes from rest to some of the loads, in its own steps.
    """
    elastic, rows, sizes = ElasticBody(body, NeoHookean(MODULUS, RATIO)).double(), [], []
    failed, undecided, apart = list[int](), list[int](), list[dict[str, float]]()
    free = np.ones(body.points.shape, dtype=bool)
    free[body.fixed] = False
    spent = {"layer": 0.0, "minimiser": 0.0}
    from_rest = {"tried": 0, "ended": 0, "same": 0}
    with Problem(body, NeoHookean(MODULUS, RATIO), TIGHT) as problem:
        layer = EquilibriumLayer(problem)
        for number, forces in loads(body, count):
            begun = time.perf_counter()
            try:
                found = layer(torch.from_numpy(forces)).numpy()
            except NotConverged:
                failed.append(number)
                continue
            spent["layer"] += time.perf_counter() - begun
            begun = time.perf_counter()
            least = minimised(elastic, forces, 0.9 * found, free.ravel())
            spent["minimiser"] += time.perf_counter() - begun
            if from_rest["tried"] < RESTED:
                alone: Floats | None = np.zeros_like(found)
                for part in np.linspace(0.0, 1.0, STEPS + 1)[1:]:
                    alone = None if alone is None else minimised(elastic, part * forces, alone, free.ravel())
                from_rest["tried"] += 1
                from_rest["ended"] += alone is not None
                from_rest["same"] += alone is not None and bool(np.abs(alone - found).max() <= 1e-9)
            if least is None:
                undecided.append(number)
                continue
            rows.append(distances(found, least))
            if rows[-1]["largest"] > 1e-9:
                apart.append(
                    {"number": number, "largest_m": rows[-1]["largest"], **compared(problem, forces, found, least)}
                )
            sizes.append(float(np.linalg.norm(found)))
    within = float(np.mean([row["largest"] <= 1e-9 for row in rows]))
    return {
        "loads": count,
        "failed": failed,
        "minimiser_failed": undecided,
        "apart": apart,
        "from_rest": from_rest,
        "norm_of_displacement_m": {"mean": float(np.mean(sizes)), "deviation": float(np.std(sizes))},
        "distance": together(rows),
        "share_within_1e-9": within,
        "seconds_a_load": {name: value / len(rows) for name, value in spent.items()},
    }


def compared(problem: Problem, forces: Floats, layer: Floats, least: Floats) -> dict[str, float]:
    """Energy under the load, joules, and negative pivots of two states."""
    found: dict[str, float] = {}
    for name, state in (("layer", layer), ("minimiser", least)):
        found[f"{name}_energy"] = problem.energy(state) - float((forces * state).sum())
        found[f"{name}_negative_pivots"] = problem.negative_pivots(state) or 0
    return found


def cloud_of(body: Body, displacement: Floats, rng: np.random.Generator, count: int = POINTS) -> Floats:
    """Points drawn over the whole deformed surface, without noise, (p, 3), metres."""
    corners = (body.points + displacement)[body.boundary]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(corners), size=count, p=areas / areas.sum())
    found: Floats = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), size=count), corners[chosen])
    return found


def force(body: Body, count: int) -> dict[str, Any]:
    """Section 7.2.2: the force on the true support from bad starts; wrong supports, which are to be called doubtful."""
    outer = np.setdiff1d(body.boundary_nodes, body.fixed)
    tip, found = body.node_sets["tip"], dict[str, Any]()
    rows: dict[str, list[dict[str, float]]] = {"minus the truth": [], "N(0, 1e-2)": []}
    wrong: dict[str, list[str]] = {"opposite": [], "tip": []}
    misses: dict[str, list[float]] = {"opposite": [], "tip": []}
    accepted: dict[str, list[tuple[float, float, float]]] = {"opposite": [], "tip": []}
    failed, spent, evaluations, from_rest = [], [], [], list[int]()
    with Problem(body, NeoHookean(MODULUS, RATIO), TIGHT) as problem:
        model, observed = ReferenceModel(problem, patient=False), SurfaceDistance(body)
        for place, (number, forces) in enumerate(loads(body, count)):
            rng = np.random.default_rng(number)
            truth = model.solve(forces).displacement
            cloud, start = cloud_of(body, truth, rng), list(rows)[place % 2]
            support = np.flatnonzero(np.abs(forces).sum(axis=1) > 0.0)
            scale = expected_force(body, MODULUS)
            unknown = nodal_forces(body, support, LogNormalPrior(scale, 1.0, minimum=1e-3 * scale))
            reduced = reduce_model(model, observed.nodes, unknown.basis)
            begun = -forces[unknown.nodes].ravel() if place % 2 == 0 else 1e-2 * rng.standard_normal(unknown.size)
            clock = time.perf_counter()
            try:
                search = Search.of(reduced, observed, cloud, noise_prior(), (unknown,))
                ended = GaussNewton().solve(search, begun)
                solved = ended.evaluations
                if ended.evaluation.match.rms > _LEFT:  # as `Registrar.follow` does where a start leads astray
                    smooth = nodal_forces(body, support, unknown.scale, SMOOTH)
                    slow = reduce_model(model, observed.nodes, smooth.basis)
                    first = Search.of(slow, observed, cloud, noise_prior(), (smooth,))
                    rough = GaussNewton().solve(first, np.zeros(smooth.size))
                    begun = smooth.forces(rough.evaluation.coefficients)[unknown.nodes].ravel()
                    again = GaussNewton().solve(search, begun)
                    solved += rough.evaluations + again.evaluations
                    from_rest.append(number)
                    ended = min(ended, again, key=lambda found: found.evaluation.match.rms)
                for noise in (1e-5, 1e-6, 1e-7):  # a cloud without noise, believed more and more
                    search = replace(search, noise=LogNormalPrior(noise, 0.0, minimum=noise))
                    ended = replace(SOLVER, settled=1e-2).solve(search, ended.evaluation.coefficients, ended.evaluation)
                    solved += ended.evaluations
            except NotConverged:
                failed.append(number)
                continue
            spent.append(time.perf_counter() - clock)
            evaluations.append(solved)
            row = distances(ended.evaluation.state.full.displacement, truth)
            row["force_off"] = float(
                np.linalg.norm(unknown.forces(ended.evaluation.coefficients) - forces) / np.linalg.norm(forces)
            )
            rows[start].append(row)
            if row["mean"] > 1e-6:
                failed.append(number)
            elsewhere = np.setdiff1d(outer, support)
            mirrored = body.points.max(axis=0) * [0.0, 1.0, 1.0] + body.points[support] * [1.0, -1.0, -1.0]
            near = np.linalg.norm(body.points[elsewhere][:, None] - mirrored[None], axis=2).argmin(axis=0)
            for name, nodes in (("opposite", np.unique(elsewhere[near])), ("tip", tip)):
                try:
                    registrar = prepare(model, nodes, force_scale=scale, smoothness=0.05, elsewhere=outer)
                    result = registrar.register(cloud)
                except (NotConverged, ValueError):
                    wrong[name].append("no state")
                    continue
                wrong[name].append(result.judgement.verdict.value)
                off, margin = np.linalg.norm(result.displacement - truth, axis=1), result.uncertainty.margin()
                misses[name].append(float(off.mean()))
                if result.judgement.verdict is Verdict.ACCEPTED:
                    accepted[name].append((off.mean(), margin.mean(), float(np.mean(off <= margin))))
    found["loads"], found["failed"], found["begun again at rest"] = count, failed, from_rest
    found["starts"] = {name: together(each) for name, each in rows.items() if each}
    found["seconds"], found["evaluations"] = float(np.mean(spent)), float(np.mean(evaluations))
    found["wrong support"] = {
        name: {
            "verdicts": counts(verdicts),
            "mean_nodal_m": float(np.mean(misses[name])) if misses[name] else None,
            **of_accepted(accepted[name]),
        }
        for name, verdicts in wrong.items()
    }
    return found


def of_accepted(states: list[tuple[float, float, float]]) -> dict[str, float | int]:
    """How good accepted states are, whose forces were looked for in a wrong place: they may be right all the same.

    Args:
        states: mean error and mean 95 % margin of the nodes, metres, and the share of nodes within theirs.
    """
    if not states:
        return {"accepted_beyond_twice_their_margin": 0}
    off, margin, held = np.array(states).T
    return {
        "accepted_mean_nodal_m": float(off.mean()),
        "accepted_largest_mean_nodal_m": float(off.max()),
        "accepted_beyond_twice_their_margin": int(np.sum(off > 2.0 * margin)),
        "accepted_nodes_in_95_margins": float(held.mean()),
    }


def controlled(
    body: Body, count: int, unknowns: tuple[InputBlock, ...], starts: list[dict[str, float]]
) -> tuple[list[dict[str, float]], list[int], list[float]]:
    """Material parameters found from clouds under known forces: what they are off, what failed, seconds."""
    rows, failed, spent = [], [], []
    observed = SurfaceDistance(body)
    with Problem(body, NeoHookean(MODULUS, RATIO), TIGHT) as problem:
        for (number, forces), start in zip(loads(body, count), starts, strict=True):
            problem.set_material(NeoHookean(MODULUS, RATIO))  # a model leaves its last parameters behind
            truth = ReferenceModel(problem).solve(forces).displacement
            cloud = cloud_of(body, truth, np.random.default_rng(number))
            model = ReferenceModel(problem, patient=True, loading=Loading(forces=forces))
            input_blocks = InputBlocks(body, start, unknowns)
            none = known_forces(body, LogNormalPrior(1.0, 0.0))
            reduced = reduce_model(model, observed.nodes, none.basis, input_blocks)
            search = Search.of(reduced, observed, cloud, EXACT, (none, input_blocks))
            clock = time.perf_counter()
            try:
                ended = SOLVER.solve(search, np.zeros(input_blocks.size))
            except NotConverged:
                failed.append(number)
                continue
            spent.append(time.perf_counter() - clock)
            inputs = input_blocks.inputs(ended.evaluation.coefficients).parameters
            row = distances(ended.evaluation.state.full.displacement, truth)
            row["modulus_off"] = abs(float(inputs["young_modulus"]) / MODULUS - 1.0)
            row["ratio_off"] = abs(float(inputs["poisson_ratio"]) / RATIO - 1.0)
            row["evaluations"] = float(ended.evaluations)
            rows.append(row)
    return rows, failed, spent


def stiffness(body: Body, count: int) -> dict[str, Any]:
    """Section 7.2.3: Young's modulus from 1e6 to 1e10 Pa towards 4500."""
    rng = np.random.default_rng(0)
    starts = [{"young_modulus": float(10.0 ** rng.uniform(6.0, 10.0)), "poisson_ratio": RATIO} for _ in range(count)]
    rows, failed, spent = controlled(body, count, (YoungModulus(10.0),), starts)
    reached = sum(row["modulus_off"] <= 1e-8 for row in rows)
    return {"loads": count, "failed": failed, "within_1e-8": reached, **_found(rows, spent)}


def ratio(body: Body, count: int) -> dict[str, Any]:
    """Section 7.2.3: Poisson's ratio from 0.2 to 0.499 towards 0.49."""
    rng = np.random.default_rng(0)
    starts = [{"young_modulus": MODULUS, "poisson_ratio": float(rng.uniform(0.2001, 0.499))} for _ in range(count)]
    rows, failed, spent = controlled(body, count, (PoissonRatio(10.0),), starts)
    reached = sum(row["ratio_off"] <= 1e-5 for row in rows)
    return {"loads": count, "failed": failed, "within_1e-5": reached, **_found(rows, spent)}


def both(body: Body, count: int) -> dict[str, Any]:
    """Beyond: both together, from both ranges."""
    rng = np.random.default_rng(0)
    starts = [
        {"young_modulus": float(10.0 ** rng.uniform(3.0, 7.0)), "poisson_ratio": float(rng.uniform(0.25, 0.499))}
        for _ in range(count)
    ]
    rows, failed, spent = controlled(body, count, (YoungModulus(10.0), PoissonRatio(10.0)), starts)
    reached = sum(row["ratio_off"] <= 1e-5 and row["modulus_off"] <= 1e-5 for row in rows)
    return {"loads": count, "failed": failed, "within_1e-5": reached, **_found(rows, spent)}


def _found(rows: list[dict[str, float]], spent: list[float]) -> dict[str, Any]:
    return {"found": together(rows), "seconds": float(np.mean(spent))} if rows else {}


def sensitivity(body: Body, count: int) -> dict[str, Any]:
    """Figures 7.26 and 7.29: what one per cent of either parameter moves, metres."""
    rows: dict[str, list[dict[str, float]]] = {}
    with Problem(body, NeoHookean(MODULUS, RATIO), TIGHT) as problem:
        model = ReferenceModel(problem)
        for _, forces in loads(body, count):
            truth = model.solve(forces)
            for name, value in (("young_modulus", MODULUS), ("poisson_ratio", RATIO)):
                for sign in (1, -1):
                    other = model.solve(forces, truth, Inputs({name: (1.0 + 0.01 * sign) * value}))
                    row = distances(other.displacement, truth.displacement)
                    rows.setdefault(f"{name} {'+' if sign > 0 else '-'}1 %", []).append(row)
    return {"loads": count, **{name: together(each) for name, each in rows.items()}}


TABLES = {
    "exactness": (exactness, 1000),
    "force": (force, 100),
    "stiffness": (stiffness, 100),
    "ratio": (ratio, 100),
    "both": (both, 100),
    "sensitivity": (sensitivity, 100),
}


def work(row: str, given: Given) -> dict[str, Any]:
    run_table, count = TABLES[row]
    return run_table(beam(), given.count or count)


_CONTROLS = {
    "stiffness": ("modulus_off", "within_1e-8"),
    "ratio": ("ratio_off", "within_1e-5"),
    "both": ("modulus_off", "within_1e-5"),
}


def lines(rows: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """What is off at the end, in the mean and at most, one line for each control and start."""
    for name, found in rows.items():
        if name == "exactness":
            asked = f"{100 * found['share_within_1e-9']:.0f} % of nodes' largest"
            yield name, {**found["distance"], "loads": found["loads"], "asked": asked,
                         "seconds": found["seconds_a_load"]["layer"]}  # fmt: skip
        elif name in _CONTROLS:
            off, asked = _CONTROLS[name]
            yield name, {**found["found"], "off": found["found"][off], "loads": found["loads"],
                         "asked": found[asked], "seconds": found["seconds"]}  # fmt: skip
        elif name == "force":
            asked = f"all but {len(found['failed'])} of {found['loads']}"
            for start, each in found["starts"].items():
                yield f"force from {start}", {**each, "off": each["force_off"], "loads": found["loads"] // 2,
                                              "asked": asked, "seconds": found["seconds"]}  # fmt: skip


BENCHMARK = Benchmark(
    name="inverse",
    title="The thesis's differentiable engine (section 7.2): exactness; force, stiffness and ratio as controls",
    about=("registration", "reference"),
    work=work,
    rows=lambda given: given.tables,
    columns=(
        Column("loads", "", "{loads}"),
        Column("as asked", "", "{asked}"),
        Column("mean nodal (largest)", "m", "{mean.mean:.1e} ({mean.largest:.1e})"),
        Column("norm / nodes", "m", "{norm_over_nodes.mean:.1e}"),
        Column("control off, relative", "", "{off.mean:.1e} ({off.largest:.1e})"),
        Column("a load", "s", "{seconds:.2f}"),
    ),
    settings={
        "tables": Setting(tuple(TABLES), choices=tuple(TABLES), picks=True),
        "count": Setting(None, "loads, fewer than the table's, for a look", kind=int),
    },
    seeds=(0,),
    small={"count": 2},
    lines=lines,
    also=("inverse_exactness",),
)


if __name__ == "__main__":
    run(BENCHMARK)
