"""Physics in the loss: a lesson whose network is also, or only, asked to be in balance (Odot 2023, 1.4, eq. 2.35)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from softtwin.reference.data.dataset import DataSet

from .architecture import Network
from .encoder_decoder import LinearEncoderDecoder
from .residual import ElasticBody

_LEAST_JACOBIAN = 0.1  # det F below it counts for more: a fresh network turns cells inside out
_AT_ONCE = 64  # validation samples whose cells are looked at together
_SHARE = 8  # one sample in so many of a batch of data is asked for its physics, too: it costs as much as the others
_FLOOR = 0.01  # keeps the semi-relative energy finite for loads near zero


@dataclass(frozen=True)
class Physics:
    """Weights of what is asked of a prediction; all terms are dimensionless.

    Args:
        energy: of the potential energy, relative to the work of the sample's load through the linear response
            (semi-relative, as the data's loss of the reduced network is). Least in equilibrium; it needs no labels.
        residual: of the squared relative residual, |R(u) - b|^2 / |b|^2 at the free nodes. It needs no labels either.
        data: of the architecture's own loss.

    Raises:
        ValueError: a weight that is negative or no number, or nothing to learn from.
    """

    energy: float = 0.0
    residual: float = 0.0
    data: float = 1.0

    def __post_init__(self) -> None:
        for name in ("energy", "residual", "data"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"Physics.{name}: expected a number not below 0, got {getattr(self, name)}.")
        if not self.energy + self.residual + self.data > 0.0:
            raise ValueError("Physics: expected a positive weight of energy, residual or data, got none.")


class PhysicsObjective(nn.Module):
    """A lesson with terms of physics in its loss.

    Predictions are taken for what they are at the free nodes. Those at fixed nodes, which a network that does not keep
    them at zero by construction may move, are asked for by a term of their own: their mean square, relative to that of
    the linear response.

    Args:
        objective: a `TrainingObjective`, network and data.
        data: the data set, for its body, material and linear response.
        physics: weights.
    """

    _loaded: Tensor
    _left: Tensor
    _right: Tensor

    def __init__(self, objective: Any, data: DataSet, physics: Physics) -> None:
        super().__init__()
        self.objective, self.physics = objective, physics
        self.body = ElasticBody(
            data.body, data.material, springs=data.springs, minimum_jacobian=_LEAST_JACOBIAN
        ).float()
        samples = objective.fields(torch.arange(min(objective.sample_count, 256)))[1]
        loaded = data.response.loaded
        linear = data.response.apply(samples[:, loaded].double().numpy())
        work = 0.5 * (linear[:, loaded] * samples[:, loaded].double().numpy()).sum(axis=(1, 2))
        self._work, self._square = float(work.mean()), float((linear**2).mean())
        left = torch.from_numpy(data.response.left).float()
        right = torch.from_numpy(data.response.right).float()
        self.register_buffer("_left", left.reshape(-1, 3, left.shape[1])[loaded].flatten(0, 1), persistent=False)
        self.register_buffer("_right", right, persistent=False)
        self.register_buffer("_loaded", torch.from_numpy(np.asarray(loaded, dtype=np.int64)), persistent=False)

    @property
    def network(self) -> nn.Module:
        """The network in training."""
        network: nn.Module = self.objective.network
        return network

    @property
    def sample_count(self) -> int:
        """Number of training samples, images of them counted."""
        count: int = self.objective.sample_count
        return count

    def loss(self, batch: Tensor) -> Tensor:
        """The weighted sum over the samples with the given numbers; beside data, physics of their first eighth."""
        wanted = self.physics
        total = wanted.data * self.objective.loss(batch) if wanted.data else torch.zeros((), device=batch.device)
        if not wanted.energy + wanted.residual:
            return total
        some = batch[: -(-len(batch) // _SHARE)] if wanted.data else batch
        return total + self._physics(*self.objective.fields(some))

    def _physics(self, displacement: Tensor, forces: Tensor) -> Tensor:
        wanted, free = self.physics, displacement * self.body.free
        total = (displacement - free).square().mean() / self._square
        if wanted.energy:
            work = self._linear_work(forces)
            weights = 1.0 / ((work * self._work).sqrt() + _FLOOR * self._work)
            total = total + wanted.energy * (self.body.potential(free, forces) * weights).mean()
        if wanted.residual:
            total = total + wanted.residual * self.body.residual(free, forces).square().mean()
        return total

    def _linear_work(self, forces: Tensor) -> Tensor:
        """Half the work of each load through the linear response, (s,), joules."""
        b = forces[:, self._loaded].flatten(1)
        return 0.5 * ((b @ self._right.T) * (b @ self._left)).sum(dim=1).clamp_min(0.0)

    @torch.no_grad()
    def error(self) -> float:
        """Error over the validation samples: the architecture's own; without data the loss, which needs no labels."""
        if self.physics.data:
            return float(self.objective.error())
        whole = torch.arange(self.objective.validation_count, device=self._left.device).split(_AT_ONCE)
        losses = [len(some) * self._physics(*self.objective.fields(some, validation=True)) for some in whole]
        return float(torch.stack(losses).sum()) / self.objective.validation_count

    def encoder_decoder(self) -> LinearEncoderDecoder:
        """The linear maps around the network."""
        encoder_decoder: LinearEncoderDecoder = self.objective.encoder_decoder()
        return encoder_decoder

    def trained(self) -> Network:
        """The network that predicts, with the weights as they are now."""
        network: Network = self.objective.trained()
        return network


def with_physics(objective: Any, data: DataSet, physics: Physics | None) -> Any:
    """The `TrainingObjective`, with physics in its loss where some is wanted."""
    return objective if physics is None else PhysicsObjective(objective, data, physics)
