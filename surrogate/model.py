"""The trained surrogate as a forward model: displacement and derivatives from forces."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from softtwin.meshes.body import Body
from softtwin.meshes.sparse_products import product
from softtwin.reference.data.discrepancy import Discrepancy
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.loading import checked_array
from softtwin.reference.data.springs import Support, springs_of

from .architecture import Linearisation, Network
from .encoder_decoder import LinearEncoderDecoder
from .galerkin import is_of_springs, varied

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_REMEMBERED = 256  # columns of forces


class SurrogateState:
    """What a surrogate predicts under one load, with its derivatives: a value.

    Args:
        surrogate: the surrogate.
        coordinates: of the load, that the network takes, (d,).
        linear: linear part of the displacement, (3n,), metres.
        near: the network at a load nearby, if one is known.
        network: for another tissue than the surrogate's own, where there is one.
        tissue: parameters of that, by name; empty for the surrogate's own.
        stiffening: how many times as stiff as its own it is: coordinates and linear part are of the load over it.
        springs: how many times as stiff as its own springs are, by the surface that they hold.
    """

    negative_pivots: int | None = None  # a network has no tangent to count them of

    def __init__(
        self,
        surrogate: Surrogate,
        coordinates: Floats,
        linear: Floats,
        near: Linearisation | None = None,
        network: Network | None = None,
        tissue: Mapping[str, ArrayLike] = MappingProxyType({}),
        stiffening: float = 1.0,
        springs: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        encoder_decoder = surrogate.encoder_decoder
        self.springs = springs
        self._surrogate, self.coordinates, self.tissue, self._stiffening = surrogate, coordinates, tissue, stiffening
        self._linear = linear
        self.inner = (network or surrogate.network).linearised(torch.from_numpy(coordinates), near)
        self.displacement: Floats = (
            encoder_decoder.offset + linear + encoder_decoder.decoded(self.inner.values.numpy())
        ).reshape(-1, 3)

    @property
    def distance(self) -> float | None:
        """How far out the load lies in the network's own coordinates, each in units of its spread over the training.

        1 at the farthest load of the training; None where that was not measured. It costs next to nothing on any body.
        """
        spread, domain = self._surrogate.encoder_decoder.spread, self._surrogate.card.get("domain")
        if spread is None or domain is None:
            return None
        scaled = self.coordinates / spread
        return float(np.sqrt(scaled @ scaled / len(scaled)) / domain["reach"])

    @property
    def extrapolation_ratio(self) -> float | None:
        """How far the load lies out: 1 at the farthest load of the training; None where that was not measured.

        The largest of `distance`, of the largest displacement of a node, relative to the largest of the training, and
        of how far out the tissue lies.
        """
        far = self.distance
        if far is None:
            return None
        moved = np.sqrt(np.einsum("ni,ni->n", self.displacement, self.displacement).max())
        return float(max(far, moved / self._surrogate.card["domain"]["displacement_m"], self._tissue_ratio))

    @property
    def _tissue_ratio(self) -> float:
        """How far out the tissue lies, 1 at the ends of the ranges that the surrogate was made for."""
        worst = 0.0
        for name, (low, high) in self._surrogate.card.get("plan", {}).get("vary", {}).items():
            if is_of_springs(name):
                factor = self.springs.get(name.partition("@")[2], 1.0)
                far = np.log(max(factor, 1e-300) ** 2 / (low * high)) / np.log(high / low)
                worst = max(worst, abs(float(far)))
                continue
            parameter, cells = self._surrogate.varied(name)
            if parameter in self.tissue:
                values = np.asarray(self.tissue[parameter], dtype=np.float64)
                here = values if cells is None or values.ndim == 0 else values[cells]
                worst = max(worst, float(np.abs(here - 0.5 * (low + high)).max()) / (0.5 * (high - low)))
        return worst

    @property
    def is_inside(self) -> bool | None:
        """Whether the extrapolation ratio is 1 at most, within the training loads; None where it is not known."""
        extrapolation_ratio = self.extrapolation_ratio
        return None if extrapolation_ratio is None else extrapolation_ratio <= 1.0

    def jvp(self, changes: ArrayLike) -> Floats:
        """J B, (3n, k), for changes of the forces B, (3n, k).

        Raises:
            ValueError: another shape, numbers that are not finite, or changes at nodes that never carry load.
        """
        linear, encoded = self._surrogate.linear_jvp(changes)
        found = linear + self._surrogate.encoder_decoder.decoded(tangent(self.inner, encoded))
        return found / self._stiffening

    def jvp_inputs(self, changes: Sequence[Change]) -> Floats:
        """Change of the displacement, (3n, k), for k changes of forces and parameters of the tissue.

        Raises:
            ValueError: prescribed displacements that change, which a surrogate has learned one of; parameters that the
                law does not have, springs that there are not.
        """
        found = np.zeros((self.displacement.size, len(changes)))
        for place, change in enumerate(changes):
            if change.displacement is not None:
                raise ValueError(
                    "SurrogateState.jvp_inputs: expected forces, parameters of the tissue and springs, got "
                    "displacements; the reference knows them (--model reference)."
                )
            if change.forces is not None:
                forces = np.asarray(change.forces, dtype=np.float64).reshape(-1, 1)
                found[:, place] += self.jvp(forces)[:, 0]
            if change.parameters or change.springs:
                found[:, place] += self._by_tissue(change.parameters, change.springs)
        return found

    def _by_tissue(self, changes: Mapping[str, ArrayLike], springs: Mapping[str, float]) -> Floats:
        """Change of the displacement, (3n,), as parameters of the tissue and springs change.

        What all cells share of a change of Young's modulus is one of the load: u(b, E) = u(b / s, E / s).
        """
        surrogate = self._surrogate
        if not surrogate.takes_inputs:
            raise ValueError(
                "SurrogateState.jvp_inputs: expected forces, got parameters of the one tissue that is known or springs."
            )
        rates, shared = dict(changes), 0.0
        if "young_modulus" in rates and surrogate.network.stiffening({"young_modulus": 1.0}) != 1.0:
            modulus = np.asarray(self.tissue.get("young_modulus", surrogate.own_modulus), dtype=np.float64)
            rate = np.asarray(rates["young_modulus"], dtype=np.float64)
            modulus, rate = np.broadcast_arrays(modulus, rate)
            shared = float((rate / modulus).mean())
            rates["young_modulus"] = (rate - shared * modulus) / self._stiffening
        values = self.inner.jvp_parameters(rates, springs).numpy()  # type: ignore[attr-defined]
        encoder_decoder = surrogate.encoder_decoder
        by_load = self._linear + encoder_decoder.decoded(tangent(self.inner, self.coordinates[:, None])[:, 0])
        return np.asarray(encoder_decoder.decoded(values) - shared * by_load)

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3): J^T g, zero at nodes that never carry load.

        Args:
            cotangent: g, gradient with respect to the displacement, (n, 3), or several, (k, n, 3).

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        given, shape = np.asarray(cotangent, dtype=np.float64), self.displacement.shape
        if given.ndim == 3 and len(given):
            return np.stack([self.vjp(each) for each in given])
        encoder_decoder = self._surrogate.encoder_decoder
        flat = checked_array("SurrogateState.cotangent", given, shape).ravel()
        gradient = np.zeros_like(flat)
        inner = self.inner.vjp(torch.from_numpy(encoder_decoder.decoded_adjoint(flat))).numpy()
        gradient[self._surrogate.rows] = encoder_decoder.linear_adjoint(flat) + encoder_decoder.encoded_adjoint(inner)
        return gradient.reshape(-1, 3) / self._stiffening


class Surrogate:
    """A trained network as a forward model with frozen weights.

    It satisfies what registration asks of a forward model and runs in double precision on the CPU.

    Args:
        body: the body it was trained on.
        encoder_decoder: linear maps around the network.
        network: the network, in double precision, on the CPU, its weights frozen.
        card: what it was trained on and how well it does.
    """

    is_concurrent = True  # a state is a value: two threads may ask for states at a time

    def __init__(
        self, body: Body, encoder_decoder: LinearEncoderDecoder, network: Network, card: Mapping[str, Any]
    ) -> None:
        self.body = body
        self.encoder_decoder = encoder_decoder
        self.network = network
        self.card: Mapping[str, Any] = MappingProxyType(dict(card))
        self.rows = (3 * encoder_decoder.loaded[:, None] + np.arange(3)).ravel()
        self._wanted: tuple[Ints, Floats] = np.zeros(0, dtype=np.int64), encoder_decoder.left[:0]  # rows, left's rows
        self._pushed: tuple[Floats, Floats, Floats] | None = None  # changes, linear parts, coordinates
        self._cells: dict[str, tuple[str, Ints | None]] = {}  # of what may vary
        self._idle = np.setdiff1d(np.arange(len(body.points)), np.union1d(encoder_decoder.loaded, body.fixed))

    @cached_property
    def single(self) -> Network:
        """The network in single precision: good to 1e-6, in half of the time."""
        return self.network.rounded()

    @property
    def error(self) -> float:
        """Largest error of a node over the body, mean of the held-out samples, metres; 0 where it was not measured."""
        held_out = self.card.get("held_out") or {}
        return float(held_out.get("largest_error", {}).get("mean", 0.0))

    @property
    def learned_material(self) -> Mapping[str, Any] | None:
        """`material`, `young_modulus`, `poisson_ratio` of what it has learned from; None where the card is silent."""
        plan = self.card.get("data", {}).get("plan", {})
        names = ("material", "young_modulus", "poisson_ratio")
        return {name: plan[name] for name in names} if all(name in plan for name in names) else None

    @property
    def learned_springs(self) -> dict[str, Support]:
        """That held the body in what it has learned from, by the surface that they held."""
        return springs_of(self.card.get("data", {}).get("plan", {}))

    @property
    def is_linear(self) -> bool:
        """Whether the law that it has learned is linear; False where that is not known."""
        plan = self.card.get("data", {}).get("plan", {})
        return bool(plan.get("material") == "linear-elastic")

    @cached_property
    def discrepancy(self) -> Discrepancy | None:
        """The errors of the validation samples as patterns; None where they were not measured."""
        modes, rest, known = (
            self.encoder_decoder.error_modes,
            self.encoder_decoder.error_rest,
            self.card.get("discrepancy"),
        )
        return None if modes is None or rest is None or not known else Discrepancy(modes, rest, known["places"])

    @property
    def takes_inputs(self) -> bool:
        """Whether states can be asked for with another tissue than the one that was learned."""
        return type(self.network).with_parameters is not Network.with_parameters

    def solve(self, forces: ArrayLike, near: Any = None, inputs: Inputs | None = None) -> SurrogateState:
        """The state under nodal forces, (n, 3) newtons.

        Args:
            forces: nodal forces, (n, 3), newtons.
            near: a state of this surrogate under a load nearby; networks that look for their values begin there.
            inputs: another tissue and springs, for networks that take them, and more forces.

        Raises:
            ValueError: another shape, numbers that are not finite, or forces at nodes that the surrogate never saw
                loaded. Forces at fixed nodes move nothing and are let pass. Inputs that it has learned one value of.
        """
        load = checked_array("Surrogate.forces", forces, self.body.points.shape)
        network, stiffening = self.network, 1.0
        tissue: dict[str, ArrayLike] = {}
        springs = {} if inputs is None else dict(inputs.springs)
        if inputs is not None:
            if inputs.displacement:
                raise ValueError(
                    "Surrogate.inputs: expected a tissue, springs and forces, got displacements, of which it has "
                    "learned one; the reference knows others (--model reference)."
                )
            if inputs.forces is not None:
                load = load + checked_array("Surrogate.inputs.forces", inputs.forces, load.shape)
            if inputs.parameters:
                tissue = dict(inputs.parameters)
                stiffening = network.stiffening(tissue)
                modulus = (
                    {"young_modulus": np.asarray(tissue["young_modulus"]) / stiffening} if stiffening != 1.0 else {}
                )
                network = network.with_parameters({**tissue, **modulus})
            if springs:
                network = network.with_springs(springs)
        self._refuse_idle("forces", np.abs(load).max(axis=1))
        loads = load.ravel()[self.rows] / stiffening
        start = near.inner if isinstance(near, SurrogateState) and near._surrogate is self else None
        encoded, linear = self.encoder_decoder.encoded(loads), self.encoder_decoder.linear(loads)
        return SurrogateState(self, encoded, linear, start, network, tissue, stiffening, springs)

    def varied(self, name: str) -> tuple[str, Ints | None]:
        """The parameter that a name of `vary` stands for, and the cells where it is meant; looked up once."""
        if name not in self._cells:
            self._cells[name] = varied(name, self.body)
        return self._cells[name]

    @property
    def own_modulus(self) -> float:
        """Young's modulus of the tissue that it has learned, pascals; 1 where the card is silent."""
        return float((self.learned_material or {}).get("young_modulus", 1.0))

    def propose(self, forces: ArrayLike, linear: Floats | None = None) -> Floats:
        """The displacement alone, (n, 3), metres, in single precision and half of the time: for Newton to start from.

        Args:
            forces: nodal forces, (n, 3), newtons.
            linear: linear response to them, (n, 3), metres, where the caller has it: to read one's own costs most.

        Raises:
            ValueError: as `solve`.
        """
        load = checked_array("Surrogate.forces", forces, self.body.points.shape)
        self._refuse_idle("forces", np.abs(load).max(axis=1))
        loads, encoder_decoder = load.ravel()[self.rows].astype(np.float32), self._rounded
        values = self.single.linearised(torch.from_numpy(encoder_decoder.encoded(loads))).values.numpy()
        known = linear is not None and encoder_decoder.left.shape[1] > 0
        rest = linear.ravel() if known and linear is not None else encoder_decoder.linear(loads)
        return np.float64(encoder_decoder.offset + rest + encoder_decoder.decoded(values)).reshape(-1, 3)

    @cached_property
    def _rounded(self) -> LinearEncoderDecoder:
        return self.encoder_decoder.rounded()

    def reduced(self, nodes: ArrayLike, basis: ArrayLike) -> ReducedSurrogate:
        """The surrogate between a few force coefficients and a few nodes, all that can be computed before computed.

        Args:
            nodes: numbers of the nodes whose displacement is wanted, (p,).
            basis: force basis B, (3n, k), newtons; the forces are B c for coefficients c.

        Raises:
            ValueError: node numbers out of range, or a basis as `SurrogateState.jvp` refuses it.
        """
        chosen = np.asarray(nodes)
        if chosen.ndim != 1 or not np.issubdtype(chosen.dtype, np.integer):
            raise ValueError(f"nodes: expected numbers of shape (p,), got {chosen.dtype} of shape {chosen.shape}.")
        if len(chosen) and (chosen.min() < 0 or chosen.max() >= len(self.body.points)):
            raise ValueError(f"nodes: expected 0..{len(self.body.points) - 1}, got {chosen.min()}..{chosen.max()}.")
        return ReducedSurrogate(self, chosen, self.at_loaded("basis", basis))

    def linear_rows(self, rows: Ints, columns: Floats) -> Floats:
        """Some rows of the linear part of the displacement, (q, k), for less than the whole.

        Args:
            rows: numbers of the wanted components, (q,).
            columns: forces at the loaded nodes, (3l, k), newtons.
        """
        if not np.array_equal(self._wanted[0], rows):  # each cold frame asks for the same again
            self._wanted = rows, np.ascontiguousarray(self.encoder_decoder.left[rows])
        return self._wanted[1] @ (
            columns if self.encoder_decoder.right is None else self.encoder_decoder.right @ columns
        )

    def linear_jvp(self, changes: ArrayLike) -> tuple[Floats, Floats]:
        """What changes of the forces B, (3n, k), do in any state: J B's linear part, (3n, k), and coordinates, (d, k).

        Raises:
            ValueError: see `SurrogateState.jvp`.
        """
        known = self._pushed  # read once: another thread may ask for something else
        if known is None or not np.array_equal(known[0], changes):
            columns = self.at_loaded("changes", changes)
            known = (
                np.array(changes, dtype=np.float64),
                self.encoder_decoder.linear(columns),
                self.encoder_decoder.encoded(columns),
            )
            if columns.shape[1] <= _REMEMBERED:  # each frame asks for the same, a whole Jacobian is asked for once
                self._pushed = known
        return known[1], known[2]

    def with_card(self, **entries: Any) -> Surrogate:
        """The same surrogate with more entries in its card, for instance held-out errors."""
        return Surrogate(self.body, self.encoder_decoder, self.network, {**self.card, **entries})

    def unseen(self, forces: Floats) -> Ints:
        """Nodes that forces, (n, 3), act on though none did in training: of those a prediction would know nothing."""
        return self._idle[np.abs(forces[self._idle]).max(axis=1) > 0.0]

    def at_loaded(self, name: str, columns: ArrayLike) -> Floats:
        """Columns of nodal forces (3n, k) at the loaded nodes, (3l, k).

        Raises:
            ValueError: another shape, numbers that are not finite, or forces at nodes that never carry load.
        """
        array = np.asarray(columns, dtype=np.float64)
        expected = self.body.points.size
        if array.ndim != 2 or array.shape[0] != expected:
            raise ValueError(f"Surrogate.{name}: expected shape ({expected}, k), got {array.shape}.")
        checked_array(f"Surrogate.{name}", array, array.shape)
        self._refuse_idle(name, np.abs(array).reshape(-1, 3 * array.shape[1]).max(axis=1, initial=0.0))
        return array[self.rows]

    def _refuse_idle(self, name: str, sizes: Floats) -> None:
        bad = self._idle[sizes[self._idle] > 0.0]
        if len(bad):
            raise ValueError(
                f"Surrogate.{name}: expected forces at the {len(self.encoder_decoder.loaded)} nodes loaded in "
                f"training (surrogate.encoder_decoder.loaded), got {len(bad)} others, first {bad[:5].tolist()}."
            )


