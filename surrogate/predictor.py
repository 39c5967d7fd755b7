"""The trained surrogate as a forward model: displacement and derivatives from forces, saved and loaded as a twin."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors
from scipy.sparse import csr_array

from softtwin.meshes.body import Body
from softtwin.reference.dataset import LinearResponse
from softtwin.reference.loading import checked_array

from .mlp import PerceptronCore
from .reduced import ReducedCore

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

WEIGHTS = "surrogate.safetensors"
CARD = "surrogate.json"
FORMAT = 1
NOTICE = "Research software, not a medical device: not for diagnosis or treatment."

_CORES: dict[str, type[ReducedCore] | type[PerceptronCore]] = {"reduced": ReducedCore, "mlp": PerceptronCore}


class TwinError(ValueError):
    """A twin that cannot be used: missing, truncated, changed, or of another body."""


class Core(Protocol):
    """A small network with its derivatives: what a frame needs in its middle."""

    def arrays(self) -> dict[str, Floats]:
        """What to store."""
        ...

    def evaluate(self, coordinates: Floats, *, single: bool = False) -> tuple[Floats, Any]:
        """Values, and a record that the derivatives go on from; `single`: 1e-6 will do."""
        ...

    def push(self, record: Any, tangents: Floats, *, single: bool = False) -> Floats:
        """Changes of the values for changes of the coordinates, column by column; `single`: 1e-6 will do."""
        ...

    def pull(self, record: Any, cotangent: Floats) -> Floats:
        """Gradient with respect to the coordinates for one with respect to the values."""
        ...


@dataclass(frozen=True, eq=False)
class Frame:
    """The linear maps around a core N: u = offset + left right b + decode N(encode b).

    Args:
        loaded: numbers of the nodes that may carry force, (l,); b are the forces there, (3l,).
        encode: (d, 3l).
        decode: (3n, e), m.
        offset: (3n,), m.
        left: of the linear response, (3n, r), m; r = 0 for none.
        right: of the linear response, (r, 3l), 1/N; None for the identity.
        spread: root mean square of each coordinate over the training loads, (d,); None where it was not measured.
        error_modes: modes of `Discrepancy`, (3n, m); None where they were not measured.
        error_rest: its rest, (n,).
    """

    loaded: Ints
    encode: Floats
    decode: Floats
    offset: Floats
    left: Floats
    right: Floats | None = None
    spread: Floats | None = None
    error_modes: Floats | None = None
    error_rest: Floats | None = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What to store."""
        named = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {name: array for name, array in named.items() if array is not None}

    def linear(self, columns: Floats) -> Floats:
        """Linear part of the displacement, (3n, ...), for forces at the loaded nodes, (3l, ...)."""
        return self.left @ (columns if self.right is None else self.right @ columns)

    def linear_adjoint(self, cotangent: Floats) -> Floats:
        """Linear part of the gradient, (3l,), for a gradient with respect to the displacement, (3n,)."""
        row = cotangent @ self.left
        return row if self.right is None else row @ self.right


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """What a surrogate gets wrong, as a normal law: u - u* = size (modes a + rest), size the largest displacement.

    Args:
        modes: for a of unit variance, (3n, m), dimensionless.
        rest: standard deviation of what they leave out in one component of each node, (n,), dimensionless.
        places: number of places on the boundary where that is independent: neighbours share it.
    """

    modes: Floats
    rest: Floats
    places: float


def response_parts(response: LinearResponse) -> tuple[Floats, Floats | None]:
    """Left and right matrix of a linear response; one matrix and None where that is cheaper to apply."""
    left, right = response.left, response.right
    return (left @ right, None) if len(right) >= right.shape[1] else (left, right)


