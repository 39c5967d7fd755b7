"""Reduced Jacobians: derivatives of the equilibria, the same for any number of ranks, found and mended when damaged."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.reference.data.jacobians import mark, missing_jacobians, read_jacobians, stored_modes
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.writing import drop_block
from softtwin.reference.differentiate import differentiate
from softtwin.reference.generate import Plan, generate
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.pod import learned_basis

PLAN = Plan(
    loads=LoadPlan(modes=4, displacement=0.08, kind="modal"),
    samples={"train": 7, "validation": 1, "test": 1},
    block=2,
    seed=3,
)
PROGRAM = """
import sys, numpy as np
from mpi4py import MPI
from softtwin.reference.differentiate import differentiate
first = MPI.COMM_WORLD.rank == 0
differentiate(sys.argv[1] if first else None, np.load(sys.argv[2]) if first else None)
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> DataSet:
    made = generate(tmp_path_factory.mktemp("data") / "data.zarr", beam((4, 2, 2), (0.5, 0.2, 0.2)), PLAN)
    assert made is not None
    return made


@pytest.fixture(scope="module")
def modes(data: DataSet) -> np.ndarray:
    return learned_basis(data, data.samples("train"), 3, False).modes


@pytest.fixture(scope="module")
def done(data: DataSet, modes: np.ndarray, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("done") / "data.zarr"
    shutil.copytree(data.path, path)
    differentiate(path, modes)
    return path


@pytest.fixture
def copy(done: Path, tmp_path: Path) -> Path:
    shutil.copytree(done, tmp_path / "data.zarr")
    return tmp_path / "data.zarr"


def test_they_are_the_derivatives_of_the_equilibria(done: Path, modes: np.ndarray) -> None:
    data = DataSet(done)
    samples = data.samples("train")
    found = read_jacobians(data, samples.draws)
    assert found is not None and found.values.shape == (len(samples), 3, 3)
    loaded, body, steps = data.response.loaded, data.body, 2.0 ** -np.arange(2, 6)
    rows = (3 * loaded[:, None] + np.arange(3)).ravel()
    forces, change, along = np.zeros_like(body.points), np.zeros(body.points.size), np.array([0.3, -1.0, 0.5])
    forces[loaded] = samples.forces[0]
    change[rows] = modes[rows] @ along
    change = change.reshape(-1, 3) * np.linalg.norm(forces) / np.linalg.norm(change)
    size = np.linalg.norm(change) / np.linalg.norm(modes[rows] @ along)
    with Problem(body, data.material, replace(PLAN.newton, tolerance=1e-12)) as problem:
        ends = [[problem.solve(forces + sign * h * change).displacement for sign in (1, -1)] for h in steps]
        slopes = [modes.T @ (up - down).ravel() / (2 * h * size) for h, (up, down) in zip(steps, ends, strict=True)]
        columns = problem.apply_inverse(modes, samples.displacements[0])[rows]
    errors = np.linalg.norm(slopes - found.values[0].T @ along, axis=1)
    assert np.log2(errors[:-1] / errors[1:]).min() > 1.8
    assert found.squares[0] == pytest.approx(np.square(columns).sum())


@pytest.mark.mpi
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="mpirun is absent")
def test_two_ranks_make_the_same(data: DataSet, modes: np.ndarray, done: Path, tmp_path: Path, mpi_environment) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(data.path, path)
    np.save(tmp_path / "modes.npy", modes)
    command = ["mpirun", "-n", "2", sys.executable, "-c", PROGRAM, str(path), str(tmp_path / "modes.npy")]
    subprocess.run(command, env=mpi_environment, check=True, timeout=300)
    assert mark(DataSet(path)) == mark(DataSet(done)) != ""


def test_what_is_missing_or_damaged_is_made_again(copy: Path, modes: np.ndarray) -> None:
    before, draws = mark(DataSet(copy)), DataSet(copy).samples("train").draws
    (chunk,) = (copy / "jacobians" / "values" / "c" / "1").glob("0/0")
    chunk.write_bytes(chunk.read_bytes()[:-7])
    (copy / "jacobians" / "checksum" / "c" / "2").unlink()
    assert missing_jacobians(DataSet(copy)) == [1, 2]
    with pytest.raises(DataSetError, match=r"block 1 .*run `softtwin generate` again with samples\.jacobians = true"):
        read_jacobians(DataSet(copy), draws)
    first = read_jacobians(DataSet(copy), draws[:1])
    assert first is not None and len(first.values) == 1
    differentiate(copy, modes)
    assert mark(DataSet(copy)) == before and missing_jacobians(DataSet(copy)) == []


def test_other_modes_take_their_place(copy: Path, modes: np.ndarray) -> None:
    before = mark(DataSet(copy))
    differentiate(copy, modes[:, :2])
    assert stored_modes(DataSet(copy)).shape[1] == 2 and mark(DataSet(copy)) != before
    assert missing_jacobians(DataSet(copy)) == []


def test_without_them_there_are_none(data: DataSet) -> None:
    assert read_jacobians(data, data.samples("train").draws) is None
    assert mark(data) == "" and stored_modes(data) is None
    assert len(missing_jacobians(data)) == 4


def test_an_unfinished_set_and_modes_of_another_body_are_refused(copy: Path, modes: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"differentiate\.modes: expected shape \(135, r\), got \(132, 3\)"):
        differentiate(copy, modes[:-3])
    drop_block(copy, 1)
    with pytest.raises(DataSetError, match=r"block 1 .* was never finished"):
        differentiate(copy, modes)


def test_equilibria_made_again_have_no_jacobians(copy: Path) -> None:
    made = generate(copy, DataSet(copy).body, PLAN, again=True)
    assert made is not None and stored_modes(made) is None
