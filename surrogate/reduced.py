"""The reduced network: linear response plus a small residual network between POD coordinates."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.spatial import cKDTree
from scipy.special import ndtr
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.reference.dataset import DataSet, LinearResponse, Samples

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_ROOT_TWO_PI = float(np.sqrt(2.0 * np.pi))
_TINY = 1e-30  # a number in single precision, too
_GATE = 0.1  # size of the scaled input, relative to its usual one, below which the correction fades quadratically
_FLOOR = 0.01  # keeps the semi-relative loss finite for loads near zero
_SHARE = 4  # one sample in so many enters the gradient's loss: it costs three times the other and needs fewer
_DENSE = 3000  # largest eigenproblem of the POD solved directly


# ------------------------------------------------------------------ symmetries


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A motion that maps a body onto itself.

    Args:
        nodes: the node that each node lands on, (n,).
        rotation: orthogonal matrix, (3, 3), that vectors turn by; of determinant -1 for a mirror.
    """

    nodes: Ints
    rotation: Floats

    def apply(self, fields: Floats) -> Floats:
        """The nodal vector fields (s, n, 3), moved and turned with the body."""
        moved = np.empty_like(fields)
        moved[:, self.nodes] = fields @ self.rotation.T
        return moved


def identity(body: Body) -> Symmetry:
    """The symmetry that every body has."""
    return Symmetry(np.arange(len(body.points)), np.eye(3))


def symmetries(body: Body, loaded: Ints, tolerance: float = 1e-6) -> tuple[Symmetry, ...]:
    """The symmetries of a discrete body of isotropic material among axis swaps and mirrors; the identity comes first.

    Axes are those of the coordinates or, where these show none, the principal axes of the nodes. Nodes must land on
    nodes, cells on cells, fixed on fixed and loaded on loaded nodes.

    Args:
        body: the body.
        loaded: numbers of the nodes that may carry force, (l,).
        tolerance: largest distance between a moved node and its partner, relative to the body's size.
    """
    centred = body.points - body.points.mean(axis=0)
    tree = cKDTree(centred)
    for axes in (np.eye(3), np.linalg.eigh(centred.T @ centred)[1]):
        found = [identity(body)]
        for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
            rotation = axes @ (np.array(signs)[:, None] * np.eye(3)[list(order)]) @ axes.T
            distance, nodes = tree.query(centred @ rotation.T)
            moved = not np.allclose(rotation, np.eye(3))
            if moved and distance.max() < tolerance * body.size and _maps(body, loaded, nodes):
                found.append(Symmetry(nodes, rotation))
        if len(found) > 1:
            return tuple(found)
    return (identity(body),)


def _maps(body: Body, loaded: Ints, nodes: Ints) -> bool:
    cells = np.sort(body.cells, axis=1)
    images = np.sort(nodes[body.cells], axis=1)
    return (
        len(np.unique(nodes)) == len(nodes)
        and np.array_equal(np.sort(nodes[body.fixed]), body.fixed)
        and np.array_equal(np.sort(nodes[loaded]), np.sort(loaded))
        and np.array_equal(np.unique(cells, axis=0), np.unique(images, axis=0))
    )


# ------------------------------------------------------------------ the basis


def correction_modes(corrections: Floats, fixed: Ints, group: Sequence[Symmetry], count: int) -> Floats:
    """Orthonormal POD modes of nodal fields and of their symmetric images, (3n, r), exactly zero at fixed nodes.

    With several symmetries no cluster of equal singular values is cut, so that the modes span an invariant space.

    Args:
        corrections: snapshots, (s, n, 3).
        fixed: numbers of the fixed nodes.
        group: symmetries of the body, the identity alone for none.
        count: most modes wanted; fewer come where the snapshots hold fewer.

    Raises:
        ValueError: the snapshots are all zero.
    """
    energies, modes = _leading(corrections, group, count + 1)
    if not energies[0] > 0.0:
        raise ValueError("corrections: expected displacements that differ from the linear response, got none that do.")
    kept = min(count, int((energies > 1e-12 * energies[0]).sum()))
    if len(group) > 1:
        while 1 < kept < len(energies) and energies[kept - 1] - energies[kept] < 1e-6 * energies[kept - 1]:
            kept -= 1
    modes = np.ascontiguousarray(modes[:, :kept])
    modes.reshape(len(corrections[0]), 3, kept)[fixed] = 0.0
    return modes


