"""The thesis's multilayer perceptron, the yardstick: four layers as wide as the displacement, mean squared error."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softtwin.reference.dataset import Samples

Floats = NDArray[np.float64]


class Perceptron(nn.Module):
    """Scaled displacements, (s, 3n), from scaled forces, (s, 3l) (Odot 2023, section 4.2.1).

    One input layer, two hidden layers and one output layer, each 3n wide: 9.0 M parameters on the beam of 304
    hexahedra if every node carries force. Inputs that are zero in every sample are left out, which changes nothing.
    The thesis does not name the activation of its perceptron; ReLU is the one it recommends (section 3.2).

    Args:
        inputs: components of the forces, 3l.
        outputs: components of the displacement, 3n.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        sizes = (inputs, outputs, outputs, outputs, outputs)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))

    def forward(self, forces: Tensor) -> Tensor:
        """Scaled displacements for scaled forces."""
        values = forces
        for layer in self.layers[:-1]:
            values = torch.relu(layer(values))
        return self.layers[-1](values)


@dataclass(frozen=True, eq=False)
class PerceptronCore:
    """What lies between the first and the last matrix of a trained perceptron, in plain arrays, with its derivatives.

    Args:
        weights: `first.bias`, then `hidden.i.weight` and `hidden.i.bias`.
    """

    weights: dict[str, Floats]

    def arrays(self) -> dict[str, Floats]:
        """What to store."""
        return self.weights

    @property
    def depth(self) -> int:
        """Number of hidden layers."""
        return (len(self.weights) - 1) // 2

    def evaluate(self, coordinates: Floats, *, single: bool = False) -> tuple[Floats, Any]:
        """Last hidden values, (3n,), for first ones before their bias, (3n,), and a record for `push` and `pull`.

        Always in double precision.
        """
        z = coordinates + self.weights["first.bias"]
        active = [z > 0.0]
        for i in range(self.depth):
            z = self.weights[f"hidden.{i}.weight"] @ np.maximum(z, 0.0) + self.weights[f"hidden.{i}.bias"]
            active.append(z > 0.0)
        return np.maximum(z, 0.0), active

    def push(self, record: Any, tangents: Floats, *, single: bool = False) -> Floats:
        """Changes of the last hidden values, (3n, k), for changes of the first, (3n, k); always in double precision."""
        values = record[0][:, None] * tangents
        for i in range(self.depth):
            values = record[i + 1][:, None] * (self.weights[f"hidden.{i}.weight"] @ values)
        return values

    def pull(self, record: Any, cotangent: Floats) -> Floats:
        """Gradient with respect to the first values, (3n,), for one with respect to the last, (3n,)."""
        values = record[-1] * cotangent
        for i in reversed(range(self.depth)):
            values = record[i] * (values @ self.weights[f"hidden.{i}.weight"])
        return values


class PerceptronLesson(nn.Module):
    """The perceptron with its training data; the loss is the mean squared error of scaled displacements.

    Forces and displacements are divided by one data scale factor each, the root mean square over the training split.

    Args:
        train: training samples.
        validation: validation samples.
    """

    forces: Tensor
    displacements: Tensor
    validation_forces: Tensor
    validation_displacements: Tensor

    def __init__(self, train: Samples, validation: Samples) -> None:
        super().__init__()
        self.force_scale = _root_mean_square(train.forces)
        self.displacement_scale = _root_mean_square(train.displacements)
        for name, samples in (("", train), ("validation_", validation)):
            self._store(f"{name}forces", samples.forces / self.force_scale)
            self._store(f"{name}displacements", samples.displacements / self.displacement_scale)
        self.network = Perceptron(self.forces.shape[1], train.displacements[0].size)

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

    def layers(self) -> tuple[Floats, PerceptronCore, Floats, Floats]:
        """First matrix, (3n, 3l), core, last matrix, (3n, 3n), and last bias, (3n,), with the scale factors in them."""
        first, *hidden, last = (
            (layer.weight.detach().double().cpu().numpy(), layer.bias.detach().double().cpu().numpy())
            for layer in self.network.layers
            if isinstance(layer, nn.Linear)
        )
        weights = {"first.bias": first[1]}
        for i, (weight, bias) in enumerate(hidden):
            weights |= {f"hidden.{i}.weight": weight, f"hidden.{i}.bias": bias}
        scale = self.displacement_scale
        return first[0] / self.force_scale, PerceptronCore(weights), scale * last[0], scale * last[1]

    def _store(self, name: str, fields: Floats) -> None:
        flat = np.ascontiguousarray(fields.reshape(len(fields), -1), dtype=np.float32)
        self.register_buffer(name, torch.from_numpy(flat), persistent=False)


def _root_mean_square(fields: Floats) -> float:
    return max(float(np.sqrt((fields**2).mean())), 1e-300)
