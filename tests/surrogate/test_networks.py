"""Every network: derivatives by hand against torch.func, what is saved, other precisions."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch

from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.architecture import Architecture, Differentiated, Network
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.reduced import AveragedNetwork, Reduced
from softtwin.surrogate.registry import TRAINED
from softtwin.surrogate.transolver import Transolver
from softtwin.surrogate.umesh import UMesh

SETTINGS: dict[str, Architecture] = {
    "reduced": Reduced(modes=6, width=24, depth=2),
    "reduced, no symmetries": Reduced(modes=6, width=24, depth=2, symmetries=False),
    "mlp": Perceptron(),
    "mlp, 20 wide, tanh": Perceptron(width=20, activation="tanh"),
    "transolver": Transolver(width=16, depth=2, heads=2, slices=4),
    "umesh": UMesh(channels=4, levels=2),
    "umesh, numbered along the long axis": UMesh(channels=4, levels=1, numbering="long"),
}


@pytest.fixture(scope="module", params=list(SETTINGS))
def objective(request: pytest.FixtureRequest, data: DataSet) -> Any:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        samples = data.samples("train")
        return SETTINGS[request.param].objective(data, samples, samples)


@pytest.fixture(scope="module")
def network(objective: Any) -> Network:
    return objective.trained()


@pytest.fixture
def point(objective: Any, data: DataSet) -> torch.Tensor:
    """The coordinates of a sample's load."""
    return torch.from_numpy(objective.encoder_decoder().encoded(data.samples("test").forces[1].ravel()))


def _drawn(*shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(3).standard_normal(shape))


def test_every_trained_architecture_is_in_this_suite() -> None:
    assert {settings.name for settings in SETTINGS.values()} == set(TRAINED)


def test_values_and_derivatives_are_those_of_torch_func(network: Network, point: torch.Tensor) -> None:
    own, expected = network.linearised(point), Differentiated(network, point)
    tangents, cotangent = _drawn(len(point), 5) * point.abs().max(), _drawn(len(own.values))
    for found, known in (
        (own.values, expected.values),
        (own.jvp(tangents), expected.jvp(tangents)),
        (own.vjp(cotangent), expected.vjp(cotangent)),
    ):
        assert known.abs().max() > 0.0
        assert (found - known).abs().max() < 1e-12 * known.abs().max()


def test_more_tangents_than_are_taken_at_once_are_pushed_one_by_one(network: Network, point: torch.Tensor) -> None:
    tangents = _drawn(len(point), 70) * point.abs().max()
    at = network.linearised(point)
    pushed = at.jvp(tangents)
    apart = torch.cat([at.jvp(tangents[:, i : i + 1]) for i in (0, 63, 64, 69)], dim=1)
    assert (pushed[:, [0, 63, 64, 69]] - apart).abs().max() < 1e-12 * pushed.abs().max()


def test_derivatives_are_those_of_differences(network: Network, point: torch.Tensor) -> None:
    tangent = _drawn(len(point), 1) * point.abs().max()
    step = 1e-6
    ahead, behind = (network((point + sign * step * tangent[:, 0])[None])[0] for sign in (1.0, -1.0))
    pushed = network.linearised(point).jvp(tangent)[:, 0]
    # the step's square, and round-off over the step
    assert ((ahead - behind) / (2.0 * step) - pushed).abs().max() < 1e-7 * pushed.abs().max()


def test_pulled_gradients_are_those_of_differences(network: Network, point: torch.Tensor) -> None:
    """Along the gradient itself, where its size is what differences say, and across it."""
    step, size = 1e-6, float(point.abs().max())
    cotangent = _drawn(len(network.linearised(point).values))
    pulled = network.linearised(point).vjp(cotangent)
    across = _drawn(len(point))
    for way in (pulled / torch.linalg.vector_norm(pulled), across / torch.linalg.vector_norm(across)):
        ahead, behind = (network((point + sign * step * size * way)[None])[0] for sign in (1.0, -1.0))
        found = float((ahead - behind) @ cotangent) / (2.0 * step * size)
        assert abs(found - float(pulled @ way)) < 1e-7 * float(torch.linalg.vector_norm(pulled))