class SurrogateState:
    """What a surrogate predicts under one load, with its derivatives: a value.

    Args:
        surrogate: the surrogate.
        coordinates: of the load, that the network takes, (d,).
        linear: linear part of the displacement, (3n,), metres.
    """

    negative_pivots: int | None = None  # a network has no tangent to count them of

    def __init__(self, surrogate: Surrogate, coordinates: Floats, linear: Floats) -> None:
        frame = surrogate.frame
        self._surrogate, self.coordinates = surrogate, coordinates
        values, self._record = surrogate.core.evaluate(coordinates)
        self.displacement: Floats = (frame.offset + linear + frame.decode @ values).reshape(-1, 3)

    @property
    def extent(self) -> float | None:
        """How far the load lies out: 1 at the farthest load of the training; None where that was not measured.

        The larger of two measures: the network's coordinates in units of their spread, and the largest displacement.
        """
        spread, domain = self._surrogate.frame.spread, self._surrogate.card.get("domain")
        if spread is None or domain is None:
            return None
        far = np.sqrt(((self.coordinates / spread) ** 2).mean()) / domain["reach"]
        moved = np.linalg.norm(self.displacement, axis=1).max() / domain["displacement_m"]
        return float(max(far, moved))

    def push(self, changes: ArrayLike) -> Floats:
        """J B, (3n, k), for changes of the forces B, (3n, k).

        Raises:
            ValueError: another shape, numbers that are not finite, or changes at nodes that never carry load.
        """
        frame, core = self._surrogate.frame, self._surrogate.core
        columns = self._surrogate.at_loaded("changes", changes)
        inner = _tangent(core, self._record, frame.encode @ columns)
        return frame.linear(columns) + frame.decode @ inner

    def pull(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3): J^T g, zero at nodes that never carry load.

        Args:
            cotangent: g, gradient with respect to the displacement, (n, 3), or several, (k, n, 3).

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        given, shape = np.asarray(cotangent, dtype=np.float64), self.displacement.shape
        if given.ndim == 3 and len(given):
            return np.stack([self.pull(each) for each in given])
        frame, core = self._surrogate.frame, self._surrogate.core
        flat = checked_array("SurrogateState.cotangent", given, shape).ravel()
        gradient = np.zeros_like(flat)
        inner = core.pull(self._record, flat @ frame.decode)
        gradient[self._surrogate.rows] = frame.linear_adjoint(flat) + inner @ frame.encode
        return gradient.reshape(-1, 3)


