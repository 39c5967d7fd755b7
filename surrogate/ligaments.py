"""Ligaments of a body in torch: energy, forces and stiffness, whole batches at a time."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.reference.data.springs import Support, ligaments_of

_TAUT = 1e-12  # of a length: rounding


class Ligaments(nn.Module):
    """The ligaments among a body's springs, as the reference has them; `to` moves them to a device or a precision.

    Args:
        body: the body.
        springs: by name; those on surfaces are left out.

    Raises:
        ValueError: a ligament that is not on the body.
    """

    cells: Tensor
    nodes: Tensor
    weights: Tensor
    places: Tensor
    ends: Tensor
    moduli: Tensor
    lengths: Tensor
    factors: Tensor

    def __init__(self, body: Body, springs: Mapping[str, Support]) -> None:
        super().__init__()
        given = ligaments_of(springs)
        self.names = tuple(given)
        carried = [each.carried(name, body) for name, each in given.items()]
        width, every = body.cells.shape[1], list(given.values())
        arrays = {
            "weights": [found.weights[0] for found in carried],
            "places": [each.place for each in every],
            "ends": [each.end for each in every],
            "moduli": [each.stiffness for each in every],
            "lengths": [each.length for each in every],
            "factors": [1.0] * len(every),
        }
        shapes = {"weights": (-1, width), "places": (-1, 3), "ends": (-1, 3)}
        for name, values in arrays.items():
            shaped = np.array(values, dtype=np.float64).reshape(shapes.get(name, (-1,)))
            self.register_buffer(name, torch.from_numpy(shaped))
        self.register_buffer("cells", torch.tensor([int(found.cells[0]) for found in carried], dtype=torch.int64))
        nodes = np.array([found.nodes[0] for found in carried], dtype=np.int64).reshape(-1, width)
        self.register_buffer("nodes", torch.from_numpy(nodes))

    def scaled(self, factors: Mapping[str, float]) -> Ligaments:
        """The same with some that are stiffer or softer, by their names; others as given."""
        other = copy.copy(self)
        values = torch.tensor([factors.get(name, 1.0) for name in self.names], dtype=torch.float64)
        other._buffers = {**self._buffers, "factors": values.to(self.factors)}
        return other

    def _pulled(self, displacement: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Directions (s, l, 3), lengths, stretches and whether they pull, (s, l)."""
        moved = torch.einsum("lk,slki->sli", self.weights, displacement[:, self.nodes])
        apart = self.places + moved - self.ends
        lengths = torch.linalg.vector_norm(apart, dim=2)
        stretch = lengths - self.lengths
        pulls = stretch >= -_TAUT * lengths
        along = apart / torch.clamp(lengths, min=torch.finfo(lengths.dtype).tiny)[..., None]
        return along, lengths, torch.where(pulls, torch.clamp(stretch, min=0.0), 0.0), pulls

    def energy(self, displacement: Tensor) -> Tensor:
        """Stored, (s,), joules."""
        stretch = self._pulled(displacement)[2]
        return (0.5 * self.factors * self.moduli * stretch.square()).sum(dim=1)

    def forces(self, displacement: Tensor, name: str = "") -> Tensor:
        """That all need to be as they are, or that one needs as it was given, (s, n, 3), newtons."""
        along, _, stretch, _ = self._pulled(displacement)
        sizes = self.moduli * stretch
        if name:
            sizes = sizes * torch.tensor([each == name for each in self.names], device=sizes.device)
        else:
            sizes = sizes * self.factors
        shares = torch.einsum("lk,sl,sli->slki", self.weights, sizes, along)
        count = len(displacement)
        return torch.zeros_like(displacement).index_add(
            1, self.nodes.reshape(-1), shares.reshape(count, self.nodes.numel(), 3)
        )

    def stiffness(self, displacement: Tensor) -> Tensor:
        """Of each in its cell, node by node, (s, l, 3k, 3k), N/m."""
        along, lengths, stretch, pulls = self._pulled(displacement)
        unit = torch.eye(3, dtype=along.dtype, device=along.device)
        pulled = along[..., :, None] * along[..., None, :]
        across = (stretch / torch.clamp(lengths, min=torch.finfo(lengths.dtype).tiny))[..., None, None]
        sizes = (pulls * self.factors * self.moduli)[..., None, None]
        blocks = torch.einsum(
            "la,lb,slij->slaibj", self.weights, self.weights, sizes * (pulled + across * (unit - pulled))
        )
        size = 3 * self.weights.shape[1]
        return blocks.reshape(len(displacement), len(self.names), size, size)
