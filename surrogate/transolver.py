"""A Transolver-like network, a baseline from elsewhere: attention between slices of the nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, Samples

from .standardised import FieldNetwork, FieldObjective


@dataclass(frozen=True)
class Transolver:
    """The settings of a network after Wu et al. 2024 (Transolver, arXiv 2402.02366).

    Args:
        width: of a node's features, a multiple of `heads`.
        depth: number of blocks.
        heads: heads of the attention.
        slices: tokens that the nodes are gathered into, of each head.

    Raises:
        ValueError: an argument out of its range.
    """

    width: int = 64
    depth: int = 4
    heads: int = 4
    slices: int = 32

    name: ClassVar[str] = "transolver"
    rate: ClassVar[float] = 1e-3
    batch: ClassVar[int] = 16

    def __post_init__(self) -> None:
        for name in ("width", "depth", "heads", "slices"):
            if getattr(self, name) < 1:
                raise ValueError(f"Transolver.{name}: expected at least 1, got {getattr(self, name)}.")
        if self.width % self.heads:
            raise ValueError(f"Transolver.width: expected a multiple of {self.heads} heads, got {self.width}.")

    def check(self, body: Body) -> None:
        """Any body will do."""

    def objective(self, data: DataSet, train: Samples, validation: Samples) -> TransolverObjective:
        """A `TrainingObjective` with fresh weights."""
        return TransolverObjective(data, train, validation, self)

    def optimizer(self, network: nn.Module, rate: float) -> torch.optim.Optimizer:
        """AdamW."""
        return torch.optim.AdamW(network.parameters(), lr=rate, fused=True)

    @staticmethod
    def from_state_dict(tensors: Mapping[str, Tensor]) -> TransolverNetwork:
        """The predicting network from what its `state_dict` was."""
        depth = sum(name.endswith("attention.temperature") for name in tensors)
        heads = tensors["blocks.0.attention.temperature"].numel()
        slices, width = len(tensors["blocks.0.attention.share.bias"]), len(tensors["leave.weight"][0])
        settings = Transolver(width, depth, heads, slices)
        network = TransolverNetwork(tensors["places"], tensors["entries"], settings).to(tensors["leave.bias"])
        network.load_state_dict(dict(tensors))
        return network.requires_grad_(False)


class PhysicsAttention(nn.Module):
    """Attention between slices: each head gathers the nodes into a few tokens by weights that it learns.

    Args:
        settings: width, heads and slices.
    """

    def __init__(self, settings: Transolver) -> None:
        super().__init__()
        size = settings.width // settings.heads
        self.heads = settings.heads
        self.temperature = nn.Parameter(torch.full((settings.heads, 1, 1), 0.5))
        self.features = nn.Linear(settings.width, settings.width)
        self.sorted = nn.Linear(settings.width, settings.width)
        self.share = nn.Linear(size, settings.slices)
        self.asked = nn.Linear(size, 3 * size, bias=False)
        self.leave = nn.Linear(settings.width, settings.width)

    def forward(self, x: Tensor) -> Tensor:
        """Features of the nodes, (s, n, w), from their features."""
        features, places = (
            part(x).unflatten(2, (self.heads, -1)).transpose(1, 2) for part in (self.features, self.sorted)
        )
        shares = torch.softmax(self.share(places) / self.temperature, dim=-1)  # (s, heads, n, slices)
        tokens = (shares.mT @ features) / (shares.sum(dim=2)[..., None] + 1e-5)
        query, key, value = self.asked(tokens).chunk(3, dim=-1)
        weights = torch.softmax(query @ key.mT / query.shape[-1] ** 0.5, dim=-1)
        changed: Tensor = self.leave((shares @ (weights @ value)).transpose(1, 2).flatten(2))
        return changed


class Block(nn.Module):
    """Attention between slices, then a small perceptron of each node, both added to what comes in.

    Args:
        settings: of the network.
    """

    def __init__(self, settings: Transolver) -> None:
        super().__init__()
        width = settings.width
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = PhysicsAttention(settings)
        self.each = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, x: Tensor) -> Tensor:
        """Features of the nodes, (s, n, w), from their features."""
        x = x + self.attention(self.before(x))
        changed: Tensor = x + self.each(self.between(x))
        return changed


class TransolverNetwork(FieldNetwork):
    """Blocks over the nodes, each of which knows its position and its force.

    Args:
        places: positions of the nodes at rest, centred, in units of the body's size, (n, 3).
        entries: numbers of the loaded nodes, (l,).
        settings: of the network.
    """

    places: Tensor

    def __init__(self, places: Tensor, entries: Tensor, settings: Transolver) -> None:
        super().__init__(entries)
        self.register_buffer("places", places)
        width = settings.width
        self.enter = nn.Sequential(nn.Linear(6, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.blocks = nn.Sequential(*(Block(settings) for _ in range(settings.depth)))
        self.last = nn.LayerNorm(width)
        self.leave = nn.Linear(width, 3)

    def moved(self, forces: Tensor) -> Tensor:
        """Displacement of all nodes, (s, n, 3), for forces at the loaded ones, (s, l, 3), both scaled."""
        count = forces.shape[0]  # len() would fix the size of an exported batch
        given = forces.new_zeros(count, len(self.places), 3).index_copy(1, self.entries, forces)
        x = self.enter(torch.cat([self.places.expand(count, -1, -1), given], dim=2))
        displacement: Tensor = self.leave(self.last(self.blocks(x)))
        return displacement


class TransolverObjective(FieldObjective):
    """The network with its training data.

    Args:
        data: the data set, for its body and loaded nodes.
        train: training samples.
        validation: validation samples.
        settings: of the network.
    """

    network: TransolverNetwork

    def __init__(self, data: DataSet, train: Samples, validation: Samples, settings: Transolver) -> None:
        super().__init__(data, train, validation)
        body = data.body
        places = torch.tensor((body.points - body.points.mean(axis=0)) / body.size, dtype=torch.float32)
        self.network = TransolverNetwork(places, self.entries, settings)
