"""What the thesis's networks learn: scaled displacements from scaled forces, by mean squared error."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softtwin.reference.dataset import DataSet, Samples

Floats = NDArray[np.float64]

_AT_ONCE = 256  # samples that are looked at together: a grid of many channels takes memory


class ScaledLesson(nn.Module):
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

    @torch.no_grad()
    def error(self) -> float:
        """Mean squared error over the validation samples."""
        whole = zip(self.validation_forces.split(_AT_ONCE), self.validation_displacements.split(_AT_ONCE), strict=True)
        missed = sum(float((self.network(forces) - truth).square().sum()) for forces, truth in whole)
        return missed / self.validation_displacements.numel()

    def _store(self, name: str, fields: Floats) -> None:
        flat = np.ascontiguousarray(fields.reshape(len(fields), -1), dtype=np.float32)
        self.register_buffer(name, torch.from_numpy(flat), persistent=False)


def _root_mean_square(fields: Floats) -> float:
    return max(float(np.sqrt((fields**2).mean())), 1e-300)