def test_a_batch_is_its_points(network: Network, point: torch.Tensor) -> None:
    batch = torch.stack([point, -0.5 * point, 0.1 * point])
    apart = torch.stack([network.linearised(each).values for each in batch])
    assert (network(batch) - apart).abs().max() < 1e-13 * apart.abs().max()


def test_what_graphs_are_made_of_is_what_registers(network: Network, point: torch.Tensor) -> None:
    own, traced = network.linearised(point), network.traced(point)
    tangents, cotangent = _drawn(len(point), 3), _drawn(len(own.values), 1)[:, 0]
    for found, wanted in (
        (own.values, traced.values),
        (own.jvp(tangents), traced.jvp(tangents)),
        (own.vjp(cotangent), traced.vjp(cotangent)),
    ):
        assert (found - wanted).abs().max() < 1e-12 * wanted.abs().max()


def test_what_is_saved_is_the_network(request: pytest.FixtureRequest, network: Network, point: torch.Tensor) -> None:
    settings = SETTINGS[request.node.callspec.params["objective"]]
    from_state_dict = settings.from_state_dict({name: tensor.clone() for name, tensor in network.state_dict().items()})
    assert not any(weights.requires_grad for weights in from_state_dict.parameters())
    assert torch.equal(from_state_dict.linearised(point).values, network.linearised(point).values)


def test_single_precision_is_good_to_a_millionth(network: Network, point: torch.Tensor) -> None:
    tangents = _drawn(len(point), 3)
    double, single = network.linearised(point), copy.deepcopy(network).float().linearised(point.float())
    assert single.values.dtype == torch.float32
    assert (single.values - double.values).abs().max() < 3e-6 * double.values.abs().max()
    pushed = double.jvp(tangents)
    assert (single.jvp(tangents.float()) - pushed).abs().max() < 1e-5 * pushed.abs().max()


def test_what_is_trained_is_what_predicts(objective: Any, data: DataSet) -> None:
    """The linear maps around the trained network give what the network in training gives."""
    forces = data.samples("train").forces[0].ravel()
    encoder_decoder, network = objective.encoder_decoder(), objective.trained()
    values = network.linearised(torch.from_numpy(encoder_decoder.encoded(forces))).values.numpy()
    inner = encoder_decoder.decoded(values) + encoder_decoder.offset
    with torch.no_grad():
        if isinstance(network, AveragedNetwork):
            images = [
                objective.network((turn.float() @ objective.loads[0])[None])[0] @ turn.float() for turn in network.turns
            ]
            expected = encoder_decoder.decode @ torch.stack(images).mean(dim=0).double().numpy()
        else:
            expected = objective.displacement_scale * objective.network(objective.forces[:1])[0].double().numpy()
    assert np.abs(inner - expected).max() < 1e-5 * np.abs(expected).max()


def test_fields_are_what_is_predicted(objective: Any, data: DataSet) -> None:
    """In metres and newtons at all nodes; over the images of a sample, turned back, their mean is the prediction."""
    samples = data.samples("train")
    count = len(samples)
    images = torch.arange(objective.sample_count // count) * count + 2
    with torch.no_grad():
        displacements, forces = objective.fields(images)
    expected = np.zeros_like(data.body.points)
    expected[data.response.loaded] = samples.forces[2]
    surrogate = Surrogate(data.body, objective.encoder_decoder(), objective.trained(), {})
    predicted = surrogate.solve(expected).displacement
    assert np.abs(forces.numpy() - expected).max() < 1e-6 * np.abs(expected).max()
    assert np.abs(displacements.mean(dim=0).numpy() - predicted).max() < 1e-5 * np.abs(predicted).max()