class Surrogate:
    """A trained network as a forward model with frozen weights.

    It satisfies what registration asks of a forward model and runs in double precision on the CPU.

    Args:
        body: the body it was trained on.
        frame: linear maps around the network.
        core: the network.
        card: what it was trained on and how well it does.
    """

    def __init__(self, body: Body, frame: Frame, core: Core, card: Mapping[str, Any]) -> None:
        self.body = body
        self.frame = frame
        self.core = core
        self.card: Mapping[str, Any] = MappingProxyType(dict(card))
        self.rows = (3 * frame.loaded[:, None] + np.arange(3)).ravel()
        self._wanted: tuple[Ints, Floats] = np.zeros(0, dtype=np.int64), frame.left[:0]  # rows, left's rows
        self._idle = np.setdiff1d(np.arange(len(body.points)), np.union1d(frame.loaded, body.fixed))

    @property
    def error(self) -> float:
        """Largest error of a node over the body, mean of the held-out samples, metres; 0 where it was not measured."""
        held_out = self.card.get("held_out") or {}
        return float(held_out.get("largest_error", {}).get("mean", 0.0))

    @cached_property
    def discrepancy(self) -> Discrepancy | None:
        """The errors of the validation samples as patterns; None where they were not measured."""
        modes, rest, known = self.frame.error_modes, self.frame.error_rest, self.card.get("discrepancy")
        return None if modes is None or rest is None or not known else Discrepancy(modes, rest, known["places"])

    def solve(self, forces: ArrayLike, near: Any = None) -> SurrogateState:
        """The state under nodal forces, (n, 3) newtons.

        Args:
            forces: nodal forces, (n, 3), newtons.
            near: of no use here; a network needs no start.

        Raises:
            ValueError: another shape, numbers that are not finite, or forces at nodes that the surrogate never saw
                loaded. Forces at fixed nodes move nothing and are let pass.
        """
        load = checked_array("Surrogate.forces", forces, self.body.points.shape)
        self._refuse_idle("forces", np.abs(load).max(axis=1))
        loads = load.ravel()[self.rows]
        return SurrogateState(self, self.frame.encode @ loads, self.frame.linear(loads))

    def reduced(self, nodes: ArrayLike, basis: ArrayLike) -> ReducedSurrogate:
        """The surrogate between a few force coefficients and a few nodes, all that can be computed before computed.

        Args:
            nodes: numbers of the nodes whose displacement is wanted, (p,).
            basis: force basis B, (3n, k), newtons; the forces are B c for coefficients c.

        Raises:
            ValueError: node numbers out of range, or a basis as `SurrogateState.push` refuses it.
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
            self._wanted = rows, np.ascontiguousarray(self.frame.left[rows])
        return self._wanted[1] @ (columns if self.frame.right is None else self.frame.right @ columns)

    def with_card(self, **entries: Any) -> Surrogate:
        """The same surrogate with more entries in its card, for instance held-out errors."""
        return Surrogate(self.body, self.frame, self.core, {**self.card, **entries})

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
                f"Surrogate.{name}: expected forces at the {len(self.frame.loaded)} nodes that carried load in "
                f"training (surrogate.frame.loaded), got some at {len(bad)} other nodes, first {bad[:5].tolist()}."
            )


def _tangent(core: Core, record: Any, columns: Floats, *, single: bool = False) -> Floats:
    """Core derivative times columns, (e, k), by way of the full derivative where the columns outnumber it."""
    if columns.shape[1] > len(columns):
        return core.push(record, np.eye(len(columns)), single=single) @ columns
    return core.push(record, columns, single=single)


class ReducedSurrogateState:
    """What a reduced surrogate predicts for one set of coefficients: a value, good to 1e-6.

    Args:
        model: the reduced surrogate.
        coefficients: (k,).
    """

    def __init__(self, model: ReducedSurrogate, coefficients: Floats) -> None:
        self.model, self.coefficients = model, coefficients
        self._found = model.surrogate.core.evaluate(model.encode @ coefficients, single=True)
        moved = model.offset_rows + model.rows @ np.concatenate([coefficients, self._found[0]])
        self.positions: Floats = moved.reshape(-1, 3)

    @cached_property
    def full(self) -> SurrogateState:
        """The whole state, in double precision."""
        model = self.model
        coordinates = model.encode @ self.coefficients
        return SurrogateState(model.surrogate, coordinates, model.linear(self.coefficients))

    @cached_property
    def _tangent(self) -> Floats:
        return _tangent(self.model.surrogate.core, self._found[1], self.model.encode, single=True)

    def jacobian(self, rows: csr_array) -> Floats:
        """Derivative of linear functions of the chosen displacements, (q, k), for rows (q, 3p); no more is touched."""
        both, count = rows @ self.model.rows, self.model.count
        return both[:, :count] + both[:, count:] @ self._tangent

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """First-order displacement of the chosen nodes, (p, 3), for a change of the coefficients, (k,).

        Args:
            change: of the coefficients.
            every: of so many nodes one, the first of all to begin with.
        """
        some = self.model.rows.reshape(-1, 3, self.model.rows.shape[1])[::every]
        return some @ np.concatenate([change, self._tangent @ change])


class ReducedSurrogate:
    """A surrogate between force coefficients and the displacement of a few nodes, made by `Surrogate.reduced`.

    Args:
        surrogate: the surrogate.
        nodes: numbers of the wanted nodes, (p,).
        basis: forces at the loaded nodes for unit coefficients, (3l, k), newtons.
    """

    def __init__(self, surrogate: Surrogate, nodes: Ints, basis: Floats) -> None:
        frame = surrogate.frame
        picked = (3 * nodes[:, None] + np.arange(3)).ravel()
        self.surrogate, self._basis, self._combination = surrogate, basis, np.eye(basis.shape[1])
        self.encode = frame.encode @ basis
        self._linear_rows, self._decode_rows = surrogate.linear_rows(picked, basis), frame.decode[picked]
        self.rows = np.hstack([self._linear_rows, self._decode_rows])  # by the coefficients and by what the core says
        self.offset_rows = frame.offset[picked]

    @property
    def count(self) -> int:
        """Number of coefficients, k."""
        return self.encode.shape[1]

    def combined(self, matrix: Floats) -> ReducedSurrogate:
        """The same for the basis times a matrix, (k, j), for the price of some small products."""
        other = copy(self)
        other.__dict__.pop("_linear", None)
        other.encode, other._combination = self.encode @ matrix, self._combination @ matrix
        other._linear_rows = self._linear_rows @ matrix
        other.rows = np.hstack([other._linear_rows, self._decode_rows])
        return other

    @cached_property
    def _linear(self) -> Floats:
        return self.surrogate.frame.linear(self._basis @ self._combination)

    def linear(self, coefficients: Floats) -> Floats:
        """Linear part of the displacement of all nodes, (3n,), metres."""
        return self._linear @ coefficients

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
        return ReducedSurrogateState(self, c)


# ------------------------------------------------------------------ on disk


def save(surrogate: Surrogate, folder: Path | str) -> None:
    """Write weights (safetensors) and card (JSON) into a folder; the body is written apart, with `meshes.files`.

    Args:
        surrogate: what to save.
        folder: made if it is not there; files of the same names are replaced.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    frame = {f"frame.{name}": np.ascontiguousarray(array) for name, array in surrogate.frame.arrays().items()}
    core = {f"core.{name}": np.ascontiguousarray(array) for name, array in surrogate.core.arrays().items()}
    weights = save_tensors(frame | core)
    card = {
        **surrogate.card,
        "format": FORMAT,
        "body": surrogate.body.fingerprint,
        "weights": hashlib.sha256(weights).hexdigest(),
        "notice": NOTICE,
    }
    _replace(folder / WEIGHTS, weights)
    _replace(folder / CARD, json.dumps(card, indent=2, allow_nan=False).encode())