def tangent(inner: Linearisation, columns: Floats) -> Floats:
    """Network derivative times columns (d, k), (e, k), by way of the whole derivative where they outnumber it."""
    size, kind = columns.shape[0], inner.values.dtype
    if columns.shape[1] > size:
        whole = inner.jvp(torch.eye(size, dtype=kind)).numpy()
        return whole.astype(np.float64) @ columns
    return inner.jvp(torch.from_numpy(columns).to(kind)).numpy().astype(np.float64, copy=False)


class ReducedSurrogateState:
    """What a reduced surrogate predicts for one set of coefficients: a value, good to 1e-6.

    Args:
        model: the reduced surrogate.
        coefficients: (k,).
        near: the network at coefficients nearby, if it is known.
    """

    def __init__(self, model: ReducedSurrogate, coefficients: Floats, near: Linearisation | None = None) -> None:
        self.model, self.coefficients = model, coefficients
        coordinates = (model.encode @ coefficients).astype(np.float32)
        self.inner = model.surrogate.single.linearised(torch.from_numpy(coordinates), near)
        moved = model.offset_rows + model.rows @ np.concatenate([coefficients, self.inner.values.numpy()[model.wanted]])
        self.positions: Floats = moved.reshape(-1, 3)

    @cached_property
    def full(self) -> SurrogateState:
        """The whole state, in double precision."""
        model = self.model
        coordinates = model.encode @ self.coefficients
        return SurrogateState(model.surrogate, coordinates, model.linear(self.coefficients), self.inner)

    @cached_property
    def _tangent(self) -> Floats:
        return tangent(self.inner, self.model.encode)[self.model.wanted]

    def jacobian(self, rows: csr_array) -> Floats:
        """Derivative of linear functions of the chosen displacements, (q, k), for rows (q, 3p); no more is touched."""
        both, count = product(rows, self.model.rows), self.model.count
        return both[:, :count] + both[:, count:] @ self._tangent

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """First-order displacement of the chosen nodes, (p, 3), for a change of the coefficients, (k,).

        Args:
            change: of the coefficients.
            every: of so many nodes one, the first of all to begin with.
        """
        return (self.model.some_rows(every) @ np.concatenate([change, self._tangent @ change])).reshape(-1, 3)


