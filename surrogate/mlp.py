"""The thesis's multilayer perceptron, the yardstick: four layers as wide as the displacement, mean squared error."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softtwin.reference.dataset import DataSet, Samples

from .architecture import Network
from .maps import LinearMaps

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Perceptron:
    """The perceptron's settings (Odot 2023, section 4.2.1, which states neither width nor activation).

    Args:
        width: width of the first and of the two hidden layers; None for that of the displacement, 3n.

    Raises:
        ValueError: an argument out of its range.
    """

    width: int | None = None

    name: ClassVar[str] = "mlp"
    rate: ClassVar[float] = 1e-3
    batch: ClassVar[int] = 50
    optimizer: ClassVar[type[torch.optim.Optimizer]] = torch.optim.Adam

    def __post_init__(self) -> None:
        if self.width is not None and self.width < 1:
            raise ValueError(f"Perceptron.width: expected at least 1, got {self.width}.")

    def lesson(self, data: DataSet, train: Samples, validation: Samples) -> PerceptronLesson:
        """A `Lesson` with fresh weights."""
        return PerceptronLesson(data, train, validation, self)

    @staticmethod
    def revived(tensors: Mapping[str, Tensor]) -> HiddenLayers:
        """The predicting network from what its `state_dict` was."""
        bias = tensors["first.bias"]
        network = HiddenLayers(len(bias), (len(tensors) - 1) // 2).to(bias)
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
    """What lies between the first and the last matrix of the perceptron, ReLU after each layer.

    ReLU since the thesis, which does not name the activation of its perceptron, recommends it (section 3.2).

    Args:
        width: width of all layers.
        depth: number of hidden layers.
        inputs: of the first layer.
    """

    def __init__(self, width: int, depth: int = 2, inputs: int = 1) -> None:
        super().__init__()
        self.first = Bias(inputs, width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))

    def forward(self, coordinates: Tensor) -> Tensor:
        """Last hidden values, (s, w), for first ones before their bias, (s, w)."""
        values = torch.relu(self.first(coordinates))
        for layer in self.hidden:
            values = torch.relu(layer(values))
        return values


class PerceptronNetwork(nn.Module):
    """Scaled displacements, (s, 3n), from scaled forces, (s, 3l): an input, two hidden and an output layer.

    Args:
        inputs: components of the forces, 3l.
        width: width of the first and of the hidden layers.
        outputs: components of the displacement, 3n.
    """

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, width, bias=False)
        self.inner = HiddenLayers(width, inputs=inputs)
        self.leave = nn.Linear(width, outputs)

    def forward(self, forces: Tensor) -> Tensor:
        """Scaled displacements for scaled forces."""
        values: Tensor = self.leave(self.inner(self.enter(forces)))
        return values


class PerceptronLesson(nn.Module):
    """The perceptron with its training data; the loss is the mean squared error of scaled displacements.

    Forces and displacements are divided by one data scale factor each, the root mean square over the training split.
    Inputs that are zero in every sample are left out, which changes nothing.

    Args:
        data: the data set, for its loaded nodes.
        train: training samples.
        validation: validation samples.
        settings: of the network.
    """

    forces: Tensor
    displacements: Tensor
    validation_forces: Tensor
    validation_displacements: Tensor

    def __init__(self, data: DataSet, train: Samples, validation: Samples, settings: Perceptron) -> None:
        super().__init__()
        self.loaded = data.response.loaded
        self.force_scale = _root_mean_square(train.forces)
        self.displacement_scale = _root_mean_square(train.displacements)
        for name, samples in (("", train), ("validation_", validation)):
            self._store(f"{name}forces", samples.forces / self.force_scale)
            self._store(f"{name}displacements", samples.displacements / self.displacement_scale)
        inputs, outputs = self.forces.shape[1], train.displacements[0].size
        self.network = PerceptronNetwork(inputs, settings.width or outputs, outputs)

    @property
    def sample_count(self) -> int:
        """Number of training samples."""
        return len(self.forces)

    def loss(self, batch: Tensor) -> Tensor:
        """Mean squared error over the samples with the given numbers."""
        return nn.functional.mse_loss(self.network(self.forces[batch]), self.displacements[batch])

    @torch.no_grad()
    def error(self) -> float:
        """Mean squared error over the validation samples."""
        return float(nn.functional.mse_loss(self.network(self.validation_forces), self.validation_displacements))

    def maps(self) -> LinearMaps:
        """First matrix, last matrix and last bias, with the scale factors in them."""
        first, last = _array(self.network.enter.weight), _array(self.network.leave.weight)
        scale, size = self.displacement_scale, len(last)
        nothing = np.zeros((size, 0)), np.zeros((0, first.shape[1]))
        bias = scale * _array(self.network.leave.bias)
        return LinearMaps(self.loaded, first / self.force_scale, scale * last, bias, *nothing)

    def trained(self) -> Network:
        """The hidden layers as they are now in double precision."""
        return copy.deepcopy(self.network.inner).cpu().double().requires_grad_(False)

    def _store(self, name: str, fields: Floats) -> None:
        flat = np.ascontiguousarray(fields.reshape(len(fields), -1), dtype=np.float32)
        self.register_buffer(name, torch.from_numpy(flat), persistent=False)


def _array(parameter: Tensor) -> Floats:
    return parameter.detach().double().cpu().numpy()


def _root_mean_square(fields: Floats) -> float:
    return max(float(np.sqrt((fields**2).mean())), 1e-300)