def _leading(fields: Floats, group: Sequence[Symmetry], count: int) -> tuple[Floats, Floats]:
    """Largest eigenvalues and eigenvectors of the covariance of the fields and their images, largest first."""
    rows = np.concatenate([motion.apply(fields).reshape(len(fields), -1) for motion in group])
    samples, size = rows.shape
    count = min(count, samples, size)
    if min(samples, size) > _DENSE:
        return _leading_iterated(rows, count)
    small = rows.T @ rows if size <= samples else rows @ rows.T
    energies, vectors = eigh(small, subset_by_index=(len(small) - count, len(small) - 1))
    energies, vectors = np.maximum(energies[::-1], 0.0), vectors[:, ::-1]
    if size > samples:
        vectors = np.linalg.qr(rows.T @ vectors / np.sqrt(np.maximum(energies, 1e-300)))[0]
    return energies, vectors


def _leading_iterated(rows: Floats, count: int) -> tuple[Floats, Floats]:
    """The same by subspace iteration (Halko, Martinsson, Tropp 2011), for many samples of many unknowns."""
    basis = np.random.default_rng(0).standard_normal((rows.shape[1], count + 32))
    for _ in range(6):
        basis = np.linalg.qr(rows.T @ (rows @ basis))[0]
    _, values, turn = np.linalg.svd(rows @ basis, full_matrices=False)
    return np.square(values[:count]), basis @ turn[:count].T


@dataclass(frozen=True, eq=False)
class ReducedBasis:
    """The coordinates that the reduced network works in.

    Args:
        modes: V, orthonormal, (3n, r), zero at fixed nodes.
        loaded: numbers of the loaded nodes, (l,).
        turns: what each symmetry does to reduced coordinates, (g, r, r).
    """

    modes: Floats
    loaded: Ints
    turns: Floats

    @property
    def count(self) -> int:
        """Number of modes."""
        return self.modes.shape[1]

    @property
    def restricted(self) -> Floats:
        """Modes at the loaded nodes, (3l, r)."""
        return self.modes.reshape(-1, 3, self.count)[self.loaded].reshape(-1, self.count)

    def images(self, coordinates: Floats) -> Floats:
        """Reduced coordinates (s, r) of all symmetric images, (g s, r), symmetry by symmetry."""
        return np.concatenate([coordinates @ turn.T for turn in self.turns])


def build_basis(corrections: Floats, body: Body, loaded: Ints, group: Sequence[Symmetry], count: int) -> ReducedBasis:
    """The reduced basis of weighted corrections (s, n, 3): see `correction_modes`."""
    modes = correction_modes(corrections, body.fixed, group, count)
    fields = modes.T.reshape(-1, *body.points.shape)
    turns = np.stack([modes.T @ motion.apply(fields).reshape(len(fields), -1).T for motion in group])
    return ReducedBasis(modes, loaded, turns)


# ------------------------------------------------------------------ the network


class ReducedNetwork(nn.Module):
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

    def forward(self, coordinates: Tensor) -> Tensor:
        """Correction coordinates, (s, r), metres, for load coordinates, (s, r), newtons."""
        x = coordinates * self.input_scale
        values = self._blocks(torch.cat([x, torch.zeros_like(x[:1])]))
        square = x.square().mean(dim=1, keepdim=True)
        gate = (square / (square + _GATE**2) + 1e-12).sqrt()  # the 1e-12 keeps the root differentiable at zero
        return gate * (values[:-1] - values[-1:]) * self.output_scale

    def _blocks(self, x: Tensor) -> Tensor:
        hidden = self.enter(x)
        for inner, outer in zip(self.inner, self.outer, strict=True):
            hidden = hidden + outer(nn.functional.gelu(inner(hidden)))
        return self.leave(hidden)


