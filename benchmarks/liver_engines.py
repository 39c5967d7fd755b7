"""The real liver by three engines, on another mesh, and with a wrong organ (figures 6.11 to 6.14 of the thesis).

    python benchmarks/liver_engines.py [--twin TWIN] [--only ROW ...] [--frames 50]
    python benchmarks/liver_engines.py pictures FOLDER TWIN

Sequences s1, s2, s3, the zone told, the noise not; frame 0 from rest and given apart, each later frame from the one
before. `hybrid` is the reference from where the surrogate has been. On mesh-remeshed the truth's nodes are carried by
the other mesh's cells. `wrong` rows register with another organ than the truth's: stiffer, softer, Poisson's ratio 0.45
for 0.49, or a linear law. With doubt, margins know of alternatives (`softtwin doubt`): what holds the organ lies
elsewhere by some 4 mm, its ratio is 0.42 to 0.49, it is meshed otherwise, and its modulus may be 30 % off. Covered is
the share of nodes whose error lies within the margin, and of net forces within their region.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column, shares, verdicts
from harness import RANKS, Benchmark, Given, Setting, run, started
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, Sequence, liver, sequence
from numpy.typing import NDArray
from record import RUNS
from scipy.stats import chi2
from summaries import counts, covered, predicted_mm
from threadpoolctl import threadpool_limits

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import Embedding, embed
from softtwin.reference.data.dataset import existing
from softtwin.reference.data.discrepancy import Discrepancy, discrepancy_of, read_discrepancy, write_discrepancy
from softtwin.reference.data.materials import LinearElastic, Material, NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.fem.fenicsx import MPI
from softtwin.reference.generate import Plan, generate
from softtwin.reference.model_error import ModelErrorEnsemble, differences
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.registration.forward import ForwardModel
from softtwin.registration.hybrid import HybridRegistrar
from softtwin.registration.options import expected_force, noise_prior, options_for
from softtwin.registration.registrar import Registrar, prepare
from softtwin.registration.result import Registration
from softtwin.surrogate.discrepancy import beside
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import load as load_twin

Floats = NDArray[np.float64]
SHARES = (0.5, 0.9, 0.95)
LOOSE = NewtonOptions(tolerance=1e-5, max_iterations=15)
DOUBT = ModelErrorEnsemble(attachment=0.004, poisson_ratio=(0.42, 0.49), meshes=3)
DRAWS, LOADS, MODULUS_OFF = 96, 48, 0.3


@dataclass(frozen=True)
class Row:
    """One way of registering.

    Args:
        engine: `reference`, `surrogate` or `hybrid`.
        mesh: `default` or `remeshed`.
        material: of the model; the truth's if not given.
        doubt: whether margins know what the organ may be otherwise.
        noise: metres that the search for it begins with and that it may fall to; the product's if not given.
        frames: of each sequence at most.
    """

    engine: str
    mesh: str = "default"
    material: Material | None = None
    doubt: bool = False
    noise: float | None = None
    frames: int = 50


ROWS = {
    "reference": Row("reference"),
    "reference, told that points are good to 0.01 mm": Row("reference", noise=1e-5, frames=11),
    "surrogate": Row("surrogate"),
    "hybrid": Row("hybrid"),
    "surrogate, doubt": Row("surrogate", doubt=True),
    "hybrid, doubt": Row("hybrid", doubt=True, frames=11),
    "remeshed, reference": Row("reference", "remeshed", frames=26),
    "remeshed, reference, doubt": Row("reference", "remeshed", doubt=True, frames=26),
    **{
        f"wrong: {name}, reference{', doubt' if doubt else ''}": Row(
            "reference", material=material, doubt=doubt, frames=11
        )
        for name, material in {
            "E 30 % too large": NeoHookean(1.3 * YOUNG_MODULUS, POISSON_RATIO),
            "E 30 % too small": NeoHookean(0.7 * YOUNG_MODULUS, POISSON_RATIO),
            "nu 0.45 for 0.49": NeoHookean(YOUNG_MODULUS, 0.45),
            "linear": LinearElastic(YOUNG_MODULUS, POISSON_RATIO),
        }.items()
        for doubt in (False, True)
    },
}


def doubt_of(mesh: str, ranks: int) -> Discrepancy:
    """What the liver may be otherwise, as patterns; what is there is not made again."""
    folder = RUNS / f"liver-doubt-{mesh}"
    file = folder / "doubt.npz"
    if not file.exists():
        started(__file__, "draw", mesh, ranks=ranks)
    return read_discrepancy(file, liver(mesh))[0]


def draw_doubt(mesh: str) -> None:
    """Solve alternatives under loads on the zones of the sequences; on all ranks where mpirun started this."""
    folder, body = RUNS / f"liver-doubt-{mesh}", liver(mesh)
    folder.mkdir(parents=True, exist_ok=True)
    loads = LoadPlan(zones=SEQUENCES, radius=(0.25, 0.8), displacement=0.05)
    samples = {"train": LOADS, "validation": 1, "test": 1}
    newton = NewtonOptions(tolerance=1e-6, max_iterations=30, max_load_steps=6)
    plan = Plan("neo-hookean", YOUNG_MODULUS, POISSON_RATIO, loads, samples, block=8, newton=newton)
    made = existing(folder / "data.zarr") if MPI.COMM_WORLD.rank == 0 else None
    if MPI.COMM_WORLD.bcast(made is None or bool(made.missing_blocks()), root=0):
        generate(folder / "data.zarr", body, plan)
    found = differences(folder / "data.zarr", DOUBT, DRAWS)
    if found is not None:
        patterns, _ = discrepancy_of(found.errors, body, 16)
        write_discrepancy(folder / "doubt.npz", patterns, body, {"failed": found.failed})


@contextmanager
def registrars(row: Row, twin: Path, ranks: int) -> Iterator[dict[str, Registrar | HybridRegistrar]]:
    """What registers each sequence."""
    body, known = liver(row.mesh), doubt_of(row.mesh, ranks) if row.doubt else None
    network: Surrogate | None = None
    if row.engine != "reference":
        network = load_twin(twin, body)
        network = network if known is None else beside(network, known)
    with ExitStack() as opened:
        exact: ReferenceModel | None = None
        if row.engine != "surrogate":
            material = row.material or NeoHookean(YOUNG_MODULUS, POISSON_RATIO)
            problem = opened.enter_context(Problem(body, material, LOOSE))
            exact = ReferenceModel(problem, patient=False, discrepancy=known)

        def alone(model: ForwardModel, zone: NDArray[np.int64]) -> Registrar:
            options = options_for(model, has_zone=True)
            if row.noise is not None:
                options = replace(options, noise=replace(noise_prior(row.noise), minimum=row.noise))
            return prepare(
                model,
                zone,
                body.surfaces["observed"],
                force_scale=expected_force(body, YOUNG_MODULUS),
                options=options,
                modulus_deviation=MODULUS_OFF if row.doubt else 0.0,
            )

        def made(zone: NDArray[np.int64]) -> Registrar | HybridRegistrar:
            if exact is None or network is None:
                only = exact if network is None else network
                assert only is not None
                return alone(only, zone)
            return HybridRegistrar(alone(network, zone), alone(exact, zone))

        yield {name: made(sequence(name, row.mesh).zone) for name in SEQUENCES}


def figures(
    result: Registration, carrier: Embedding | None, data: Sequence, frame: int, rest: Floats
) -> dict[str, Any]:
    """Errors and doubt of one frame at the truth's nodes."""
    moved = result.displacement if carrier is None else carrier.displace(result.displacement)
    errors = np.linalg.norm(rest + moved - data.positions[frame], axis=1)
    known, missed = result.uncertainty, result.net_force - data.net_forces[frame]
    size = float(np.linalg.norm(data.net_forces[frame]))
    found = {
        "sequence": data.name,
        "frame": frame,
        "moved_mm": 1e3 * float(np.linalg.norm(data.positions[frame] - rest, axis=1).mean()),
        "tre_mm": 1e3 * float(errors.mean()),
        "predicted_mm": predicted_mm(known),
        "force_error": float(np.linalg.norm(missed)) / size if size > 0.0 else None,
        "z2": float(missed @ np.linalg.solve(result.net_force_covariance, missed) / 3.0),
        "covered": covered(errors, known, SHARES, carrier),
        "seconds": result.seconds,
        "iterations": len(result.trace),
        "verdict": result.judgement.verdict.value,
        "reasons": list(result.judgement.reasons),
    }
    if result.draft is not None:
        apart = np.linalg.norm(result.draft.displacement - result.displacement, axis=1)
        found["draft_apart_mm"] = {"mean": 1e3 * float(apart.mean()), "largest": 1e3 * float(apart.max())}
    return found


