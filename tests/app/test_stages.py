"""Stages answer for what they read: what has changed is made again or refused, never answered with old results."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app import chain, launch
from softtwin.app.chain import build_twin
from softtwin.app.cli import main
from softtwin.app.config import Config, ConfigError, parse_config, read_config, to_toml
from softtwin.app.doctor import available_cores
from softtwin.app.installation import Launcher
from softtwin.app.stages.learn import train_stage
from softtwin.app.twin import Twin
from softtwin.app.workspace import locked, open_workspace, read_records, timed
from softtwin.meshes.body import Body, BodyError
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import outer
from softtwin.meshes.io import read_body, write_body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.jacobians import stored_modes
from softtwin.surrogate.calibration import CalibrationWarning
from softtwin.surrogate.error_indicators import CalibrationError

ENTRIES = {
    "folder": ".",
    "body": {"source": "beam.vtu", "fixed": "fixed.txt", "zones": {"tool": "tool.txt"}},
    "loads": {"modes": 4, "displacement": 0.05},
    "samples": {"train": 6, "validation": 2, "test": 2, "block": 2, "ranks": 1},
    "training": {"modes": 4, "width": 16, "seconds": 0.5},
    "doubt": {"draws": 12},
}


def bar(length: float = 0.6) -> Body:
    return beam((6, 2, 2), (length, 0.2, 0.2), "tetrahedron")


def config(**sections: dict) -> Config:
    return Config.model_validate({**ENTRIES, **{name: {**ENTRIES.get(name, {}), **s} for name, s in sections.items()}})


def write_files(folder: Path, body: Body) -> None:
    write_body(folder / "beam.vtu", body)
    np.savetxt(folder / "fixed.txt", body.fixed, fmt="%d")
    np.savetxt(folder / "tool.txt", body.node_sets["tip"], fmt="%d")


def build(folder: Path, *, again: bool = False, **sections: dict) -> str:
    said: list[str] = []
    build_twin(config(**sections), folder, said.append, again)
    return "\n".join(said)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished twin of a short bar."""
    folder = tmp_path_factory.mktemp("made") / "out"
    folder.mkdir()
    write_files(folder, bar())
    build(folder)
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "out")
    return tmp_path / "out"


