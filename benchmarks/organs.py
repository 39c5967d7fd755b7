"""One table for all ways to register an organ: measured lungs, the real liver, simulated organs; theirs and ours.

    pip install '.[benchmark]'                    # pycpd; trimesh is there
    python benchmarks/organs.py [--only "real liver: hybrid" ...]

Data, read where they lie and copied nowhere: `lungs` (../shared/data/lungs: five patients, ten lungs, 1,500 landmarks
that experts set; made from DIR-Lab COPDgene), whole surface and lateral half; `liver` (../shared/data/liver: sequences
s1 to s3 of Mestdagh and Cotin 2022, every tenth frame by itself); `surfaces` (../shared/data/surfaces): a liver and a
kidney as another program wrote them, pulled at a patch that a camera sees by the reference on a finer mesh than the
twin's, half of what is seen in the cloud, 0.5 mm of noise. Methods without tissue (`surface_methods.py`) get the
observed surface and the cloud. Ours get the twin, too: what holds the organ, its material, and on the real liver the
zone that tools may touch. Each case is registered from rest.

Places: landmarks in the lungs; elsewhere the nodes of the truth's mesh: on the surface where the cloud is within 8 mm
(seen), on the rest of it (hidden), and inside. What is refused counts with the state that was found, where there is
one; what gives none counts as nothing moved. Covered: places within the margin that a method itself states.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import lungs
import numpy as np
from columns import Column
from harness import Benchmark, Figures, Given, Setting, run
from liver import SEQUENCES, liver, sequence
from numpy.typing import NDArray
from record import ROOT, RUNS
from scipy.spatial import cKDTree
from surface_methods import METHODS, Scene

from softtwin.app.chain import build_twin
from softtwin.app.config import parse_config
from softtwin.app.twin import MODEL_ERROR, Twin
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import embed, outer
from softtwin.meshes.io import read_body
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.solve.problem import Problem

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
SURFACES = ROOT.parent / "shared" / "data" / "surfaces"
ENGINES = ("surrogate", "hybrid", "reference")
FRAMES = (10, 20, 30, 40, 49)
NEAR = 0.008  # metres
MODULUS, RATIO, NOISE, POINTS = 4500.0, 0.45, 5e-4, 1000
PULLS, MOVED, PATCH = 8, 0.02, 0.02  # cases; largest displacement; radius of a patch, metres
# File, its fixed side and its camera, millimetres in its own axes.
SIMULATED = {
    "simulated liver": ("sks-liver-sub.ply", "halfspace:0,-95,0:0,1,0", (0.0, -1.0, 0.0)),
    "simulated kidney": ("sks-kidney.vtk", "halfspace:0,0,-915:0,0,-1", (0.0, -1.0, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Case:
    """One thing to register.

    Args:
        name: of it.
        body: that is known at rest.
        cloud: of it moved, (p, 3), metres.
        places: at rest, (q, 3), metres, and where they are.
        moved: likewise.
        kinds: of the places: `seen`, `hidden`, `inside`.
        shares_frame: whether rest and cloud are in one frame.
        shows_all: whether the cloud shows the whole surface.
        zone: node set that may carry force; empty for all.
    """

    name: str
    body: Body
    cloud: Floats
    places: Floats
    moved: Floats
    kinds: dict[str, Flags]
    shares_frame: bool = True
    shows_all: bool = False
    zone: str = ""


def kinds_of(body: Body, moved: Floats, cloud: Floats) -> dict[str, Flags]:
    """Which nodes of a body lie where the cloud is, elsewhere on the surface, and inside."""
    outside = np.zeros(len(body.points), dtype=bool)
    outside[body.boundary_nodes] = True
    is_near = cKDTree(cloud).query(moved)[0] <= NEAR
    return {"seen": outside & is_near, "hidden": outside & ~is_near, "inside": ~outside}


def of_lungs(part: str) -> Callable[[], Iterator[Case]]:
    """The ten lungs, by landmarks."""

    def cases() -> Iterator[Case]:
        for case in lungs.CASES:
            for side, label in lungs.SIDES.items():
                folder = RUNS / "lungs" / f"case_{case:02d}_{side}"
                if not (folder / "lung" / "body.vtu").exists():
                    lungs.prepared(case, side)
                body = read_body(folder / "lung" / "body.vtu")
                file = lungs.LUNGS / f"case_{case:02d}" / f"cloud_expiration_{label}{lungs.SEEN[part]}.txt"
                rest, moved = (1e-3 * np.loadtxt(folder / f"landmarks_{n}.txt") for n in ("inspiration", "expiration"))
                kinds = {"inside": np.ones(len(rest), dtype=bool)}
                yield Case(
                    f"case {case}, {side}", body, 1e-3 * np.loadtxt(file), rest, moved, kinds, False, part == "whole"
                )

    return cases


def of_liver() -> Iterator[Case]:
    """Frames of the three sequences."""
    body = liver()
    for name in SEQUENCES:
        data = sequence(name)
        for frame in FRAMES:
            cloud, moved = data.clouds[frame], data.positions[frame]
            kinds = kinds_of(body, moved, cloud)
            yield Case(f"{name}, frame {frame}", body, cloud, body.points, moved, kinds, zone=name)


@cache
def twin_of(name: str) -> Path:
    """The twin of a simulated organ; one that is there is not built again."""
    folder = RUNS / f"organs-{name.replace(' ', '-')}"
    if not (folder / "twin" / MODEL_ERROR).exists():
        build_twin(config_of(name, 900), folder, print)
    return folder / "twin"


def config_of(name: str, nodes: int) -> Any:
    file, fixed, camera = SIMULATED[name]
    return parse_config(
        {
            "folder": ".",
            "body": {
                "source": str(SURFACES / file),
                "unit": "mm",
                "nodes": nodes,
                "fixed": fixed,
                "observed": "seen-from:" + ",".join(f"{1e4 * axis:g}" for axis in camera),
            },
            "material": {"young_modulus": MODULUS, "poisson_ratio": RATIO},
            "loads": {"modes": 16, "displacement": 0.03},
            "samples": {"train": 256, "validation": 16, "test": 16, "smooth": 16},
            "training": {"seconds": 120.0},
        }
    )


def of_organ(name: str) -> Callable[[], Iterator[Case]]:
    """Pulls at patches that a camera sees, by the reference on a finer mesh."""

    def cases() -> Iterator[Case]:
        from softtwin.app.organ import make_body

        known, rng = read_body(twin_of(name) / "body.vtu"), np.random.default_rng(0)
        finer = make_body(config_of(name, 1800).body, Path())
        camera = SIMULATED[name][2]
        seen = np.setdiff1d(np.unique(finer.surfaces["observed"]), finer.fixed)
        with Problem(finer, NeoHookean(MODULUS, RATIO)) as problem:
            count = 0
            while count < PULLS:
                displacement = pulled(problem, rng.choice(seen), rng.standard_normal(3))
                if displacement is None:
                    continue
                count += 1
                cloud = partial_view(finer, displacement, camera, 2 * POINTS, NOISE, rng)
                across = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)[2][0]
                along = cloud @ across * rng.choice([-1.0, 1.0])
                cloud = cloud[along > np.median(along)]
                moved = finer.points + displacement
                yield Case(f"pull {count}", known, cloud, finer.points, moved, kinds_of(finer, moved, cloud))

    return cases


def pulled(problem: Problem, node: int, direction: Floats) -> Floats | None:
    """A state under a pull at a patch, its largest displacement near `MOVED`; None where there is none."""
    body = problem.body
    near = np.linalg.norm(body.points - body.points[node], axis=1) <= PATCH
    near[body.fixed] = False
    near &= np.isin(np.arange(len(near)), body.boundary_nodes)
    forces = np.zeros_like(body.points)
    forces[near] = direction / np.linalg.norm(direction) / near.sum()
    response = problem.apply_inverse(forces.reshape(-1, 1)).reshape(-1, 3)
    forces *= MOVED / np.linalg.norm(response, axis=1).max()
    try:
        return problem.solve(forces).displacement
    except NotConverged:
        return None


DATA: dict[str, Callable[[], Iterator[Case]]] = {
    "lungs, whole": of_lungs("whole"),
    "lungs, half": of_lungs("half"),
    "real liver": of_liver,
    **{name: of_organ(name) for name in SIMULATED},
}


def ways_of(data: str) -> list[str]:
    """Theirs and ours; a lung has no network."""
    return [*METHODS, *(["reference"] if data.startswith("lungs") else ENGINES)]


ROWS = {f"{data}: {way}": (data, way) for data in DATA for way in ways_of(data)}


@dataclass(frozen=True, eq=False)
class Found:
    """Where places were found, (q, 3), metres, margins of 95 % where a way states them, and what it says of itself."""

    places: Floats
    seconds: float
    margins: Floats | None = None
    verdict: str = ""


def by_surface(case: Case, way: str) -> Found:
    """By a way without tissue."""
    whole = outer(case.body).rest
    side = Surface(whole.points, case.body.surfaces.get("observed", whole.triangles))
    begin = time.perf_counter()
    moved = METHODS[way](Scene(side, case.cloud, case.shares_frame, case.shows_all))(case.places)
    return Found(moved, time.perf_counter() - begin)


def by_twin(case: Case, twin: Twin) -> Found:
    """By one of ours."""
    carried = embed(twin.body, case.places)
    begin = time.perf_counter()
    try:
        result = twin.register(case.cloud, zone=case.zone)
    except (NotConverged, ValueError):
        return Found(case.places, time.perf_counter() - begin, None, "refused")
    seconds = time.perf_counter() - begin
    moved = result.pose.apply(case.places + carried.displace(result.displacement))
    margins = result.camera_uncertainty.margin(carried)
    return Found(moved, seconds, margins, result.judgement.verdict.value)


def opened(case: Case, data: str, way: str, given: Given) -> Twin:
    """The twin of a case's organ with an engine."""
    if data.startswith("lungs"):
        number, side = case.name.removeprefix("case ").split(", ")
        return Twin.open(RUNS / "lungs" / f"case_{int(number):02d}_{side}" / "organ.toml", way)
    return given.opened(Twin.open, given.twin if data == "real liver" else twin_of(data), way)


