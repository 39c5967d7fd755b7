"""Networks against the reference: tables 4.1, 4.2 and 4.5 of the thesis, physics in the loss, error against samples.

    python benchmarks/networks.py [--tables 4.2 physics ...] [--ranks 2] [--train 8192] [--seconds 200]
    python benchmarks/networks.py --tables thesis --data FOLDER --device cuda [--epochs 100] [--channels 128]
    python benchmarks/networks.py --tables thesis --name networks_thesis --train 20480 --law isochoric-neo-hookean
                                  --own-alone --only "thesis: mlp, 100 epochs"

The second asks for torch alone, and takes any data set (`networks_bodies.py` makes those of other bodies). The third is
the thesis's own size and law on the processor: an hour and a half of one core.

Makes the data of the beam of 304 hexahedra under benchmarks/runs/ where they are not there (under mpirun; goes on where
it was stopped). Each row is one training, judged on held-out samples of its own and of the other distribution, and is
written as it is finished; the same command goes on with the rows that are missing.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from columns import Column
from harness import RANKS, Benchmark, Given, Setting, run
from made import beam_data
from numpy.typing import NDArray
from record import RUNS

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, Samples, existing
from softtwin.reference.data.jacobians import missing_jacobians
from softtwin.surrogate.architecture import Architecture, Network
from softtwin.surrogate.balance import balance
from softtwin.surrogate.encoder_decoder import LinearEncoderDecoder
from softtwin.surrogate.evaluate import evaluate, jacobian_errors, spread
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.physics import Physics
from softtwin.surrogate.plan import Device, TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train
from softtwin.surrogate.transolver import Transolver
from softtwin.surrogate.umesh import UMesh

if TYPE_CHECKING:
    from softtwin.reference.solve.problem import Problem

Floats = NDArray[np.float64]
JACOBIANS, PIVOTS = 20, 100  # samples whose Jacobian is compared, whose pivots are counted
PROBES, MOST_COLUMNS = 64, 3000  # random loads that stand for the Jacobian's columns where these are more
POD_MODES = 64
# Newtons; the thesis has |u|_2 of 1.71 +- 1.61 m (modal) and 1.01 +- 1.78 m (random), the record says what these give.
AMPLITUDES = {"modal": 0.03, "random": 0.13}
CHANNELS, FEW = 16, 2048  # of U-Mesh, and its samples, on two cores; the thesis has 128 and 20,480
EPOCHS = 100  # of the thesis
LAW, THESIS_LAW = "neo-hookean", "isochoric-neo-hookean"


def data_of(
    kind: str, counts: dict[str, int], ranks: int, seed: int = 0, jacobians: bool = False, law: str = LAW
) -> DataSet:
    """The beam under modal or random loads, with Jacobians in a folder of its own; what is there is not made again."""
    plain = RUNS / f"beam-{kind}-{counts['train']}{f'-seed-{seed}' if seed else ''}{'' if law == LAW else f'-{law}'}"
    folder = plain.with_name(f"{plain.name}-jacobians") if jacobians else plain
    loads = {"kind": kind, "amplitude": AMPLITUDES[kind], "patches": 1, "radius": (0.055, 0.64)}
    samples = {**counts, "block": 16, "ranks": ranks, "seed": seed, "jacobians": jacobians}
    made = existing(folder / "data.zarr")
    if made is not None and not made.missing_blocks() and not (jacobians and missing_jacobians(made)):
        return made
    if jacobians and made is None and (plain / "data.zarr").exists():
        shutil.copytree(plain, folder)
    return beam_data(folder, {"loads": loads, "samples": samples, "material": {"law": law}}, ranks)


@dataclass(frozen=True)
class Row:
    """One training of a table.

    Args:
        table: its name.
        label: what stands in the first column.
        plan: what is trained; None for the baseline without training, a linear map between POD coordinates.
        kind: distribution that it learns from.
        jacobians: whether it learns from whole Jacobians, too.
        samples: that the baseline without training has; None for all.
    """

    table: str
    label: str
    plan: TrainingPlan | None
    kind: str = "modal"
    jacobians: bool = False
    samples: int | None = None

    @property
    def key(self) -> str:
        """Name in the record."""
        return f"{self.table}: {self.label}"


def rows(tables: list[str], train_count: int, seconds: float) -> Iterator[Row]:
    """All rows that are asked for; the dearest last."""
    kinds: dict[str, tuple[Architecture, int]] = {
        "reduced": (Reduced(), 3),
        "mlp": (Perceptron(), 3),
        f"umesh, {CHANNELS} channels": (UMesh(CHANNELS), 1),
        "transolver": (Transolver(), 1),
    }
    if "4.1" in tables:
        for kind in AMPLITUDES:
            yield Row("4.1", f"mlp, {kind} forces", TrainingPlan(Perceptron(), seconds=seconds), kind)
    if "4.2" in tables:
        yield Row("4.2", f"POD of {POD_MODES} modes, linear map", None)
        for name, (architecture, seeds) in kinds.items():
            for seed in range(seeds):
                yield Row("4.2", f"{name}, seed {seed}", TrainingPlan(architecture, seconds=seconds, seed=seed))
        for seed in range(3):
            plan = TrainingPlan(Reduced(), seconds=seconds, seed=seed)
            yield Row("4.2", f"reduced, whole Jacobians, seed {seed}", plan, jacobians=True)
        longer = TrainingPlan(Reduced(), seconds=6.0 * seconds)
        yield Row("4.2", "reduced, whole Jacobians, six times as long", longer, jacobians=True)
        for name in ("reduced", "mlp"):
            yield Row("4.2", f"{name}, {EPOCHS} epochs", TrainingPlan(kinds[name][0], epochs=EPOCHS))
    if "4.5" in tables:
        for numbering in ("short", "long"):
            plan = TrainingPlan(UMesh(CHANNELS, numbering=numbering), epochs=EPOCHS, samples=FEW)
            label = f"umesh, {CHANNELS} channels, {numbering} axis first, {FEW} samples, {EPOCHS} epochs"
            yield Row("4.5", label, plan)
    if "physics" in tables:
        for count in (256, 1024, 4096):
            for label, physics in PHYSICS.items():
                batch = 16 if physics is not None and not physics.data else None  # the cells of more leave the cache
                plan = TrainingPlan(Reduced(), seconds=seconds, samples=count, physics=physics, batch=batch)
                yield Row("physics", f"reduced, {count} samples, {label}", plan)
    if "samples" in tables:
        count = 256
        while count <= train_count:
            for name in ("reduced", "mlp"):
                plan = TrainingPlan(kinds[name][0], seconds=seconds, samples=count)
                yield Row("samples", f"{name}, {count} samples", plan)
            plan = TrainingPlan(Reduced(), seconds=seconds, samples=count)
            yield Row("samples", f"reduced, whole Jacobians, {count} samples", plan, jacobians=True)
            count *= 2


def thesis_rows(architectures: Iterable[Architecture], body: Body, epochs: int, device: Device) -> Iterator[Row]:
    """The thesis's budget, for a GPU: all samples, so many epochs; U-Mesh in mixed precision, too, or not at all."""
    for architecture in architectures:
        name = architecture.name
        try:
            architecture.check(body)
        except ValueError as error:
            print(f"thesis: {name}: left out: {error}")
            continue
        size = f", {architecture.channels} channels" if isinstance(architecture, UMesh) else ""
        plan = TrainingPlan(architecture, epochs=epochs, device=device)
        yield Row("thesis", f"{name}{size}, {epochs} epochs", plan)
        if isinstance(architecture, UMesh):
            yield Row("thesis", f"{name}{size}, {epochs} epochs, mixed", replace(plan, precision="mixed"))


