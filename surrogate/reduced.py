"""The reduced network: linear response plus a small residual network between POD coordinates.

A reduced-basis derivative-informed network (O'Leary-Roseberry et al. 2022, arXiv 2206.10745) on top of the linear
response: it learns from gradients, too.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, LinearResponse, Samples, probe_cotangents
from softtwin.reference.data.jacobians import Jacobians, read_jacobians

from .architecture import Linearisation, Network, NewSamples
from .encoder_decoder import LinearEncoderDecoder, response_parts
from .optimizers import MuonWithAdamW
from .pod import ReducedBasis, basis_of, learned_basis, semi_relative, sizes_of

Floats = NDArray[np.float64]

_GATE = 0.1  # size of the scaled input, relative to its usual one, below which the correction fades quadratically
_ROOT_HALF, _DENSITY = 0.5**0.5, float((2.0 * np.pi) ** -0.5)  # of the normal law in the GELU
_TINY = 1e-30  # a number in single precision, too
_DIRECTIONS = 8192  # that Jacobians are looked at in
_LEAST_SPREAD = 0.3  # of the largest: coordinates that training loads hardly have, and others may, are not whitened
_WEIGHT_DECAY = 0.2  # less of it is more exact on loads like those of the training, and worse on others
_RATE, _AT_A_TIME = 1e-3, 128  # while it is used: learning rate, falling to zero; samples a step, new and known ones
_LEAST_WEIGHED = 0.01  # of the mean square, as `pod.semi_relative` has it
_SHARE = 4  # one sample in so many enters the gradient's loss: it costs three times the other and needs fewer


Array = NDArray[Any]  # in the network's own precision
Layer = tuple[Array, Array]  # weights, (in, out), and bias, (out,)


@dataclass(frozen=True)
class Arrays:
    """An averaged network's memory as arrays.

    Args:
        turns: of its coordinates, (g, r, r).
        input_scale: (r,).
        output_scale: one number.
        gate: squared length of the scaled input below which the correction fades.
        enter: the first layer.
        pairs: the two layers of each block.
        leave: the last layer.
        rest: what the blocks give at rest, (r,).
    """

    turns: Array
    input_scale: Array
    output_scale: Any
    gate: Any
    enter: Layer
    pairs: list[tuple[Layer, Layer]]
    leave: Layer
    rest: Array


@dataclass(frozen=True)
class Reduced:
    """The reduced network's settings.

    Args:
        modes: POD modes at most.
        width: width of its blocks.
        depth: number of its blocks.
        sobolev: weight of the derivative's error in the loss: of whole reduced Jacobians where the data set has them,
            in a fresh direction a sample and step, else of the one gradient that is stored with each sample; 0 leaves
            it out, as data without gradients do.
        symmetries: use the body's symmetries, if it has any: learn from symmetric images too, and average over them
            when predicting.

    Raises:
        ValueError: an argument out of its range.
    """

    modes: int = 64
    width: int = 256
    depth: int = 3
    sobolev: float = 0.03
    symmetries: bool = True

    name: ClassVar[str] = "reduced"
    rehearsed: ClassVar[int] = 192
    rate: ClassVar[float] = 3e-3
    batch: ClassVar[int] = 256

    def __post_init__(self) -> None:
        for name in ("modes", "width", "depth"):
            if getattr(self, name) < 1:
                raise ValueError(f"Reduced.{name}: expected at least 1, got {getattr(self, name)}.")
        if not 0.0 <= self.sobolev < np.inf:
            raise ValueError(f"Reduced.sobolev: expected a number not below 0, got {self.sobolev}.")

    def check(self, body: Body) -> None:
        """Any body will do."""

    def objective(self, data: DataSet, train: Samples, validation: Samples) -> ReducedObjective:
        """A `TrainingObjective` with fresh weights."""
        return ReducedObjective(data, train, validation, self)

    def optimizer(self, network: ReducedNetwork, rate: float) -> torch.optim.Optimizer:
        """Muon for the blocks, AdamW for the layers around them."""
        hidden = [layer.weight for pair in network.pairs for layer in pair]
        inside = {id(weight) for weight in hidden}
        others = [weight for weight in network.parameters() if id(weight) not in inside]
        return MuonWithAdamW(hidden, others, rate, _WEIGHT_DECAY)

    @staticmethod
    def adapted(
        encoder_decoder: LinearEncoderDecoder, network: AveragedNetwork, samples: NewSamples
    ) -> tuple[LinearEncoderDecoder, AveragedNetwork]:
        """Trained on from its weights, on equilibria with their first-order changes, and on what it was built to know.

        Args:
            encoder_decoder: the maps around the network.
            network: as it was made.
            samples: the equilibria.
        """
        loads, targets, weights = _images_of(encoder_decoder, network, samples)
        inner = ReducedNetwork(
            network.input_scale.float(), float(network.output_scale), network.enter.out_features, len(network.inner)
        )
        inner.load_state_dict({name: network.state_dict()[name].float() for name in inner.state_dict()})
        new, chance = len(loads) - len(network.turns) * len(samples.known_loads), torch.Generator().manual_seed(0)
        optimizer, begin, used = torch.optim.Adam(inner.parameters(), lr=_RATE), time.monotonic(), 0.0
        while used < 1.0:
            for group in optimizer.param_groups:
                group["lr"] = _RATE * (1.0 - used)
            batch = torch.cat(
                [
                    torch.randint(new, (_AT_A_TIME,), generator=chance),
                    torch.randint(new, len(loads), (_AT_A_TIME if new < len(loads) else 0,), generator=chance),
                ]
            )
            optimizer.zero_grad()
            missed = (inner(loads[batch]) - targets[batch]).square().sum(dim=1)
            (missed * weights[batch]).mean().backward()
            optimizer.step()
            used = (time.monotonic() - begin) / max(samples.seconds, 1e-9)
        trained = AveragedNetwork(inner.double(), network.turns).requires_grad_(False)
        return encoder_decoder, trained

    @staticmethod
    def from_state_dict(tensors: Mapping[str, Tensor]) -> AveragedNetwork:
        """The predicting network from what its `state_dict` was."""
        depth = sum(name.startswith("inner") and name.endswith("weight") for name in tensors)
        inner = ReducedNetwork(tensors["input_scale"], 1.0, len(tensors["enter.bias"]), depth)
        network = AveragedNetwork(inner, tensors["turns"]).to(tensors["turns"])
        network.load_state_dict(dict(tensors))
        return network.requires_grad_(False)


# ------------------------------------------------------------------ the network


class ReducedNetwork(Network):
    """Correction coordinates a = N(c), (s, r), from load coordinates c = V^T b, (s, r).

    N(c) = t(x) (M(x) - M(0)) with x = S c, M residual GELU blocks and t(x) = |x| / sqrt(|x|^2 + eps^2): N and its
    derivative are zero at c = 0, so that the tangent at rest is the linear response.

    Args:
        input_scale: S, (r,), 1/N.
        output_scale: typical size of the correction, one number for all coordinates, metres.
        width: width of the blocks.
        depth: number of blocks.
    """

    input_scale: Tensor
    output_scale: Tensor

    def __init__(self, input_scale: Tensor, output_scale: float, width: int, depth: int) -> None:
        super().__init__()
        self.register_buffer("input_scale", input_scale)
        self.register_buffer("output_scale", torch.tensor(output_scale, dtype=torch.float32))
        self.enter = nn.Linear(len(input_scale), width)
        self.inner = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))
        self.outer = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))
        self.leave = nn.Linear(width, len(input_scale))

    @property
    def pairs(self) -> list[tuple[nn.Linear, nn.Linear]]:
        """The two layers of each block."""
        return cast("list[tuple[nn.Linear, nn.Linear]]", list(zip(self.inner, self.outer, strict=True)))

    def forward(self, coordinates: Tensor) -> Tensor:
        """Correction coordinates, (s, r), metres, for load coordinates, (s, r), newtons."""
        x = coordinates * self.input_scale
        values = self.blocks(torch.cat([x, torch.zeros_like(x[:1])]))
        return self.gate(x) * (values[:-1] - values[-1:]) * self.output_scale

    def gate(self, x: Tensor) -> Tensor:
        """t(x), (..., 1), for scaled inputs, (..., r)."""
        size = torch.linalg.vector_norm(x, dim=-1, keepdim=True)  # whose derivative at zero is zero
        return size * (size * size + x.shape[-1] * _GATE**2).rsqrt()

    def blocks(self, x: Tensor, trace: list[Tensor] | None = None) -> Tensor:
        """M(x), (..., r), for scaled inputs, (..., r); a trace collects what the activations are given."""
        linear, gelu = nn.functional.linear, nn.functional.gelu  # calling modules costs as much as what they do here
        hidden = linear(x, self.enter.weight, self.enter.bias)
        for inner, outer in self.pairs:
            z = linear(hidden, inner.weight, inner.bias)
            if trace is not None:
                trace.append(z)
            hidden = hidden + linear(gelu(z), outer.weight, outer.bias)
        return linear(hidden, self.leave.weight, self.leave.bias)


class AveragedNetwork(ReducedNetwork):
    """A reduced network averaged over the symmetries of its body, its derivatives by hand.

    By hand since they are wanted in the middle of every step of a registration: 64 tangents of 64 coordinates through
    three blocks of width 256 take 22 ms by torch.func on one thread, and 1.4 ms so.

    Args:
        network: gives it its weights.
        turns: what each symmetry does to the coordinates, (g, r, r); the first is the identity.
    """

    turns: Tensor
    rest: Tensor
    _arrays: Arrays | None = None

    def __init__(self, network: ReducedNetwork, turns: Tensor) -> None:
        width, depth = network.enter.out_features, len(network.inner)
        with torch.random.fork_rng(devices=[]):  # its weights are given: the caller's chance is left alone
            super().__init__(network.input_scale, float(network.output_scale), width, depth)
        self.to(network.enter.weight)
        self.load_state_dict(network.state_dict())
        with torch.no_grad():
            self.register_buffer("rest", self.blocks(torch.zeros_like(self.input_scale[None]))[0])
        self.register_buffer("turns", turns.to(self.rest))

    @property
    def arrays(self) -> Arrays:
        """Its memory: what changes the one changes the other."""
        if self._arrays is None:
            scale = self.input_scale.numpy()
            gate = scale.dtype.type(len(scale) * _GATE**2)
            pairs = [(_layer(inner), _layer(outer)) for inner, outer in self.pairs]
            ends, own = (_layer(self.enter), _layer(self.leave)), (self.turns.numpy(), self.rest.numpy())
            factor = self.output_scale.numpy()[()]
            self._arrays = Arrays(own[0], scale, factor, gate, ends[0], pairs, ends[1], own[1])
        return self._arrays

    def _apply(self, function: Any, recurse: bool = True) -> AveragedNetwork:
        self._arrays = None  # another precision has other memory
        super()._apply(function, recurse)
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_arrays": None}  # so has a copy

    def forward(self, coordinates: Tensor) -> Tensor:
        """Correction coordinates, (s, r), metres, for load coordinates, (s, r), newtons."""
        count, modes = len(self.turns), coordinates.shape[1]
        turned = torch.einsum("gij,sj->gsi", self.turns, coordinates)
        values = super().forward(turned.reshape(-1, modes)).reshape(count, -1, modes)
        return torch.einsum("gij,gsi->sj", self.turns, values) / count

    def linearised(self, coordinates: Tensor, near: Linearisation | None = None) -> AverageAtPoint:
        """The network at one point, (r,), on the processor."""
        return AverageAtPoint(self, coordinates)

    def traced(self, coordinates: Tensor) -> LinearisedAverage:
        """See `Network.traced`."""
        return LinearisedAverage(self, coordinates)


class LinearisedAverage:
    """An averaged network at a point in torch, which graphs are made of and a GPU runs, with derivatives by hand.

    Args:
        network: the network; its weights need no gradient.
        coordinates: the point, (r,), or several at once, (s, r): then all results have s in front.
    """

    def __init__(self, network: AveragedNetwork, coordinates: Tensor) -> None:
        self.network = network
        self._x = (network.turns @ coordinates[..., None, :, None])[..., 0] * network.input_scale  # (g, r)
        self._trace: list[Tensor] = []
        self._missing = network.blocks(self._x, self._trace) - network.rest
        self._gate = network.gate(self._x)
        values = self._gate * self._missing * network.output_scale
        self.values = (values[..., None, :] @ network.turns).mean(dim=-3)[..., 0, :]

    def _slopes(self) -> tuple[Tensor, list[Tensor]]:
        """Of the gate, (g, r), zero at rest where the values are zero as well, and of each activation, (g, w)."""
        x, count = self._x, self._x.shape[-1]
        square = x.square().mean(dim=-1, keepdim=True)
        gate = x * (_GATE**2 / count) / (self._gate.clamp_min(_TINY) * (square + _GATE**2) ** 2)
        bent = [0.5 + 0.5 * torch.erf(_ROOT_HALF * z) + z * torch.exp(-0.5 * z * z) * _DENSITY for z in self._trace]
        return gate, bent

    def jvp(self, tangents: Tensor) -> Tensor:
        """Changes of the values, (r, k), for changes of the coordinates, (r, k)."""
        net = self.network
        gate, slopes = self._slopes()
        dx = (tangents.T @ net.turns.mT) * net.input_scale  # (g, k, r)
        hidden = dx @ net.enter.weight.T
        for slope, (inner, outer) in zip(slopes, net.pairs, strict=True):
            hidden = hidden + (slope[..., None, :] * (hidden @ inner.weight.T)) @ outer.weight.T
        change = self._gate[..., None, :] * (hidden @ net.leave.weight.T)
        change = change + (dx @ gate[..., None]) * self._missing[..., None, :]
        return ((change * net.output_scale) @ net.turns).mean(dim=-3).mT

    def vjp(self, cotangent: Tensor) -> Tensor:
        """Gradient with respect to the coordinates, (r,), for one with respect to the values, (r,), at one point."""
        net = self.network
        gate, slopes = self._slopes()
        change = (net.turns @ cotangent) * (net.output_scale / len(net.turns))  # (g, r)
        hidden = (self._gate * change) @ net.leave.weight
        for slope, (inner, outer) in zip(reversed(slopes), reversed(net.pairs), strict=True):
            hidden = hidden + (slope * (hidden @ outer.weight)) @ inner.weight
        dx = hidden @ net.enter.weight + gate * (self._missing * change).sum(dim=1, keepdim=True)
        return ((dx * net.input_scale)[:, None] @ net.turns).sum(dim=0)[0]


class AverageAtPoint:
    """An averaged network at one point, with derivatives by hand.

    In NumPy, on the network's own memory: at one point torch spends several times as long on being called as on what it
    is called for.

    Args:
        network: the network, on the processor; its weights need no gradient.
        coordinates: the point, (r,).
    """

    def __init__(self, network: AveragedNetwork, coordinates: Tensor) -> None:
        self._net = net = network.arrays
        self._x = (net.turns @ coordinates.numpy()) * net.input_scale  # (g, r)
        square = np.square(self._x).sum(axis=1, keepdims=True)
        self._gate = np.sqrt(square / (square + net.gate))
        hidden = self._x @ net.enter[0] + net.enter[1]
        self._trace: list[tuple[Array, Array]] = []
        for inner, outer in net.pairs:
            z = hidden @ inner[0] + inner[1]
            normal = 0.5 + 0.5 * torch.erf(torch.from_numpy(_ROOT_HALF * z)).numpy()
            self._trace.append((z, normal))
            hidden = hidden + (z * normal) @ outer[0] + outer[1]
        self._missing = hidden @ net.leave[0] + net.leave[1] - net.rest
        values = (self._gate * self._missing)[:, None] @ net.turns
        self.values = torch.from_numpy(net.output_scale * values.mean(axis=0)[0])

    @cached_property
    def _slopes(self) -> tuple[Array, list[Array]]:
        """Of the gate, (g, r), zero at rest where the values are zero as well, and of each activation, (g, w)."""
        x, limit = self._x, self._net.gate
        square = np.square(x).sum(axis=1, keepdims=True)
        gate = x * limit / (np.maximum(self._gate, _TINY) * np.square(square + limit))
        return gate, [normal + z * np.exp(-0.5 * z * z) * _DENSITY for z, normal in self._trace]

    def jvp(self, tangents: Tensor) -> Tensor:
        """Changes of the values, (r, k), for changes of the coordinates, (r, k)."""
        net, (gate, slopes) = self._net, self._slopes
        dx = (tangents.numpy().T @ net.turns.transpose(0, 2, 1)) * net.input_scale  # (g, k, r)
        hidden = _times(dx, net.enter[0])
        for slope, (inner, outer) in zip(slopes, net.pairs, strict=True):
            bent = _times(hidden, inner[0])
            bent *= slope[:, None]
            hidden += _times(bent, outer[0])
        change = _times(hidden, net.leave[0])
        change *= self._gate[:, None]
        change += (dx @ gate[:, :, None]) * self._missing[:, None]
        change *= net.output_scale
        return torch.from_numpy((change @ net.turns).mean(axis=0).T)

    def vjp(self, cotangent: Tensor) -> Tensor:
        """Gradient with respect to the coordinates, (r,), for one with respect to the values, (r,)."""
        net, (gate, slopes) = self._net, self._slopes
        change = (net.turns @ cotangent.numpy()) * (net.output_scale / len(net.turns))  # (g, r)
        hidden = (self._gate * change) @ net.leave[0].T
        for slope, (inner, outer) in zip(reversed(slopes), reversed(net.pairs), strict=True):
            hidden = hidden + (slope * (hidden @ outer[0].T)) @ inner[0].T
        dx = hidden @ net.enter[0].T + gate * (self._missing * change).sum(axis=1, keepdims=True)
        return torch.from_numpy(((dx * net.input_scale)[:, None] @ net.turns).sum(axis=0)[0])


def _times(rows: Array, matrix: Array) -> Array:
    """A product of some dozen rows by torch, whose kernels are made for networks."""
    found: Array = torch.matmul(torch.from_numpy(rows), torch.from_numpy(matrix)).numpy()
    return found


def _layer(layer: nn.Linear) -> Layer:
    return layer.weight.detach().numpy().T, layer.bias.detach().numpy()


# ------------------------------------------------------------------ what it learns


class ReducedObjective(nn.Module):
    """The reduced network with its training data in reduced coordinates; loss and validation error are methods.

    The loss is |u - u*|^2 / (|u*| rms + 0.01 rms^2), without the part outside the modes, plus `sobolev` times the
    squared relative error of the gradient J^T g against the stored adjoints, or of J^T V z with z of unit variance
    against the data set's Jacobians, which makes it in the mean that of J^T V in the Frobenius norm.

    Args:
        data: the data set, for its body, modes and linear response.
        train: training samples.
        validation: validation samples.
        settings: of the network.

    Raises:
        DataSetError: the data set's Jacobians are damaged or not finished.
        ValueError: no training samples, or none that differ from the linear response; Jacobians of other modes.
    """

    forces: Tensor
    turns: Tensor
    modes: Tensor
    left: Tensor
    right: Tensor
    loads: Tensor
    targets: Tensor
    weights: Tensor
    cotangents: Tensor
    adjoints: Tensor
    adjoint_weights: Tensor
    jacobians: Tensor
    directions: Tensor
    metric: Tensor
    validation_forces: Tensor
    validation_loads: Tensor
    validation_targets: Tensor
    validation_rest: Tensor
    validation_weights: Tensor

    def __init__(self, data: DataSet, train: Samples, validation: Samples, settings: Reduced) -> None:
        super().__init__()
        self.response = data.response
        self.sobolev = settings.sobolev if data.has_gradients else 0.0
        self._rms = float(np.sqrt(np.mean(sizes_of(train.displacements) ** 2)))
        stored = read_jacobians(data, train.draws) if self.sobolev > 0.0 else None
        if stored is None:
            self.basis = learned_basis(data, train, settings.modes, settings.symmetries)
        else:
            self.basis = _basis_of(stored, data, settings)
        self._store_training(data, train, _corrections(data.response, train))
        if stored is not None:
            self._store_jacobians(stored)
        elif self.sobolev > 0.0:
            self._store_adjoints(data, train)
        self._store_validation(validation, _corrections(data.response, validation))
        self._build(settings)

    @property
    def sample_count(self) -> int:
        """Number of training samples, symmetric images counted."""
        return len(self.targets)

    def loss(self, batch: Tensor) -> Tensor:
        """Loss over the samples with the given numbers; the gradient's error over the first quarter of them."""
        missed = (self.network(self.loads[batch]) - self.targets[batch]).square().sum(dim=1)
        loss = (missed * self.weights[batch]).mean()
        if not self.sobolev:
            return loss
        few = batch[: -(-len(batch) // _SHARE)]
        return loss + self.sobolev * (self._jacobian_loss(few) if self.whole else self._gradient_loss(few))

    @property
    def whole(self) -> bool:
        """Whether whole Jacobians are learned from."""
        return hasattr(self, "jacobians")

    @property
    def validation_count(self) -> int:
        """Number of validation samples."""
        return len(self.validation_loads)

    def fields(self, batch: Tensor, validation: bool = False) -> tuple[Tensor, Tensor]:
        """Predicted displacements and forces of the samples with the given numbers, (s, n, 3) each, metres, newtons.

        Those of an image are turned back, and are its sample's.
        """
        forces, loads = (self.validation_forces, self.validation_loads) if validation else (self.forces, self.loads)
        samples, turns = batch % len(forces), self.turns[batch // len(forces)]
        coordinates = torch.einsum("sij,si->sj", turns, self.network(loads[batch]))
        given = forces[samples]
        displacement = (given @ self.right.T) @ self.left.T + coordinates @ self.modes.T
        entries = torch.as_tensor(self.response.loaded, device=given.device)
        moved = displacement.unflatten(1, (-1, 3))
        return moved, torch.zeros_like(moved).index_copy(1, entries, given.unflatten(1, (-1, 3)))

    def _gradient_loss(self, batch: Tensor) -> Tensor:
        loads = self.loads[batch].requires_grad_()
        (pulled,) = torch.autograd.grad(self.network(loads), loads, self.cotangents[batch], create_graph=True)
        missed = (pulled @ self.metric.T - self.adjoints[batch]).square().sum(dim=1)
        return (missed * self.adjoint_weights[batch]).mean()

    def _jacobian_loss(self, batch: Tensor) -> Tensor:
        count, loads = len(self.jacobians), self.loads[batch].requires_grad_()
        turns = self.turns[batch // count]
        # A sample meets other directions in other company: a function of the batch, so that training can go on.
        along = self.directions[(batch + batch.sum()) % len(self.directions)]
        (pulled,) = torch.autograd.grad(self.network(loads), loads, along, create_graph=True)
        in_sample = torch.bmm(along[:, None], turns)  # one product at a time: einsum would begin with the matrices
        of_sample = torch.bmm(self.jacobians[batch % count], in_sample.mT)
        wanted = torch.bmm(turns, of_sample)[:, :, 0]
        missed = (pulled @ self.metric.T - wanted).square().sum(dim=1)
        return (missed * self.adjoint_weights[batch]).mean()

    @torch.no_grad()
    def error(self) -> float:
        """Mean over the validation samples of the root of the semi-relative error, outside the modes too."""
        missed = (self.network(self.validation_loads) - self.validation_targets).square().sum(dim=1)
        return float(((missed + self.validation_rest) * self.validation_weights).sqrt().mean())

    def encoder_decoder(self) -> LinearEncoderDecoder:
        """The linear response, and the modes on both sides of the network."""
        encode = np.ascontiguousarray(self.basis.restricted.T)
        left, right = response_parts(self.response)
        return LinearEncoderDecoder(self.response.loaded, np.zeros(len(left)), left, right, encode, self.basis.modes)

    def trained(self) -> AveragedNetwork:
        """The network as it is now in double precision, averaged over the symmetries."""
        network = AveragedNetwork(copy.deepcopy(self.network).cpu().double(), torch.from_numpy(self.basis.turns))
        return network.requires_grad_(False)

    def _build(self, settings: Reduced) -> None:
        spread = _deviation(self.loads.double().numpy())
        scale = 1.0 / np.maximum(spread, _LEAST_SPREAD * spread.max())
        size = float(self.targets.square().mean().sqrt())
        self.network = ReducedNetwork(_tensor(scale), size, settings.width, settings.depth)

    def _scale(self, samples: Samples) -> Floats:
        return semi_relative(samples.displacements, self._rms)

    def _store_training(self, data: DataSet, train: Samples, corrections: Floats) -> None:
        basis, group = self.basis, len(self.basis.turns)
        self._store("loads", basis.images(train.forces.reshape(len(train), -1) @ basis.restricted))
        self._store("targets", basis.images(corrections.reshape(len(train), -1) @ basis.modes))
        self._store("weights", np.tile(1.0 / self._scale(train), group))
        self._store("forces", train.forces.reshape(len(train), -1))
        named = {"turns": basis.turns, "modes": basis.modes, "left": self.response.left, "right": self.response.right}
        for name, values in named.items():
            self._store(name, values)

    def _root(self) -> tuple[Floats, Floats]:
        """(P^T P)^(1/2) of the modes P at the loaded nodes, which commutes with the symmetries, and its inverse."""
        restricted = self.basis.restricted
        values, vectors = np.linalg.eigh(restricted.T @ restricted)
        values = np.sqrt(np.maximum(values, 1e-12 * values.max()))
        return (vectors * values) @ vectors.T, (vectors / values) @ vectors.T

    def _store_jacobians(self, stored: Jacobians) -> None:
        """|P K^-1 V z - LR^T V z - P y|^2 as for gradients, z from many that are drawn once."""
        basis, (root, inverse) = self.basis, self._root()
        left, right = self.response.left, self.response.right
        at_rest = basis.restricted.T @ right.T @ (left.T @ basis.modes)
        self._store("metric", root)
        self._store("jacobians", np.einsum("ij,sjk->sik", inverse.astype(np.float32), stored.values - at_rest))
        self._store("adjoint_weights", np.tile(1.0 / stored.squares, len(basis.turns)))
        self._store("directions", np.random.default_rng(0).standard_normal((_DIRECTIONS, basis.count)))

    def _store_adjoints(self, data: DataSet, train: Samples) -> None:
        """|h - LR^T g - P y|^2 = |R y - Q^T (h - LR^T g)|^2 + const for P = Q R: r numbers a sample instead of 3l."""
        basis, group = self.basis, len(self.basis.turns)
        cotangents = probe_cotangents(data.body, data.shapes, train.probes).reshape(len(train), -1)
        adjoints = train.adjoints.reshape(len(train), -1)
        missing = (adjoints - cotangents @ data.response.left @ data.response.right) @ basis.restricted
        root, inverse = self._root()  # in place of Q and R, which do not commute with the symmetries
        self._store("metric", root)
        self._store("adjoints", basis.images(missing @ inverse))
        self._store("cotangents", basis.images(cotangents @ basis.modes))
        sizes = np.maximum((adjoints**2).sum(axis=1), 1e-300)
        self._store("adjoint_weights", np.tile(1.0 / sizes, group))

    def _store_validation(self, validation: Samples, corrections: Floats) -> None:
        flat = corrections.reshape(len(validation), -1)
        targets = flat @ self.basis.modes
        self._store("validation_forces", validation.forces.reshape(len(validation), -1))
        self._store("validation_loads", validation.forces.reshape(len(validation), -1) @ self.basis.restricted)
        self._store("validation_targets", targets)
        self._store("validation_rest", ((flat - targets @ self.basis.modes.T) ** 2).sum(axis=1))
        self._store("validation_weights", 1.0 / self._scale(validation))

    def _store(self, name: str, values: Floats) -> None:
        self.register_buffer(name, _tensor(values), persistent=False)


def _corrections(response: LinearResponse, samples: Samples) -> Floats:
    return samples.displacements - response.apply(samples.forces)


def _images_of(
    encoder_decoder: LinearEncoderDecoder, network: AveragedNetwork, samples: NewSamples
) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates, (s, r), corrections, (s, r), and weights, (s,), of all symmetric images: new ones first."""
    assert encoder_decoder.decode is not None
    new_loads, new_states = [samples.loads], [samples.displacements]
    for load, state, pushes, changes in zip(
        samples.loads, samples.displacements, samples.pushes, samples.changes, strict=True
    ):
        new_loads += [load + pushes, load - pushes]
        new_states += [state + changes, state - changes]
    new = np.concatenate(new_loads), np.concatenate(new_states)
    known = samples.known_loads, samples.known_displacements
    mean = float(np.mean(np.concatenate([np.square(each[1]).sum(axis=1) for each in (new, known)])))
    turns, parts = network.turns.numpy(), []
    for loads, states in (new, known):
        coordinates = encoder_decoder.encoded(loads.T).T
        corrections = (states - encoder_decoder.linear(loads.T).T) @ encoder_decoder.decode
        weights = 1.0 / (np.sqrt(np.square(states).sum(axis=1) * mean) + _LEAST_WEIGHED * mean)
        images = [
            np.einsum("gij,sj->gsi", turns, each).reshape(-1, len(turns[0])) for each in (coordinates, corrections)
        ]
        parts.append((*images, np.tile(weights, len(turns))))
    whole = [_tensor(np.concatenate(each)) for each in zip(*parts, strict=True)]
    return whole[0], whole[1], whole[2]


def _basis_of(stored: Jacobians, data: DataSet, settings: Reduced) -> ReducedBasis:
    if stored.modes.shape[1] > settings.modes:
        raise ValueError(
            f"Reduced.modes: expected at least the {stored.modes.shape[1]} that the Jacobians in {data.path} are of, "
            f"got {settings.modes}; make the Jacobians again, or leave them out with sobolev = 0."
        )
    return basis_of(data, stored.modes, settings.symmetries)


def _deviation(coordinates: Floats) -> Floats:
    """Root mean square of each coordinate about zero: loads come in both signs."""
    return np.sqrt((coordinates**2).mean(axis=0))


def _tensor(values: Floats) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