@dataclass(frozen=True, eq=False)
class ReducedCore:
    """The trained reduced network in plain arrays, averaged over the symmetries, with its derivatives.

    Args:
        weights: the network's arrays by name, and `turns`, (g, r, r).
    """

    weights: dict[str, Floats]

    def arrays(self) -> dict[str, Floats]:
        """What to store."""
        return self.weights

    @property
    def depth(self) -> int:
        """Number of residual blocks."""
        return sum(name.startswith("inner") and name.endswith("weight") for name in self.weights)

    def evaluate(self, coordinates: Floats, *, single: bool = False) -> tuple[Floats, Any]:
        """Correction coordinates, (r,), for load coordinates, (r,), and a record that `push` and `pull` go on from.

        Args:
            coordinates: of the load.
            single: in single precision: good to 1e-6, in half of the time.
        """
        w: dict[str, Any] = self.weights
        if single:
            w, coordinates = self._single, coordinates.astype(np.float32)
        x = (w["turns"] @ coordinates) * w["input_scale"]  # (g, r)
        hidden, slopes = x @ w["enter.weight"].T + w["enter.bias"], []
        for i in range(self.depth):
            z = hidden @ w[f"inner.{i}.weight"].T + w[f"inner.{i}.bias"]
            share = ndtr(z)
            slopes.append(share + z * np.exp(-0.5 * z * z) / _ROOT_TWO_PI)
            hidden = hidden + (z * share) @ w[f"outer.{i}.weight"].T + w[f"outer.{i}.bias"]
        values = hidden @ w["leave.weight"].T + w["leave.bias"] - w["rest"]
        square = (x * x).mean(axis=1, keepdims=True)
        gate = np.sqrt(square / (square + _GATE**2))
        # d gate = slope . dx, zero at rest where values is zero as well
        slope = x * _GATE**2 / (np.maximum(gate, _TINY) * (square + _GATE**2) ** 2 * x.shape[1])
        mean = np.einsum("gij,gi->j", w["turns"], gate * values * w["output_scale"]) / len(w["turns"])
        return mean.astype(np.float64), (gate, slope, values, slopes)

    @cached_property
    def _single(self) -> dict[str, NDArray[np.float32]]:
        return {name: array.astype(np.float32) for name, array in self.weights.items()}

    def push(self, record: Any, tangents: Floats, *, single: bool = False) -> Floats:
        """Change of the correction coordinates, (r, k), for changes of the load coordinates, (r, k).

        Args:
            record: from `evaluate`.
            tangents: changes of the load coordinates.
            single: in single precision: good to 1e-6, in half of the time.
        """
        w: dict[str, Any] = self.weights
        gate, slope, values, slopes = record
        if single:
            w, tangents = self._single, tangents.astype(np.float32)
            gate, slope, values = (array.astype(np.float32, copy=False) for array in (gate, slope, values))
            slopes = [array.astype(np.float32, copy=False) for array in slopes]
        dx = (w["turns"] @ tangents) * w["input_scale"][:, None]  # (g, r, k)
        hidden = w["enter.weight"] @ dx
        for i in range(self.depth):
            hidden = hidden + w[f"outer.{i}.weight"] @ (slopes[i][:, :, None] * (w[f"inner.{i}.weight"] @ hidden))
        change = gate[:, :, None] * (w["leave.weight"] @ hidden) + values[:, :, None] * (slope[:, None, :] @ dx)
        change *= w["output_scale"]
        mean: Floats = (w["turns"].transpose(0, 2, 1) @ change).mean(axis=0).astype(np.float64)
        return mean

    def pull(self, record: Any, cotangent: Floats) -> Floats:
        """Gradient with respect to the load coordinates, (r,), for one with respect to the correction, (r,)."""
        w = self.weights
        gate, slope, values, slopes = record
        change = (w["turns"] @ cotangent) * w["output_scale"] / len(w["turns"])  # (g, r)
        hidden = (gate * change) @ w["leave.weight"]
        for i in reversed(range(self.depth)):
            hidden = hidden + (slopes[i] * (hidden @ w[f"outer.{i}.weight"])) @ w[f"inner.{i}.weight"]
        dx = hidden @ w["enter.weight"] + slope * (values * change).sum(axis=1, keepdims=True)
        return np.einsum("gij,gi->j", w["turns"], dx * w["input_scale"])


