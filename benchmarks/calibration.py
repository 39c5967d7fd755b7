"""Is the doubt right where the model is? Truths drawn from the prior, a thousand cases on the beam and on the liver.

    python benchmarks/calibration.py [--only liver ...] [--cases 1000] [--twin TWIN]

Nodal forces are drawn as the registration believes: smooth over a zone, their size log-normal about the one told (in
the rows of points spread as much as it believes, in the others by half more). The reference solves them, and a noisy
cloud of 500 points of one side shows them; the surrogate registers it from rest, told neither noise nor size. Covered
is the share of nodes whose error lies within the margin, and of net forces within their region (chi-square, three
components). z are the net force's errors in the coordinates in which its covariance is one: three standard normal
numbers a case, if the doubt is right. Ranks are those of the truth in the posterior (simulation-based calibration,
Talts et al. 2018), here by its normal law: uniform if right. The largest distance of their distribution from the
uniform one is given with Kolmogorov's 95 % envelope. Refused frames are counted and left out.

`any camera`: each case has another noise (0.3 to 3 mm), number of points (100 to 1,000) and share of the side that is
seen (a quarter to all of it, in one piece), so that predicted errors differ by more than chance. `300 points` to
`50,000 points`: the same liver, half of its side seen in one piece, under clouds of a millimetre of noise, from few
points to more than are used. Hidden are nodes of the surface that are not seen, inner ones those below it, where
tumours and vessels are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from beam_registration import BODY, MODULUS, RATIO, network_of
from columns import Column, shares, verdicts
from harness import RANKS, Benchmark, Given, Setting, run
from liver import POISSON_RATIO, YOUNG_MODULUS, liver
from networks_bodies import data_of
from numpy.typing import NDArray
from record import RUNS
from scipy.stats import chi2, norm
from summaries import counts, predicted_mm
from tqdm import tqdm

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.clouds import CloudError, sample
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.solve.problem import Problem
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.options import options_for
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.policy import POLICY
from softtwin.registration.registrar import prepare
from softtwin.registration.verdict import Verdict
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import load as load_twin

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
POINTS, SPREAD = 500, 0.5  # of the logarithm of the forces' size: more than the product believes now
DENSITIES = (300, 1_000, 5_000, 50_000)  # points of a cloud
NOISES, COUNTS, SEEN = (3e-4, 3e-3), (100, 1000), (0.25, 1.0)  # of any camera: metres, points, share of the side
SHARES = (0.5, 0.9, 0.95)


@dataclass(frozen=True, eq=False)
class Case:
    """A body with its network.

    Args:
        network: that registers.
        material: of the reference.
        zone: nodes that may carry force.
        observed: the side that is seen, (t, 3).
        smoothness: correlation length of the forces, metres.
        noise: of a point, metres.
        moved: largest displacement under forces of the size told, in the median, metres.
        any_camera: whether noise, points and the share seen are drawn anew for each case.
        points: of a cloud, where they are not.
        share: of the side that is seen then, in one piece.
        spread: of the logarithm of the forces' size.
    """

    network: Surrogate
    material: NeoHookean
    zone: Ints
    observed: Ints
    smoothness: float
    noise: float
    moved: float
    any_camera: bool = False
    points: int = POINTS
    share: float = 1.0
    spread: float = SPREAD

    def seen(self, truth: Floats, rng: np.random.Generator) -> tuple[Floats, Ints]:
        """A cloud of a displacement, (p, 3), metres, and the triangles that it shows."""
        body, noise, count, share = self.network.body, self.noise, self.points, self.share
        if self.any_camera:
            noise, count = np.exp(rng.uniform(*np.log(NOISES))), int(np.exp(rng.uniform(*np.log(COUNTS))))
            share = rng.uniform(*SEEN)
        triangles = nearest_share(body.points, self.observed, share, rng) if share < 1.0 else self.observed
        cloud = sample(Surface(body.points + truth, triangles), count, rng)
        return cloud + noise * rng.standard_normal(cloud.shape), triangles


def nearest_share(points: Floats, triangles: Ints, share: float, rng: np.random.Generator) -> Ints:
    """The triangles nearest to one of them that make up a share of the area, (t, 3)."""
    corners = points[triangles]
    sizes = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    centres = corners.mean(axis=1)
    order = np.argsort(np.linalg.norm(centres - centres[rng.integers(len(centres))], axis=1))
    return triangles[order[: 1 + int(np.searchsorted(np.cumsum(sizes[order]), share * sizes.sum()))]]


def beam_case(twin: Path, ranks: int) -> Case:
    """The thesis's beam of table 6.1, seen from above and the side, pulled on its outer half."""
    data = data_of(BODY, ranks, jacobians=True)
    network, body = network_of(data, 200.0), data.body
    corners = body.points[body.boundary]
    seen = (corners[:, :, 1:] > 0.2499).all(axis=1).any(axis=1)
    zone = np.flatnonzero(body.points[:, 0] > 0.5)
    return Case(network, NeoHookean(MODULUS, RATIO), zone, body.boundary[seen], 0.1, 1e-3, 0.08)


