"""U-Mesh: a convolutional U-Net on the regular grid of nodes that a body of hexahedra has, as the thesis has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, Samples

from .standardised import FieldNetwork, FieldObjective

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_ROUND_OFF = 1e-6  # of a cell: nodes are so close to the grid's


@dataclass(frozen=True)
class UMesh:
    """The settings of U-Mesh (Odot 2023, figure 4.4; Mendizabal et al. 2020).

    Args:
        channels: of the first level; each level below has twice as many. The thesis has 128.
        levels: times that the grid is halved. The thesis has 3.
        numbering: how nodes fill the tensor (figure 4.5): `short` begins with the short axes, so that neighbours in
            the body are neighbours in the tensor; `long` numbers along the longest axis first and fills the same
            tensor with that, which the thesis warns of.

    Raises:
        ValueError: an argument out of its range.
    """

    channels: int = 128
    levels: int = 3
    numbering: Literal["short", "long"] = "short"

    name: ClassVar[str] = "umesh"
    rate: ClassVar[float] = 1e-3
    batch: ClassVar[int] = 50

    def __post_init__(self) -> None:
        for name in ("channels", "levels"):
            if getattr(self, name) < 1:
                raise ValueError(f"UMesh.{name}: expected at least 1, got {getattr(self, name)}.")
        if self.numbering not in ("short", "long"):
            raise ValueError(f"UMesh.numbering: expected 'short' or 'long', got {self.numbering!r}.")

    def check(self, body: Body) -> None:
        """Refuse a body whose nodes are not those of a regular grid.

        Raises:
            ValueError: see `lattice`.
        """
        lattice(body)

    def objective(self, data: DataSet, train: Samples, validation: Samples) -> UMeshObjective:
        """A `TrainingObjective` with fresh weights.

        Raises:
            ValueError: the body's nodes are not those of a regular grid.
        """
        return UMeshObjective(data, train, validation, self)

    def optimizer(self, network: nn.Module, rate: float) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(network.parameters(), lr=rate, fused=True)

    @staticmethod
    def from_state_dict(tensors: Mapping[str, Tensor]) -> UMeshNetwork:
        """The predicting network from what its `state_dict` was."""
        levels = sum(name.startswith("rises") and name.endswith("bias") for name in tensors)
        shape = (int(size) for size in tensors["shape"])
        channels = len(tensors["falls.0.0.bias"])
        network = UMeshNetwork(tensors["places"], tensors["entries"], tuple(shape), channels, levels)
        network = network.to(tensors["leave.bias"])
        network.load_state_dict(dict(tensors))
        return network.requires_grad_(False)


def lattice(body: Body) -> tuple[Ints, tuple[int, int, int]]:
    """Position of each node in the regular grid that holds all, (n, 3), and the nodes of that along each axis.

    Args:
        body: a body of hexahedra whose edges lie along the axes and are alike, as of `shapes.beam` or `sparse_grid`.

    Raises:
        ValueError: it is of other cells, or its nodes are not those of a regular grid.
    """
    if body.kind.name != "hexahedron":
        raise ValueError(
            f"lattice.body: expected linear hexahedra on a regular grid, got {body.kind.name} cells; "
            "put the organ on one (`build --grid`)."
        )
    corners = body.points[body.cells]
    edges = np.ptp(corners, axis=1)
    places = (body.points - body.points.min(axis=0)) / edges[0]
    positions = np.rint(places).astype(np.int64)
    off = max(np.abs(places - positions).max(), np.abs(edges / edges[0] - 1.0).max())
    if off > _ROUND_OFF:
        raise ValueError(
            f"lattice.body: expected hexahedra of a regular grid along the axes, got nodes up to {off:.3g} cells away "
            "from one; make the body with shapes.beam or meshes.grid.gridded (`build --grid`)."
        )
    x, y, z = (int(count) for count in positions.max(axis=0) + 1)
    return positions, (x, y, z)


def tensor_places(positions: Ints, shape: tuple[int, int, int], numbering: str) -> Ints:
    """Where nodes stand in the tensor, (n, 3), for their positions in the grid, (n, 3), and a numbering of `UMesh`."""
    if numbering == "short":
        return positions
    order = np.argsort(shape)[::-1]  # the longest axis first: the last of these runs slowest
    strides = np.cumprod([1, *np.array(shape)[order][:-1]])
    numbers = (positions[:, order] * strides).sum(axis=1)
    return np.stack(np.unravel_index(numbers, shape), axis=1)


class UMeshNetwork(FieldNetwork):
    """A U-Net on the grid that holds the nodes.

    The grid is padded with zeros to a multiple of 2^levels. At each level two padded 3 x 3 x 3 convolutions, each with
    a ReLU; 2 x 2 x 2 max-pooling down, 2 x 2 x 2 transposed convolutions up; levels are joined by concatenation.

    Args:
        places: where the nodes stand in the tensor, (n, 3).
        entries: numbers of the loaded nodes, (l,).
        shape: nodes of the grid along each axis.
        channels: of the first level.
        levels: times that the grid is halved.
    """

    places: Tensor
    shape: Tensor
    numbers: Tensor

    def __init__(self, places: Tensor, entries: Tensor, shape: tuple[int, ...], channels: int, levels: int) -> None:
        super().__init__(entries)
        self.register_buffer("places", places)
        self.register_buffer("shape", torch.tensor(shape))
        multiple = 2**levels
        self._padded = [-(-size // multiple) * multiple for size in shape]
        margins = [(padded - size) // 2 for padded, size in zip(self._padded, shape, strict=True)]
        x, y, z = (places + torch.tensor(margins)).T
        numbers = (x * self._padded[1] + y) * self._padded[2] + z
        self.register_buffer("numbers", numbers, persistent=False)
        widths = [channels * 2**level for level in range(levels + 1)]
        self.falls = nn.ModuleList(_two(a, b) for a, b in zip([3, *widths], widths, strict=False))
        self.rises = nn.ModuleList(nn.ConvTranspose3d(2 * a, a, 2, 2) for a in reversed(widths[:-1]))
        self.joins = nn.ModuleList(_two(2 * a, a) for a in reversed(widths[:-1]))
        self.leave = nn.Conv3d(channels, 3, 1)
        # Channels last: the other way cuDNN takes slow kernels (1.4 steps a second on an H100, 64 on an H200 this way:
        # benchmarks/results/gpu).
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]  # which no stub knows

    def moved(self, forces: Tensor) -> Tensor:
        """Displacement of all nodes, (s, n, 3), for forces at the loaded ones, (s, l, 3), both scaled."""
        count, numbers = forces.shape[0], self.numbers  # len() would fix the size of an exported batch
        flat = forces.new_zeros(count, 3, int(np.prod(self._padded)))
        values = flat.index_copy(2, numbers[self.entries], forces.mT).reshape(count, 3, *self._padded)
        passed = []
        for level, fall in enumerate(self.falls):
            values = fall(values if level == 0 else nn.functional.max_pool3d(values, 2))
            passed.append(values)
        for rise, join, beside in zip(self.rises, self.joins, reversed(passed[:-1]), strict=True):
            values = join(torch.cat([beside, rise(values)], dim=1))
        displacement: Tensor = self.leave(values).flatten(2)[:, :, numbers].mT
        return displacement


def _two(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv3d(inputs, outputs, 3, padding=1), nn.ReLU(), nn.Conv3d(outputs, outputs, 3, padding=1), nn.ReLU()
    )


class UMeshObjective(FieldObjective):
    """U-Mesh with its training data; the loss is that of the body's nodes alone, a masked loss.

    Args:
        data: the data set, for its body and loaded nodes.
        train: training samples.
        validation: validation samples.
        settings: of the network.
    """

    network: UMeshNetwork

    def __init__(self, data: DataSet, train: Samples, validation: Samples, settings: UMesh) -> None:
        super().__init__(data, train, validation)
        positions, shape = lattice(data.body)
        places = torch.from_numpy(tensor_places(positions, shape, settings.numbering))
        self.network = UMeshNetwork(places, self.entries, shape, settings.channels, settings.levels)
