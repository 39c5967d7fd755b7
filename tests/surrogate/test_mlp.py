"""The perceptron: its activation is what was asked for, in training, in twins and in those of before."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save

from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate import twin
from softtwin.surrogate.checkpoint import CHECKPOINT, CheckpointError
from softtwin.surrogate.mlp import Activation, HiddenLayers, Perceptron
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import TwinError

FORMULAS = {
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "gelu": lambda x: 0.5 * x * (1.0 + torch.erf(torch.from_numpy(x) / 2.0**0.5).numpy()),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
}
PLAN = TrainingPlan(Perceptron(8, "tanh"), epochs=1)


@pytest.mark.parametrize("activation", get_args(Activation))
def test_the_activation_stands_after_each_layer(activation: Activation) -> None:
    network = HiddenLayers(6, activation=activation).double().requires_grad_(False)
    given = np.random.default_rng(0).standard_normal((4, 6))
    expected = FORMULAS[activation](given + network.first.bias.numpy())
    for layer in network.hidden:
        expected = FORMULAS[activation](expected @ layer.weight.numpy().T + layer.bias.numpy())
    np.testing.assert_allclose(network(torch.from_numpy(given)).numpy(), expected, rtol=1e-12, atol=1e-15)
    from_state_dict = Perceptron.from_state_dict(network.state_dict())
    assert torch.equal(from_state_dict(torch.from_numpy(given)), network(torch.from_numpy(given)))


def test_twins_that_say_none_have_relu() -> None:
    """What a twin or checkpoint of before holds: two hidden layers and a bias, no word of an activation."""
    names = {"first.bias", "hidden.0.weight", "hidden.0.bias", "hidden.1.weight", "hidden.1.bias"}
    network = HiddenLayers(6)
    assert set(network.state_dict()) == names
    assert Perceptron.from_state_dict(network.state_dict()).activation == "relu"


def test_card_checkpoint_and_twin_keep_it(data: DataSet, tmp_path: Path, forces: np.ndarray) -> None:
    surrogate = train(data, PLAN, tmp_path / "training")
    assert surrogate.card["plan"]["activation"] == "tanh"
    twin.save(surrogate, tmp_path / "twin")
    again = twin.load(tmp_path / "twin", data.body)
    assert isinstance(again.network, HiddenLayers) and again.network.activation == "tanh"
    np.testing.assert_array_equal(again.solve(forces).displacement, surrogate.solve(forces).displacement)
    with pytest.raises(CheckpointError, match=r"another plan \(differs in activation\)"):
        train(data, TrainingPlan(Perceptron(8), epochs=1), tmp_path / "training")


def test_a_checkpoint_of_before_goes_on_as_relu(data: DataSet, tmp_path: Path) -> None:
    plan = TrainingPlan(Perceptron(8), epochs=1)
    whole = train(data, plan, tmp_path)
    checkpoint = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    assert checkpoint["course"]["plan"].pop("activation") == "relu"
    torch.save(checkpoint, tmp_path / CHECKPOINT)
    again = train(data, plan, tmp_path)
    assert all(torch.equal(a, b) for a, b in zip(whole.network.parameters(), again.network.parameters(), strict=True))
    with pytest.raises(CheckpointError, match=r"another plan \(differs in activation\)"):
        train(data, PLAN, tmp_path)


def test_an_activation_of_a_newer_version_is_refused(data: DataSet, tmp_path: Path) -> None:
    twin.save(train(data, PLAN), tmp_path)
    tensors = load_file(tmp_path / twin.WEIGHTS)
    tensors["core.activation_letters"] = np.frombuffer(b"swish", dtype=np.uint8)
    weights = save(tensors)
    (tmp_path / twin.WEIGHTS).write_bytes(weights)
    card = json.loads((tmp_path / twin.CARD).read_text()) | {"weights": hashlib.sha256(weights).hexdigest()}
    (tmp_path / twin.CARD).write_text(json.dumps(card))
    with pytest.raises(TwinError, match=r"newer version.*Perceptron\.activation: expected one of .*, got 'swish'"):
        twin.load(tmp_path, data.body)
