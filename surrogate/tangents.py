"""Tangents of many states of one body at once in torch, and their Cholesky factors layer by layer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, shortest_path
from torch import Tensor

Ints = NDArray[np.int64]


def layers_of(cells: Ints, is_free: NDArray[np.bool_]) -> Ints:
    """Layer of each node, (n,), -1 where it is held: cells join free nodes of one layer or of two neighbours alone.

    Layers are the distances, counted in cells, from a node at the far end of the body, as in Cuthill and McKee's
    method; parts of the body that no free node joins are counted apart, and share the numbers.

    Args:
        cells: nodes of the cells, (cells, k).
        is_free: nodes that move, (n,).
    """
    size, width = len(is_free), cells.shape[1]
    starts, ends = np.repeat(cells, width, axis=1).ravel(), np.tile(cells, width).ravel()
    both = is_free[starts] & is_free[ends]
    graph: csr_array = coo_array((np.ones(both.sum()), (starts[both], ends[both])), shape=(size, size)).tocsr()
    layers = np.full(size, -1)
    _, part = connected_components(graph, directed=False)
    for number in np.unique(part[is_free]):
        nodes = np.flatnonzero((part == number) & is_free)
        inside = graph[nodes][:, nodes]
        far = 0
        for _ in range(3):  # the farthest from the farthest: an end
            distances = shortest_path(inside, unweighted=True, indices=far)
            far = int(np.argmax(distances))
        layers[nodes] = distances.astype(np.int64)
    return layers


class LayeredMatrices:
    """Symmetric matrices of one body, s at a time, whose unknowns lie in layers: block tridiagonal.

    Args:
        numbers: of the cells' unknowns, (cells, w); `count` stands for one that is held.
        layers: layer of each unknown, (u,).
    """

    def __init__(self, numbers: Tensor, layers: Ints) -> None:
        device, count = numbers.device, len(layers)
        order = np.argsort(layers, kind="stable")
        self.sizes = np.bincount(layers).tolist()
        first = np.concatenate([[0], np.cumsum(self.sizes)])
        place = np.empty(count, dtype=np.int64)
        place[order] = np.arange(count) - first[layers[order]]
        self.order = torch.from_numpy(order).to(device)
        self.back = torch.from_numpy(np.argsort(order)).to(device)
        own = np.array(self.sizes) ** 2
        below = np.array([a * b for a, b in zip(self.sizes[1:], self.sizes[:-1], strict=True)], dtype=np.int64)
        self._own = np.concatenate([[0], np.cumsum(own)]).astype(np.int64)
        self._below = self._own[-1] + np.concatenate([[0], np.cumsum(below)]).astype(np.int64)
        self.entries = int(self._below[-1])
        entries = numbers.cpu().numpy()
        rows, columns = np.broadcast_arrays(entries[:, :, None], entries[:, None, :])
        rows, columns = rows.ravel(), columns.ravel()
        kept = np.flatnonzero((rows < count) & (columns < count))
        row, column = rows[kept], columns[kept]
        apart = layers[row] - layers[column]
        width = np.array(self.sizes)[layers[column]]
        start = np.where(apart == 0, self._own[layers[column]], self._below[layers[column]])
        target = start + place[row] * width + place[column]
        is_lower = apart >= 0
        self._kept = torch.from_numpy(kept[is_lower]).to(device)
        self._target = torch.from_numpy(target[is_lower]).to(device)

    def assembled(self, blocks: Tensor) -> Tensor:
        """Entries of the matrices, (s, entries), from those of the cells, (s, cells, w, w)."""
        flat = blocks.flatten(1)[:, self._kept]
        return flat.new_zeros(len(flat), self.entries).index_add_(1, self._target, flat)

    def factor(self, entries: Tensor) -> Factors:
        """Cholesky factors of matrices, by their entries, (s, entries)."""
        lower: list[Tensor] = []
        joins: list[Tensor] = []
        is_positive = torch.ones(len(entries), dtype=torch.bool, device=entries.device)
        for number, size in enumerate(self.sizes):
            block = entries[:, self._own[number] : self._own[number + 1]].reshape(-1, size, size)
            if number:
                block = torch.baddbmm(block, joins[-1], joins[-1].mT, alpha=-1.0)
            factor, info = torch.linalg.cholesky_ex(block)
            is_positive &= info == 0
            lower.append(factor)
            if number + 1 < len(self.sizes):
                below = entries[:, self._below[number] : self._below[number + 1]]
                below = below.reshape(-1, self.sizes[number + 1], size)
                joins.append(torch.linalg.solve_triangular(factor.mT, below, upper=True, left=False))
        return Factors(self, lower, joins, is_positive)


@dataclass(frozen=True, eq=False)
class Factors:
    """Cholesky factors of s matrices.

    Args:
        matrices: their layers.
        lower: of each layer, (s, b, b).
        joins: between a layer and the next, (s, b', b).
        is_positive: whether the matrix is positive definite, (s,); the factors of others mean nothing.
    """

    matrices: LayeredMatrices
    lower: list[Tensor]
    joins: list[Tensor]
    is_positive: Tensor

    def put(self, chosen: Tensor, others: Factors) -> None:
        """Take some matrices' factors, by number, (k,), from others."""
        for mine, theirs in zip([*self.lower, *self.joins], [*others.lower, *others.joins], strict=True):
            mine[chosen] = theirs
        self.is_positive[chosen] = others.is_positive

    def solve(self, right: Tensor) -> Tensor:
        """The solutions, (s, u, k), for right-hand sides, (s, u, k); those of one matrix serve any number of these."""
        parts = list(right[:, self.matrices.order].split(self.matrices.sizes, dim=1))
        for number, factor in enumerate(self.lower):
            part = parts[number] - self.joins[number - 1] @ parts[number - 1] if number else parts[number]
            parts[number] = torch.linalg.solve_triangular(factor, part, upper=False)
        for number in reversed(range(len(self.lower))):
            part = parts[number]
            if number + 1 < len(self.lower):
                part = part - self.joins[number].mT @ parts[number + 1]
            parts[number] = torch.linalg.solve_triangular(self.lower[number].mT, part, upper=True)
        return torch.cat(parts, dim=1)[:, self.matrices.back]
