"""Organs that nothing was learned for: what predicts their states at once, and with 32 equilibria of their own.

    python benchmarks/unseen.py [--organs 40] [--blends 8] [--only family ...]

Organs of a family (`meshes/family.py`; forms, supports, Poisson's ratios of 0.40 to 0.47), blends of given organs (the
phantom, a kidney, a liver, with supports and ratios of the family), and others of no family: a kidney and a liver as
another program wrote them, the real liver, a lung (`../shared/data`). Loads of the default kind,
scaled to 30 mm, and smooth ones on patches as registration expects them; truths by the reference. Errors are
|u - u*| / |u*| over the nodes. Ways that learn nothing: the linear response, with its turns made finite (warped), the
Galerkin model of linear modes alone, with modal derivatives, and with what 32 equilibria add; torch's solver, stopped
early. Beside them the reduced network trained on the same 32. Bounds are calibrated on 32 further draws
(`surrogate/calibration.py`) and held against the test draws.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lungs
import numpy as np
import torch
from columns import Column
from harness import RANKS, Benchmark, Figures, Given, Setting, run, started
from liver import liver
from numpy.typing import NDArray
from organs import SIMULATED, SURFACES
from record import RUNS
from summaries import median_seconds

from softtwin.app.config import parse_config
from softtwin.app.stages.mesh import mesh_stage
from softtwin.app.workspace import Workspace
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.family import Member, blend, member
from softtwin.meshes.io import read_body
from softtwin.meshes.shapes import liver_phantom
from softtwin.reference.data.dataset import DataSet, Samples, existing
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.generate import Plan, generate
from softtwin.surrogate.calibration import calibrate, coverage
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.equilibria import Equilibria, NewtonSettings
from softtwin.surrogate.galerkin import Galerkin
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.residual import ElasticBody
from softtwin.surrogate.tangents import layers_of
from softtwin.surrogate.train import train
from softtwin.surrogate.warping import Warping

Floats = NDArray[np.float64]
SAMPLES = {"train": 32, "validation": 8, "test": 32, "calibration": 32, "smooth": 16}
MOVED, NODES, EARLY = 0.03, 2060, 0.03  # metres; of bodies made from surfaces; out-of-balance forces to stop at
LEARNED = "network, 32 own"
LABELS = {
    "linear": "linear response",
    "warped": "warped linear response",
    "modes": "Galerkin, linear modes alone",
    "curved": "Galerkin, modal derivatives, none own",
    "own": "Galerkin, 32 own",
    "torch": "torch's solver, stopped early",
    LEARNED: LEARNED,
}


@dataclass(frozen=True, eq=False)
class Organ:
    """A body with its tissue."""

    body: Body
    young_modulus: float
    poisson_ratio: float


def meshed(name: str) -> Body:
    """A surface of another program made solid; what is there is not made again."""
    folder, (file, fixed, camera) = RUNS / f"unseen-{name.replace(' ', '-')}", SIMULATED[name]
    if not (folder / "body.vtu").exists():
        folder.mkdir(parents=True, exist_ok=True)
        seen = "seen-from:" + ",".join(f"{1e4 * axis:g}" for axis in camera)
        body = {"source": str(SURFACES / file), "unit": "mm", "nodes": NODES, "fixed": fixed, "observed": seen}
        mesh_stage(Workspace(parse_config({"folder": ".", "body": body}), folder))
    return read_body(folder / "body.vtu")


def lung() -> Body:
    """A lung of the second patient, as `lungs.py` meshes it."""
    folder = RUNS / "lungs" / f"case_{lungs.CASES[1]:02d}_left"
    if not (folder / "lung" / "body.vtu").exists():
        lungs.prepared(lungs.CASES[1], "left")
    return read_body(folder / "lung" / "body.vtu")


OTHERS: dict[str, Callable[[], Organ]] = {
    "kidney": lambda: Organ(meshed("simulated kidney"), 4500.0, 0.45),
    "liver of another program": lambda: Organ(meshed("simulated liver"), 4500.0, 0.45),
    "real liver, Poisson's ratio 0.45": lambda: Organ(liver(), 4500.0, 0.45),
    "real liver, Poisson's ratio 0.49": lambda: Organ(liver(), 4500.0, 0.49),
    "lung, Poisson's ratio 0.3": lambda: Organ(lung(), 1000.0, 0.3),
}


def organ_of(name: str) -> Organ:
    """By the name of a row."""
    if name in OTHERS:
        return OTHERS[name]()
    found = member_of(name)
    return Organ(found.body, found.young_modulus, found.poisson_ratio)


def member_of(name: str) -> Member:
    """An organ of the family by the name of a row."""
    kind, number = name.split()
    return member(int(number)) if kind == "family" else blend(int(number), given_organs())


def given_organs() -> list[Surface]:
    """Between which blends lie."""
    found = [liver_phantom(0.012).boundary_surface]
    return found + [meshed(name).boundary_surface for name in ("simulated kidney", "simulated liver")]


def plan_of(organ: Organ) -> Plan:
    """Loads, tissue and draws."""
    loads = LoadPlan(modes=10, patches=2, displacement=MOVED)
    return Plan("neo-hookean", organ.young_modulus, organ.poisson_ratio, loads, SAMPLES, block=8)


def path_of(name: str) -> Path:
    """Where an organ's equilibria are."""
    return RUNS / f"unseen-data-{name.replace(' ', '-').replace(',', '')}.zarr"


