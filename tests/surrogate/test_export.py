"""Exported graphs: equal to torch to 1e-6, in onnxruntime and from torch.export, and refused where they are others'."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("onnxruntime", reason="onnxruntime is absent")
pytest.importorskip("onnxscript", reason="onnxscript is absent")

from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.architecture import Architecture
from softtwin.surrogate.export import export, leading_directions
from softtwin.surrogate.exported import ExportedTwin, ExportError
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.registry import TRAINED
from softtwin.surrogate.train import train
from softtwin.surrogate.transolver import Transolver
from softtwin.surrogate.twin import load, save
from softtwin.surrogate.umesh import UMesh

KINDS: dict[str, Architecture] = {
    "reduced": Reduced(modes=6, width=24, depth=2),
    "mlp": Perceptron(width=20),
    "umesh": UMesh(channels=4, levels=2),
    "transolver": Transolver(width=8, depth=1, heads=2, slices=4),
}
_DEAR = ("umesh", "transolver")
CLOSE = 1e-6  # of the largest: single precision


def untrained(kind: str, data: DataSet) -> Surrogate:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        samples = data.samples("train")
        objective = KINDS[kind].objective(data, samples, samples)
    return Surrogate(data.body, objective.encoder_decoder(), objective.trained(), {"architecture": kind})


# Each graph takes a quarter of a minute to be traced: two architectures before a release alone.
@pytest.fixture(
    scope="module", params=[pytest.param(kind, marks=[pytest.mark.slow] * (kind in _DEAR)) for kind in KINDS]
)
def pair(request: pytest.FixtureRequest, data: DataSet, tmp_path_factory) -> tuple[Surrogate, Path]:
    surrogate = untrained(request.param, data)
    return surrogate, export(surrogate, tmp_path_factory.mktemp("export") / "graphs", directions=7)


@pytest.fixture
def forces(data: DataSet) -> np.ndarray:
    samples = data.samples("test")
    given = np.zeros((len(samples), *data.body.points.shape))
    given[:, data.response.loaded] = samples.forces
    return given


def test_every_trained_architecture_is_exported_here() -> None:
    assert set(KINDS) == set(TRAINED)


@pytest.mark.slow
def test_displacements_are_those_of_torch_in_batches_of_any_size(
    pair: tuple[Surrogate, Path], forces: np.ndarray
) -> None:
    surrogate, folder = pair
    graphs = ExportedTwin(folder)
    expected = np.stack([surrogate.solve(one).displacement for one in forces])
    size = np.abs(expected).max()
    for count in (1, 5, len(forces)):
        assert np.abs(graphs.solve(forces[:count]) - expected[:count]).max() < CLOSE * size
    assert np.abs(graphs.solve(forces[0]) - expected[0]).max() < CLOSE * size
    program = torch.export.load(folder / "value.pt2").module()
    loads = torch.from_numpy(forces[:, surrogate.encoder_decoder.loaded].reshape(len(forces), -1)).float()
    assert np.abs(program(loads).numpy().reshape(expected.shape) - expected).max() < CLOSE * size


def test_jacobians_are_those_of_torch(pair: tuple[Surrogate, Path], forces: np.ndarray) -> None:
    surrogate, folder = pair
    graphs = ExportedTwin(folder)
    rows = (3 * surrogate.encoder_decoder.loaded[:, None] + np.arange(3)).ravel()
    coefficients = graphs.directions.T @ forces[1].ravel()[rows]
    load, columns = np.zeros(forces[1].size), np.zeros((forces[1].size, graphs.directions.shape[1]))
    load[rows], columns[rows] = graphs.directions @ coefficients, graphs.directions
    state = surrogate.solve(load.reshape(-1, 3))
    expected = state.jvp(columns)
    displacement, jacobian = graphs.linearised(coefficients)
    assert jacobian.shape[1] == 7 and np.abs(expected).max() > 0.0
    assert np.abs(displacement - state.displacement).max() < CLOSE * np.abs(state.displacement).max()
    assert np.abs(jacobian - expected).max() < CLOSE * np.abs(expected).max()
    program = torch.export.load(folder / "linearised.pt2").module()
    again = program(torch.from_numpy(coefficients).float())[1].numpy()
    assert np.abs(again - expected).max() < CLOSE * np.abs(expected).max()


@pytest.fixture(scope="module")
def exported(data: DataSet, tmp_path_factory) -> Path:
    return export(untrained("reduced", data), tmp_path_factory.mktemp("export") / "graphs", directions=3)


@pytest.fixture
def copy(exported: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(exported, tmp_path / "graphs"))


def test_directions_are_those_that_move_the_body_most(data: DataSet) -> None:
    surrogate = untrained("reduced", data)
    found = leading_directions(surrogate, 4)
    np.testing.assert_allclose(found.T @ found, np.eye(4), atol=1e-12)
    other = np.linalg.qr(np.random.default_rng(0).standard_normal(found.shape))[0]
    moved = [np.linalg.norm(surrogate.encoder_decoder.linear(basis)) for basis in (found, other)]
    assert moved[0] > 3.0 * moved[1]
    with pytest.raises(ValueError, match=r"leading_directions\.count: expected at least 1, got 0"):
        leading_directions(surrogate, 0)


@pytest.mark.slow
def test_graphs_of_another_twin_are_refused(copy: Path, data: DataSet, tmp_path: Path) -> None:
    for seed, name in enumerate(("one", "another")):
        plan = TrainingPlan(KINDS["reduced"], epochs=1, seed=seed)
        save(train(data, plan), tmp_path / name)
    graphs = export(load(tmp_path / "one", data.body), tmp_path / "one" / "onnx", directions=3)
    assert ExportedTwin(graphs, tmp_path / "one").nodes == len(data.body.points)
    with pytest.raises(
        ExportError, match=r"ExportedTwin\.twin: .* are of another twin than .*another, or of an earlier"
    ):
        ExportedTwin(graphs, tmp_path / "another")
    with pytest.raises(ExportError, match=r"ExportedTwin\.twin: expected a twin with surrogate\.json"):
        ExportedTwin(graphs, tmp_path)
    other = export(untrained("mlp", data), tmp_path / "other", directions=3)
    shutil.copy(other / "value.onnx", copy / "value.onnx")
    with pytest.raises(ExportError, match=r"value\.onnx is not the file .* of another twin"):
        ExportedTwin(copy)


def test_damaged_exports_are_refused(copy: Path, tmp_path: Path) -> None:
    path = copy / "linearised.onnx"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ExportError, match=r"linearised\.onnx is not the file"):
        ExportedTwin(copy)
    (copy / "export.json").write_text("{")
    with pytest.raises(ExportError, match="cannot be read"):
        ExportedTwin(copy)
    with pytest.raises(ExportError, match="found none"):
        ExportedTwin(tmp_path / "nowhere")


def test_running_graphs_leaves_torch_unloaded(exported: Path, tmp_path: Path) -> None:
    """In a process of its own, which predicts and takes a Jacobian."""
    script = (
        "import sys\n"
        "import numpy as np\n"
        "from softtwin.surrogate.exported import ExportedTwin\n"
        f"twin = ExportedTwin({str(exported)!r})\n"
        "moved = twin.solve(np.zeros((twin.nodes, 3)))\n"
        "jacobian = twin.linearised(np.full(twin.directions.shape[1], 0.01))[1]\n"
        "print(moved.shape == (twin.nodes, 3), np.abs(jacobian).max() > 0.0, 'onnxruntime' in sys.modules)\n"
        "print([name for name in ('torch', 'lightning', 'onnx', 'dolfinx', 'petsc4py') if name in sys.modules])\n"
    )
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert told.returncode == 0, told.stderr
    assert told.stdout.splitlines() == ["True True True", "[]"]


def test_wrong_input_is_named(exported: Path, forces: np.ndarray) -> None:
    graphs = ExportedTwin(exported)
    for wrong, message in (
        (forces[0, 1:], r"expected shape \(45, 3\) or \(s, 45, 3\), got \(44, 3\)"),
        (forces[0] * np.nan, "expected finite numbers"),
        (forces[0].astype(str), r"ExportedTwin\.forces: expected real numbers, got <U\d+"),
        (forces[0].astype(complex), r"ExportedTwin\.forces: expected real numbers, got complex128"),
        ([[0.0] * 3] * 44 + [[0.0] * 2], r"ExportedTwin\.forces: .*rows of different lengths"),
        (forces[0] + 1.0, r"at the \d+ nodes that carried load in training"),
    ):
        with pytest.raises(ValueError, match=message):
            graphs.solve(wrong)
    for coefficients, message in (
        (np.zeros(4), r"expected shape \(3,\), got \(4,\)"),
        (np.full(3, np.inf), "expected finite numbers"),
        (["1", "2", "3"], "expected real numbers, got <U1"),
        (np.ones(3, dtype=complex), "expected real numbers, got complex128"),
    ):
        with pytest.raises(ValueError, match=rf"ExportedTwin\.coefficients: {message}"):
            graphs.linearised(coefficients)


def test_a_folder_of_something_else_stays(data: DataSet, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(ValueError, match=r"export\.folder: expected none, or one that was exported before"):
        export(untrained("reduced", data), tmp_path)
    assert (tmp_path / "mine.txt").exists()