def run(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> str:
    """Output and errors of a command that ends with the code."""
    ended = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        ended = int(stop.code or 0)
    captured = capsys.readouterr()
    assert ended == code, captured.out + captured.err
    return captured.out + captured.err


def edit(folder: Path, before: str, after: str) -> None:
    text = (folder / "organ.toml").read_text()
    assert before in text
    (folder / "organ.toml").write_text(text.replace(before, after))


def stamps(folder: Path) -> dict[str, int]:
    return {name: (folder / name).stat().st_mtime_ns for name in ("body.vtu", "data.zarr/zarr.json")}


def test_every_stage_records_what_it_read(made: Path) -> None:
    records = read_records(made)
    assert records["mesh"]["read"]["body.source"].startswith("sha256:")
    assert records["mesh"]["read"]["body.zones.tool"].startswith("sha256:")
    assert records["generate"]["read"]["plan.young_modulus"] == 5000.0
    assert records["generate"]["read"]["body"] == read_body(made / "body.vtu").fingerprint
    assert records["train"]["read"]["training.width"] == 16 and "data set" in records["validate"]["read"]
    assert not list(made.rglob("*.partial*"))


def test_what_is_current_is_not_made_again(copy: Path) -> None:
    before, weights = stamps(copy), (copy / "twin" / "surrogate.safetensors").read_bytes()
    said = build(copy)
    assert "there already" in said and "made again" not in said and "from the start" not in said
    assert stamps(copy) == before and (copy / "twin" / "surrogate.safetensors").read_bytes() == weights


def test_other_training_is_another_training_on_the_same_equilibria(copy: Path) -> None:
    before = stamps(copy)
    said = build(copy, training={"width": 24})
    assert "there already" in said
    assert "from the start" in said and "another plan (differs in width)" in said
    assert stamps(copy) == before
    assert read_records(copy)["train"]["read"]["training.width"] == 24


@pytest.mark.parametrize(
    ("sections", "named"),
    [
        ({"material": {"young_modulus": 6000.0}}, r"young_modulus \(5000\.0 there, 6000\.0 here\)"),
        ({"loads": {"displacement": 0.06}}, r"loads\.displacement \(0\.05 there, 0\.06 here\)"),
        ({"samples": {"train": 8}}, r"samples\.train \(6 there, 8 here\)"),
        ({"body": {"cell_size": 0.05}}, r"body\.cell_size \(0\.0 then, 0\.05 now\)"),
    ],
)
def test_solved_equilibria_are_not_thrown_away_unasked(copy: Path, sections: dict, named: str) -> None:
    before, text = stamps(copy), (copy / "organ.toml").read_text()
    with pytest.raises(ConfigError, match=rf"another configuration or other files: {named}\..*--output.*--again"):
        build(copy, **sections)
    assert stamps(copy) == before and (copy / "organ.toml").read_text() == text


def test_asked_for_equilibria_are_made_anew(copy: Path) -> None:
    build(copy, again=True, material={"young_modulus": 6000.0})
    assert read_records(copy)["generate"]["read"]["plan.young_modulus"] == 6000.0
    learned = json.loads((copy / "twin" / "surrogate.json").read_text())["data"]["plan"]
    assert learned["young_modulus"] == 6000.0


@pytest.mark.parametrize("file", ["beam.vtu", "fixed.txt", "tool.txt"])
def test_a_changed_input_file_is_seen(copy: Path, file: str) -> None:
    other = bar(0.7)
    if file != "beam.vtu":
        other = bar().with_sets(fixed=bar().fixed[:-1], tip=bar().node_sets["tip"][1:])
    write_files(copy / "twin", other)
    shutil.move(copy / "twin" / file, copy / file)
    with pytest.raises(ConfigError, match=r"other files: body\.\S+ \(sha256:\w+\.\.\. then, sha256:\w+\.\.\. now\)"):
        build(copy)


def test_a_mesh_without_equilibria_is_made_again(copy: Path) -> None:
    shutil.rmtree(copy / "data.zarr")
    write_files(copy, bar(0.7))
    said = build(copy, material={"young_modulus": 6000.0})
    assert "made again, what it is made of has changed: body.source (sha256:" in said
    assert np.ptp(read_body(copy / "twin" / "body.vtu").points[:, 0]) == pytest.approx(0.7)


def test_build_may_be_repeated_with_other_options_until_it_succeeds(capsys, tmp_path: Path) -> None:
    write_files(tmp_path, bar())
    words = ["build", tmp_path / "beam.vtu", "--samples", 8, "--seconds", 0.5, "--ranks", 1]
    words += ["--displacement", 0.05, "--output", tmp_path / "out"]
    assert "body.fixed" in run(capsys, *words, code=2)
    assert "held-out" in run(capsys, *words, "--fixed", tmp_path / "fixed.txt")
    assert read_config(tmp_path / "out" / "organ.toml")[0].samples.smooth == 8
    assert len(DataSet(tmp_path / "out" / "data.zarr").samples("smooth")) == 8


def test_build_keeps_equilibria_from_before_there_were_smooth_draws(tmp_path: Path) -> None:
    write_files(tmp_path, bar())
    words = {"folder": ".", "body": {"source": str(tmp_path / "beam.vtu"), "fixed": str(tmp_path / "fixed.txt")}}
    words |= {"loads": {"modes": 4}, "training": {"epochs": 2, "modes": 4, "width": 8}, "model_error": {"draws": 0}}
    counts = {"train": 4, "validation": 2, "test": 2, "block": 2, "ranks": 1, "jacobians": False}
    said = list[str]()
    build_twin(parse_config({**words, "samples": counts}), tmp_path / "out", said.append)
    before = DataSet(tmp_path / "out" / "data.zarr").identity
    said.clear()
    build_twin(parse_config({**words, "samples": {**counts, "smooth": 4}}), tmp_path / "out", said.append)
    assert said[0].startswith("equilibria: those here have no smooth draws")
    assert DataSet(tmp_path / "out" / "data.zarr").identity == before
    build_twin(parse_config({**words, "samples": {**counts, "smooth": 4}}), tmp_path / "out", said.append, again=True)
    assert len(DataSet(tmp_path / "out" / "data.zarr").samples("smooth")) == 4


def test_training_refuses_the_data_of_another_mesh(capsys, copy: Path) -> None:
    first = read_body(copy / "body.vtu").fingerprint[:12]
    write_files(copy, bar(0.7))
    organ = copy / "organ.toml"
    for stage in ("generate", "train", "validate"):
        said = run(capsys, stage, organ, code=2)
        assert "body.source" in said and "Run `softtwin mesh` again" in said
    run(capsys, "mesh", organ)
    second = read_body(copy / "body.vtu").fingerprint[:12]
    for stage in ("generate", "train", "validate"):
        said = run(capsys, stage, organ, code=2)
        assert first in said and second in said and "softtwin generate --again" in said
    run(capsys, "generate", organ, "--again")
    assert "softtwin train --fresh" in run(capsys, "train", organ, code=2)
    run(capsys, "train", organ, "--fresh")
    run(capsys, "validate", organ)


def test_training_refuses_the_data_of_another_material(capsys, copy: Path) -> None:
    edit(copy, "young_modulus = 5000.0", "young_modulus = 7000.0")
    for stage in ("generate", "train", "validate"):
        assert "young_modulus (5000.0 there, 7000.0 here)" in run(capsys, stage, copy / "organ.toml", code=2)


def test_validation_refuses_a_twin_of_another_training(capsys, copy: Path) -> None:
    edit(copy, "width = 16", "width = 24")
    said = run(capsys, "validate", copy / "organ.toml", code=2)
    assert "training.width (16 then, 24 now)" in said and "Run `softtwin train` again" in said


def test_the_card_answers_for_its_data_without_a_record(capsys, copy: Path) -> None:
    (copy / "stages.json").unlink()
    run(capsys, "validate", copy / "organ.toml")
    edit(copy, "seed = 0 # seed of everything", "seed = 3 # seed of everything")
    run(capsys, "generate", copy / "organ.toml", "--again")
    said = run(capsys, "validate", copy / "organ.toml", code=2)
    assert "data set (" in said and "Run `softtwin train` again" in said


def test_a_twin_whose_material_was_edited_is_refused(capsys, copy: Path) -> None:
    edit(copy / "twin", "young_modulus = 5000.0", "young_modulus = 7000.0")
    np.save(copy / "cloud.npy", read_body(copy / "body.vtu").points)
    said = run(capsys, "register", copy / "twin", copy / "cloud.npy", "--output", copy / "found", code=2)
    assert "material.young_modulus (5000.0 learned, 7000.0 in organ.toml)" in said


@pytest.mark.parametrize("broken", ["{", "[]", '{"mesh": 3}', '{"mesh": {"seconds": "long", "read": 1}}', "\0"])
def test_a_broken_record_is_no_record(capsys, copy: Path, broken: str) -> None:
    (copy / "stages.json").write_text(broken)
    with pytest.raises(ConfigError, match=r"no record in .*stages\.json says what the mesh was made of"):
        build(copy)
    run(capsys, "validate", copy / "organ.toml")
    run(capsys, "mesh", copy / "organ.toml")
    assert {"mesh", "validate"} <= set(read_records(copy))
    assert "there already" in build(copy)


def test_a_stage_that_is_cut_short_leaves_no_record(copy: Path) -> None:
    space = open_workspace(copy / "organ.toml")
    with pytest.raises(KeyboardInterrupt), timed(space, "mesh", {}):
        raise KeyboardInterrupt
    assert "mesh" not in read_records(copy) and "train" in read_records(copy)


def test_a_damaged_block_is_made_again_by_build(copy: Path) -> None:
    chunk = copy / "data.zarr" / "samples" / "displacements" / "c" / "1" / "0" / "0"
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[: len(whole) // 2])
    with pytest.warns(UserWarning, match="block 1 in .* is damaged .*made again"):
        build(copy)
    assert chunk.read_bytes() == whole


# ------------------------------------------------------------------ refused at the door


@pytest.fixture
def unsolved(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Solving is not to be begun."""

    def solve(*_: object) -> None:
        raise AssertionError("the equilibria were begun")

    monkeypatch.setattr(chain, "generate_in_parallel", solve)
    yield


@pytest.mark.usefixtures("unsolved")
@pytest.mark.parametrize(
    ("flag", "value", "message", "meshed"),
    [
        ("--load-path", 3, "samples.load_path: expected a divisor of samples.block (8), got 3", False),
        ("--displacement", 50.0, "LoadPlan.displacement: expected at most the size of the body", True),
        ("--zone", "tool=fixed.txt", "is on the free boundary", True),
    ],
)
def test_what_cannot_be_is_refused_before_it_costs(
    capsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flag: str, value: object, message: str, meshed: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    write_files(tmp_path, bar())
    words = ["build", "beam.vtu", "--fixed", "fixed.txt", "--output", "out", flag, value]
    said = run(capsys, *words, code=2)
    assert said.count("error: ") == 1 and message in said
    assert (tmp_path / "out").exists() == meshed


def test_one_block_too_many_is_refused(capsys, copy: Path) -> None:
    for wrong in (999, -1):
        said = run(capsys, "generate", copy / "organ.toml", "--redo", wrong, code=2)
        assert f"expected numbers of blocks in 0..4, got [{wrong}]" in said and "Traceback" not in said


@pytest.mark.mpi
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="mpirun is absent")
@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("changed plan", "seed (0 there, 3 here)"),
        # Like the first, these end on rank 0 before the work is shared.
        pytest.param("no body", "softtwin mesh", marks=pytest.mark.slow),
        pytest.param("no configuration", "is no TOML", marks=pytest.mark.slow),
        pytest.param("zone inside the fixed set", "is on the free boundary", marks=pytest.mark.slow),
        pytest.param("all of the boundary fixed", "expected free nodes on the boundary", marks=pytest.mark.slow),
        pytest.param("wrong entry", "samples.load_path: expected a divisor", marks=pytest.mark.slow),
    ],
)
def test_ranks_end_together_with_one_message(
    copy: Path, mpi_environment: dict[str, str], case: str, message: str
) -> None:
    body = bar()
    if case == "changed plan":
        edit(copy, "seed = 0 # seed of everything", "seed = 3 # seed of everything")
    elif case == "zone inside the fixed set":
        (copy / "organ.toml").write_text(to_toml(config(loads={"zones": ["tool"]})))
        write_files(copy, body.with_sets(tip=body.fixed))
    elif case == "all of the boundary fixed":
        write_files(copy, body.with_sets(fixed=body.boundary_nodes))
    elif case == "no body":
        (copy / "body.vtu").unlink()
    elif case == "no configuration":
        (copy / "organ.toml").write_text("[body\n")
    else:
        edit(copy, "load_path = 1", "load_path = 5")
    if "fixed" in case:
        main(["mesh", str(copy / "organ.toml")])
    program = [sys.executable, "-m", "softtwin.app.cli", "generate", str(copy / "organ.toml")]
    command = ["mpirun", "-n", "2", *program]
    done = subprocess.run(command, env=mpi_environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stderr.count("error: ") == 1 and message in done.stderr
    assert "Traceback" not in done.stderr


def test_ranks_that_refuse_have_said_why(capsys, copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)  # one core starts no ranks
    monkeypatch.setattr(launch, "launcher", lambda: Launcher(Path("mpirun"), "MPICH"))
    monkeypatch.setattr(launch.subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], 2))
    said = run(capsys, "build", copy / "beam.vtu", "--fixed", copy / "fixed.txt", "--output", copy / "new", code=2)
    assert "error" not in said


def test_ranks_are_the_cores_that_may_be_used(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = []

    def start(command: list[str], **_: object) -> subprocess.CompletedProcess:
        started.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(launch.os, "sched_getaffinity", lambda _: {1, 4, 5}, raising=False)
    monkeypatch.setattr(launch.os, "cpu_count", lambda: 64)
    monkeypatch.setattr(launch, "launcher", lambda: Launcher(Path("mpirun"), "MPICH"))
    monkeypatch.setattr(launch.subprocess, "run", start)
    launch.generate_in_parallel(copy / "organ.toml", 0, again=True)
    assert available_cores() == 3
    assert started[0][started[0].index("-n") + 1] == "3" and started[0][-1] == "--again"


def test_training_leaves_the_twin_whole(copy: Path) -> None:
    shutil.rmtree(copy / "twin")
    train_stage(open_workspace(copy / "organ.toml"))
    assert {path.name for path in (copy / "twin").iterdir()} == {
        "body.vtu",
        "organ.toml",
        "surrogate.json",
        "surrogate.safetensors",
    }


def test_two_trainings_in_one_folder_are_one_too_many(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softtwin.app.workspace._PATIENCE_S", 0.1)
    space = open_workspace(copy / "organ.toml")
    with locked(space, "train"), pytest.raises(ConfigError, match=r"another `train` is at work here"):
        train_stage(space)
    with locked(space, "train"):
        pass  # let go of


@pytest.mark.chain
@pytest.mark.slow
def test_a_twin_on_a_regular_grid_registers_clouds_of_the_surface(capsys, tmp_path: Path) -> None:
    """`build --grid`: the surface rides in hexahedra, which U-Mesh learns on too; clouds are matched to it."""
    write_files(tmp_path, bar())
    out = tmp_path / "out"
    words = ["build", tmp_path / "beam.vtu", "--samples", 24, "--seconds", 2, "--ranks", 1, "--grid", 0.08]
    said = run(capsys, *words, "--fixed", tmp_path / "fixed.txt", "--displacement", 0.05, "--output", out)
    assert "hexahedra of 80 mm" in said
    body = read_body(out / "body.vtu")
    assert body.kind.name == "hexahedron" and len(body.skin.points) == len(bar().boundary_nodes)
    truth = DataSet(out / "data.zarr").samples("test", 1).displacements[0]
    cloud = partial_view(body, truth, (0.0, -1.0, 0.5), 400, 0.0, np.random.default_rng(0))
    np.save(tmp_path / "cloud.npy", cloud)
    run(capsys, "register", out, tmp_path / "cloud.npy", "--output", tmp_path / "found", "--format", "vtp")
    moved = 1e-3 * pyvista.read(tmp_path / "found" / "organ_0000.vtp").points  # millimetres
    apart = np.linalg.norm(moved - outer(body).moved(truth).points, axis=1)
    assert apart.mean() < 0.2 * np.linalg.norm(outer(body).carried(truth), axis=1).mean()
    edit(out, 'architecture = "reduced"', 'architecture = "umesh"')
    edit(out, "settings = {}", "settings = { channels = 2, levels = 1 }")
    run(capsys, "train", out / "organ.toml", "--fresh")
    assert "umesh" in (out / "twin" / "surrogate.json").read_text()
    run(capsys, "validate", out / "organ.toml")


def test_jacobians_are_made_where_they_are_wanted(tmp_path: Path) -> None:
    write_files(tmp_path, bar())
    build(tmp_path, samples={"jacobians": False})
    assert stored_modes(DataSet(tmp_path / "data.zarr")) is None
    weights = (tmp_path / "twin" / "surrogate.safetensors").read_bytes()
    said = build(tmp_path)
    assert "there already" not in said and "from the start" in said
    modes = stored_modes(DataSet(tmp_path / "data.zarr"))
    assert modes is not None and modes.shape[1] == 4
    assert (tmp_path / "twin" / "surrogate.safetensors").read_bytes() != weights
    assert "there already: 10 equilibria accepted, 0 rejected, Jacobians of 4 modes" in build(tmp_path)
    edit(tmp_path, "modes = 4 # displacement modes", "modes = 3 # displacement modes")
    with pytest.raises(ConfigError, match=r"samples\.jacobians: .* of other modes .* run `softtwin generate` again"):
        train_stage(open_workspace(tmp_path / "organ.toml"), fresh=True)
    build(tmp_path, training={"modes": 3})
    assert stored_modes(DataSet(tmp_path / "data.zarr")).shape[1] == 3


def test_a_grid_as_coarse_as_the_organ_is_refused(tmp_path: Path) -> None:
    write_files(tmp_path, bar())
    with pytest.raises(BodyError, match=r"body\.grid: expected an edge length in metres .* got 80 m"):
        build(tmp_path, body={"grid": 80.0})


def test_a_body_that_the_network_cannot_learn_on_is_refused_before_anything_is_solved(tmp_path: Path) -> None:
    write_files(tmp_path, bar())
    with pytest.raises(ValueError, match=r"regular grid, got tetra cells; put the organ on one \(`build --grid`\)"):
        build(tmp_path, training={"architecture": "umesh", "modes": 64, "width": 256})
    assert not (tmp_path / "data.zarr").exists()


@pytest.mark.parametrize(
    ("samples", "training", "wanted"),
    [
        ({}, {}, True),
        ({"jacobians": False}, {}, False),
        ({}, {"architecture": "mlp", "modes": 64, "width": 256}, False),
        ({}, {"settings": {"sobolev": 0.0}}, False),
    ],
)
def test_jacobians_are_wanted_where_the_network_learns_from_them(samples: Any, training: Any, wanted: bool) -> None:
    assert config(samples=samples, training=training).wants_jacobians is wanted


def test_a_twin_says_how_wrong_it_may_be(capsys, tmp_path: Path) -> None:
    """Bounds in the card, held against held-out samples by `validate`, and given for a prediction from Python."""
    folder = tmp_path / "out"
    folder.mkdir()
    write_files(folder, bar())
    text = build(folder, samples={"calibration": 12})
    assert "certificate: " in text and "made for 90 %" in text
    card = json.loads((folder / "twin" / "surrogate.json").read_text())["certificate"]
    assert card["samples"] == 12 and set(card["held_out"]["kept"]) == {"mean", "largest"}
    assert "certificate: " in json.loads((folder / "validation.json").read_text())["table"]
    assert "calibration  12 accepted" in run(capsys, "data", "show", folder / "organ.toml")
    with Twin.open(folder / "twin") as twin:
        load = np.zeros_like(twin.body.points)
        load[twin.model.encoder_decoder.loaded, 2] = 1e-3
        found = twin.bound_error(load, twin.predict(load))
        assert 0.0 < found.mean <= found.largest < np.inf
        assert not twin.bound_error(1e3 * load).is_inside
    with (
        Twin.open(folder / "twin", "reference") as twin,
        pytest.raises(CalibrationError, match="a twin with a network"),
    ):
        twin.bound_error(load)


def test_too_few_draws_for_a_bound_leave_a_twin_without_one(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    write_files(folder, bar())
    with pytest.warns(
        CalibrationWarning, match=r"no bounds on its errors: .*expected accepted samples of at least 9 load paths"
    ):
        text = build(folder, samples={"calibration": 4})
    assert "certificate: " not in text
    with (
        Twin.open(folder / "twin") as twin,
        pytest.raises(CalibrationError, match="expected a twin that was calibrated"),
    ):
        twin.bound_error(np.zeros_like(twin.body.points))