def make(name: str) -> None:
    """Solve the equilibria; on all ranks where mpirun started this."""
    organ = organ_of(name)
    generate(path_of(name), organ.body, plan_of(organ))


def data_of(name: str, ranks: int) -> DataSet:
    """The equilibria of an organ; what is there is not made again."""
    made = existing(path_of(name))
    if made is None or made.missing_blocks():
        if name in OTHERS:
            organ_of(name)  # meshed by one process before several read it
        started(__file__, "generate", name, ranks=ranks)
    return DataSet(path_of(name))


def whole(data: DataSet, samples: Samples) -> Floats:
    """Forces at all nodes, (s, n, 3)."""
    return data.response.spread(samples.forces)


def ways_of(data: DataSet, learn: bool) -> Iterable[tuple[str, Callable[[Floats], Floats], float, Surrogate | None]]:
    """Each way to predict: name, displacement for forces, (n, 3) each, seconds that it took to make, its surrogate."""
    loaded, body = data.response.loaded, data.body

    def linear(forces: Floats) -> Floats:
        return data.response.apply(forces[None, loaded])[0]

    elastic = ElasticBody(body, data.material)
    layers = layers_of(body.cells.astype(np.int64), elastic.free[:, 0].numpy() > 0.0)
    warping = Warping(elastic, layers, body.size)
    yield "linear", linear, 0.0, None
    yield "warped", lambda f: warping.warped(torch.from_numpy(linear(f)[None]))[0].numpy(), 0.0, None
    settings = {
        "modes": Galerkin(modes=72, curved=1, derivatives=0, own=0),
        "curved": Galerkin(own=0),
        "own": Galerkin(),
    }
    for name, kind in settings.items():
        begin = time.perf_counter()
        made = train(data, TrainingPlan(kind))
        yield name, made.propose, time.perf_counter() - begin, made
    solver = Equilibria(body, data.material, settings=NewtonSettings(tolerance=EARLY))
    yield "torch", lambda f: solver.solve(f[None]).displacement[0].numpy(), 0.0, None
    if learn:
        made = train(data, TrainingPlan(Reduced(), seconds=20.0))
        yield LEARNED, made.propose, 20.0, made


def errors_of(predict: Callable[[Floats], Floats], forces: Floats, truths: Floats) -> list[float]:
    """Relative errors, one a sample."""
    found = np.stack([predict(load) for load in forces])
    missed = np.linalg.norm(found - truths, axis=(1, 2)) / np.linalg.norm(truths, axis=(1, 2))
    return [round(float(value), 6) for value in missed]