PHYSICS = {
    "data": None,
    "energy alone": Physics(energy=1.0, data=0.0),
    "residual alone": Physics(residual=1.0, data=0.0),
    "data and energy": Physics(energy=1e-4),  # of 0.1, 1e-3 and 1e-4 the one that cost least accuracy
    "data and residual": Physics(residual=1e-6),
}


class _Nothing(Network):
    """No correction: the linear maps around it are the whole surrogate."""

    def forward(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Zeros, (s, 1)."""
        return torch.zeros_like(coordinates[:, :1])


def linear_map(data: DataSet, count: int | None = None) -> Surrogate:
    """The baseline: least squares from forces to the leading POD coordinates of the displacements.

    Directions of force that were hardly loaded are left out: how many, the validation samples decide.
    """
    samples, held = data.samples("train", count), data.samples("validation")
    fields, forces = (array.reshape(len(samples), -1) for array in (samples.displacements, samples.forces))
    truth, loads = (array.reshape(len(held), -1) for array in (held.displacements, held.forces))
    modes = np.linalg.svd(fields, full_matrices=False)[2][:POD_MODES].T
    left, values, right = np.linalg.svd(forces, full_matrices=False)
    coordinates, found = left.T @ (fields @ modes), []
    for least in np.geomspace(1e-4, 0.5, 12):
        kept = values > least * values[0]
        tried = (coordinates[kept].T / values[kept]) @ right[kept]
        found.append((float(np.linalg.norm(loads @ tried.T @ modes.T - truth)), tried))
    to_coordinates = min(found, key=lambda pair: pair[0])[1]
    size, inputs = len(modes), forces.shape[1]
    maps = LinearEncoderDecoder(
        data.response.loaded, np.zeros(size), modes, to_coordinates, np.zeros((1, inputs)), np.zeros((size, 1))
    )
    return Surrogate(data.body, maps, _Nothing(), {"architecture": "linear map"})


def judged(
    surrogate: Surrogate, data: DataSet, problem: Problem | None, with_jacobian: bool = True, pivots: int = PIVOTS
) -> dict[str, Any]:
    """All figures on the held-out samples of one distribution; Jacobians of large bodies by random loads."""
    found = {**evaluate(surrogate, data).as_dict()}
    counted = None if problem is None else problem.negative_pivots
    found["balance"] = balance(surrogate, data, limit=pivots, negative_pivots=counted).as_dict()
    if with_jacobian and problem is not None:
        test = data.samples("test", JACOBIANS)
        few = Samples(*(getattr(test, n) for n in ("draws", "forces", "displacements", "probes", "adjoints")))
        probes = PROBES if 3 * len(data.response.loaded) > MOST_COLUMNS else None
        errors = jacobian_errors(surrogate, data, few, problem.apply_inverse, probes)
        found["jacobian_error"] = {**asdict(spread(errors)), "probes": probes}
    return found


@contextmanager
def reference(data: DataSet) -> Iterator[Problem | None]:
    """The problem that a data set is of; None, and said, where FEniCSx is absent (a machine lent for its GPU)."""
    try:
        from softtwin.reference.generate import plan_from_header
        from softtwin.reference.solve.problem import Problem
    except ModuleNotFoundError as error:
        print(f"without {error.name}: no Jacobians and no pivots are compared")
        yield None
        return
    plan = plan_from_header(data.header)
    with Problem(data.body, plan.build_material(), plan.newton) as problem:
        yield problem


def trained(
    row: Row, data: dict[str, DataSet], problem: Problem | None, learned: DataSet | None = None
) -> dict[str, Any]:
    """Train, on other data than are judged where these are given, and judge one row."""
    began = time.perf_counter()
    own = learned or data[row.kind]
    surrogate = linear_map(own, row.samples) if row.plan is None else train(own, row.plan)
    seconds = time.perf_counter() - began
    figures: dict[str, Any] = {"plan": None if row.plan is None else row.plan.entries(), "learned_from": row.kind}
    figures |= {"training": surrogate.card.get("training"), "samples": surrogate.card.get("samples"), "wall_s": seconds}
    figures["weights"] = sum(weights.numel() for weights in surrogate.network.parameters())
    figures["draws"] = draws_of(row, own)
    for kind, each in data.items():
        figures[kind] = judged(surrogate, each, problem, with_jacobian=kind == row.kind)
    return figures


def draws_of(row: Row, data: DataSet) -> int:
    """How many draws a row learns from, those that were rejected with them."""
    few = row.samples if row.plan is None else row.plan.samples
    every = int(data.header["samples"]["train"])
    return every if few is None else min(few, every)


def sets_of(given: Given) -> dict[str, DataSet]:
    """The data that rows are judged on, by their distribution."""
    held_out = {"validation": 256, "test": 512}
    if given.data:
        return {"modal": DataSet(given.data)}
    how = {"ranks": given.ranks, "seed": given.data_seed, "law": given.law}
    found = {"modal": data_of("modal", {"train": given.train, **held_out}, **how)}
    if not given.own_alone:
        count = given.train if "4.1" in given.tables else 16
        found["random"] = data_of("random", {"train": count, **held_out}, **how)
    return found


def rows_of(given: Given) -> dict[str, Row]:
    """All rows that are asked for, by their names in the record."""
    wanted = list(rows(given.tables, given.train, given.seconds))
    if "thesis" in given.tables:
        kinds = (Reduced(), Perceptron(given.width), UMesh(given.channels), Transolver())
        wanted += thesis_rows(kinds, given.once(sets_of, given)["modal"].body, given.epochs, given.device)
    return {f"{row.key}, data {given.data_seed}" if given.data_seed else row.key: row for row in wanted}


def work(name: str, given: Given) -> dict[str, Any]:
    row, data, learned = given.once(rows_of, given)[name], given.once(sets_of, given), None
    if row.jacobians:
        counts = {"train": given.train, "validation": 256, "test": 512}
        learned = data_of("modal", counts, given.ranks, given.data_seed, True)
    return trained(row, data, given.opened(reference, data["modal"]), learned)


def with_deviation(name: str, factor: str = "", form: str = ".3f") -> str:
    """A cell with mean and standard deviation over samples."""
    return f"{{{name}.mean{factor}:{form}}} +- {{{name}.std{factor}:{form}}}"


def lines(found: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for each row: held-out errors, how sound the predictions are, other loads, steps and time."""
    for key, row in found.items():
        own = row[row["learned_from"]]
        other = [row[kind] for kind in AMPLITUDES if kind in row and row[kind] is not own]
        steps = (row["training"] or {}).get("steps", "-")
        more = {"other": other[0]} if other else {}
        yield key, {**own, **more, "steps": steps, "wall_s": row["wall_s"]}


def least_signal_to_noise(figures: dict[str, Any]) -> str:
    """The smallest SNR of a split, decibels: that of its largest relative error, since older records hold no least."""
    return f"{-20.0 * math.log10(figures['relative_error']['max']):.1f}"


COLUMNS = (
    Column("u_2", "m", with_deviation("displacement_norm")),
    Column("e", "mm", with_deviation("nodal_error", "*1000")),
    Column("largest", "mm", with_deviation("largest_error", "*1000", ".2f")),
    Column("norm / nodes", "um", with_deviation("thesis_error", "*1e6", ".2f")),
    Column("relative (95 %)", "%", "{relative_error.median*100:.3f} ({relative_error.p95*100:.2f})"),
    Column("SNR", "dB", with_deviation("signal_to_noise", form=".1f")),
    Column("least SNR", "dB", least_signal_to_noise),
    Column("cosine", "", "{gradient_cosine.mean:.5f}"),
    Column("Jacobian", "%", "{jacobian_error.mean*100:.1f}"),
    Column("residual", "", "{balance.residual.median:.2g}"),
    Column("inside out; indefinite", "", "{balance.inside_out}; {balance.indefinite} of {balance.samples}"),
    Column("f(0)", "mm", "{balance.at_rest*1000:.3f}"),
    Column("other loads: e; largest", "mm", "{other.nodal_error.mean*1000:.3f}; {other.largest_error.mean*1000:.3f}"),
    Column("steps; s", "", "{steps}; {wall_s:.0f}"),
)
BENCHMARK = Benchmark(
    name="networks",
    title="Networks against the reference: tables 4.1, 4.2, 4.5, physics in the loss, error against samples",
    about=("surrogate", "reference"),
    work=work,
    rows=lambda given: given.once(rows_of, given),
    columns=COLUMNS,
    settings={
        "tables": Setting(("4.2",), choices=("4.1", "4.2", "4.5", "physics", "samples", "thesis"), picks=True),
        "train": Setting(8192, "samples to learn from"),
        "seconds": Setting(200.0, "of training"),
        "data_seed": Setting(0, "other data, that nothing was chosen on"),
        "law": Setting(
            LAW, "of the tissue; the thesis has isochoric-neo-hookean (its eq. 2.27)", choices=(LAW, THESIS_LAW)
        ),
        "own_alone": Setting(False, "leave the other distribution out"),
        "data": Setting(None, "data that are there, where FEniCSx is not; `modal` in the record", Path, picks=True),
        "device": Setting("auto", "of the table thesis", choices=("auto", "cpu", "cuda")),
        "channels": Setting(128, "of U-Mesh in the table thesis"),
        "width": Setting(None, "of the perceptron in the table thesis; the displacement's if not said", int),
        "epochs": Setting(EPOCHS, "of the table thesis"),
        "ranks": RANKS,
    },
    lines=lines,
    also=("networks_physics", "networks_samples", "networks_thesis"),
)


if __name__ == "__main__":
    run(BENCHMARK)