def run_row(row: Row, twin: Path, ranks: int, frames: int) -> list[dict[str, Any]]:
    """All frames of all sequences; a frame without a state is counted as failed."""
    rest, rows = liver().points, []
    with registrars(row, twin, ranks) as each:
        for name, registrar in each.items():
            data, last = sequence(name, row.mesh), None
            carrier = None if row.mesh == "default" else embed(liver(row.mesh), rest)
            for frame, cloud in enumerate(data.clouds[: min(frames, row.frames)]):
                try:
                    result = registrar.follow(cloud, last)
                except NotConverged as error:
                    rows.append({"sequence": name, "frame": frame, "failed": str(error)})
                    continue
                last = result if result.judgement.is_usable else last
                rows.append(figures(result, carrier, data, frame, rest))
                print(name, frame, {key: rows[-1][key] for key in ("tre_mm", "force_error", "seconds", "verdict")},
                      flush=True)  # fmt: skip
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over frames 1 and later that have a result; frame 0, which starts from rest, apart."""
    done = [row for row in rows if "failed" not in row]
    warm, cold = ([row for row in done if (row["frame"] > 0) is later] for later in (True, False))
    squares = np.array([3.0 * row["z2"] for row in done])
    found: dict[str, Any] = {
        "frames": len(rows),
        "failed": len(rows) - len(done),
        "verdicts": counts(row["verdict"] for row in done),
        "tre_mm": {
            name: float(np.mean([row["tre_mm"] for row in warm if row["sequence"] == name])) for name in SEQUENCES
        },
        "mean_tre_mm": float(np.mean([row["tre_mm"] for row in warm])),
        "predicted_mm": float(np.mean([row["predicted_mm"] for row in warm])),
        "worst_tre_mm": max(row["tre_mm"] for row in warm),
        "force_error": float(np.mean([row["force_error"] for row in warm if row["force_error"] is not None])),
        "z_rms": float(np.sqrt(np.mean(squares / 3.0))),
        "covered": {str(share): float(np.mean([row["covered"][str(share)] for row in done])) for share in SHARES},
        "force_covered": {str(share): float(np.mean(squares <= chi2.ppf(share, 3))) for share in SHARES},
        "median_seconds": float(np.median([row["seconds"] for row in warm])),
        "longest_seconds": max(row["seconds"] for row in warm),
        "cold": {
            "tre_mm": float(np.mean([row["tre_mm"] for row in cold])),
            "seconds": [row["seconds"] for row in cold],
        },
    }
    apart = [row["draft_apart_mm"] for row in done if "draft_apart_mm" in row]
    if apart:
        found["draft_apart_mm"] = {name: float(np.mean([each[name] for each in apart])) for name in ("mean", "largest")}
    return found


def pictures(folder: Path, twin: Path, frames: tuple[int, ...] = (5, 20, 40), name: str = "s3") -> None:
    """Nodal forces of three frames of a sequence: the truth's, the reference's, the surrogate's (figure 6.12)."""
    import pyvista

    data, body = sequence(name), liver()
    shown: dict[str, list[tuple[Floats, Floats]]] = {"truth": [], "reference": [], "surrogate": []}
    for frame in frames:
        shown["truth"].append((data.positions[frame], data.nodal_forces(frame)))
    for engine in ("reference", "surrogate"):
        with registrars(ROWS[engine], twin, 1) as each:
            for frame in frames:
                result = each[name].register(data.clouds[frame])
                shown[engine].append((body.points + result.displacement, result.forces))
    plotter = pyvista.Plotter(off_screen=True, shape=(len(frames), len(shown)), window_size=(1500, 420 * len(frames)))
    for column, (engine, states) in enumerate(shown.items()):
        for row, (points, forces) in enumerate(states):
            plotter.subplot(row, column)
            _draw(plotter, body, points, forces)
            plotter.add_text(f"{engine}, frame {frames[row]}", font_size=10, color="black")
    plotter.link_views()
    plotter.camera_position = "xz"
    plotter.reset_camera()
    plotter.set_background("white")
    folder.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(folder / "nodal_forces.png")
    plotter.close()


