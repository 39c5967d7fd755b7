"""What [training] asks for: every architecture and its settings, refused by name before anything is made."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.chain import make_twin
from softtwin.app.config import Config, ConfigError, parse_config, to_toml
from softtwin.app.stages.plan import training_plan
from softtwin.app.workspace import Workspace
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.physics import Physics
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.registry import ARCHITECTURES
from softtwin.surrogate.umesh import UMesh


def plan(**training: object) -> TrainingPlan:
    return training_plan(parse_config({"training": training}).training)


def test_every_architecture_can_be_asked_for() -> None:
    for name, kind in ARCHITECTURES.items():
        assert type(plan(architecture=name).architecture) is kind


def test_settings_and_physics_reach_the_plan() -> None:
    assert plan().physics is None and plan().architecture == Reduced()
    assert plan(modes=32, width=128, settings={"depth": 2, "symmetries": False}).architecture == Reduced(
        32, 128, 2, symmetries=False
    )
    assert plan(architecture="mlp", settings={"width": 1500}).architecture == Perceptron(1500)
    smooth = plan(architecture="mlp", settings={"width": 20, "activation": "silu"})
    assert smooth.architecture == Perceptron(20, "silu")
    grid = plan(architecture="umesh", settings={"channels": 16, "numbering": "long"}, physics={"energy": 0.5})
    assert grid.architecture == UMesh(16, numbering="long") and grid.physics == Physics(energy=0.5)


def test_a_gpu_that_is_not_there_is_refused_before_anything_is_made(tmp_path: Path, monkeypatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"TrainingPlan\.device: expected a GPU that torch can use, found none"):
        make_twin(Workspace(Config(), tmp_path), tmp_path / "organ.toml", print, device="cuda")
    assert list(tmp_path.iterdir()) == []


def test_they_survive_the_configuration_file(tmp_path: Path) -> None:
    training = {"architecture": "umesh", "settings": {"channels": 8, "numbering": "long"}, "physics": {"residual": 0.5}}
    config = parse_config({"training": training})
    (tmp_path / "organ.toml").write_text(to_toml(config))
    import tomllib

    assert parse_config(tomllib.loads((tmp_path / "organ.toml").read_text())) == config


@pytest.mark.parametrize(
    ("training", "message"),
    [
        (
            {"settings": {"chanels": 3}},
            r"training\.settings: expected names among modes, width, depth, .*, got chanels",
        ),
        ({"settings": {"depth": 0}}, r"training\.settings: Reduced\.depth: expected at least 1, got 0"),
        ({"settings": {"depth": "two"}}, r"training\.settings: "),
        (
            {"architecture": "mlp", "settings": {"activation": "swish"}},
            r"training\.settings: Perceptron\.activation: expected one of relu, tanh, gelu, silu, got 'swish'",
        ),
        ({"physics": {"work": 1.0}}, r"training\.physics: expected names among energy, residual, data, got work"),
        ({"physics": {"data": 0.0}}, r"training\.physics: Physics: expected a positive weight"),
    ],
)
def test_what_no_architecture_has_is_refused_before_anything_is_made(
    training: dict[str, object], message: str, tmp_path: Path
) -> None:
    config: Config = parse_config({"training": training})
    with pytest.raises(ConfigError, match=message):
        make_twin(Workspace(config, tmp_path), tmp_path / "organ.toml", print)
    assert list(tmp_path.iterdir()) == []
