"""A twin that learns nothing, of the small quickstart: made, validated, registered, its tissue unknown."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from click.testing import CliRunner

from softtwin.app.cli import softtwin
from softtwin.app.config import ConfigError, parse_config
from softtwin.app.quickstart import CAMERA, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Problem
from softtwin.registration.verdict import Verdict

pytestmark = pytest.mark.fenicsx
VARY = '{ poisson-ratio = [0.38, 0.48], "young-modulus@tumour" = [5000.0, 40000.0] }'


@pytest.fixture(scope="module")
def folder(small_quickstart: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small quickstart's equilibria, learned from by the Galerkin model."""
    place = tmp_path_factory.mktemp("galerkin") / "out"
    shutil.copytree(small_quickstart, place)
    text = (place / "organ.toml").read_text()
    text = re.sub(r'^architecture = "reduced"', 'architecture = "galerkin"', text, flags=re.M)
    text = re.sub(r"^vary = \{\}", f"vary = {VARY}", text, flags=re.M)
    (place / "organ.toml").write_text(text)
    for words in (["train", str(place / "organ.toml"), "--fresh"], ["validate", str(place / "organ.toml")]):
        done = CliRunner().invoke(softtwin, words)
        assert done.exit_code == 0, done.output
    return place


def test_it_is_nearer_than_the_network(folder: Path, small_quickstart: Path) -> None:
    cards = [json.loads((place / "twin" / "surrogate.json").read_text()) for place in (folder, small_quickstart)]
    ours, network = (card["held_out"]["relative_error"] for card in cards)
    assert ours["median"] < 0.01 and ours["median"] < 0.5 * network["median"] and ours["p95"] < network["p95"]
    assert cards[0]["plan"]["vary"]["poisson-ratio"] == [0.38, 0.48]


def test_it_registers_a_tissue_that_is_unknown_as_exact_states_do(folder: Path) -> None:
    """Of another Poisson's ratio and a stiffer tumour: what torch finds, the surrogate finds."""
    with Twin.open(folder) as twin:
        body = twin.body
    modulus = np.full(len(body.cells), 5000.0)
    from softtwin.meshes.signed import cells_inside

    modulus[cells_inside(body, "tumour")] = 20000.0
    with np.load(folder / "demo" / "reference.npz") as arrays:
        load = arrays["true_forces"]
    with Problem(body, NeoHookean(modulus, 0.41)) as problem:
        truth = problem.solve(load).displacement
    cloud = partial_view(body, truth, CAMERA, POINTS, 5e-4, np.random.default_rng(0), surface="observed")
    unknown = ("poisson-ratio=0.7", "young-modulus@tumour=0.7")
    found = {}
    for model in ("surrogate", "torch"):
        with Twin.open(folder, model, parameters=unknown) as twin:
            found[model] = twin.register(cloud, "")
    ours, exact = found["surrogate"], found["torch"]
    assert ours.judgement.verdict is Verdict.ACCEPTED, ours.judgement.reasons
    for mine, theirs in zip(ours.estimates, exact.estimates, strict=True):
        wide = theirs.interval[1] - theirs.interval[0]
        assert mine.name == theirs.name and abs(mine.value - theirs.value) < 0.15 * wide
        assert mine.interval[1] - mine.interval[0] == pytest.approx(wide, rel=0.25)
    missed = nodal_distances(ours.displacement, truth).mean()
    assert missed < 1.3 * nodal_distances(exact.displacement, truth).mean() + 5e-5


def test_a_parameter_without_a_range_is_refused(folder: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"training\.vary: poisson-ratio, young-modulus@tumour\), got young-modulus@ves"
    ):
        Twin.open(folder, "surrogate", parameters=("young-modulus@vessel_portal",))
    with pytest.raises(ConfigError, match=r"expected architecture galerkin beside it, got reduced"):
        parse_config({"training": {"vary": {"poisson-ratio": [0.4, 0.45]}}, "body": {"source": "liver-phantom"}}, "x")
    with pytest.raises(ConfigError, match=r"samples\.rounds: expected 0 with architecture galerkin"):
        given = {
            "training": {"architecture": "galerkin"},
            "samples": {"rounds": 2},
            "body": {"source": "liver-phantom"},
        }
        parse_config(given, "x")
    with pytest.raises(ConfigError, match="two growing positive numbers for poisson-ratio"):
        from softtwin.app.stages.plan import training_plan

        given = {"architecture": "galerkin", "vary": {"poisson-ratio": [0.45, 0.4]}}
        training_plan(parse_config({"training": given, "body": {"source": "liver-phantom"}}, "x").training)


def test_samples_are_few_where_nothing_is_learned() -> None:
    from softtwin.app.config import default_samples

    assert default_samples("galerkin") < 0.1 * default_samples("reduced")