def _draw(plotter: Any, body: Body, points: Floats, forces: Floats) -> None:
    import pyvista

    faces = np.column_stack([np.full(len(body.boundary), 3), body.boundary]).ravel()
    plotter.add_mesh(pyvista.PolyData(points, faces), color="#c96f53", opacity=0.45, smooth_shading=True)
    sizes = np.linalg.norm(forces, axis=1)
    acting = np.flatnonzero(sizes > 0.05 * sizes.max())
    arrows = pyvista.PolyData(points[acting])
    arrows["force"] = forces[acting] * (0.05 / sizes.max())
    plotter.add_mesh(arrows.glyph(orient="force", scale="force", factor=1.0), color="#1f4e8c")


def work(row: str, given: Given) -> dict[str, Any]:
    rows = run_row(ROWS[row], given.twin, given.ranks, given.frames)
    return {"summary": summary(rows), "rows": rows}


def picture(folder: str, twin: str) -> None:
    """Draw nodal forces into a folder (figure 6.12)."""
    with threadpool_limits(1):
        pictures(Path(folder), Path(twin))


BENCHMARK = Benchmark(
    name="liver_engines",
    title="The real liver by three engines, on another mesh, with a wrong organ (figures 6.11 to 6.14)",
    about=("registration", "surrogate", "reference"),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column("frames: accepted; doubtful; refused", "", lambda f: f"{f['frames']}: {verdicts(f)}"),
        Column("failed", "", "{failed}"),
        Column(
            "TRE: s1; s2; s3 (worst)", "mm", "{tre_mm.s1:.3f}; {tre_mm.s2:.3f}; {tre_mm.s3:.3f} ({worst_tre_mm:.2f})"
        ),
        Column("predicted", "mm", "{predicted_mm:.3f}"),
        Column("force", "%", "{force_error*100:.1f}"),
        Column("nodes covered by 50 / 90 / 95 % margins", "%", lambda f: shares(f["covered"])),
        Column("net force", "%", lambda f: shares(f["force_covered"])),
        Column("median (longest)", "s", "{median_seconds:.3f} ({longest_seconds:.2f})"),
        Column("cold", "s", lambda f: " / ".join(f"{seconds:.2f}" for seconds in f["cold"]["seconds"])),
    ),
    settings={
        "twin": Setting(RUNS / "liver" / "twin", "that registration_surrogate.py makes", picks=True),
        "frames": Setting(50, "of each sequence, at most"),
        "ranks": RANKS,
    },
    small={"frames": 2},
    lines=lambda rows: ((name, found["summary"]) for name, found in rows.items()),
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"draw": draw_doubt, "pictures": picture})
