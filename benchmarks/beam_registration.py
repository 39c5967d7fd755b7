"""Registration of the thesis's beam with a network (table 6.1, figure 6.9): bending, torsion and both, unseen cases.

    python benchmarks/beam_registration.py [--cases 10000] [--seconds 200] [--ranks 2]

1 x 0.25 x 0.25 m, 304 hexahedra, Neo-Hookean, 4500 Pa, 0.49. The network learns from 8,192 modal loads; cases are
fresh loads of that kind on a patch, made of the bending modes alone, of the torsional ones alone, and of both, solved
by the reference. Clouds are 1,000 points of the whole deformed surface without noise. One row knows which nodes may
carry force, one does not, and one minimises as the thesis does: first order (L-BFGS), gradient by the adjoint, on nodes
that may carry force, ended by its rule, a gradient of 1e-4 of the first.

The beam may be pushed into one place in several ways: cases whose surface is matched in another state are counted.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import made
import numpy as np
import torch
from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from inverse import cloud_of
from networks_bodies import case, data_of
from numpy.typing import NDArray
from record import RUNS
from scipy.optimize import minimize
from summaries import counts
from tqdm import tqdm

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.samplers import draw_load
from softtwin.reference.solve.problem import Problem
from softtwin.registration.forward import ForwardModel
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.options import expected_force, options_for
from softtwin.registration.problem import Problem as Search
from softtwin.registration.registrar import prepare
from softtwin.registration.result import Registration
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.surrogate.discrepancy import with_discrepancy
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.residual import ElasticBody
from softtwin.surrogate.train import train

Floats = NDArray[np.float64]
BODY = "beam-6.1"
MODULUS, RATIO, POINTS = 4500.0, 0.49, 1000
CLEAR = LogNormalPrior(1e-4, 1.0, minimum=1e-5)  # metres: points without noise
KINDS = ("bending", "torsion", "both")
FRESH = 1_000_000
MATCHED, WRONG = (
    1e-4,
    1e-3,
)  # metres: root mean square distance of a surface that is matched, mean error of a wrong state
STRESSED = 300  # cases whose stresses are compared
_SWEEPS, _RELATIVE = 400, 1e-4  # of the thesis's rule


def kinds_of_modes(body: Body, shapes: Floats) -> dict[str, NDArray[np.int64]]:
    """Modes that bend the beam, that twist it, and both; by how the tip moves: as a whole aside, or about the axis."""
    tip = body.node_sets["tip"]
    arm = body.points[tip][:, 1:] - body.points[tip][:, 1:].mean(axis=0)
    across = shapes[:, tip, 1:]
    aside = np.linalg.norm(across.mean(axis=1), axis=1)
    turn = np.abs((arm[:, 0] * across[:, :, 1] - arm[:, 1] * across[:, :, 0]).mean(axis=1)) / np.abs(arm).max()
    along = np.abs(shapes[:, tip, 0].mean(axis=1))
    bends = np.flatnonzero((aside > turn) & (aside > along))
    twists = np.flatnonzero((turn > aside) & (turn > along))
    return {"bending": bends, "torsion": twists, "both": np.sort(np.concatenate([bends, twists]))}


@dataclass(frozen=True)
class Case:
    """One load with its equilibrium.

    Args:
        number: of the draw.
        kind: of its modes.
        forces: (n, 3), newtons.
        truth: displacement, (n, 3), metres.
        cloud: points of the deformed surface, (p, 3), metres.
    """

    number: int
    kind: str
    forces: Floats
    truth: Floats
    cloud: Floats


def cases(data: DataSet, problem: Problem, count: int) -> Iterator[Case]:
    """Fresh cases, a third of each kind; a load without a stable equilibrium is drawn again."""
    plan, modes = case(BODY).plan, kinds_of_modes(data.body, data.shapes[: case(BODY).plan.loads.modes])
    made, number = 0, FRESH
    while made < count:
        kind = KINDS[made % len(KINDS)]
        rng = np.random.default_rng([plan.seed, 7, number])
        own = replace(plan.loads, modes=len(modes[kind]))
        assert own.amplitude is not None
        forces = own.amplitude * draw_load(data.body, data.shapes[modes[kind]], own, rng)
        number += 1
        try:
            state = problem.solve(forces)
        except NotConverged:
            continue
        if state.negative_pivots == 0:
            made += 1
            cloud = cloud_of(data.body, state.displacement, rng, POINTS)
            yield Case(number - 1, kind, forces, state.displacement, cloud)


def network_of(data: DataSet, seconds: float) -> Surrogate:
    """The reduced network, trained once."""
    folder = RUNS / f"{BODY}-{seconds:g}s"

    def learn() -> Surrogate:
        learned = train(data, TrainingPlan(Reduced(modes=64), seconds=seconds))
        return with_discrepancy(with_domain(learned, data), data)

    return made.network(folder, data.body, learn)


class Clock:
    """Seconds that registrations spend in states, closest points and derivatives."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)

    def timed(self, name: str, run: Callable[..., Any]) -> Callable[..., Any]:
        """The same, its time taken."""

        def wrapped(*given: Any, **named: Any) -> Any:
            begun = time.perf_counter()
            try:
                return run(*given, **named)
            finally:
                self.spent[name] += time.perf_counter() - begun

        return wrapped