def _replace(path: Path, content: bytes) -> None:
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(content)
    os.replace(partial, path)


def load(folder: Path | str, body: Body) -> Surrogate:
    """The surrogate saved in a folder.

    Args:
        folder: where `save` wrote it.
        body: the body it was trained on.

    Raises:
        TwinError: files missing, truncated or changed, another format, or another body.
    """
    folder = Path(folder)
    card = _read_card(folder / CARD)
    if card["body"] != body.fingerprint:
        raise TwinError(
            f"load.body: the twin in {folder} belongs to another body (fingerprint {card['body'][:12]}..., "
            f"got {body.fingerprint[:12]}...); nodes, cells and fixed nodes must be those it was trained on."
        )
    tensors = _read_weights(folder / WEIGHTS, card["weights"])
    frame = {name.removeprefix("frame."): array for name, array in tensors.items() if name.startswith("frame.")}
    core = {name.removeprefix("core."): array for name, array in tensors.items() if name.startswith("core.")}
    return Surrogate(body, Frame(**frame), _CORES[card["architecture"]](core), card)


def _read_card(path: Path) -> dict[str, Any]:
    try:
        card: dict[str, Any] = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise TwinError(f"load.folder: expected a twin with {path.name} in {path.parent}, found none.") from error
    except (ValueError, OSError) as error:
        raise TwinError(f"load.folder: {path} cannot be read ({error}); is it truncated?") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise TwinError(f"load.folder: expected a card of format {FORMAT} in {path}.")
    missing = [name for name in ("architecture", "body", "weights") if name not in card]
    if missing or card["architecture"] not in _CORES:
        raise TwinError(f"load.folder: {path} lacks {missing or 'a known architecture'}; was it edited?")
    return card


def _read_weights(path: Path, expected: str) -> dict[str, NDArray[Any]]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TwinError(f"load.folder: the weights {path} cannot be read ({error}).") from error
    if hashlib.sha256(content).hexdigest() != expected:
        raise TwinError(
            f"load.folder: {path} ({len(content)} bytes) is not the file its card names: truncated or changed. "
            "Copy the twin again, or train it again."
        )
    try:
        return load_tensors(content)
    except SafetensorError as error:
        raise TwinError(f"load.folder: {path} is no safetensors file ({error}).") from error