def work(row: str, given: Given) -> dict[str, Any]:
    data, way = ROWS[row]
    every = given.once(cases_of, data)
    told = []
    for case in every[: given.cases or None]:
        if way in METHODS:
            found = by_surface(case, way)
        elif data.startswith("lungs"):
            with opened(case, data, way, given) as twin:
                found = by_twin(case, twin)
        else:
            found = by_twin(case, opened(case, data, way, given))
        told.append(summary_of(case, found))
    return together(told)


def cases_of(data: str) -> list[Case]:
    """All cases of some data."""
    return list(DATA[data]())


def summary_of(case: Case, found: Found) -> dict[str, Any]:
    errors = 1e3 * np.linalg.norm(found.places - case.moved, axis=1)
    covered = None if found.margins is None else errors <= 1e3 * found.margins
    return {
        "case": case.name,
        "error_mm": {kind: float(errors[chosen].mean()) for kind, chosen in case.kinds.items() if chosen.any()},
        "all_mm": float(errors.mean()),
        "places": len(errors),
        "covered": None if covered is None else float(covered.mean()),
        "verdict": found.verdict,
        "seconds": found.seconds,
    }


def together(told: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over places of all cases; seconds are medians."""
    kinds = sorted({kind for each in told for kind in each["error_mm"]})
    known = [each for each in told if each["covered"] is not None]
    verdicts = [each["verdict"] for each in told]
    return {
        "cases": told,
        "count": len(told),
        "error_mm": {
            kind: float(np.mean([e["error_mm"][kind] for e in told if kind in e["error_mm"]])) for kind in kinds
        },
        "all_mm": mean_of(told, "all_mm"),
        "worst_mm": max(each["all_mm"] for each in told),
        "covered": mean_of(known, "covered") if known else None,
        "accepted": verdicts.count("accepted"),
        "doubtful": verdicts.count("doubtful"),
        "refused": verdicts.count("refused"),
        "accepted_worst_mm": max((each["all_mm"] for each in told if each["verdict"] == "accepted"), default=None),
        "seconds": float(np.median([each["seconds"] for each in told])),
    }


def mean_of(told: list[dict[str, Any]], name: str) -> float:
    """Over all places."""
    return float(np.average([each[name] for each in told], weights=[each["places"] for each in told]))


def by_kind(figures: Figures) -> str:
    """Errors on the seen and the hidden surface, and inside."""
    found = figures["error_mm"]
    return " / ".join(f"{found[kind]:.2f}" if kind in found else "-" for kind in ("seen", "hidden", "inside"))


def verdicts(figures: Figures) -> str:
    """What a way says of its own results."""
    words = [figures["accepted"], figures["doubtful"], figures["refused"]]
    return " / ".join(map(str, words)) if sum(words) else "says nothing"


BENCHMARK = Benchmark(
    name="organs",
    title="One table for all ways to register an organ: measured lungs, a real liver, simulated organs",
    about=("registration", "reference", "surrogate", "meshes", "benchmarks/surface_methods.py"),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column("cases", "", "{count}"),
        Column("all places", "mm", "{all_mm:.2f}"),
        Column("seen / hidden / inside", "mm", by_kind),
        Column("worst case", "mm", "{worst_mm:.1f}"),
        Column("accepted / doubtful / refused", "", verdicts),
        Column("worst accepted", "mm", "{accepted_worst_mm:.2f}"),
        Column("within their own 95 % margins", "%", "{covered*100:.0f}"),
        Column("a case, median", "s", "{seconds:.2f}"),
    ),
    settings={
        "twin": Setting(RUNS / "liver" / "twin", "of the real liver, that registration_surrogate.py makes", picks=True),
        "cases": Setting(0, "of each data set at most; 0: all"),
    },
    small={"cases": 1},
    seeds=(0,),
)


if __name__ == "__main__":
    run(BENCHMARK)
