"""What the thesis's networks learn: scaled displacements from scaled forces, by mean squared error."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softtwin.reference.data.dataset import DataSet, Samples

from .architecture import Network
from .encoder_decoder import LinearEncoderDecoder, no_response

Floats = NDArray[np.float64]

_AT_ONCE = 256  # samples that are looked at together: a grid of many channels takes memory


class StandardisedObjective(nn.Module):
    """Scaled samples with the mean squared error as loss, for a network that a subclass brings.

    Forces and displacements are divided by one data scale factor each, the root mean square over the training split
    (Odot 2023, section 4.2). Forces are those of the loaded nodes: inputs that are zero in every sample are left out.

    Args:
        data: the data set, for its loaded nodes.
        train: training samples.
        validation: validation samples.
    """

    network: nn.Module
    forces: Tensor
    displacements: Tensor
    validation_forces: Tensor
    validation_displacements: Tensor

    def __init__(self, data: DataSet, train: Samples, validation: Samples) -> None:
        super().__init__()
        self.loaded = data.response.loaded
        self.force_scale = _root_mean_square(train.forces)
        self.displacement_scale = _root_mean_square(train.displacements)
        for name, samples in (("", train), ("validation_", validation)):
            self._store(f"{name}forces", samples.forces / self.force_scale)
            self._store(f"{name}displacements", samples.displacements / self.displacement_scale)

    @property
    def sample_count(self) -> int:
        """Number of training samples."""
        return len(self.forces)

    def loss(self, batch: Tensor) -> Tensor:
        """Mean squared error over the samples with the given numbers."""
        return nn.functional.mse_loss(self.network(self.forces[batch]), self.displacements[batch])

    @property
    def validation_count(self) -> int:
        """Number of validation samples."""
        return len(self.validation_forces)

    def fields(self, batch: Tensor, validation: bool = False) -> tuple[Tensor, Tensor]:
        """Predicted displacements and forces of the samples with the given numbers, (s, n, 3) each, metres, newtons."""
        given = (self.validation_forces if validation else self.forces)[batch]
        displacement = self.displacement_scale * self.network(given).unflatten(1, (-1, 3))
        forces = (self.force_scale * given).unflatten(1, (-1, 3))
        entries = torch.as_tensor(self.loaded, device=given.device)
        return displacement, torch.zeros_like(displacement).index_copy(1, entries, forces)

    @torch.no_grad()
    def error(self) -> float:
        """Mean squared error over the validation samples."""
        whole = zip(self.validation_forces.split(_AT_ONCE), self.validation_displacements.split(_AT_ONCE), strict=True)
        missed = sum(float((self.network(forces) - truth).square().sum()) for forces, truth in whole)
        return missed / self.validation_displacements.numel()

    def _store(self, name: str, fields: Floats) -> None:
        flat = np.ascontiguousarray(fields.reshape(len(fields), -1), dtype=np.float32)
        self.register_buffer(name, torch.from_numpy(flat), persistent=False)


class FieldNetwork(Network):
    """A network from forces at the loaded nodes, (s, 3l), to the displacement of all nodes, (s, 3n).

    Its scale factors are 1 in training, whose samples are scaled.

    Args:
        entries: numbers of the loaded nodes, (l,).
    """

    entries: Tensor
    input_scale: Tensor
    output_scale: Tensor

    def __init__(self, entries: Tensor) -> None:
        super().__init__()
        self.register_buffer("entries", entries)
        self.register_buffer("input_scale", torch.ones(()))
        self.register_buffer("output_scale", torch.ones(()))

    def forward(self, coordinates: Tensor) -> Tensor:
        """Displacements for forces."""
        forces = (coordinates * self.input_scale).unflatten(1, (-1, 3))
        return self.moved(forces).flatten(1) * self.output_scale

    def moved(self, forces: Tensor) -> Tensor:
        """Displacement of all nodes, (s, n, 3), for forces at the loaded ones, (s, l, 3), both scaled."""
        raise NotImplementedError


class FieldObjective(StandardisedObjective):
    """Scaled samples with a network between whole fields."""

    network: FieldNetwork

    @property
    def entries(self) -> Tensor:
        """Numbers of the loaded nodes, (l,)."""
        return torch.from_numpy(np.asarray(self.loaded, dtype=np.int64))

    def encoder_decoder(self) -> LinearEncoderDecoder:
        """None: the network takes forces and gives displacements."""
        size, inputs = self.displacements.shape[1], self.forces.shape[1]
        return LinearEncoderDecoder(self.loaded, np.zeros(size), *no_response(size, inputs))

    def trained(self) -> FieldNetwork:
        """The network as it is now in double precision, with the scale factors in it."""
        network = copy.deepcopy(self.network).cpu().double().requires_grad_(False)
        network.input_scale.fill_(1.0 / self.force_scale)
        network.output_scale.fill_(self.displacement_scale)
        return network


def _root_mean_square(fields: Floats) -> float:
    return max(float(np.sqrt((fields**2).mean())), 1e-300)