def work(name: str, given: Given) -> dict[str, Any]:
    data = data_of(name, given.ranks)
    splits = {split: data.samples(split) for split in ("test", "smooth")}
    forces = {split: whole(data, samples) for split, samples in splits.items()}
    ways, bounds = {}, {}
    learn = name in OTHERS or (name.startswith("family") and int(name.split()[1]) % given.learn_every == 0)
    for way, predict, seconds, surrogate in ways_of(data, learn):
        one = forces["test"][0]
        ways[way] = {
            "seconds": seconds,
            "ms": 1e3 * median_seconds(lambda predict=predict, one=one: predict(one), 5),
            **{split: errors_of(predict, forces[split], samples.displacements) for split, samples in splits.items()},
        }
        if way == "own":
            assert surrogate is not None
            held = coverage(calibrate(with_domain(surrogate, data), data), data)
            bounds = {"kept": held.kept, "widths": held.widths, "outside": held.outside}
    found = {
        "nodes": len(data.body.points),
        "poisson_ratio": float(data.header["plan"]["poisson_ratio"]),
        "form": "" if name in OTHERS else member_of(name).form,
        "rejected": len(data.rejected().draws),
        "moved_mm": [round(1e3 * float(np.linalg.norm(u, axis=1).max()), 2) for u in splits["test"].displacements],
        "ways": ways,
        "bounds": bounds,
    }
    if not given.keep and name not in OTHERS:
        shutil.rmtree(data.path)
    return found


def rows_of(given: Given) -> list[str]:
    """Organs."""
    counts = {"family": given.organs, "blend": given.blends}
    made = (f"{kind} {number}" for kind, count in counts.items() for number in range(count))
    return [*made, *OTHERS]


def summarised(figures: Figures, given: Given | None = None) -> Figures:
    """Organs of the family together, others one by one: of each way, errors in percent, pooled over organs."""
    organs = figures["organs"]
    groups = {kind: [row for name, row in organs.items() if name.startswith(kind)] for kind in ("family", "blend")}
    groups = {kind: rows for kind, rows in groups.items() if rows}
    groups |= {name: [organs[name]] for name in OTHERS if name in organs}
    found: Figures = {}
    for group, rows in groups.items():
        ways = {way: [row["ways"][way] for row in rows if way in row["ways"]] for way in LABELS}
        found[group] = {way: _pooled(each) for way, each in ways.items() if each}
        kept = [100.0 * row["bounds"]["kept"]["mean"] for row in rows]
        if kept:
            found[group]["own"]["kept"] = {"mean": float(np.mean(kept)), "least": float(np.min(kept))}
    return {"summary": found}


def _pooled(each: list[Figures]) -> Figures:
    entry: Figures = {name: float(np.median([one[name] for one in each])) for name in ("ms", "seconds")}
    for split in ("test", "smooth"):
        errors = 100.0 * np.concatenate([one[split] for one in each])
        entry[split] = {"median": float(np.median(errors)), "p95": float(np.percentile(errors, 95))}
    return {"organs": len(each), **entry}


def lines(organs: Figures) -> Iterable[tuple[str, Figures]]:
    """A line for each group of organs and each way."""
    for group, ways in summarised({"organs": organs})["summary"].items():
        for way, entry in ways.items():
            yield f"{group}: {LABELS[way]}", entry


BENCHMARK = Benchmark(
    name="unseen",
    title="Organs that nothing was learned for: a family of forty, and others, by ways that learn nothing",
    about=("meshes/family.py", "surrogate", "reference"),
    work=work,
    rows=rows_of,
    columns=(
        Column("organs", "", "{organs}"),
        Column("relative error, median; 95 %", "%", "{test.median:.2f}; {test.p95:.2f}"),
        Column("under smooth forces", "%", "{smooth.median:.2f}; {smooth.p95:.2f}"),
        Column("90 % bounds hold, mean; least organ", "%", "{kept.mean:.0f}; {kept.least:.0f}"),
        Column("to make", "s", "{seconds:.1f}"),
        Column("a prediction", "ms", "{ms:.1f}"),
    ),
    settings={
        "organs": Setting(40, "of the family", picks=True),
        "blends": Setting(8, "of given organs", picks=True),
        "learn_every": Setting(8, "organ of the family, that a network is trained for, too", picks=True),
        "keep": Setting(False, "keep equilibria of the family", picks=True),
        "ranks": RANKS,
    },
    seeds=(0,),
    small={"organs": 1, "blends": 0},
    under="organs",
    finish=summarised,
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"generate": make})
