"""The thesis's multilayer perceptron, the yardstick: four layers as wide as the displacement, mean squared error."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, Samples

from .architecture import Network
from .encoder_decoder import LinearEncoderDecoder, no_response
from .standardised import StandardisedObjective

Floats = NDArray[np.float64]
Activation = Literal["relu", "tanh", "gelu", "silu"]

_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": torch.relu,
    "tanh": torch.tanh,
    "gelu": nn.functional.gelu,
    "silu": nn.functional.silu,
}
_LETTERS = "activation_letters"  # name of a tensor


@dataclass(frozen=True)
class Perceptron:
    """The perceptron's settings (Odot 2023, section 4.2.1, which states neither width nor activation).

    Args:
        width: width of the first and of the two hidden layers; None for that of the displacement, 3n.
        activation: after each of these layers; ReLU unless said, since the thesis recommends it (section 3.2).

    Raises:
        ValueError: an argument out of its range.
    """

    width: int | None = None
    activation: Activation = "relu"

    name: ClassVar[str] = "mlp"
    rate: ClassVar[float] = 1e-3
    batch: ClassVar[int] = 50

    def __post_init__(self) -> None:
        if self.width is not None and self.width < 1:
            raise ValueError(f"Perceptron.width: expected at least 1, got {self.width}.")
        if self.activation not in get_args(Activation):
            known = ", ".join(get_args(Activation))
            raise ValueError(f"Perceptron.activation: expected one of {known}, got {self.activation!r}.")

    def check(self, body: Body) -> None:
        """Any body will do."""

    def objective(self, data: DataSet, train: Samples, validation: Samples) -> PerceptronObjective:
        """A `TrainingObjective` with fresh weights."""
        return PerceptronObjective(data, train, validation, self)

    def optimizer(self, network: nn.Module, rate: float) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(network.parameters(), lr=rate, fused=True)

    @staticmethod
    def from_state_dict(tensors: Mapping[str, Tensor]) -> HiddenLayers:
        """The predicting network from what its `state_dict` was.

        Raises:
            ValueError: an activation that this version does not know.
        """
        bias = tensors["first.bias"]
        depth = sum(name.startswith("hidden") and name.endswith("bias") for name in tensors)
        settings = Perceptron(len(bias), _activation_in(tensors))
        network = HiddenLayers(len(bias), depth, activation=settings.activation).to(bias)
        network.load_state_dict(dict(tensors))
        return network.requires_grad_(False)


class Bias(nn.Module):
    """Adds a vector; drawn as that of a linear layer is.

    Args:
        inputs: of the layer that it belongs to.
        outputs: length of the vector.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.empty(outputs).uniform_(-(inputs**-0.5), inputs**-0.5))

    def forward(self, values: Tensor) -> Tensor:
        """The values, (s, outputs), with the vector added."""
        return values + self.bias


class HiddenLayers(Network):
    """What lies between the first and the last matrix of the perceptron, an activation after each layer.

    Args:
        width: width of all layers.
        depth: number of hidden layers.
        inputs: of the first layer.
        activation: its name.
    """

    def __init__(self, width: int, depth: int = 2, inputs: int = 1, activation: Activation = "relu") -> None:
        super().__init__()
        self.activation = activation
        self.first = Bias(inputs, width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))
        if activation != "relu":  # of twins and checkpoints that say none
            self.register_buffer(_LETTERS, torch.tensor(list(activation.encode()), dtype=torch.uint8))

    def forward(self, coordinates: Tensor) -> Tensor:
        """Last hidden values, (s, w), for first ones before their bias, (s, w)."""
        active = _ACTIVATIONS[self.activation]
        values = active(self.first(coordinates))
        for layer in self.hidden:
            values = active(layer(values))
        return values


def _activation_in(tensors: Mapping[str, Tensor]) -> Activation:
    """The name that a network keeps among its weights, which say all that a twin needs."""
    letters = tensors.get(_LETTERS)
    name = "relu" if letters is None else bytes(letters.tolist()).decode(errors="replace")
    return cast("Activation", name)


class PerceptronNetwork(nn.Module):
    """Scaled displacements, (s, 3n), from scaled forces, (s, 3l): an input, two hidden and an output layer.

    Args:
        inputs: components of the forces, 3l.
        width: width of the first and of the hidden layers.
        outputs: components of the displacement, 3n.
        activation: its name.
    """

    def __init__(self, inputs: int, width: int, outputs: int, activation: Activation = "relu") -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, width, bias=False)
        self.inner = HiddenLayers(width, inputs=inputs, activation=activation)
        self.leave = nn.Linear(width, outputs)

    def forward(self, forces: Tensor) -> Tensor:
        """Scaled displacements for scaled forces."""
        values: Tensor = self.leave(self.inner(self.enter(forces)))
        return values


class PerceptronObjective(StandardisedObjective):
    """The perceptron with its training data.

    Args:
        data: the data set, for its loaded nodes.
        train: training samples.
        validation: validation samples.
        settings: of the network.
    """

    network: PerceptronNetwork

    def __init__(self, data: DataSet, train: Samples, validation: Samples, settings: Perceptron) -> None:
        super().__init__(data, train, validation)
        inputs, outputs = self.forces.shape[1], train.displacements[0].size
        self.network = PerceptronNetwork(inputs, settings.width or outputs, outputs, settings.activation)

    def encoder_decoder(self) -> LinearEncoderDecoder:
        """First matrix, last matrix and last bias, with the scale factors in them."""
        first, last = _array(self.network.enter.weight), _array(self.network.leave.weight)
        scale = self.displacement_scale
        bias = scale * _array(self.network.leave.bias)
        nothing = no_response(len(last), first.shape[1])
        return LinearEncoderDecoder(self.loaded, bias, *nothing, encode=first / self.force_scale, decode=scale * last)

    def trained(self) -> Network:
        """The hidden layers as they are now in double precision."""
        return copy.deepcopy(self.network.inner).cpu().double().requires_grad_(False)


def _array(parameter: Tensor) -> Floats:
    return parameter.detach().double().cpu().numpy()
