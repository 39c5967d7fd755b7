"""`softtwin identify`, and unknowns beside the forces in `register`, as a user runs them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import chi2

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.app.cli import softtwin
from softtwin.app.config import ConfigError, parse_config
from softtwin.app.parameters import NamedParameter, ParameterError, priors_taken
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.io import read_body, write_body
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
        np.save(place / f"cloud_{number}.npy", drawn(body, moved, rng))
    return place


def drawn(body: Body, moved: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points over the whole surface of a moved body with a millimetre of noise, (1500, 3), metres."""
    triangles = body.boundary[rng.integers(len(body.boundary), size=1500)]
    weights = rng.dirichlet(np.ones(3), size=1500)
    return np.einsum("pk,pki->pi", weights, moved[triangles]) + 1e-3 * rng.standard_normal((1500, 3))


def run(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(softtwin, [str(word) for word in words])
    said = done.output + (str(done.exception) if done.exception is not None else "")
    return done.exit_code, said


def identified(folder: Path, output: Path, *words: object) -> tuple[int, str, dict]:
    code, said = run("identify", folder / "organ.toml", *words, "--output", output)
    path = output / "registration.json"
    return code, said, json.loads(path.read_text()) if path.exists() else {}


def is_explained(frame: dict, net: np.ndarray) -> bool:
    """Whether a net force, newtons, lies within what a frame says of it: 99.9 % of a normal law."""
    missed = np.array(frame["net_force_N"]) - net
    return bool(missed @ np.linalg.solve(frame["net_force_covariance_N2"], missed) < chi2.ppf(0.999, 3))


def test_stiffness_and_ratio_from_several_clouds(folder: Path, tmp_path: Path) -> None:
    clouds = [folder / f"cloud_{number}.npy" for number in range(3)]
    known = ["--gravity", 0, 0, -GRAVITY, "--known-forces", folder / "forces.npy"]
    unknown = ["--parameter", "young-modulus", "--parameter", "poisson-ratio=0.8"]
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
    assert record["options"]["parameters"] == ["young-modulus", "poisson-ratio=0.8"]


def test_what_is_not_told_is_said(folder: Path, tmp_path: Path) -> None:
    """Nothing acts, and the cloud shows the beam at rest."""
    body = read_body(folder / "body.vtu")
    chance = np.random.default_rng(0).dirichlet(np.ones(3), size=len(body.boundary))
    np.save(tmp_path / "rest.npy", np.einsum("pk,pki->pi", chance, body.points[body.boundary]))
    code, said, _ = identified(folder, tmp_path / "out", tmp_path / "rest.npy", "--parameter", "young-modulus")
    assert code == 0, said
    assert "doubtful (the cloud does not tell Young's modulus under this load" in said
    assert "not told by the cloud" in said
    assert "warning: 1 of them are doubtful, and so is what follows: the cloud does not tell Young's modulus" in said


def test_forces_and_stiffness_together_carry_the_prior(folder: Path, tmp_path: Path) -> None:
    words = ["--model", "reference", "--parameter", "young-modulus=0.3", "--gravity", 0, 0, -GRAVITY]
    code, said = run("register", folder / "organ.toml", folder / "cloud_0.npy", *words, "--output", tmp_path)
    assert code == 0, said
    frame = json.loads((tmp_path / "registration.json").read_text())["frames"][0]
    assert frame["verdict"] == "accepted"
    net = np.load(folder / "forces.npy").sum(axis=0)
    assert is_explained(frame, net)  # and not with the weight, which is many times as much and known
    assert 20.0 * np.linalg.norm(net) < 1060.0 * GRAVITY * 0.0625
    (modulus,) = frame["estimates"]
    assert modulus["interval"][0] < TRUE_MODULUS < modulus["interval"][1]
    assert len(frame["net_force_over_modulus_m2"]) == 3
    assert "Young's modulus" in said and "taken" not in said


def test_forces_and_stiffness_without_a_prior_say_which_was_taken(folder: Path, tmp_path: Path) -> None:
    words = ["--model", "reference", "--parameter", "young-modulus", "--output", tmp_path]
    code, said = run("register", folder / "organ.toml", folder / "cloud_0.npy", *words)
    assert code == 0, said
    first = said.splitlines()[0]
    assert first == "young-modulus: prior of ±50 % taken, and forces are known no better; say young-modulus=DEVIATION"
    (frame,) = json.loads((tmp_path / "registration.json").read_text())["frames"]
    force, doubt = frame["net_force_N"], frame["net_force_deviation_N"]
    low, high = frame["estimates"][0]["interval"]
    relative = np.log(high / low) / (2.0 * 1.645)  # standard deviation of the modulus' logarithm
    assert relative > 0.1  # little is known of it
    assert np.linalg.norm(doubt) > 0.9 * relative * np.linalg.norm(force)  # and newtons are worth no more
    assert priors_taken(("young-modulus=0.5", "poisson-ratio")) == []
    assert "young-modulus@tumour: prior of" in priors_taken(("young-modulus@tumour",))[0]


def test_a_pull_is_found_under_pneumoperitoneum(folder: Path, tmp_path: Path) -> None:
    """12 mmHg follow the surface and move it by 27 mm: known, they leave the pull; unsaid, they are taken for one."""
    body, net = read_body(folder / "body.vtu"), np.array([0.0, 0.1, -0.2])
    tip, forces = body.node_sets["tip"], np.zeros_like(body.points)
    forces[tip] = net / len(tip)
    with Problem(body, NeoHookean(5500.0, 0.45)) as problem:
        moved = body.points + problem.solve(Loading(forces, pressure={"boundary": 1600.0})).displacement
    np.save(tmp_path / "cloud.npy", drawn(body, moved, np.random.default_rng(5)))
    frames = []
    for words in (["--pressure", 1600.0], []):
        given = [folder / "organ.toml", tmp_path / "cloud.npy", "--zone", "tip", "--model", "reference", *words]
        code, said = run("register", *given, "--pose", "fixed", "--output", tmp_path / "out")
        assert code == 0, said
        frames += json.loads((tmp_path / "out" / "registration.json").read_text())["frames"]
    known, silent = frames
    assert known["verdict"] == "accepted" and is_explained(known, net)
    assert np.linalg.norm(known["net_force_deviation_N"]) < 0.3 * np.linalg.norm(net)
    assert silent["verdict"] != "accepted" or not is_explained(silent, net)


@pytest.mark.parametrize("command", ["identify", "register"])
def test_a_stiff_structure_on_the_command_line(folder: Path, tmp_path: Path, command: str) -> None:
    """A third of the beam is three times as stiff, under its weight: both moduli are found, each by its name."""
    body, middle, half = read_body(folder / "body.vtu"), np.array([0.7, 0.125, 0.125]), np.array([0.17, 0.2, 0.2])
    (tmp_path / "organ.toml").write_text((folder / "organ.toml").read_text())
    write_body(tmp_path / "body.vtu", replace(body, inner={"tumour": box(middle, half)}))
    inside = (np.abs(body.points[body.cells].mean(axis=1) - middle) < half).all(axis=1)
    with Problem(body, NeoHookean(np.where(inside, 16500.0, 5500.0), 0.45)) as problem:
        moved = body.points + problem.solve(Loading(body_force=[0.0, 0.0, -1060.0 * GRAVITY])).displacement
    np.save(tmp_path / "cloud.npy", drawn(body, moved, np.random.default_rng(5)))
    words = ["--parameter", "young-modulus=0.3", "--parameter", "young-modulus@tumour=1", "--gravity", 0, 0, -GRAVITY]
    words += ["--model", "reference"] if command == "register" else []
    code, said = run(command, tmp_path / "organ.toml", tmp_path / "cloud.npy", *words, "--output", tmp_path / "out")
    assert code == 0, said
    (frame,) = json.loads((tmp_path / "out" / "registration.json").read_text())["frames"]
    rest, tumour = frame["estimates"]
    assert tumour["name"] == "Young's modulus of tumour" and "Young's modulus of tumour" in said
    assert rest["interval"][0] < 5500.0 < rest["interval"][1]
    assert tumour["interval"][0] < 16500.0 < tumour["interval"][1]
    if command == "identify":  # where the load is known, it is told from the rest's
        assert tumour["interval"][0] > rest["interval"][1] and tumour["variance_reduction"] > 0.5


def box(middle: np.ndarray, half: np.ndarray) -> Surface:
    """A closed surface of twelve triangles, outward."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [each for a, b, c, d in sides for each in ((a, b, c), (a, c, d))]
    return Surface(middle + half * signs, np.array(triangles))


def test_one_contact(folder: Path, tmp_path: Path) -> None:
    words = ["--model", "reference", "--parameter", "contact=0.05"]
    code, said = run("register", folder / "organ.toml", folder / "cloud_0.npy", *words, "--output", tmp_path)
    assert code == 0, said
    frame = json.loads((tmp_path / "registration.json").read_text())["frames"][0]
    assert [estimate["unit"] for estimate in frame["estimates"]] == ["m"] * 3 + ["N"] * 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--parameter", "elasticity"], "expected young-modulus, young-modulus@STRUCTURE"),
        (["--parameter", "poisson-ratio=-1"], "expected a positive number behind ="),
        (["--parameter", "poisson-ratio@tumour"], "expected poisson-ratio, got"),
        (["--parameter", "moved"], "expected moved@NODES, got"),
        (["--parameter", "moved@grip"], "expected moved@ one of"),
        (["--parameter", "young-modulus@tumour"], "expected an inner surface among"),
        (["--parameter", "young-modulus", "--parameter", "young-modulus=0.2"], "expected each input once"),
        (["--parameter", "contact"], "expected at least one"),
        (["--parameter", "young-modulus", "--known-forces", "cloud_0.npy"], r"expected finite numbers of shape"),
    ],
)
def test_bad_unknowns(folder: Path, tmp_path: Path, words: list[str], message: str) -> None:
    given = [folder / word if word.endswith(".npy") else word for word in words]
    code, said, record = identified(folder, tmp_path / "out", folder / "cloud_0.npy", *given)
    assert code != 0
    assert message in said
    assert not record


def test_a_network_takes_no_other_stiffness() -> None:
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference or hybrid or torch with"):
        parse_config({"registration": {"parameters": ["young-modulus"]}})
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference with these parameters"):
        parse_config({"registration": {"model": "hybrid", "gravity": [0.0, 0.0, -9.81]}})
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference or hybrid or torch with"):
        parse_config({"registration": {"known_forces": "forces.npy"}})
    with pytest.raises(ConfigError, match=r"registration\.model: expected reference with these parameters"):
        known = {"parameters": ["young-modulus"], "forces": "known"}  # nothing is left for a network to find
        parse_config({"registration": {"model": "hybrid", **known}})
    parse_config({"registration": {"parameters": ["contact"]}})
    parse_config({"registration": {"model": "hybrid", "known_forces": "forces.npy"}})


@pytest.mark.parametrize("text", ["young-modulus@", "=3", "moved@a=b", "contact=nan"])
def test_words_that_are_none(text: str) -> None:
    with pytest.raises(ParameterError):
        NamedParameter.parse(text)
