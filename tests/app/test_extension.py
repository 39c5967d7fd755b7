"""A parameter of one's own, asked for by a word: one line of a table, and command, record and report know of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import softtwin.app
from softtwin.app.config import RegistrationSection
from softtwin.app.parameters import KINDS, Kind
from softtwin.app.twin import Twin
from softtwin.meshes.clouds import partial_view
from softtwin.registration.parameters.block import Estimate, FieldBlock, estimate
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import run

Floats = NDArray[np.float64]
PHANTOM = Path(softtwin.app.__file__).parent / "twins" / "phantom"
TRUE_GROWTH = 0.02


class Growth(FieldBlock):
    """The organ has grown about its middle since it was segmented, all of it alike."""

    def __init__(self, observed: SurfaceDistance, deviation: float) -> None:
        points = observed.body.points
        super().__init__((points - points.mean(axis=0)).reshape(-1, 1), observed, deviation)

    def estimates(self, mean: Floats, covariance: Floats) -> tuple[Estimate, ...]:
        return (estimate("growth", "", lambda c: self.amplitude * c, float(mean[0]), float(covariance[0, 0])),)


@pytest.fixture
def _known(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = Kind("growth (of all the organ)", block=lambda observed, _, number: Growth(observed, number or 0.05))
    monkeypatch.setitem(KINDS, "growth", kind)


@pytest.mark.usefixtures("_known")
def test_a_new_word_registers_and_is_said_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Twin.open(PHANTOM) as twin:
        body = twin.body
    grown = TRUE_GROWTH * (body.points - body.points.mean(axis=0))
    cloud = partial_view(body, grown, (0.1, -0.8, 0.5), 800, 3e-4, np.random.default_rng(0), surface="observed")
    np.save(tmp_path / "cloud.npy", cloud)
    out = tmp_path / "out"
    words = ["--parameter", "growth=0.05", "--pose", "fixed", "--output", out]
    said = run(capsys, "register", PHANTOM, tmp_path / "cloud.npy", *words)
    (frame,) = json.loads((out / "registration.json").read_text())["frames"]
    (growth,) = frame["estimates"]
    assert growth["name"] == "growth" and growth["interval"][0] < TRUE_GROWTH < growth["interval"][1]
    assert growth["value"] == pytest.approx(TRUE_GROWTH, abs=0.01)
    (check,) = (each for each in frame["checks"] if each["code"] == "parameter")
    assert check["subject"] == "growth" and check["verdict"] == "accepted"
    assert "growth 0.0" in said  # the report shows the same words: see `describe_estimate`


@pytest.mark.usefixtures("_known")
def test_a_new_word_is_checked_as_all_are() -> None:
    assert RegistrationSection(parameters=["growth"]).model == "surrogate"  # it is no input that a network would know
    with pytest.raises(ValueError, match=r"expected growth, got 'growth@liver'"):
        RegistrationSection(parameters=["growth@liver"])
    with pytest.raises(ValueError, match=r"expected young-modulus, .* or growth \(of all the organ\)"):
        RegistrationSection(parameters=["shrinkage"])
