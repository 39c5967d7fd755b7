"""The small twin that comes with the package is small, whole, and what its script makes."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.config import read_config
from softtwin.app.quickstart import unseen_load
from softtwin.app.twin import Twin, forward_models
from softtwin.meshes.io import read_body
from softtwin.meshes.shapes import liver_phantom
from softtwin.surrogate.low_rank import compressed
from softtwin.surrogate.twin import load, save

ROOT = Path(__file__).parents[2]
PHANTOM = ROOT / "app" / "twins" / "phantom"
SINGLE = 2.0**-23  # what a number of single precision is good to


@pytest.fixture(scope="module")
def maker() -> Any:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    found = importlib.util.spec_from_file_location("make_phantom", ROOT / "ci" / "make_phantom.py")
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def test_it_is_small_and_names_no_machine() -> None:
    files = sorted(PHANTOM.iterdir())
    assert sum(file.stat().st_size for file in files) <= 500_000
    for file in files:
        if file.suffix in (".json", ".toml"):
            assert "/home" not in file.read_text() and "/tmp" not in file.read_text()


def test_it_is_calibrated_and_has_held_out_errors() -> None:
    card = json.loads((PHANTOM / "surrogate.json").read_text())
    assert card["certificate"]["held_out"]["kept"]["largest"] >= card["certificate"]["confidence"] - 0.1
    assert 0.0 < card["held_out"]["nodal_error"]["mean"] < 5e-4
    assert card["held_out"]["split"] == "test" and card["held_out"]["samples"] == 32


def test_its_body_and_configuration_are_those_of_the_script(maker: Any) -> None:
    body = read_body(PHANTOM / "body.vtu")
    made = liver_phantom(maker.CONFIG["body"]["cell_size"])
    assert read_config(PHANTOM / "organ.toml")[0] == maker.config()
    assert body.fingerprint == made.fingerprint
    for name, surface in maker.light(made).inner.items():
        assert np.array_equal(body.inner[name].triangles, surface.triangles)
        assert np.allclose(body.inner[name].points, surface.points, atol=1e-9)
    assert {file.name for file in PHANTOM.iterdir()} == set(maker.FILES)


def test_its_true_states_are_equilibria_of_the_reference(maker: Any) -> None:
    body, (config, _) = read_body(PHANTOM / "body.vtu"), read_config(PHANTOM / "organ.toml")
    with np.load(PHANTOM / "truth.npz") as truth, forward_models("reference", PHANTOM, body, config) as (model, _):
        pull, _ = unseen_load(body, model, config.loads.displacement)
        push = maker._push(body, model)
        for number in (0, 5, 12):
            angle = 2 * np.pi * number / maker.STATES
            forces = 0.5 * (1 - np.cos(angle)) * pull + 0.5 * (1 - np.cos(2 * angle)) * push
            moved = (truth["modes"] @ truth["coefficients"][number]).reshape(-1, 3)
            # Modes that were left out, single precision, and Newton's tolerance: a hundredth of a millimetre.
            assert np.abs(model.solve(forces).displacement - moved).max() < 1e-5
            assert np.allclose(truth["net_forces"][number], forces.sum(axis=0), atol=1e-4)


def test_the_certificate_holds_against_the_reference_on_a_load_of_its_own_kind(maker: Any) -> None:
    with Twin.open(PHANTOM) as twin:
        modes = twin.model.encoder_decoder.load_modes  # type: ignore[attr-defined]
        forces = np.zeros_like(twin.body.points)
        forces[twin.model.encoder_decoder.loaded] = 0.5 * modes[:, 0].reshape(-1, 3)  # type: ignore[attr-defined]
        found, known = twin.predict(forces).displacement, twin.bound_error(forces)
        with forward_models("reference", PHANTOM, twin.body, twin.config) as (model, _):
            truth = model.solve(forces).displacement
    error = np.linalg.norm(found - truth, axis=1).max()
    assert known.is_inside
    assert error < 3.0 * known.largest  # a bound that nine of ten loads keep; thrice it is no chance


def test_compacting_and_single_precision_change_what_is_predicted_by_no_more_than_they_say(tmp_path: Path) -> None:
    body = read_body(PHANTOM / "body.vtu")
    whole = load(PHANTOM, body)
    forces = np.zeros_like(body.points)
    forces[whole.encoder_decoder.loaded] = whole.encoder_decoder.load_modes[:, 1].reshape(-1, 3)  # type: ignore[index]
    truth = whole.solve(forces).displacement
    same = compressed(whole, rank=whole.encoder_decoder.left.shape[1], load_modes=12)
    assert "certificate" not in same.card and same.discrepancy is None
    size = np.abs(truth).max()
    assert np.abs(same.solve(forces).displacement - truth).max() < 100 * SINGLE * size
    save(same, tmp_path, single=True)
    again = load(tmp_path, body)
    assert np.array_equal(again.solve(forces).displacement, same.solve(forces).displacement)  # stored without loss
    fewer = compressed(whole, rank=6, load_modes=3)
    assert fewer.encoder_decoder.left.shape[1] == 6
    assert 100 * SINGLE * size < np.abs(fewer.solve(forces).displacement - truth).max() < size
    total = np.square(whole.encoder_decoder.load_modes).sum() + whole.encoder_decoder.load_rest[0] * len(
        whole.encoder_decoder.load_modes
    )  # type: ignore[arg-type,index]
    kept = np.square(fewer.encoder_decoder.load_modes).sum() + fewer.encoder_decoder.load_rest[0] * len(
        fewer.encoder_decoder.load_modes
    )  # type: ignore[arg-type,index]
    assert kept == pytest.approx(total, rel=1e-5)  # what is not kept as a direction is spread
    with pytest.raises(ValueError, match=r"compacted.rank: expected at least 1"):
        compressed(whole, 0, 1)