@contextmanager
def watched(clock: Clock) -> Iterator[None]:
    """Take the times of all problems of registration meanwhile."""
    kept = {name: getattr(Search, name) for name in ("_state", "jacobian")}
    match = SurfaceDistance.match
    try:
        Search._state = clock.timed("states", kept["_state"])
        Search.jacobian = clock.timed("derivatives", kept["jacobian"])
        SurfaceDistance.match = clock.timed("closest points", match)
        yield
    finally:
        for name, run in kept.items():
            setattr(Search, name, run)
        SurfaceDistance.match = match


def stresses(elastic: ElasticBody, displacement: Floats) -> Floats:
    """Von Mises stress of each cell, (c,), pascals: of the mean Cauchy stress of its points."""
    gradients = elastic.deformation_gradients(torch.from_numpy(displacement)[None])[0].requires_grad_()
    density = elastic.density(gradients)
    (first,) = torch.autograd.grad(density.sum(), gradients)
    cauchy = first @ gradients.transpose(-1, -2) / torch.linalg.det(gradients)[..., None, None]
    mean = cauchy.detach().mean(dim=1).numpy()
    deviatoric = mean - np.trace(mean, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
    return np.sqrt(1.5 * (deviatoric**2).sum(axis=(1, 2)))


@dataclass(frozen=True)
class Answer:
    """What a way of registering made of a case.

    Args:
        displacement: (n, 3), metres.
        forces: (n, 3), newtons.
        rms: distance of the cloud to the surface, metres.
        iterations: of it.
        seconds: that it took, without what is prepared before a cloud comes.
        verdict: in words; empty for a way that gives none.
        registration: with its doubt; None for a way that gives none.
    """

    displacement: Floats
    forces: Floats
    rms: float
    iterations: int
    seconds: float
    verdict: str = ""
    registration: Registration | None = None


Way = Callable[[Case], Answer]


def ours(network: ForwardModel, is_known: bool) -> Way:
    """The product's registrar, from rest."""
    outer = np.setdiff1d(network.body.boundary_nodes, network.body.fixed)
    scale = expected_force(network.body, MODULUS)
    options = replace(options_for(network, is_known), noise=CLEAR)
    everywhere = None if is_known else prepare(network, outer, force_scale=scale, options=options)

    def run(given: Case) -> Answer:
        registrar = everywhere
        if registrar is None:
            own = np.flatnonzero(np.abs(given.forces).max(axis=1) > 0.0)
            registrar = prepare(network, own, force_scale=scale, options=options)
        begun = time.perf_counter()
        found = registrar.register(given.cloud)
        seconds = time.perf_counter() - begun
        return Answer(
            found.displacement,
            found.forces,
            found.rms_distance,
            len(found.trace),
            seconds,
            found.judgement.verdict.value,
            found,
        )

    return run


def first_order(network: Surrogate) -> Way:
    """As the thesis minimises: mean square distance, gradient by the network's adjoint, no prior, L-BFGS."""
    observed, body = SurfaceDistance(network.body), network.body

    def run(given: Case) -> Answer:
        own = np.flatnonzero(np.abs(given.forces).max(axis=1) > 0.0)
        count, first, kept, begun = [0], [0.0], [np.zeros(3 * len(own))], time.perf_counter()

        def value(coefficients: Floats) -> tuple[float, Floats]:
            forces = np.zeros_like(body.points)
            forces[own] = coefficients.reshape(-1, 3)
            state = network.solve(forces)
            positions = state.displacement[observed.nodes]
            match = observed.match(positions, given.cloud)
            full = np.zeros_like(body.points)
            full[observed.nodes] = (observed.rows(match).T @ match.distances).reshape(-1, 3) / len(given.cloud)
            gradient = state.vjp(full)[own].ravel()
            first[0] = first[0] or float(np.linalg.norm(gradient))
            if np.linalg.norm(gradient) <= _RELATIVE * first[0]:
                kept[0] = coefficients.copy()
                raise StopIteration
            return 0.5e8 * float(
                np.mean(match.distances**2)
            ), 1e8 * gradient  # SciPy's line search dislikes tiny numbers

        def step(coefficients: Floats) -> None:
            count[0] += 1
            kept[0] = coefficients.copy()

        try:
            options = {"maxiter": _SWEEPS, "gtol": 0.0, "ftol": 0.0, "maxcor": 30}
            minimize(value, kept[0], jac=True, method="L-BFGS-B", callback=step, options=options)
        except StopIteration:
            count[0] += 1
        forces = np.zeros_like(body.points)
        forces[own] = kept[0].reshape(-1, 3)
        found = network.solve(forces).displacement
        seconds = time.perf_counter() - begun
        return Answer(found, forces, observed.match(found[observed.nodes], given.cloud).rms, count[0], seconds)

    return run


def figures_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means, deviations, extremes over all cases; failures are counted and in no average."""
    done = [row for row in rows if row["failure"] is None]
    found: dict[str, Any] = {"cases": len(rows), "failed": [row["number"] for row in rows if row["failure"]]}
    for name in ("mean_m", "largest_m", "norm_over_nodes_m", "rms_m", "force_off", "iterations", "ms"):
        values = np.array([row[name] for row in done], dtype=np.float64)
        found[name] = {"mean": values.mean(), "deviation": values.std(), "least": values.min(), "most": values.max()}
        found[name] |= {"median": np.median(values), "p95": np.quantile(values, 0.95)}
    matched = [row["rms_m"] <= MATCHED for row in done]
    wrong = [row["mean_m"] > WRONG for row in done]
    found["matched"] = float(np.mean(matched))
    found["matched_in_a_wrong_state"] = float(np.mean(np.logical_and(matched, wrong)))
    found["verdicts"] = counts(row["verdict"] for row in done)
    accepted = [row["mean_m"] for row in done if row["verdict"] == "accepted"]
    found["accepted_largest_mean_m"] = max(accepted, default=None)
    stress = [row["stress_off"] for row in done if row["stress_off"] is not None]
    found["stress_off"] = float(np.mean(stress)) if stress else None
    return found


def answered(way: Way, given: Case) -> Answer | str:
    """What a way makes of a case, or why it makes nothing of it."""
    try:
        return way(given)
    except (NotConverged, ValueError) as error:
        return str(error)


def judged(found: Answer | str, given: Case, elastic: ElasticBody | None) -> dict[str, Any]:
    """One case by one way."""
    row: dict[str, Any] = {"number": given.number, "kind": given.kind, "failure": None}
    if isinstance(found, str):
        return {**row, "failure": found}
    row["ms"] = 1e3 * found.seconds
    away = np.linalg.norm(found.displacement - given.truth, axis=1)
    row |= {"mean_m": away.mean(), "largest_m": away.max(), "norm_over_nodes_m": np.linalg.norm(away) / len(away)}
    row |= {"rms_m": found.rms, "iterations": found.iterations, "verdict": found.verdict}
    row["force_off"] = np.linalg.norm((found.forces - given.forces).sum(axis=0)) / np.linalg.norm(
        given.forces.sum(axis=0)
    )
    row["stress_off"] = None
    if elastic is not None:
        true = stresses(elastic, given.truth)
        row["stress_off"] = np.abs(stresses(elastic, found.displacement) - true).mean() / true.mean()
    return row


SLOW = "L-BFGS, gradient 1e-4, no prior"
WAYS: dict[str, Callable[[Surrogate], Way]] = {
    "where forces act is known": lambda network: ours(network, True),
    "forces anywhere": lambda network: ours(network, False),
    SLOW: first_order,
}


@contextmanager
def solved(ranks: int, count: int) -> Iterator[list[Case]]:
    """So many cases."""
    data = data_of(BODY, ranks, jacobians=True)
    with Problem(data.body, NeoHookean(MODULUS, RATIO)) as problem:
        yield list(tqdm(cases(data, problem, count), total=count, desc="cases"))


def work(row: str, given: Given) -> dict[str, Any]:
    data = given.once(data_of, BODY, given.ranks, True)
    way = WAYS[row](given.once(network_of, data, given.seconds))
    elastic, clock, rows = ElasticBody(data.body, NeoHookean(MODULUS, RATIO)).double(), Clock(), []
    few = given.cases if row == next(iter(WAYS)) else given.few
    for place, one in enumerate(tqdm(given.opened(solved, given.ranks, given.cases)[:few], desc=row)):
        with watched(clock):
            found = answered(way, one)
        rows.append(judged(found, one, elastic if place < STRESSED else None))
    kinds = {kind: figures_of([each for each in rows if each["kind"] == kind]) for kind in KINDS}
    return {**figures_of(rows), "kinds": kinds, "seconds_in": dict(clock.spent)}


def lines(rows: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for each way, and for each kind of load."""
    for way, whole in rows.items():
        for kind, found in {"": whole, **whole["kinds"]}.items():
            yield f"{way}{', ' if kind else ''}{kind}", found


BENCHMARK = Benchmark(
    name="beam_registration",
    title="Registration of the thesis's beam with a network (table 6.1, figure 6.9), unseen cases",
    about=("registration", "surrogate"),
    work=work,
    rows=tuple(WAYS),
    columns=(
        Column("cases; failed", "", lambda f: f"{f['cases']}; {len(f['failed'])}"),
        Column("mean nodal", "mm", "{mean_m.mean*1000:.3f} +- {mean_m.deviation*1000:.3f}"),
        Column("largest", "mm", "{largest_m.mean*1000:.2f} ({largest_m.most*1000:.1f})"),
        Column("net force off, median", "%", "{force_off.median*100:.1f}"),
        Column("stress off", "%", "{stress_off*100:.1f}"),
        Column("iterations", "", "{iterations.mean:.0f} +- {iterations.deviation:.0f}"),
        Column("time", "ms", "{ms.mean:.0f} +- {ms.deviation:.0f}"),
        Column("matched; in a wrong state", "%", "{matched*100:.1f}; {matched_in_a_wrong_state*100:.1f}"),
        Column("verdicts", "", lambda f: ", ".join(f"{count} {name}" for name, count in f["verdicts"].items()) or "-"),
    ),
    settings={
        "cases": Setting(10_000, "of all three kinds together"),
        "few": Setting(1000, "cases of the ways that are slower"),
        "seconds": Setting(200.0, "of training"),
        "ranks": RANKS,
    },
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK)
