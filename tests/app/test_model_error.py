"""The model-error ensemble: drawn once for a twin, known to the margins of every engine."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.config import ConfigError
from softtwin.app.stages.model_error import is_current, model_error_stage
from softtwin.app.twin import FORMER_MODEL_ERROR, MODEL_ERROR, Twin, find_twin, forward_models
from softtwin.app.workspace import open_workspace
from softtwin.meshes.io import read_body
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.discrepancy import DiscrepancyError, read_discrepancy
from softtwin.surrogate.twin import load

from .conftest import run

CLOUD = "cloud.npy"


@pytest.fixture
def quickstart(small_quickstart: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_quickstart, tmp_path / "out"))


def changed(folder: Path, *replacements: tuple[str, str]) -> Path:
    """The configuration with other words in it."""
    file = folder / "organ.toml"
    words = file.read_text()
    for old, new in replacements:
        assert words.count(old) == 1, old
        words = words.replace(old, new)
    file.write_text(words)
    return file


def test_the_chain_has_drawn_them(quickstart: Path) -> None:
    space = open_workspace(quickstart / "organ.toml")
    found, made_of = read_discrepancy(space.twin / MODEL_ERROR, read_body(space.body))
    assert made_of == {
        "attachment": 0.004, "poisson_ratio": None, "meshes": 0, "draws": 96, "failed": made_of["failed"],
        "material": "neo-hookean",
    }  # fmt: skip
    assert made_of["failed"] < 48 and found.modes.shape[1] > 3 and (found.modes**2).sum() > 0.0
    assert is_current(space, DataSet(space.data))
    changed(quickstart, ("attachment = 0.004", "attachment = 0.005"))
    assert not is_current(open_workspace(quickstart / "organ.toml"), DataSet(space.data))


@pytest.mark.parametrize("model", ["reference", "hybrid"])
def test_margins_know_of_them(quickstart: Path, model: str) -> None:
    cloud = np.load(quickstart / "demo" / CLOUD)
    deviations = []
    for known in (True, False):
        with Twin.open(quickstart, model) as twin:
            assert bool(twin.model_error) is known
            deviations.append(twin.register(cloud, "").uncertainty.deviation.mean())
        (quickstart / "twin" / MODEL_ERROR).unlink(missing_ok=True)
    assert deviations[0] > 1.05 * deviations[1]


def test_a_surrogate_has_them_beside_its_own(quickstart: Path) -> None:
    """The small quickstart's network is so far off that its margins hardly show them."""
    body = read_body(quickstart / "body.vtu")
    further = read_discrepancy(quickstart / "twin" / MODEL_ERROR, body)[0]
    own = load(quickstart / "twin", body).discrepancy
    with forward_models("surrogate", quickstart / "twin", body, find_twin(quickstart).config) as (model, _):
        both = model.discrepancy
    assert own is not None and both is not None
    np.testing.assert_array_equal(both.modes, np.hstack([own.modes, further.modes]))
    np.testing.assert_allclose(both.rest, np.hypot(own.rest, further.rest))


@pytest.mark.mpi
def test_ranks_draw_the_same(quickstart: Path, mpi_environment: dict[str, str]) -> None:
    file, body = quickstart / "organ.toml", read_body(quickstart / "body.vtu")
    before, _ = read_discrepancy(quickstart / "twin" / MODEL_ERROR, body)
    command = ["mpirun", "-n", "2", sys.executable, "-m", "softtwin.app.cli", "model-error", str(file)]
    done = subprocess.run(command, env=mpi_environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("perturbed models: a node lies") == 1
    after, _ = read_discrepancy(quickstart / "twin" / MODEL_ERROR, body)
    scale = np.abs(before.modes).max()
    np.testing.assert_allclose(after.modes @ after.modes.T, before.modes @ before.modes.T, atol=1e-6 * scale**2)


def test_poissons_ratio_may_be_another(quickstart: Path) -> None:
    file = changed(quickstart, ("attachment = 0.004", "attachment = 0"), ("draws = 96", "draws = 8"),
                   ("poisson_ratio = []", "poisson_ratio = [0.3, 0.4]"))  # fmt: skip
    assert "8 perturbed models" in str(model_error_stage(file))
    with Twin.open(quickstart) as twin:
        assert twin.model_error["poisson_ratio"] == [0.3, 0.4] and twin.model_error["attachment"] == 0.0


def test_the_record_says_so(quickstart: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(capsys, "register", quickstart, quickstart / "demo" / CLOUD, "--output", quickstart / "mine")
    assert json.loads((quickstart / "mine" / "registration.json").read_text())["model_error"]["attachment"] == 0.004


def test_the_file_of_before_is_read(quickstart: Path) -> None:
    """As a twin has it that was made when the ensemble's file and stage were called doubt."""
    (quickstart / "twin" / MODEL_ERROR).rename(quickstart / "twin" / FORMER_MODEL_ERROR)
    records = quickstart / "stages.json"
    records.write_text(records.read_text().replace('"model_error', '"doubt'))
    assert '"doubt"' in records.read_text() and '"doubt.draws"' in records.read_text()
    space = open_workspace(quickstart / "organ.toml")
    assert is_current(space, DataSet(space.data))
    with Twin.open(quickstart) as twin:
        assert twin.model_error["attachment"] == 0.004


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("draws = 96", "draws = 0", "model_error.draws: expected at least 1"),
        ("attachment = 0.004", "attachment = 0", "something that may be otherwise"),
        ("poisson_ratio = []", "poisson_ratio = [0.4, 0.6]", "expected 0 <= least <= largest < 0.5"),
        ("draws = 96", "draws = 4", "expected at least 8 perturbed models, got"),
    ],
)
def test_what_cannot_be_asked_is_refused(
    quickstart: Path, old: str, new: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert words in run(capsys, "model-error", changed(quickstart, (old, new)), code=2)


def test_files_of_other_twins_are_refused(quickstart: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = quickstart / "twin" / MODEL_ERROR
    home = find_twin(quickstart)
    material = home.config.material.model_copy(update={"law": "linear-elastic"})
    other = type(home)(home.folder, home.body, home.config.model_copy(update={"material": material}))
    with pytest.raises(ConfigError, match="made for the material 'neo-hookean'"):
        other.twin("reference")
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(DiscrepancyError, match=r"model_error\.npz cannot be read"):
        home.twin("surrogate")
    assert "cannot be read" in run(capsys, "register", quickstart, quickstart / "demo" / CLOUD, code=2)
