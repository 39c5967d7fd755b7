"""Networks on larger bodies: the thesis's liver on a sparse grid (4.3, 4.5), its beam and propeller (5.1, 5.2).

    python benchmarks/networks_bodies.py [--bodies liver propeller beam] [--ranks 2] [--seconds 300] [--only reduced]
                                         [--samples 1024]

Makes the data under benchmarks/runs/ where they are not there (under mpirun; goes on where it was stopped). Each row is
one training, judged on 100 held-out samples.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from harness import RANKS, Benchmark, Given, Setting, run, started
from networks import AMPLITUDES, COLUMNS, Row, lines, trained
from numpy.typing import NDArray
from record import LIVER, RUNS

from softtwin.meshes.body import Body
from softtwin.meshes.grid import gridded
from softtwin.meshes.io import read_volume
from softtwin.meshes.shapes import beam, propeller
from softtwin.reference.data.dataset import DataSet, existing
from softtwin.reference.data.jacobians import missing_jacobians
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.differentiate import differentiate
from softtwin.reference.fem.fenicsx import MPI
from softtwin.reference.generate import Plan, generate
from softtwin.reference.ranks import on_first
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.surrogate.architecture import Architecture
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.pod import learned_basis
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.transolver import Transolver
from softtwin.surrogate.umesh import UMesh

HELD_OUT = {"validation": 100, "test": 100}
WIDTH = 1500  # of the perceptron's hidden layers in chapter 5


@dataclass(frozen=True)
class Case:
    """A body of the thesis with its material and loads.

    Args:
        table: of the thesis.
        body: makes it.
        plan: how its equilibria are made.
        channels: of U-Mesh on two cores, which the thesis has 128 of; 0 where the body is on no regular grid.
        modes: of the larger of the reduced networks, which learns from whole Jacobians.
    """

    table: str
    body: Callable[[], Body]
    plan: Plan
    channels: int
    modes: int


def tetrahedral_liver() -> Body:
    """The real liver as it comes, 10,703 linear tetrahedra, held where the sequences hold it."""
    folder = LIVER / "mesh-default"
    return Body(*read_volume(folder / "liver.msh"), {"fixed": np.load(folder / "dirichlet-vertices.npy")})


def liver() -> Body:
    """The same on the thesis's grid of 25 x 22 x 21 nodes."""
    return gridded(tetrahedral_liver(), cells_per_axis=(24, 21, 20))


def case(name: str) -> Case:
    """By name; displacements are chosen to the thesis's: |u|_2 of 0.657 +- 0.352 m (liver), 40 m (beam), 1 cm.

    The soft beam has draws that no equilibrium balances (1 in 30): looking for one in a hundred load steps would take
    37 s where a solve takes 0.3 s, and load steps have saved none of the draws that the whole load has failed with.
    """
    if name == "liver":
        loads = LoadPlan(patches=5, displacement=0.055)
        return Case("4.3", liver, Plan("neo-hookean", 5000.0, 0.45, loads, {"train": 2048, **HELD_OUT}), 8, 192)
    if name == "liver-tetrahedra":  # for certificates.py
        loads = LoadPlan(patches=5, displacement=0.055)
        samples = {"train": 1024, "validation": 128, "test": 1000, "calibration": 1000}
        plan = Plan("neo-hookean", 5000.0, 0.45, loads, samples)
        return Case("certificates", tetrahedral_liver, plan, 0, 192)
    if name == "beam":
        loads, samples = LoadPlan(displacement=40.0), {"train": 4095, **HELD_OUT}
        plan = Plan("saint-venant-kirchhoff", 4500.0, 0.3, loads, samples, newton=NewtonOptions(max_load_steps=1))
        return Case("5.1", lambda: beam((39, 9, 9), (100.0, 25.0, 25.0)), plan, 8, 64)
    if name == "beam-few":  # the first draws of "beam", from which a network learns as well: for hybrid_newton.py
        few = case("beam")
        return replace(few, plan=replace(few.plan, samples={"train": 1024, **HELD_OUT}))
    if name == "beam-small":  # moved as far as table 5.2's errors and decibels together say, |u|_2 of 2.7 m
        loads, samples = LoadPlan(displacement=0.2), {"train": 512, **HELD_OUT}
        plan = Plan("saint-venant-kirchhoff", 4500.0, 0.3, loads, samples)
        return Case("5.1", lambda: beam((39, 9, 9), (100.0, 25.0, 25.0)), plan, 8, 64)
    if name == "modal":  # the loads of table 4.2, other draws than networks.py learns from: for certificates.py
        loads = LoadPlan(amplitude=AMPLITUDES["modal"], radius=(0.055, 0.64))
        samples = {"train": 1, "validation": 1000, "test": 10000, "calibration": 10000}
        return Case("certificates", beam, Plan("neo-hookean", 5000.0, 0.45, loads, samples, seed=9), 0, 64)
    if name == "beam-6.1":  # for beam_registration.py
        loads = LoadPlan(amplitude=AMPLITUDES["modal"], radius=(0.055, 0.64))
        samples = {"train": 8192, "validation": 256, "test": 512}
        return Case("6.1", beam, Plan("neo-hookean", 4500.0, 0.49, loads, samples, seed=6), 0, 64)
    if name == "ranges":  # the small beam under loads of all sizes, for certificates.py
        loads = LoadPlan(displacement=0.4, radius=(0.055, 0.64))
        samples = {"train": 4096, "validation": 256, "test": 10000, "calibration": 10000}
        return Case("certificates", beam, Plan("neo-hookean", 5000.0, 0.45, loads, samples), 0, 64)
    loads, samples = LoadPlan(displacement=0.02), {"train": 4095, **HELD_OUT}
    plan = Plan("neo-hookean", 2.03e11, 0.4, loads, samples)
    return Case("5.1", lambda: propeller(PROPELLER_CELL), plan, 0, 192)


