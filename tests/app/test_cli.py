"""The command line as a user meets it: help, good runs of single stages, and what is said of bad input."""

from __future__ import annotations

import errno
import json
import os
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista

from softtwin.app.cli import main
from softtwin.app.config import Config, to_toml
from softtwin.meshes.io import read_body

from .conftest import run


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


@pytest.mark.parametrize(
    "command",
    [
        "",
        "data",
        "build",
        "register",
        "generate",
        "mesh",
        "train",
        "validate",
        "report",
        "quickstart",
        "doctor",
        "config",
    ],
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
    [
        ("--young-modulus", "-3", "--young-modulus: expected a finite number > 0, in pascals, got '-3'"),
        ("--poisson-ratio", "0.5", "--poisson-ratio: expected a finite number > 0 and < 0.5, got '0.5'"),
    ],
)
def test_materials_that_cannot_be_are_named(capsys, tmp_path, sphere, flag, value, named) -> None:
    assert named in build(capsys, tmp_path, sphere, flag, value)


def test_a_missing_surface_is_named(capsys, tmp_path) -> None:
    assert "nothing.stl" in build(capsys, tmp_path, tmp_path / "nothing.stl", "--fixed", tmp_path / "nothing.stl")


def test_too_many_modes_are_refused_before_meshing(capsys, tmp_path, sphere) -> None:
    (tmp_path / "organ.toml").write_text(f'body = {{source = "{sphere}", nodes = 200}}\nloads = {{modes = 301}}\n')
    said = run(capsys, "mesh", tmp_path / "organ.toml", code=2)
    assert said.splitlines()[1:] == ["  loads.modes: expected at most 300 with body.nodes = 200, got 301"]


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


def test_words_for_places_stand_in_lines_of_their_own(capsys) -> None:
    lines = run(capsys, "build", "--help").splitlines()
    assert any(line.split()[:4] == ["ball:10,-20,35mm:15mm", "centre", "and", "radius"] for line in lines)
    assert not any("\\b" in line or "\b" in line for line in lines)


@pytest.mark.filterwarnings("default")
def test_warnings_are_shown_in_one_line_but_for_those_to_developers(capsys, monkeypatch) -> None:
    from softtwin.app import doctor

    def warned() -> list:
        warnings.warn("the mesh is\nrather coarse", UserWarning, stacklevel=1)
        warnings.warn("the mesh is rather coarse", UserWarning, stacklevel=1)
        warnings.warn("invalid value", RuntimeWarning, stacklevel=1)
        warnings.warn("use another name", DeprecationWarning, stacklevel=1)
        warnings.warn("use another name", FutureWarning, stacklevel=1)
        return []

    before = warnings.showwarning
    monkeypatch.setattr(doctor, "checks", warned)
    said = run(capsys, "doctor").splitlines()
    assert said.count("warning: the mesh is rather coarse") == 1 and "warning: invalid value" in said
    assert not any("another name" in line for line in said)
    assert warnings.showwarning is before


def test_stages_in_the_wrong_order_say_which_comes_first(capsys, tmp_path: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    (tmp_path / "organ.toml").write_text(to_toml(Config()))
    assert "softtwin mesh" in run(capsys, "generate", tmp_path / "organ.toml", code=2)
    pytest.importorskip("torch", reason="torch is absent")
    assert "softtwin generate" in run(capsys, "train", tmp_path / "organ.toml", code=2)