def liver_case(twin: Path, ranks: int) -> Case:
    """The real liver, pulled in the zone of s1."""
    body = liver()
    material = NeoHookean(YOUNG_MODULUS, POISSON_RATIO)
    return Case(load_twin(twin, body), material, body.node_sets["s1"], body.surfaces["observed"], 0.02, 1e-3, 0.02)


CASES: dict[str, Callable[[Path, int], Case]] = {
    "beam": beam_case,
    "liver": liver_case,
    "beam, any camera": lambda *given: replace(beam_case(*given), any_camera=True),
    "liver, any camera": lambda *given: replace(liver_case(*given), any_camera=True),
}


def dense(points: int) -> Callable[[Path, int], Case]:
    """Half of the liver's side under clouds of so many points."""
    return lambda *given: replace(liver_case(*given), points=points, share=0.5, spread=POLICY.force_spread)


ROWS = CASES | {f"liver, {points:,} points": dense(points) for points in DENSITIES}


def size_told(case: Case, body: Body) -> float:
    """Newtons for which forces of the prior move the body as far as is wanted, in the median, to first order."""
    forces = nodal_forces(body, case.zone, LogNormalPrior(1.0, case.spread), case.smoothness)
    rng = np.random.default_rng(1)
    draws = forces.basis @ rng.standard_normal((forces.size, 50))
    moved = case.network.solve(np.zeros_like(body.points)).jvp(draws).reshape(-1, 3, 50)
    return case.moved / float(np.median(np.linalg.norm(moved, axis=1).max(axis=0)))


def run_cases(case: Case, count: int) -> dict[str, Any]:
    """What so many cases come to."""
    rows, told = rows_of(case, count)
    return {**summary(rows), **told}


