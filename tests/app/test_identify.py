"""`softtwin identify`, and unknowns beside the forces in `register`, as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.app.cli import softtwin
from softtwin.app.config import ConfigError, parse_config
from softtwin.app.unknowns import Unknown, UnknownError, priors_taken
from softtwin.meshes.files import read_body
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Loading, Problem

pytestmark = pytest.mark.fenicsx
TRUE_MODULUS, TRUE_RATIO, GRAVITY = 4000.0, 0.42, 0.04


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A beam with clouds of it under a known part of its weight."""
    place = tmp_path_factory.mktemp("identify")
    (place / "organ.toml").write_text('folder = "."\n[body]\nsource = "beam"\n[material]\nyoung_modulus = 5500.0\n')
    done = CliRunner().invoke(softtwin, ["mesh", str(place / "organ.toml")], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    body, rng = read_body(place / "body.vtu"), np.random.default_rng(3)
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"], 1] = 0.001
    np.save(place / "forces.npy", forces)
    with Problem(body, NeoHookean(TRUE_MODULUS, TRUE_RATIO)) as problem:
        load = Loading(forces, body_force=[0.0, 0.0, -1060.0 * GRAVITY])
        moved = body.points + problem.solve(load).displacement
    for number in range(3):
        triangles = body.boundary[rng.integers(len(body.boundary), size=1500)]
        weights = rng.dirichlet(np.ones(3), size=1500)
        points = np.einsum("pk,pki->pi", weights, moved[triangles]) + 1e-3 * rng.standard_normal((1500, 3))
        np.save(place / f"cloud_{number}.npy", points)
    return place


def run(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(softtwin, [str(word) for word in words])
    said = done.output + (str(done.exception) if done.exception is not None else "")
    return done.exit_code, said


def identified(folder: Path, output: Path, *words: object) -> tuple[int, str, dict]:
    code, said = run("identify", folder / "organ.toml", *words, "--output", output)
    path = output / "registration.json"
    return code, said, json.loads(path.read_text()) if path.exists() else {}


def test_stiffness_and_ratio_from_several_clouds(folder: Path, tmp_path: Path) -> None:
    clouds = [folder / f"cloud_{number}.npy" for number in range(3)]
    known = ["--gravity", 0, 0, -GRAVITY, "--known-forces", folder / "forces.npy"]
    unknown = ["--unknown", "young-modulus", "--unknown", "poisson-ratio=0.8"]
    code, said, record = identified(folder, tmp_path, *clouds, *known, *unknown)
    assert code == 0, said
    assert "of 3 clouds 3 could be used" in said
    assert "net force" not in said and "taken" not in said
    modulus, ratio = record["together"]
    for estimate, truth in ((modulus, TRUE_MODULUS), (ratio, TRUE_RATIO)):
        low, high = estimate["interval"]
        middle, reach = estimate["value"], 2.5 * (high - low) / 3.29  # 4 deviations would let a wrong one pass
        assert abs(middle - truth) < 1.5 * reach
        widths = [np.ptp(frame["estimates"][0 if estimate is modulus else 1]["interval"]) for frame in record["frames"]]
        assert high - low == pytest.approx(np.mean(widths) / np.sqrt(3.0), rel=0.1)
    assert modulus["name"] == "Young's modulus"
    assert record["options"]["unknowns"] == ["young-modulus", "poisson-ratio=0.8"]


def test_what_is_not_told_is_said(folder: Path, tmp_path: Path) -> None:
    """Nothing acts, and the cloud shows the beam at rest."""
    body = read_body(folder / "body.vtu")
    chance = np.random.default_rng(0).dirichlet(np.ones(3), size=len(body.boundary))
    np.save(tmp_path / "rest.npy", np.einsum("pk,pki->pi", chance, body.points[body.boundary]))
    code, said, _ = identified(folder, tmp_path / "out", tmp_path / "rest.npy", "--unknown", "young-modulus")
    assert code == 0, said
    assert "doubtful (the cloud does not tell Young's modulus under this load" in said
    assert "not told by the cloud" in said


def test_forces_and_stiffness_together_carry_the_prior(folder: Path, tmp_path: Path) -> None:
    words = ["--engine", "reference", "--unknown", "young-modulus=0.3", "--gravity", 0, 0, -GRAVITY]
    code, said = run("register", folder / "organ.toml", folder / "cloud_0.npy", *words, "--output", tmp_path)
    assert code == 0, said
    frame = json.loads((tmp_path / "registration.json").read_text())["frames"][0]
    assert frame["verdict"] == "accepted"
    (modulus,) = frame["estimates"]
    assert modulus["interval"][0] < TRUE_MODULUS < modulus["interval"][1]
    assert len(frame["net_force_over_modulus_m2"]) == 3
    assert "Young's modulus" in said and "taken" not in said


def test_forces_and_stiffness_without_a_prior_say_which_was_taken(folder: Path, tmp_path: Path) -> None:
    words = ["--engine", "reference", "--unknown", "young-modulus", "--output", tmp_path]
    code, said = run("register", folder / "organ.toml", folder / "cloud_0.npy", *words)
    assert code == 0, said
    first = said.splitlines()[0]
    assert first == "young-modulus: prior of ±50 % taken, and forces are known no better; say young-modulus=DEVIATION"
    (frame,) = json.loads((tmp_path / "registration.json").read_text())["frames"]
    force, doubt = frame["net_force_N"], frame["net_force_deviation_N"]
    assert np.linalg.norm(doubt) > 0.3 * np.linalg.norm(force)  # newtons are worth that prior
    assert priors_taken(("young-modulus=0.5", "poisson-ratio")) == []
    assert "young-modulus@tumour: prior of" in priors_taken(("young-modulus@tumour",))[0]


def test_one_contact(folder: Path, tmp_path: Path) -> None:
    words = ["--engine", "reference", "--unknown", "contact=0.05"]
    code, said = run("register", folder / "organ.toml", folder / "cloud_0.npy", *words, "--output", tmp_path)
    assert code == 0, said
    frame = json.loads((tmp_path / "registration.json").read_text())["frames"][0]
    assert [estimate["unit"] for estimate in frame["estimates"]] == ["m"] * 3 + ["N"] * 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--unknown", "elasticity"], "expected young-modulus, young-modulus@STRUCTURE"),
        (["--unknown", "poisson-ratio=-1"], "expected a positive number behind ="),
        (["--unknown", "poisson-ratio@tumour"], "expected poisson-ratio, got"),
        (["--unknown", "moved"], "expected moved@NODES, got"),
        (["--unknown", "moved@grip"], "expected moved@ one of"),
        (["--unknown", "young-modulus@tumour"], "expected an inner surface among"),
        (["--unknown", "young-modulus", "--unknown", "young-modulus=0.2"], "expected each unknown once"),
        (["--unknown", "contact"], "expected at least one"),
        (["--unknown", "young-modulus", "--known-forces", "cloud_0.npy"], r"expected finite numbers of shape"),
    ],
)
def test_bad_unknowns(folder: Path, tmp_path: Path, words: list[str], message: str) -> None:
    given = [folder / word if word.endswith(".npy") else word for word in words]
    code, said, record = identified(folder, tmp_path / "out", folder / "cloud_0.npy", *given)
    assert code != 0
    assert message in said
    assert not record


def test_a_network_takes_no_other_stiffness() -> None:
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference or hybrid with these unknowns"):
        parse_config({"registration": {"unknowns": ["young-modulus"]}})
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference with these unknowns"):
        parse_config({"registration": {"model": "hybrid", "gravity": [0.0, 0.0, -9.81]}})
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference or hybrid with these unknowns"):
        parse_config({"registration": {"known_forces": "forces.npy"}})
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference with these unknowns"):
        known = {"unknowns": ["young-modulus"], "forces": "known"}  # nothing is left for a network to find
        parse_config({"registration": {"model": "hybrid", **known}})
    parse_config({"registration": {"unknowns": ["contact"]}})
    parse_config({"registration": {"model": "hybrid", "known_forces": "forces.npy"}})


@pytest.mark.parametrize("text", ["young-modulus@", "=3", "moved@a=b", "contact=nan"])
def test_words_that_are_none(text: str) -> None:
    with pytest.raises(UnknownError):
        Unknown.parse(text)