class ReducedSurrogate:
    """A surrogate between force coefficients and the displacement of a few nodes, made by `Surrogate.reduced`.

    Args:
        surrogate: the surrogate.
        nodes: numbers of the wanted nodes, (p,).
        basis: forces at the loaded nodes for unit coefficients, (3l, k), newtons.
    """

    def __init__(self, surrogate: Surrogate, nodes: Ints, basis: Floats) -> None:
        encoder_decoder = surrogate.encoder_decoder
        picked = (3 * nodes[:, None] + np.arange(3)).ravel()
        self.surrogate, self._basis, self._combination = surrogate, basis, np.eye(basis.shape[1])
        self.encode = encoder_decoder.encoded(basis)
        self._linear_rows = surrogate.linear_rows(picked, basis)
        self.wanted = picked if encoder_decoder.decode is None else slice(None)  # of the network's values
        self._decode_rows = np.eye(len(picked)) if encoder_decoder.decode is None else encoder_decoder.decode[picked]
        self.rows = np.hstack(
            [self._linear_rows, self._decode_rows]
        )  # by the coefficients and by what the network says
        self.offset_rows = encoder_decoder.offset[picked]
        self._some: tuple[int, Floats] | None = None
        self._is_asked = False

    @property
    def count(self) -> int:
        """Number of coefficients, k."""
        return self.encode.shape[1]

    def some_rows(self, every: int) -> Floats:
        """The rows of one chosen node of so many, the first to begin with, (3q, k + r)."""
        if self._some is None or self._some[0] != every:
            rows = self.rows.reshape(-1, 3, self.rows.shape[1])[::every]
            self._some = every, np.ascontiguousarray(rows.reshape(-1, self.rows.shape[1]))
        return self._some[1]

    def combined(self, matrix: Floats) -> ReducedSurrogate:
        """The same for the basis times a matrix, (k, j), for the price of some small products."""
        other = copy.copy(self)
        other.__dict__.pop("_linear", None)
        other._some, other._is_asked = None, False
        other.encode, other._combination = self.encode @ matrix, self._combination @ matrix
        other._linear_rows = self._linear_rows @ matrix
        other.rows = np.hstack([other._linear_rows, self._decode_rows])
        return other

    @cached_property
    def _linear(self) -> Floats:
        return self.surrogate.encoder_decoder.linear(self._basis @ self._combination)

    def linear(self, coefficients: Floats) -> Floats:
        """Linear part of the displacement of all nodes, (3n,), metres.

        The first time without the matrix between them: a search from rest asks once, the frames that follow again.
        """
        if self._is_asked:
            return self._linear @ coefficients
        self._is_asked = True
        return self.surrogate.encoder_decoder.linear(self._basis @ (self._combination @ coefficients))

    def solve(self, coefficients: ArrayLike, near: Any = None) -> ReducedSurrogateState:
        """The state for force coefficients, (k,): `near` itself where it is that.

        Raises:
            ValueError: another shape.
        """
        c = np.asarray(coefficients, dtype=np.float64)
        if c.shape != (self.encode.shape[1],):
            raise ValueError(f"coefficients: expected shape ({self.encode.shape[1]},), got {c.shape}.")
        if isinstance(near, ReducedSurrogateState) and near.model is self and np.array_equal(near.coefficients, c):
            return near
        is_own = isinstance(near, ReducedSurrogateState) and near.model.surrogate is self.surrogate
        return ReducedSurrogateState(self, c, near.inner if is_own else None)
