"""The main job, small: the same path from shape to report, and what a user does with the twin it leaves."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import pyvista

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.cli import main
from softtwin.meshes.io import read_body, write_body


def softtwin(*arguments: object) -> int:
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture(scope="module")
def made(small_quickstart: Path) -> Path:
    return small_quickstart


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


def test_it_says_what_it_does_and_complains_of_nothing(made: Path) -> None:
    said, complained = (made / "said.txt").read_text(), (made / "complained.txt").read_text()
    assert "not a medical device" in said
    assert said.strip().splitlines()[-1] == "open out/report.html"
    assert "Traceback" not in complained and "Warning" not in complained, complained


def test_every_stage_left_its_result(made: Path) -> None:
    for name in (
        "organ.toml",
        "body.vtu",
        "data.zarr",
        "twin",
        "validation.json",
        "demo",
        "report.html",
        "stages.json",
    ):
        assert (made / name).exists(), name
    assert {"mesh", "generate", "train", "validate", "demo", "report"} <= set(
        json.loads((made / "stages.json").read_text())
    )
    assert {"body.vtu", "organ.toml", "surrogate.json", "surrogate.safetensors"} <= {
        p.name for p in (made / "twin").iterdir()
    }


@pytest.mark.parametrize(("model", "factor"), [("surrogate", 4.0), ("surrogate-without-zone", 4.0), ("reference", 8.0)])
def test_registration_finds_the_tumour(made: Path, model: str, factor: float) -> None:
    """The tumour's error falls by a clear factor; a registration that does nothing, or pulls rigidly, would fail."""
    frame = json.loads((made / "demo" / model / "registration.json").read_text())["frames"][0]
    tumour = frame["targets"]["tumour"]
    truth = np.load(made / "demo" / "truth.npy")
    before = frame["targets"]["tumour"]["movement_m"]
    assert before > 5e-3 and np.linalg.norm(truth, axis=1).max() > 0.02
    assert tumour["error_m"] < before / factor


def test_the_card_says_what_the_twin_is(made: Path) -> None:
    card = json.loads((made / "twin" / "surrogate.json").read_text())
    assert card["training"]["steps"] == 200  # one batch holds all samples: by epochs, on a busy machine too
    assert "not a medical device" in card["notice"].lower()
    assert card["held_out"]["samples"] > 0


@pytest.mark.chain
@pytest.mark.slow
def test_running_again_makes_nothing_twice(copy: Path, capsys) -> None:
    """The second run finds mesh and equilibria: their files keep their times."""
    stamps = {path: path.stat().st_mtime_ns for path in (copy / "body.vtu", copy / "data.zarr" / "zarr.json")}
    assert softtwin("quickstart", "--small", "--output", copy) == 0
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())
    capsys.readouterr()


def test_the_twin_registers_a_sequence_without_the_reference(made: Path, tmp_path: Path, capsys) -> None:
    cloud = np.load(made / "demo" / "cloud.npy")
    paths = []
    for i, shift in enumerate((0.0, 2e-4)):
        paths.append(tmp_path / f"{i}.txt")
        np.savetxt(paths[-1], 1e3 * (cloud + shift))
    output = tmp_path / "found"
    words = ["register", made / "twin", *paths, "--unit", "mm", "--smoothness", 0.02, "--output", output]
    assert softtwin(*words) == 0
    said = capsys.readouterr().out
    assert said.count("cloud to surface") == 2 and "tumour moved" in said
    frames = json.loads((output / "registration.json").read_text())["frames"]
    assert max(frame["rms_distance_m"] for frame in frames) < 3e-3
    assert {"frame_0001.vtu", "tumour_0001.vtp", "frames.pvd"} <= {path.name for path in output.iterdir()}


def test_the_hybrid_engine_is_nearer_and_surer_than_the_network(copy: Path, capsys) -> None:
    cloud, body = copy / "demo" / "cloud.npy", read_body(copy / "body.vtu")
    np.save(copy / "truth.npy", body.points + np.load(copy / "demo" / "truth.npy"))
    rows = {}
    for engine in ("surrogate", "hybrid"):
        folder = copy / f"by-{engine}"
        arguments = ("register", copy, cloud, "--model", engine, "--truth", copy / "truth.npy", "--output", folder)
        assert softtwin(*arguments) == 0
        record = json.loads((folder / "registration.json").read_text())
        assert record["options"]["model"] == engine
        (rows[engine],) = record["frames"]
        assert rows[engine]["verdict"] == "accepted"
        assert rows[engine]["network"]["mean_error_bound_m"] > 0.0
        grid = pyvista.read(folder / "frame_0000.vtu")
        assert grid.point_data["deviation"].shape == (len(body.points),) and grid.point_data["deviation"].min() >= 0.0
        for target in rows[engine]["targets"].values():
            assert 0.0 < target["error_m"] < target["margin95_m"] < target["movement_m"]
    assert "draft" not in rows["surrogate"]
    draft = rows["hybrid"]["draft"]
    assert 0.0 < draft["mean_distance_m"] < draft["largest_distance_m"] < 5e-3
    assert rows["hybrid"]["error"]["mean"] < rows["surrogate"]["error"]["mean"]
    assert rows["hybrid"]["deviation_m"]["mean"] < rows["surrogate"]["deviation_m"]["mean"]
    assert "tumour moved" in capsys.readouterr().out
    (copy / "report.html").unlink()
    assert softtwin("report", copy) == 0  # alone, of both registrations
    page = (copy / "report.html").read_text()
    assert len(page) > 100_000
    assert "<h3>by-surrogate</h3>" in page and "1 frame with the surrogate" in page
    assert "with the hybrid engine" in page and "reference and network apart" in page and "95 % margin" in page
    assert "network off, mean (mm)" in page and "certificate: " in page
    assert "and for an attachment that lies elsewhere by some 4.0 mm along each axis; not for a wrong shape" in page


def test_validate_runs_alone(copy: Path, capsys) -> None:
    assert softtwin("validate", copy / "organ.toml") == 0
    assert "cosine of J^T g" in capsys.readouterr().out


def test_a_body_that_does_not_match_is_refused(copy: Path, capsys) -> None:
    body = read_body(copy / "twin" / "body.vtu")
    other = body.with_sets(fixed=body.fixed[1:])
    write_body(copy / "twin" / "body.vtu", other)
    assert softtwin("register", copy / "twin", copy / "demo" / "cloud.npy") == 2
    assert "belongs to another body" in capsys.readouterr().err


def test_truncated_weights_are_refused(copy: Path, capsys) -> None:
    weights = copy / "twin" / "surrogate.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    assert softtwin("register", copy / "twin", copy / "demo" / "cloud.npy") == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and "surrogate.safetensors" in said


def test_a_truncated_checkpoint_is_refused_with_advice(copy: Path, capsys) -> None:
    checkpoint = next((copy / "training").glob("*.ckpt"))
    checkpoint.write_bytes(checkpoint.read_bytes()[:500])
    words = (copy / "organ.toml").read_text()
    assert words.count("epochs = 200") == 1
    (copy / "organ.toml").write_text(words.replace("epochs = 200", "epochs = 2"))
    assert softtwin("train", copy / "organ.toml") == 2
    assert "training.ckpt" in capsys.readouterr().err
    assert softtwin("train", copy / "organ.toml", "--fresh") == 0
    capsys.readouterr()
