"""What somebody met who used the program for the first time."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest
import pyvista

from softtwin.app import inputs, report
from softtwin.app.config import ConfigError, read_config
from softtwin.app.page.demo import run_demo
from softtwin.app.pictures import chart
from softtwin.app.twin import Sequence, Twin

from .conftest import run


def test_each_split_has_a_colour_however_many_there_are() -> None:
    names = ("train", "validation", "test", "calibration", "smooth", "active", "another")
    peaks = {name: np.linspace(0.001, 0.002, 5) for name in names}
    iterations = {name: np.arange(1, 6) for name in names}
    assert chart(lambda sheet: report._draw_data(sheet, peaks, iterations), "histograms")


def test_a_body_that_nothing_has_changed_stays(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Its equilibria are of no other; and where something has, what it was is kept beside it."""
    pyvista.Icosphere(radius=0.05, nsub=3).save(tmp_path / "ball.stl")
    text = 'body = {source = "ball.stl", nodes = 150, fixed = "halfspace:0,0,-0.02:0,0,-1"}\n'
    (tmp_path / "organ.toml").write_text(text)
    run(capsys, "mesh", tmp_path / "organ.toml")
    (body,) = tmp_path.rglob("body.vtu")
    before = body.read_bytes()
    assert "nothing has changed" in run(capsys, "mesh", tmp_path / "organ.toml")
    assert body.read_bytes() == before
    (tmp_path / "organ.toml").write_text(text.replace("150", "200"))
    run(capsys, "mesh", tmp_path / "organ.toml")
    (tmp_path / "organ.toml").write_text(text.replace("150", "250"))
    run(capsys, "mesh", tmp_path / "organ.toml")
    kept = [path.read_bytes() for path in body.parent.glob("body.*.vtu")]
    assert body.read_bytes() != before and before in kept and len(kept) == 2


def test_files_of_one_content_in_other_units_are_told_apart() -> None:
    assert inputs._shown(f"sha256:{64 * 'a'}:mm") == "sha256:aaaaaaaaaaaa...:mm"


def test_results_are_not_written_among_what_is_read(
    capsys: pytest.CaptureFixture[str], mesh_folder: Path, tmp_path: Path
) -> None:
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    np.savetxt(clouds / "cloud.txt", 0.02 * np.random.default_rng(0).standard_normal((50, 3)))
    for names in (clouds, f"{clouds}/*.txt"):
        said = run(capsys, "register", mesh_folder, names, "--model", "reference", "--output", clouds, code=2)
        assert "--output: expected a folder of its own" in said and "in which the clouds are" in said
    said = run(capsys, "register", mesh_folder, clouds, "--model", "reference", "--output", mesh_folder, code=2)
    assert "in which the twin is" in said
    assert [path.name for path in clouds.iterdir()] == ["cloud.txt"]


def test_a_recording_in_no_folder_is_refused_before_it_begins(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--record: expected a file in a folder that is there"):
        run_demo(0, browser=False, record=tmp_path / "none" / "scene.html", seconds=1.0)


def test_a_folder_stands_for_the_configuration_in_it(tmp_path: Path) -> None:
    (tmp_path / "organ.toml").write_text("material = {young_modulus = 1234.0}\n")
    config, root = read_config(tmp_path)
    assert config.material.young_modulus == 1234.0 and root == tmp_path
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"expected a TOML file, found none at .*empty"):
        read_config(tmp_path / "empty")


def test_no_answer_of_a_live_sequence_waits_for_garbage_of_what_was_loaded(plain_twin: Twin) -> None:
    before = gc.get_freeze_count()
    sequence = Sequence(plain_twin, is_live=True)
    assert gc.get_freeze_count() > before + 1000
    sequence.close()
    assert gc.get_freeze_count() == 0
    still = Sequence(plain_twin)
    assert gc.get_freeze_count() == 0
    still.close()