PROPELLER_CELL = 0.016  # metres: 12,069 unknowns, where the thesis has 12,075


def folder_of(name: str, jacobians: bool) -> Path:
    """Where the equilibria of a case are, those with Jacobians in a copy of their own."""
    return RUNS / f"bodies-{name}{'-jacobians' if jacobians else ''}"


def data_of(name: str, ranks: int, jacobians: bool = False) -> DataSet:
    """The equilibria of a case; what is there is not made again."""
    path = folder_of(name, jacobians) / "data.zarr"
    made = existing(path)
    if made is None or made.missing_blocks() or (jacobians and missing_jacobians(made)):
        if jacobians and made is None:
            shutil.copytree(data_of(name, ranks).path, path)
        started(__file__, "differentiate" if jacobians else "generate", name, ranks=ranks)
    return DataSet(path)


def make(name: str) -> None:
    """Solve the equilibria; on all ranks where mpirun started this."""
    path = folder_of(name, False) / "data.zarr"
    path.parent.mkdir(parents=True, exist_ok=True)
    generate(path, case(name).body(), case(name).plan)


def differentiate_all(name: str) -> None:
    """Make the Jacobians; on all ranks where mpirun started this."""
    path = folder_of(name, True) / "data.zarr"

    def modes() -> NDArray[np.float64]:
        data = DataSet(path)
        return learned_basis(data, data.samples("train"), case(name).modes, True).modes

    differentiate(path, on_first(MPI.COMM_WORLD, modes))


def rows(name: str, seconds: float, samples: int | None) -> Iterator[Row]:
    """All networks on one body."""

    def plan(architecture: Architecture) -> TrainingPlan:
        return TrainingPlan(architecture, seconds=seconds, samples=samples)

    few = "" if samples is None else f", {samples} samples"
    chosen = case(name)
    kinds = {"reduced": Reduced(), f"mlp, width {WIDTH}": Perceptron(WIDTH), "transolver": Transolver()}
    if chosen.channels:
        kinds[f"umesh, {chosen.channels} channels"] = UMesh(chosen.channels)
    yield Row(chosen.table, f"{name}, POD, linear map{few}", None, name, samples=samples)
    for label, architecture in kinds.items():
        yield Row(chosen.table, f"{name}, {label}{few}", plan(architecture), name)
    if chosen.channels:
        numbered = plan(UMesh(chosen.channels, numbering="long"))
        yield Row("4.5", f"{name}, umesh, {chosen.channels} channels, long axis first{few}", numbered, name)
    larger = plan(Reduced(modes=chosen.modes))
    if larger.architecture != Reduced():
        yield Row(chosen.table, f"{name}, reduced, {chosen.modes} modes{few}", larger, name)
    yield Row(chosen.table, f"{name}, reduced, {chosen.modes} modes, whole Jacobians{few}", larger, name, True)


def rows_of(given: Given) -> dict[str, Row]:
    """All rows that are asked for, by their names in the record; their kind is their body."""
    return {row.key: row for name in given.bodies for row in rows(name, given.seconds, given.samples)}


@contextmanager
def problem_of(name: str, data: DataSet) -> Iterator[Problem]:
    """The problem that a body's equilibria are of."""
    with Problem(data.body, data.material, case(name).plan.newton) as problem:
        yield problem


def work(name: str, given: Given) -> dict[str, Any]:
    row = given.once(rows_of, given)[name]
    data = given.once(data_of, row.kind, given.ranks)
    learned = data_of(row.kind, given.ranks, True) if row.jacobians else None
    return trained(row, {row.kind: data}, given.opened(problem_of, row.kind, data), learned)


BENCHMARK = Benchmark(
    name="networks_bodies",
    title="Networks on larger bodies: the liver on a sparse grid (4.3, 4.5), beam and propeller (5.1, 5.2)",
    about=("surrogate", "reference"),
    work=work,
    rows=lambda given: given.once(rows_of, given),
    columns=COLUMNS,
    settings={
        "bodies": Setting(("liver", "propeller", "beam"), picks=True),
        "seconds": Setting(300.0, "of training"),
        "samples": Setting(None, "learn from the first so many alone", int),
        "ranks": RANKS,
    },
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"generate": make, "differentiate": differentiate_all})