def freeze(network: ReducedNetwork, basis: ReducedBasis) -> ReducedCore:
    """The network's arrays in float64, averaged over the symmetries of the basis."""
    weights = {name: value.double().cpu().numpy() for name, value in network.state_dict().items()}
    core = ReducedCore(weights | {"turns": basis.turns, "rest": np.zeros(basis.count)})
    _, (_, _, values, _) = core.evaluate(np.zeros(basis.count))
    return ReducedCore(core.weights | {"rest": values[0]})


# ------------------------------------------------------------------ what it learns


class ReducedLesson(nn.Module):
    """The reduced network with its training data in reduced coordinates; loss and validation error are methods.

    The loss is |u - u*|^2 / (|u*| rms + 0.01 rms^2), without the part outside the modes, plus `sobolev` times the
    squared relative error of the gradient J^T g against the stored adjoints.

    Args:
        data: the data set, for its body, modes and linear response.
        train: training samples.
        validation: validation samples.
        modes: most POD modes.
        width: width of the network.
        depth: its residual blocks.
        sobolev: weight of the gradient's error; 0 leaves it out.
        use_symmetries: learn from symmetric images too, and average over them when predicting.

    Raises:
        ValueError: no training samples, or none that differ from the linear response.
    """

    loads: Tensor
    targets: Tensor
    weights: Tensor
    cotangents: Tensor
    adjoints: Tensor
    adjoint_weights: Tensor
    metric: Tensor
    validation_loads: Tensor
    validation_targets: Tensor
    validation_rest: Tensor
    validation_weights: Tensor

    def __init__(
        self,
        data: DataSet,
        train: Samples,
        validation: Samples,
        modes: int,
        width: int,
        depth: int,
        sobolev: float,
        use_symmetries: bool,
    ) -> None:
        super().__init__()
        self.response = data.response
        self.sobolev = sobolev
        loaded = data.response.loaded
        group = symmetries(data.body, loaded) if use_symmetries else (identity(data.body),)
        self._rms = float(np.sqrt(np.mean(_sizes(train.displacements) ** 2)))
        corrections = _corrections(data.response, train)
        weights = 1.0 / np.sqrt(self._scale(train))
        self.basis = build_basis(corrections * weights[:, None, None], data.body, loaded, group, modes)
        self._store_training(data, train, corrections)
        self._store_validation(validation, _corrections(data.response, validation))
        self._build(train, width, depth)

    @property
    def sample_count(self) -> int:
        """Number of training samples, symmetric images counted."""
        return len(self.targets)

    def loss(self, batch: Tensor) -> Tensor:
        """Loss over the samples with the given numbers; the gradient's error over the first quarter of them."""
        missed = (self.network(self.loads[batch]) - self.targets[batch]).square().sum(dim=1)
        loss = (missed * self.weights[batch]).mean()
        return loss + self.sobolev * self._gradient_loss(batch[: -(-len(batch) // _SHARE)]) if self.sobolev else loss

    def _gradient_loss(self, batch: Tensor) -> Tensor:
        loads = self.loads[batch].requires_grad_()
        (pulled,) = torch.autograd.grad(self.network(loads), loads, self.cotangents[batch], create_graph=True)
        missed = (pulled @ self.metric.T - self.adjoints[batch]).square().sum(dim=1)
        return (missed * self.adjoint_weights[batch]).mean()

    @torch.no_grad()
    def error(self) -> float:
        """Mean over the validation samples of the root of the semi-relative error, outside the modes too."""
        missed = (self.network(self.validation_loads) - self.validation_targets).square().sum(dim=1)
        return float(((missed + self.validation_rest) * self.validation_weights).sqrt().mean())

    def core(self) -> ReducedCore:
        """The network as it is now, ready to predict."""
        return freeze(self.network, self.basis)

    def _build(self, train: Samples, width: int, depth: int) -> None:
        linear = self.response.apply(train.forces).reshape(len(train), -1) @ self.basis.modes
        importance = _deviation(self.basis.images(linear))
        # between whitening, which drowns in the small coordinates, and importance, which starves them
        spread = _deviation(self.loads.double().numpy())
        spread = np.maximum(spread, 1e-3 * spread.max())  # a direction hardly ever loaded must not be blown up
        scale = (importance / importance.max()) ** 0.25 / spread
        size = float(self.targets.square().mean().sqrt())
        self.network = ReducedNetwork(_tensor(scale), size, width, depth)

    def _scale(self, samples: Samples) -> Floats:
        return _sizes(samples.displacements) * self._rms + _FLOOR * self._rms**2

    def _store_training(self, data: DataSet, train: Samples, corrections: Floats) -> None:
        basis, group = self.basis, len(self.basis.turns)
        self._store("loads", basis.images(train.forces.reshape(len(train), -1) @ basis.restricted))
        self._store("targets", basis.images(corrections.reshape(len(train), -1) @ basis.modes))
        self._store("weights", np.tile(1.0 / self._scale(train), group))
        if self.sobolev > 0.0:
            self._store_adjoints(data, train)

    def _store_adjoints(self, data: DataSet, train: Samples) -> None:
        """|h - LR^T g - P y|^2 = |R y - Q^T (h - LR^T g)|^2 + const for P = Q R: r numbers a sample instead of 3l."""
        basis, group = self.basis, len(self.basis.turns)
        cotangents = probe_cotangents(data.body, data.shapes, train.probes).reshape(len(train), -1)
        adjoints = train.adjoints.reshape(len(train), -1)
        missing = (adjoints - cotangents @ data.response.left @ data.response.right) @ basis.restricted
        # In coordinates P^T d and the metric (P^T P)^(1/2), which commute with the symmetries, unlike Q and R.
        values, vectors = np.linalg.eigh(basis.restricted.T @ basis.restricted)
        values = np.maximum(values, 1e-12 * values.max())
        self._store("metric", (vectors * np.sqrt(values)) @ vectors.T)
        self._store("adjoints", basis.images(missing @ (vectors / np.sqrt(values)) @ vectors.T))
        self._store("cotangents", basis.images(cotangents @ basis.modes))
        sizes = np.maximum((adjoints**2).sum(axis=1), 1e-300)
        self._store("adjoint_weights", np.tile(1.0 / sizes, group))

    def _store_validation(self, validation: Samples, corrections: Floats) -> None:
        flat = corrections.reshape(len(validation), -1)
        targets = flat @ self.basis.modes
        self._store("validation_loads", validation.forces.reshape(len(validation), -1) @ self.basis.restricted)
        self._store("validation_targets", targets)
        self._store("validation_rest", ((flat - targets @ self.basis.modes.T) ** 2).sum(axis=1))
        self._store("validation_weights", 1.0 / self._scale(validation))

    def _store(self, name: str, values: Floats) -> None:
        self.register_buffer(name, _tensor(values), persistent=False)


def probe_cotangents(body: Body, shapes: Floats, probes: Floats) -> Floats:
    """The cotangents that probes (s, k) stand for, (s, n, 3): combinations of the modes, on the boundary only."""
    cotangents = np.zeros((len(probes), *body.points.shape))
    nodes = body.boundary_nodes
    cotangents[:, nodes] = np.tensordot(probes, shapes[:, nodes], axes=1)
    return cotangents


def _corrections(response: LinearResponse, samples: Samples) -> Floats:
    return samples.displacements - response.apply(samples.forces)


def _sizes(fields: Floats) -> Floats:
    return np.linalg.norm(fields.reshape(len(fields), -1), axis=1)


def _deviation(coordinates: Floats) -> Floats:
    """Root mean square of each coordinate about zero: loads come in both signs."""
    return np.sqrt((coordinates**2).mean(axis=0))


def _tensor(values: Floats) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