def rows_of(case: Case, count: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """So many cases; a load without a stable equilibrium, or beyond what the network has learned, is drawn again."""
    body = case.network.body
    scale = LogNormalPrior(size_told(case, body), case.spread, minimum=1e-6)
    drawn = nodal_forces(body, case.zone, scale, case.smoothness)
    registrar = prepare(
        case.network,
        case.zone,
        case.observed,
        force_scale=scale.median,
        smoothness=case.smoothness,
        options=options_for(case.network, has_zone=True),
    )
    rows, again = [], {"no stable equilibrium": 0, "beyond what was learned": 0}
    with Problem(body, case.material) as problem, tqdm(total=count, desc="cases") as bar:
        number = 0
        while len(rows) < count:
            rng = np.random.default_rng([11, number])
            number += 1
            size = scale.median * np.exp(case.spread * rng.standard_normal())
            forces = drawn.forces(size * rng.standard_normal(drawn.size))
            if (case.network.solve(forces).extrapolation_ratio or 0.0) > 1.0:
                again["beyond what was learned"] += 1
                continue
            try:
                state = problem.solve(forces)
            except NotConverged:
                state = None
            if state is None or not state.is_stable:
                again["no stable equilibrium"] += 1
                continue
            rows.append(one(case, registrar, forces, state.displacement, rng))
            bar.update()
    return rows, {"drawn_again": again, "force_scale_N": scale.median}


def one(case: Case, registrar: Any, forces: Floats, truth: Floats, rng: np.random.Generator) -> dict[str, Any]:
    """Errors and doubt of one registration."""
    body, moved = case.network.body, 1e3 * float(np.linalg.norm(truth, axis=1).mean())
    cloud, shown = case.seen(truth, rng)
    try:
        result = registrar.register(cloud)
    except (CloudError, NotConverged) as error:
        return {"verdict": Verdict.REFUSED.value, "moved_mm": moved, "failure": str(error)}
    known, missed = result.uncertainty, result.net_force - forces.sum(axis=0)
    errors = np.linalg.norm(result.displacement - truth, axis=1)
    free = np.setdiff1d(np.arange(len(errors)), body.fixed)
    outer = np.unique(body.boundary)
    parts = {
        "covered": free,
        "hidden": np.setdiff1d(outer, np.union1d(np.unique(shown), body.fixed)),
        "inner": np.setdiff1d(free, outer),
    }
    within = [errors <= known.margin(None, share) for share in SHARES]
    root = np.linalg.cholesky(result.net_force_covariance)
    return {
        "verdict": result.judgement.verdict.value,
        "moved_mm": moved,
        "error_mm": 1e3 * float(errors.mean()),
        "predicted_mm": predicted_mm(known),
        **{name: [float(kept[nodes].mean()) for kept in within] for name, nodes in parts.items()},
        "force_off": float(np.linalg.norm(missed) / np.linalg.norm(forces.sum(axis=0))),
        "z": np.linalg.solve(root, missed).tolist(),
        "ranks": norm.cdf(-missed / result.net_force_deviation).tolist(),
        "seconds": result.seconds,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over the cases that were not refused."""
    used = [row for row in rows if row["verdict"] != Verdict.REFUSED.value]
    z = np.array([row["z"] for row in used])
    squares, ranks = (z**2).sum(axis=1), np.sort([row["ranks"] for row in used], axis=0)
    errors, predicted = (np.array([row[name] for row in used]) for name in ("error_mm", "predicted_mm"))
    steps = np.arange(1, len(used) + 1) / len(used)
    apart = np.maximum(steps[:, None] - ranks, ranks - steps[:, None] + 1.0 / len(used)).max(axis=0)
    return {
        "cases": len(rows),
        "verdicts": counts(row["verdict"] for row in rows),
        "error_mm": float(errors.mean()),
        "predicted_mm": float(predicted.mean()),
        "correlation": float(np.corrcoef(errors, predicted)[0, 1]),
        "off_mm": float(np.abs(errors - predicted).mean()),
        "nodes": mean_shares(used, "covered"),
        "hidden": mean_shares(used, "hidden"),
        "inner": mean_shares(used, "inner"),
        "force": {str(share): float(np.mean(squares <= chi2.ppf(share, 3))) for share in SHARES},
        "z_mean": z.mean(axis=0).tolist(),
        "z_deviation": z.std(axis=0).tolist(),
        "ranks_apart": apart.tolist(),
        "envelope": 1.358 / np.sqrt(len(used)),  # Kolmogorov's, 95 %
        "median_seconds": float(np.median([row["seconds"] for row in used])),
    }


def mean_shares(rows: list[dict[str, Any]], name: str) -> dict[str, float]:
    """Of the cases, by confidence."""
    return dict(zip(map(str, SHARES), np.mean([row[name] for row in rows], axis=0).tolist(), strict=True))


def work(row: str, given: Given) -> dict[str, Any]:
    return run_cases(ROWS[row](given.twin, given.ranks), given.cases)


BENCHMARK = Benchmark(
    name="calibration",
    title="Whether the posterior is right where the model is: truths drawn from the prior",
    about=("registration", "surrogate", "reference"),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column("accepted; doubtful; refused", "", verdicts),
        Column("error; predicted", "mm", "{error_mm:.2f}; {predicted_mm:.2f}"),
        Column("r", "", "{correlation:.2f}"),
        Column("nodes covered by 50 / 90 / 95 % margins", "%", lambda f: shares(f["nodes"])),
        Column("hidden nodes", "%", lambda f: shares(f["hidden"]) if "hidden" in f else "-"),
        Column("inner nodes", "%", lambda f: shares(f["inner"]) if "inner" in f else "-"),
        Column("net force", "%", lambda f: shares(f["force"])),
        Column("z: mean", "", lambda f: ", ".join(f"{z:.2f}" for z in f["z_mean"])),
        Column("z: deviation", "", lambda f: ", ".join(f"{z:.2f}" for z in f["z_deviation"])),
        Column("ranks apart", "", lambda f: ", ".join(f"{apart:.3f}" for apart in f["ranks_apart"])),
        Column("envelope", "", "{envelope:.3f}"),
        Column("median", "s", "{median_seconds:.2f}"),
    ),
    settings={
        "cases": Setting(1000, "of each row"),
        "twin": Setting(RUNS / "liver" / "twin", "that registration_surrogate.py makes", picks=True),
        "ranks": RANKS,
    },
    small={"cases": 3},
)


if __name__ == "__main__":
    run(BENCHMARK)
