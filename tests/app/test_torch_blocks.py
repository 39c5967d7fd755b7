"""A data set that torch has solved is the one that the reference solves: the same draws, states, reasons, adjoints."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
torch = pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.config import Config, ConfigError, to_toml
from softtwin.app.stages.generate import generate_stage
from softtwin.app.torch_blocks import TorchBlocks, agreement
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import SPLITS, DataSet
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.schema import Reason
from softtwin.reference.data.writing import drop_block
from softtwin.reference.generate import Plan, generate
from softtwin.reference.solve.problem import NewtonOptions

from .conftest import run
from .test_stages import ENTRIES, bar, write_files

pytestmark = pytest.mark.fenicsx
PLAN = Plan(
    loads=LoadPlan(modes=4, displacement=0.15),
    samples={"train": 9, "validation": 2, "test": 4, "calibration": 2, "smooth": 3},
    block=4,
    ramp=2,
    newton=NewtonOptions(tolerance=1e-9),
)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[DataSet, DataSet, TorchBlocks]:
    """By the reference, and by torch."""
    folder, body, task = tmp_path_factory.mktemp("both"), beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron"), TorchBlocks()
    made = [
        generate(folder / f"{name}.zarr", body, PLAN, task=each) for name, each in (("ours", None), ("torch", task))
    ]
    assert made[0] is not None and made[1] is not None
    return made[0], made[1], task


def test_draws_states_and_adjoints_are_the_references(both: tuple[DataSet, DataSet, TorchBlocks]) -> None:
    ours, theirs, _ = both
    assert theirs.missing_blocks() == [] and theirs.damaged_blocks() == {}
    assert ours.header == theirs.header
    for split in SPLITS:
        draws = ours.split_draws(split)
        if not len(draws):
            continue
        one, other = ours.rows(draws), theirs.rows(draws)
        for name in ("forces", "probes", "reason", "negative_pivots"):
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)
        for name, part in (("displacements", 1e-7), ("adjoints", 1e-6), ("energy", 1e-7)):
            np.testing.assert_allclose(
                other[name], one[name], rtol=0.0, atol=part * np.abs(one[name]).max(), err_msg=name
            )
        load = np.linalg.norm(other["forces"], axis=(1, 2))
        assert (other["residual"] <= 1.01e-9 * load).all() and (other["iterations"] > 0).all()


def test_draws_without_an_equilibrium_are_kept_apart_alike(tmp_path: Path) -> None:
    """Loads of thirty times the size: what either does not find, or finds unstable or too far, is not learned from."""
    plan = Plan(
        loads=LoadPlan(modes=4, amplitude=3.0),
        samples={"train": 8, "validation": 1, "test": 1},
        newton=NewtonOptions(max_iterations=6, max_load_steps=1),
        block=2,
    )
    made = generate(tmp_path / "data.zarr", beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron"), plan, task=TorchBlocks())
    assert made is not None
    rejected = made.rejected()
    kinds = {reason.words for reason in Reason if reason is not Reason.ACCEPTED}
    assert len(rejected.draws) > 0 and set(rejected.reasons) <= kinds
    assert np.isfinite(made.rows(range(8))["displacements"]).all()


def test_agreement_is_measured_and_tells_what_disagrees(both: tuple[DataSet, DataSet, TorchBlocks]) -> None:
    _, theirs, task = both
    assert sorted(task.draws) == [
        draw for split in SPLITS for draw in (theirs.samples(split).draws.tolist() if theirs.split_draws(split) else [])
    ]
    found = agreement(theirs, task.draws, 0.3)
    assert len(found["draws"]) == int(np.ceil(0.3 * len(task.draws))) == len(found["differences"])
    assert max(found["differences"]) < 1e-7 and found["not_found"] == []
    assert agreement(theirs, task.draws, 0.3)["draws"] == found["draws"]  # by the seed

    class Other:
        """The same set, its states moved by a thousandth."""

        path, header, body, response = theirs.path, theirs.header, theirs.body, theirs.response

        @staticmethod
        def rows(draws: range) -> dict[str, np.ndarray]:
            rows = dict(theirs.rows(draws))
            return rows | {"displacements": rows["displacements"] * 1.001}

    assert min(agreement(Other, task.draws, 0.3)["differences"]) > 1e-4


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_files(tmp_path, bar())
    (tmp_path / "organ.toml").write_text(to_toml(Config.model_validate(ENTRIES)))
    return tmp_path


def test_the_command_solves_goes_on_and_says_how_well_it_agrees(capsys, folder: Path) -> None:
    run(capsys, "mesh", folder / "organ.toml")
    said = run(capsys, "generate", folder / "organ.toml", "--engine", "torch")
    assert "10 by torch (cpu); 1 solved again by the reference: at most" in said and "10 equilibria accepted" in said
    data = DataSet(folder / "data.zarr")
    (entry,) = data.engines
    assert entry["torch"] == torch.__version__ and entry["accepted"] == 10
    assert max(entry["agreement"]["differences"]) < 1e-5
    before = data.identity
    drop_block(data.path, 1)
    run(capsys, "generate", folder / "organ.toml", "--engine", "torch")
    again = DataSet(folder / "data.zarr")
    assert again.missing_blocks() == [] and [each["accepted"] for each in again.engines] == [10, 2]
    drop_block(data.path, 1)
    run(capsys, "generate", folder / "organ.toml")  # the reference goes on with it
    assert len(DataSet(folder / "data.zarr").engines) == 2
    assert "engines" in run(capsys, "data", "show", folder / "organ.toml")
    shutil.rmtree(folder / "data.zarr")
    generate_stage(folder / "organ.toml", torch_device="cpu")
    assert DataSet(folder / "data.zarr").identity == before


def test_what_cannot_be_is_said(capsys, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(capsys, "mesh", folder / "organ.toml")
    said = run(capsys, "generate", folder / "organ.toml", "--device", "cuda", code=2)
    assert "expected --engine torch beside it" in said
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    said = run(capsys, "generate", folder / "organ.toml", "--engine", "torch", "--device", "cuda", code=2)
    assert "expected a GPU that torch can use, found none" in said
    assert not (folder / "data.zarr").exists() or json.loads((folder / "stages.json").read_text()).keys() == {"mesh"}
    with pytest.raises(ConfigError, match="found none"):
        TorchBlocks("cuda")
