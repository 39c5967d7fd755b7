"""What training and twins need of an architecture; the derivatives that every network has from torch.func."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, Samples

from .encoder_decoder import LinearEncoderDecoder
from .residual import ElasticBody

Floats = NDArray[np.float64]
_AT_ONCE = 64  # tangents: a thousand through the grids of a U-Net would take 20 GB


class Linearisation(Protocol):
    """A network at one point: its values and their derivative there."""

    @property
    def values(self) -> Tensor:
        """(e,)."""

    def jvp(self, tangents: Tensor) -> Tensor:
        """Changes of the values, (e, k), for changes of the coordinates, (d, k)."""

    def vjp(self, cotangent: Tensor) -> Tensor:
        """Gradient with respect to the coordinates, (d,), for one with respect to the values, (e,)."""


class Network(nn.Module):
    """Values (s, e) from coordinates (s, d), written once, for any precision and device.

    Its derivatives come from torch.func, unless it brings its own because they were measured to pay.
    """

    is_graph = True
    """Whether values are always made by the same operations, so that other programs can be given them."""

    def linearised(self, coordinates: Tensor, near: Linearisation | None = None) -> Linearisation:
        """The network at one point, (d,).

        Args:
            coordinates: the point.
            near: the network at a point nearby, for those that look for their values and find them sooner so.
        """
        return Differentiated(self, coordinates)

    def traced(self, coordinates: Tensor) -> Linearisation:
        """The same by operations of torch alone: for graphs that other programs are given, and for a GPU.

        Args:
            coordinates: the point, (d,), on any device.
        """
        return self.linearised(coordinates)

    def with_parameters(self, values: Mapping[str, ArrayLike]) -> Network:
        """The same for a tissue of other parameters.

        Args:
            values: a number, or one for each cell of the body, by the parameters' names; others stay.

        Raises:
            ValueError: it has learned one tissue.
        """
        raise ValueError(
            f"{type(self).__name__}: expected the tissue that it has learned, got other values of {sorted(values)}; "
            "the galerkin architecture takes them, and so do --model reference, torch and hybrid."
        )

    def with_springs(self, factors: Mapping[str, float]) -> Network:
        """The same on springs that are stiffer or softer than its own.

        Args:
            factors: how many times as stiff, by the surface that they hold; others stay.

        Raises:
            ValueError: it has learned one support.
        """
        if all(factor == 1.0 for factor in factors.values()):
            return self
        raise ValueError(
            f"{type(self).__name__}: expected the springs that it has learned, got other ones of {sorted(factors)}; "
            "the galerkin architecture takes them, and so do --model reference, torch and hybrid."
        )

    def stiffening(self, values: Mapping[str, ArrayLike]) -> float:
        """How many times as stiff as its own a tissue is, where that scales loads alone: 1 if it has learned one."""
        return 1.0

    def rounded(self) -> Network:
        """The same, good to six digits, and faster."""
        return copy.deepcopy(self).float()


class Differentiated:
    """A network at one point, differentiated by torch.func.

    Args:
        network: values (s, e) from coordinates (s, d).
        coordinates: the point, (d,).
    """

    def __init__(self, network: nn.Module, coordinates: Tensor) -> None:
        self.network, self.coordinates = network, coordinates

    @cached_property
    def values(self) -> Tensor:
        """(e,)."""
        return self._value(self.coordinates)

    def jvp(self, tangents: Tensor) -> Tensor:
        """Changes of the values, (e, k), for changes of the coordinates, (d, k)."""

        def one(tangent: Tensor) -> Tensor:
            return torch.func.jvp(self._value, (self.coordinates,), (tangent,))[1]

        return torch.func.vmap(one, in_dims=1, out_dims=1, chunk_size=_AT_ONCE)(tangents)

    def vjp(self, cotangent: Tensor) -> Tensor:
        """Gradient with respect to the coordinates, (d,), for one with respect to the values, (e,)."""
        gradient: Tensor = torch.func.vjp(self._value, self.coordinates)[1](cotangent)[0]
        return gradient

    def _value(self, coordinates: Tensor) -> Tensor:
        values: Tensor = self.network(coordinates[None])[0]
        return values


class TrainingObjective(Protocol):
    """A network in training, with its data: a module, since its data move to the device with it."""

    network: nn.Module

    @property
    def sample_count(self) -> int:
        """Number of training samples, images of them counted."""

    def loss(self, batch: Tensor) -> Tensor:
        """Loss over the samples with the given numbers, (s,)."""

    @property
    def validation_count(self) -> int:
        """Number of validation samples."""

    def fields(self, batch: Tensor, validation: bool = False) -> tuple[Tensor, Tensor]:
        """Predicted displacements and forces of the samples with the given numbers, (s, n, 3) each, metres, newtons.

        Those of all nodes; an image of a sample stands where the sample does. For losses that know physics.
        """

    def error(self) -> float:
        """Error over the validation samples: the weights with the least are kept."""

    def encoder_decoder(self) -> LinearEncoderDecoder:
        """The linear maps around the network."""

    def trained(self) -> Network:
        """The network that predicts, with the weights as they are now."""


class Architecture(Protocol):
    """A kind of network with its settings: a frozen dataclass whose fields are its part of the configuration."""

    name: ClassVar[str]

    def check(self, body: Body) -> None:
        """Refuse a body that it cannot learn on, before equilibria are solved for it.

        Raises:
            ValueError: what is wrong with the body.
        """

    @staticmethod
    def from_state_dict(tensors: Mapping[str, Tensor]) -> Network:
        """The predicting network from what its `state_dict` was."""


@runtime_checkable
class TrainedArchitecture(Architecture, Protocol):
    """One whose weights are found step by step."""

    rate: ClassVar[float]
    """Learning rate, where a plan says none."""
    batch: ClassVar[int]
    """Samples a step, where a plan says none."""

    def objective(self, data: DataSet, train: Samples, validation: Samples) -> Any:
        """A `TrainingObjective` with fresh weights."""

    def optimizer(self, network: Any, rate: float) -> torch.optim.Optimizer:
        """What trains a new network; its rate is set before every step."""


@dataclass(frozen=True, eq=False)
class NewSamples:
    """What a network that is in use is to learn, beside what it knows.

    Args:
        elastic: the body with the material that the network has learned.
        loads: forces at the loaded nodes, (s, 3l), newtons.
        displacements: the equilibria under them, (s, 3n), metres.
        pushes: small changes of each load, (k, 3l), newtons.
        changes: of the displacement by each of these, (k, 3n), metres, to first order.
        known_loads: as those that it was made with, (r, 3l), newtons.
        known_displacements: what it makes of them, (r, 3n), metres.
        seconds: that it may train for.
    """

    elastic: ElasticBody
    loads: Floats
    displacements: Floats
    pushes: Sequence[Floats]
    changes: Sequence[Floats]
    known_loads: Floats
    known_displacements: Floats
    seconds: float


@runtime_checkable
class AdaptableArchitecture(Architecture, Protocol):
    """One that learns from equilibria of its own use."""

    rehearsed: ClassVar[int]
    """States of the surrogate as it was built that it learns from again, so that it does not forget."""

    @staticmethod
    def adapted(
        encoder_decoder: LinearEncoderDecoder, network: Any, samples: NewSamples
    ) -> tuple[LinearEncoderDecoder, Network]:
        """The maps and the network after they have learned; coordinates of the loads that are new come last."""


@runtime_checkable
class FittedArchitecture(Architecture, Protocol):
    """One that is made at once, from the body and a few equilibria."""

    def fitted(self, data: DataSet, train: Samples) -> tuple[LinearEncoderDecoder, Network]:
        """The linear maps around the network, and the network, which is ready."""
