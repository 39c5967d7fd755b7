"""Linear responses with their rotations made finite, in torch: where Newton's method starts."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .residual import ElasticBody
from .tangents import LayeredMatrices


class Warping:
    """The field whose gradient is closest to exp(W)(I + e) - I, where e + W is the gradient of a linear response.

    The reference starts there, too (`reference.solve.start`); the idea is modal warping's (Choi and Ko 2005), with a
    Poisson problem in place of modes.

    Args:
        elastic: the body.
        layers: layer of each free node, (n,), -1 where it is held.
        size: of the body, metres.
    """

    def __init__(self, elastic: ElasticBody, layers: NDArray[np.int64], size: float) -> None:
        self.elastic = elastic
        free = np.flatnonzero(layers >= 0)
        numbers = np.full(len(layers), len(free))
        numbers[free] = np.arange(len(free))
        device = elastic.gradients.device
        self._free = torch.from_numpy(free).to(device)
        matrices = LayeredMatrices(torch.from_numpy(numbers).to(device)[elastic.cells], layers[free])
        blocks = torch.einsum("cqki,cqli,cq->ckl", elastic.gradients, elastic.gradients, elastic.volumes)
        # Springs hold the field where the linear response has it, as in the reference.
        self._held = elastic.spring_areas / size
        blocks = blocks.index_add(0, elastic.sprung, self._held)
        self._poisson = matrices.factor(matrices.assembled(blocks[None]))

    def warped(self, linear: Tensor) -> Tensor:
        """Of linear responses, (s, n, 3), metres."""
        G = self.elastic.deformation_gradients(linear)
        identity = torch.eye(3, dtype=G.dtype, device=G.device)
        G = G - identity
        W, e = 0.5 * (G - G.mT), 0.5 * (G + G.mT)
        angle = (W.square().sum(dim=(-2, -1), keepdim=True) / 2).sqrt()
        turn = torch.sinc(angle / torch.pi) * W + 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2 * (W @ W)
        wanted = (identity + turn) @ (identity + e) - identity
        right = self.elastic.assembled(wanted)
        if len(self.elastic.sprung):
            cells = self.elastic.cells[self.elastic.sprung]
            pulled = torch.einsum("ckl,scli->scki", self._held, linear[:, cells])
            right = right.index_add(1, cells.reshape(-1), pulled.reshape(len(linear), cells.numel(), 3))
        right = right[:, self._free]  # (s, f, 3)
        count = len(right)
        columns = right.permute(1, 0, 2).reshape(1, -1, 3 * count)
        field = self._poisson.solve(columns).reshape(-1, count, 3).permute(1, 0, 2)
        return torch.zeros_like(linear).index_copy(1, self._free, field)
