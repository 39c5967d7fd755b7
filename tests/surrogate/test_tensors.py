"""A data set as one tensors file: what is read is what was written, without Zarr, VTK and the readers of files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from kept_out import refusing

from softtwin.app.cli import softtwin
from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.reference.data.tensors import export_tensors
from softtwin.reference.data.writing import drop_block
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

SPLITS = ("train", "validation", "test")
FIELDS = ("draws", "forces", "displacements", "probes", "adjoints")
KEPT_OUT = ("vtkmodules", "zarr", "meshio", "pydantic", "pyvista", "dolfinx", "petsc4py")


def exported(data: DataSet, folder: Path, precision: str = "double") -> DataSet:
    return DataSet(export_tensors(data, folder / "set.safetensors", precision))  # type: ignore[arg-type]


def test_in_double_precision_nothing_changes(data: DataSet, tmp_path: Path) -> None:
    """Samples, rejected draws, figures, body, response and material are the same bytes."""
    found = exported(data, tmp_path)
    for split in SPLITS:
        ours, theirs = found.samples(split), data.samples(split)
        assert all(np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in FIELDS)
        told, wanted = found.figures(split), data.figures(split)
        assert all(np.array_equal(told[name], wanted[name]) for name in wanted)
    assert found.body.fingerprint == data.body.fingerprint
    assert np.array_equal(found.response.left, data.response.left)
    assert found.rejected().reasons == data.rejected().reasons


def test_single_precision_rounds_once(data: DataSet, tmp_path: Path) -> None:
    found, truth = exported(data, tmp_path, "single").samples("test"), data.samples("test")
    largest = np.abs(truth.displacements).max()
    error = np.abs(found.displacements - truth.displacements).max()
    assert 0.0 < error <= np.finfo(np.float32).eps * largest
    assert found.displacements.dtype == np.float64


def test_training_on_the_file_is_training_on_the_set(data: DataSet, tmp_path: Path) -> None:
    """The same weights to the last bit, and the same held-out errors."""
    plan = TrainingPlan(Reduced(width=8, modes=6, depth=1), epochs=4)
    one, other = train(data, plan), train(exported(data, tmp_path), plan)
    pairs = zip(one.network.state_dict().values(), other.network.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert evaluate(one, data).nodal_error == evaluate(other, exported(data, tmp_path)).nodal_error


def test_a_machine_without_zarr_and_vtk_trains_and_predicts(data: DataSet, tmp_path: Path) -> None:
    """In a process that refuses to import them; the contract of the path that runs on a GPU machine."""
    path = export_tensors(data, tmp_path / "set.safetensors")
    program = f"""{refusing(KEPT_OUT)}
import numpy as np
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.fast import FastSurrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

data = DataSet({str(path)!r})
surrogate = train(data, TrainingPlan(Reduced(width=8, modes=6, depth=1), epochs=2))
fast = FastSurrogate(surrogate, "cpu", directions=4)
assert fast.solve(np.zeros_like(data.body.points)).shape == data.body.points.shape
print(evaluate(surrogate, data).samples)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) == len(data.samples("test"))


def test_a_changed_byte_is_found(data: DataSet, tmp_path: Path) -> None:
    found = exported(data, tmp_path)
    content = bytearray(found.path.read_bytes())
    content[-100] ^= 1  # of the last array that safetensors wrote: samples or response
    found.path.write_bytes(content)
    with pytest.raises(DataSetError, match="checksum"):
        changed = DataSet(found.path)
        _ = changed.body, changed.response, changed.shapes, changed.eigenvalues
        for split in SPLITS:
            changed.samples(split)


def test_a_file_cut_short_is_refused(data: DataSet, tmp_path: Path) -> None:
    found = exported(data, tmp_path)
    found.path.write_bytes(found.path.read_bytes()[:-8])
    with pytest.raises(DataSetError, match="truncated"):
        DataSet(found.path)


def test_a_safetensors_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    save_file({"weights": np.zeros(3)}, tmp_path / "net.safetensors")
    with pytest.raises(DataSetError, match="softtwin tensors"):
        DataSet(tmp_path / "net.safetensors")


def test_a_set_that_is_not_complete_is_not_exported(data: DataSet, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(data.path, tmp_path / "copy.zarr")
    drop_block(tmp_path / "copy.zarr", 0)
    with pytest.raises(DataSetError, match="never finished"):
        export_tensors(DataSet(tmp_path / "copy.zarr"), tmp_path / "set.safetensors")
    assert not (tmp_path / "set.safetensors").exists()


def test_the_command_writes_it(data: DataSet, tmp_path: Path) -> None:
    target = tmp_path / "set.safetensors"
    told = CliRunner().invoke(softtwin, ["tensors", str(data.path), str(target), "--precision", "double"])
    assert told.exit_code == 0, told.output
    assert len(DataSet(target).samples("train")) == len(data.samples("train"))


def test_another_ending_is_refused(data: DataSet, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.safetensors"):
        export_tensors(data, tmp_path / "set.npz")


def test_jacobians_that_are_not_all_there_are_not_left_out_in_silence(data: DataSet, tmp_path: Path) -> None:
    import shutil

    from softtwin.reference.data.jacobians import prepare_jacobians

    shutil.copytree(data.path, tmp_path / "copy.zarr")
    copied = DataSet(tmp_path / "copy.zarr")
    prepare_jacobians(copied, np.eye(data.body.points.size)[:, :4])
    with pytest.raises(DataSetError, match=r"Jacobians of all training samples .* got none in \d+ blocks"):
        export_tensors(copied, tmp_path / "set.safetensors")
    assert len(DataSet(export_tensors(copied, tmp_path / "set.safetensors", jacobians=False)).samples("train"))


def test_a_tensors_file_is_not_exported_again(data: DataSet, tmp_path: Path) -> None:
    with pytest.raises(DataSetError, match="got the tensors file"):
        export_tensors(exported(data, tmp_path), tmp_path / "again.safetensors")
