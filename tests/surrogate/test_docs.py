"""The code in docs/surrogates.md runs as it stands, and what it says of the configuration is so."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softtwin.app.config import parse_config
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.registry import ARCHITECTURES

TEXT = (Path(__file__).parents[2] / "docs" / "surrogates.md").read_text()


def test_the_guide_runs(data: DataSet, closed_form: Any, tmp_path: Path, capsys, monkeypatch) -> None:
    known = {"material": "neo-hookean", "young_modulus": 20.0, "poisson_ratio": 0.4, "loads": {"kind": "modal"}}
    plan = {**data.header["plan"], **known}
    monkeypatch.setitem(data.header, "plan", plan)
    forces = np.zeros((30, *data.body.points.shape))
    forces[:, data.response.loaded] = np.resize(data.samples("train").forces, (30, len(data.response.loaded), 3))
    moved = np.stack([closed_form.solve(one) for one in forces])
    names: dict[str, Any] = {
        "data": data,
        "folder": tmp_path,
        "forces": forces[0],
        "simulated_forces": forces,
        "simulated_displacements": 1e3 * moved,
    }
    blocks = re.findall(r"```python\n(.*?)```", TEXT, flags=re.S)
    assert len(blocks) == 4
    for block in blocks:
        exec(compile(block, "docs/surrogates.md", "exec"), names)
    assert "accepted test samples averaged" in capsys.readouterr().out
    np.testing.assert_array_equal(names["again"].solve(forces[0]).displacement, names["state"].displacement)
    exact = names["again"].solve(forces[0]).displacement
    for found in (names["single"], names["both"][0]):
        np.testing.assert_allclose(found, exact, rtol=0.0, atol=1e-6 * np.abs(exact).max())
    assert names["jacobian"].shape == (exact.size, 8)
    assert len(names["mine"].samples("train")) == 24


def test_the_configurations_are_such() -> None:
    varied, training, smooth, rounds, spread = (
        parse_config(tomllib.loads(b)) for b in re.findall(r"```toml\n(.*?)```", TEXT, flags=re.S)
    )
    assert varied.training.vary["poisson-ratio"] == (0.40, 0.49)
    assert training.training.physics == {"energy": 0.1}
    assert smooth.samples.smooth == 64
    assert (rounds.samples.rounds, rounds.samples.chosen, rounds.samples.candidates) == (6, 256, 16)
    assert spread.loads.sequence == "sobol"


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_every_architecture_is_in_the_guide(name: str) -> None:
    assert f"`{ARCHITECTURES[name].__name__}`" in TEXT and (name == "reduced" or f"`{name}`" in TEXT)
