"""The command line as a user meets it: help, good runs of single stages, and what is said of bad input."""

from __future__ import annotations

import errno
import json
import os
import shutil
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista

from softtwin.app.cli import main
from softtwin.app.config import Config, to_toml
from softtwin.app.register import forward_model, make_registrar, open_twin, register_clouds
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.files import read_body, write_body
from softtwin.meshes.shapes import beam


def run(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> str:
    """Output and errors of a command that ends with the code."""
    try:
        main([str(argument) for argument in arguments])
        ended = 0
    except SystemExit as stop:
        ended = int(stop.code or 0)
    captured = capsys.readouterr()
    assert ended == code, captured.out + captured.err
    return captured.out + captured.err


def ball() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a sphere of radius 50."""
    made = pyvista.Icosphere(radius=50.0, nsub=3)
    return np.asarray(made.points, dtype=np.float64), np.asarray(made.regular_faces)


def write_stl(path: Path, points: np.ndarray, triangles: np.ndarray) -> Path:
    meshio.Mesh(points, [("triangle", triangles)]).write(path, binary=True)
    return path


@pytest.fixture
def sphere(tmp_path: Path) -> Path:
    return write_stl(tmp_path / "sphere_mm.stl", *ball())


@pytest.fixture
def cap(tmp_path: Path) -> Path:
    """Points of the sphere's lower cap, in millimetres."""
    points, _ = ball()
    path = tmp_path / "cap.txt"
    np.savetxt(path, points[points[:, 2] < -35.0])
    return path


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    """A twin that the reference can register: body and configuration, no network."""
    folder = tmp_path / "twin"
    folder.mkdir()
    write_body(folder / "body.vtu", beam((6, 2, 2), (0.6, 0.2, 0.2), "tetrahedron"))
    (folder / "organ.toml").write_text(to_toml(Config()))
    return folder


def cloud(folder: Path, body: Body, shift: float = 0.0) -> Path:
    bent = np.zeros_like(body.points)
    bent[:, 2] = 0.05 * body.points[:, 0] ** 2
    points = partial_view(body, bent, (0.3, 0.4, 1.0), 200, 1e-4, np.random.default_rng(0)) + shift
    path = folder / f"cloud_{shift}.npy"
    np.save(path, points)
    return path


@pytest.mark.parametrize(
    "command",
    ["", "build", "register", "generate", "mesh", "train", "validate", "report", "quickstart", "doctor", "config"],
)
def test_help_reads(capsys, command: str) -> None:
    text = run(capsys, *command.split(), "--help")
    assert "Usage:" in text and len(text.splitlines()) > 4


def test_the_main_help_says_what_it_is_not(capsys) -> None:
    assert "not a medical device" in run(capsys, "--help")


def test_config_writes_a_file_that_mesh_takes(capsys, tmp_path: Path) -> None:
    text = run(capsys, "config").replace('source = "liver-phantom"', 'source = "beam"')
    (tmp_path / "organ.toml").write_text(text)
    said = run(capsys, "mesh", tmp_path / "organ.toml")
    assert "500 nodes" in said
    assert len(read_body(tmp_path / "twin-run" / "body.vtu").points) == 500
    assert "mesh" in json.loads((tmp_path / "twin-run" / "stages.json").read_text())


def build(capsys, tmp_path: Path, *arguments: object) -> str:
    return run(capsys, "build", *arguments, "--output", tmp_path / "out", code=2)


def test_no_fixed_nodes_is_said_with_the_flag(capsys, tmp_path, sphere) -> None:
    assert "Give --fixed FILE" in build(capsys, tmp_path, sphere, "--unit", "mm", "--nodes", 200)


def test_a_fixed_set_far_from_the_boundary_is_said_with_the_distance(capsys, tmp_path, sphere) -> None:
    np.savetxt(tmp_path / "far.txt", np.full((5, 3), 300.0) + np.eye(5)[:, :3])
    said = build(capsys, tmp_path, sphere, "--unit", "mm", "--nodes", 200, "--fixed", tmp_path / "far.txt")
    assert "no boundary node lies within" in said and "mm away" in said


@pytest.mark.parametrize(
    ("flag", "value", "named"),
    [("--young-modulus", "-3", "material.young_modulus"), ("--poisson-ratio", "0.5", "material.poisson_ratio")],
)
def test_materials_that_cannot_be_are_named(capsys, tmp_path, sphere, flag, value, named) -> None:
    assert named in build(capsys, tmp_path, sphere, flag, value)


def test_a_missing_surface_is_named(capsys, tmp_path) -> None:
    assert "nothing.stl" in build(capsys, tmp_path, tmp_path / "nothing.stl", "--fixed", tmp_path / "nothing.stl")


def test_too_many_modes_are_refused_before_meshing(capsys, tmp_path, sphere) -> None:
    (tmp_path / "organ.toml").write_text(f'body = {{source = "{sphere}", nodes = 200}}\nloads = {{modes = 301}}\n')
    said = run(capsys, "mesh", tmp_path / "organ.toml", code=2)
    assert said.splitlines()[1:] == ["  loads.modes: expected at most 300 with body.nodes = 200, got 301"]


def register(capsys, twin: Path, *clouds: Path, code: int = 0) -> str:
    return run(capsys, "register", twin, *clouds, "--model", "reference", "--output", twin / "found", code=code)


def test_the_reference_registers_a_cloud(capsys, twin: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    said = register(capsys, twin, cloud(twin, read_body(twin / "body.vtu")))
    assert "frame   0: cloud to surface" in said and "not a medical device" in said
    frames = json.loads((twin / "found" / "registration.json").read_text())["frames"]
    assert frames[0]["rms_distance_m"] < 1e-3 and (twin / "found" / "frame_0000.vtu").exists()


@pytest.mark.parametrize(
    ("points", "message"),
    [(np.empty((0, 3)), "point"), (np.array([[0.1, 0.1, np.nan]] * 9), "finite"), (np.zeros((4, 2)), "(p, 3)")],
)
def test_clouds_that_cannot_be_are_refused_with_their_file(capsys, twin: Path, points, message: str) -> None:
    np.save(twin / "bad.npy", points)
    said = register(capsys, twin, twin / "bad.npy", code=2)
    assert "bad.npy" in said and message in said and "Traceback" not in said


def test_a_cloud_one_metre_away_is_refused_with_the_distance(capsys, twin: Path) -> None:
    said = register(capsys, twin, cloud(twin, read_body(twin / "body.vtu"), shift=1.0), code=2)
    assert " m" in said and "rigid" in said


def test_a_bad_cloud_is_found_before_the_first_is_registered(capsys, twin: Path) -> None:
    good = cloud(twin, read_body(twin / "body.vtu"))
    np.save(twin / "bad.npy", np.empty((0, 3)))
    register(capsys, twin, good, twin / "bad.npy", code=2)
    assert not (twin / "found").exists()


def test_a_folder_that_is_no_twin_is_refused(capsys, tmp_path: Path, twin: Path) -> None:
    good = cloud(twin, read_body(twin / "body.vtu"))
    shutil.rmtree(twin)
    twin.mkdir()
    assert "softtwin build" in run(capsys, "register", twin, good, code=2)


def test_a_twin_without_a_network_says_so(capsys, twin: Path) -> None:
    pytest.importorskip("torch", reason="torch is absent")
    said = run(capsys, "register", twin, cloud(twin, read_body(twin / "body.vtu")), code=2)
    assert "surrogate.json" in said and "Traceback" not in said


def test_unknown_zones_are_named(capsys, twin: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    found = cloud(twin, read_body(twin / "body.vtu"))
    said = run(capsys, "register", twin, found, "--model", "reference", "--zone", "nowhere", code=2)
    assert "registration.zone" in said and "nowhere" in said


def test_ctrl_c_between_frames_keeps_the_frames_before(twin: Path, tmp_path: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    body, settings = open_twin(twin)
    points = np.load(cloud(twin, body))

    def interrupted(line: str) -> None:
        if line.startswith("frame   1"):
            raise KeyboardInterrupt

    with forward_model("reference", twin, body, settings) as model, pytest.raises(KeyboardInterrupt):
        registrar = make_registrar(model, settings, settings.registration)
        register_clouds(registrar, [points] * 3, tmp_path / "found", say=interrupted)
    frames = json.loads((tmp_path / "found" / "registration.json").read_text())["frames"]
    assert [frame["frame"] for frame in frames] == [0, 1]
    assert (tmp_path / "found" / "frame_0001.vtu").exists()


def test_ctrl_c_is_one_line_and_code_130(capsys, monkeypatch) -> None:
    from softtwin.app import doctor

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "checks", interrupted)
    assert "goes on from there" in run(capsys, "doctor", code=130)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full"),
        (OSError(errno.EDQUOT, "Disk quota exceeded", "/data/x"), "the disk is full"),
        (PermissionError(errno.EACCES, "Permission denied", "/data/x"), "/data/x: Permission denied; choose a place"),
        (OSError(errno.EROFS, "Read-only file system", "/data/x"), "/data/x: Read-only file system; choose a place"),
        (IsADirectoryError(errno.EISDIR, "Is a directory", "/data/x"), "/data/x: Is a directory."),
        (MemoryError(), "not enough memory"),
    ],
)
def test_what_the_system_refuses_is_one_message(capsys, monkeypatch, error: Exception, message: str) -> None:
    from softtwin.app import doctor

    def refused() -> None:
        raise error

    monkeypatch.setattr(doctor, "checks", refused)
    said = run(capsys, "doctor", code=2)
    assert said.startswith("error: ") and message in said and len(said.splitlines()) == 1


def test_threads_wait_without_spinning(capsys, monkeypatch) -> None:
    from softtwin.app import doctor

    monkeypatch.delenv("OMP_WAIT_POLICY")
    monkeypatch.setattr(doctor, "checks", list)
    run(capsys, "doctor")
    assert os.environ["OMP_WAIT_POLICY"] == "passive"


@pytest.mark.parametrize("place", ["taken", "taken/within"])
def test_a_file_where_a_folder_is_to_be_made_is_said(capsys, tmp_path, sphere, place: str) -> None:
    (tmp_path / "taken").write_text("mine")
    said = run(capsys, "build", sphere, "--fixed", sphere, "--output", tmp_path / place, code=2)
    assert said.splitlines()[-1].startswith("error: ") and "taken" in said and "expected a folder" in said
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_defect_of_the_program_is_not_hidden(monkeypatch) -> None:
    from softtwin.app import doctor

    monkeypatch.setattr(doctor, "checks", lambda: [].index(3))
    with pytest.raises(ValueError, match="not in list"):
        main(["doctor"])


@pytest.mark.filterwarnings("default")
def test_warnings_are_shown_in_one_line_but_for_those_to_developers(capsys, monkeypatch) -> None:
    from softtwin.app import doctor

    def warned() -> list:
        warnings.warn("the mesh is\nrather coarse", UserWarning, stacklevel=1)
        warnings.warn("invalid value", RuntimeWarning, stacklevel=1)
        warnings.warn("use another name", DeprecationWarning, stacklevel=1)
        warnings.warn("use another name", FutureWarning, stacklevel=1)
        return []

    before = warnings.showwarning
    monkeypatch.setattr(doctor, "checks", warned)
    said = run(capsys, "doctor").splitlines()
    assert "warning: the mesh is rather coarse" in said and "warning: invalid value" in said
    assert not any("another name" in line for line in said)
    assert warnings.showwarning is before


def test_stages_in_the_wrong_order_say_which_comes_first(capsys, tmp_path: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    (tmp_path / "organ.toml").write_text(to_toml(Config()))
    assert "softtwin mesh" in run(capsys, "generate", tmp_path / "organ.toml", code=2)
    pytest.importorskip("torch", reason="torch is absent")
    assert "softtwin generate" in run(capsys, "train", tmp_path / "organ.toml", code=2)
