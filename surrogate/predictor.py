"""The trained surrogate as a forward model: displacement and derivatives from forces, saved and loaded as a twin."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

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

    def evaluate(self, coordinates: Floats) -> tuple[Floats, Any]:
        """Values, and a record that the derivatives go on from."""
        ...

    def push(self, record: Any, tangents: Floats) -> Floats:
        """Changes of the values for changes of the coordinates, column by column."""
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
    """

    loaded: Ints
    encode: Floats
    decode: Floats
    offset: Floats
    left: Floats
    right: Floats | None = None

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


def response_parts(response: LinearResponse) -> tuple[Floats, Floats | None]:
    """Left and right matrix of a linear response; one matrix and None where that is cheaper to apply."""
    left, right = response.left, response.right
    return (left @ right, None) if len(right) >= right.shape[1] else (left, right)


class Surrogate:
    """A trained network as a forward model: frozen weights, derivatives at the last state.

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
        self._loaded = (3 * frame.loaded[:, None] + np.arange(3)).ravel()
        self._idle = np.setdiff1d(np.arange(len(body.points)), np.union1d(frame.loaded, body.fixed))
        self.reset()

    def reset(self) -> None:
        """Go back to rest: derivatives are those of zero forces until the next solve."""
        self._record = self.core.evaluate(np.zeros(len(self.frame.encode)))[1]

    def solve(self, forces: ArrayLike) -> Floats:
        """Displacement, (n, 3) metres, under nodal forces, (n, 3) newtons.

        Raises:
            ValueError: another shape, numbers that are not finite, or forces at nodes that the surrogate never saw
                loaded. Forces at fixed nodes move nothing and are let pass.
        """
        load = checked_array("Surrogate.forces", forces, self.body.points.shape)
        self._refuse_idle("forces", np.abs(load).max(axis=1))
        loads = load.ravel()[self._loaded]
        values, self._record = self.core.evaluate(self.frame.encode @ loads)
        displacement = self.frame.offset + self.frame.linear(loads) + self.frame.decode @ values
        return displacement.reshape(-1, 3)

    def pullback(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3): J^T g at the last state, zero at nodes that never carry load.

        Args:
            cotangent: g, gradient with respect to the displacement, (n, 3).

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        flat = checked_array("Surrogate.cotangent", cotangent, self.body.points.shape).ravel()
        inner = self.core.pull(self._record, flat @ self.frame.decode)
        gradient = np.zeros_like(flat)
        gradient[self._loaded] = self.frame.linear_adjoint(flat) + inner @ self.frame.encode
        return gradient.reshape(-1, 3)

    def sensitivity(self, columns: ArrayLike) -> Floats:
        """J B, (3n, k), at the last state for changes of the forces B, (3n, k).

        Raises:
            ValueError: another shape, numbers that are not finite, or changes at nodes that never carry load.
        """
        changes = self._checked_columns("columns", columns)[self._loaded]
        inner = _tangent(self.core, self._record, self.frame.encode @ changes)
        return self.frame.linear(changes) + self.frame.decode @ inner

    def restricted(self, rows: ArrayLike, columns: ArrayLike) -> Restricted:
        """The surrogate between a few force coefficients and a few nodes, all that can be computed before computed.

        Args:
            rows: numbers of the nodes whose displacement is wanted, (p,).
            columns: force basis B, (3n, k), newtons; the forces are B c for coefficients c.

        Raises:
            ValueError: node numbers out of range, or a basis as `sensitivity` refuses it.
        """
        nodes = np.asarray(rows)
        if nodes.ndim != 1 or not np.issubdtype(nodes.dtype, np.integer):
            raise ValueError(f"rows: expected node numbers of shape (p,), got {nodes.dtype} of shape {nodes.shape}.")
        if len(nodes) and (nodes.min() < 0 or nodes.max() >= len(self.body.points)):
            raise ValueError(f"rows: expected 0..{len(self.body.points) - 1}, got {nodes.min()}..{nodes.max()}.")
        basis = self._checked_columns("columns", columns)[self._loaded]
        picked = (3 * nodes[:, None] + np.arange(3)).ravel()
        linear = self.frame.linear(basis)
        return Restricted(self.core, self.frame.encode @ basis, linear, self.frame.decode, self.frame.offset, picked)

    def with_card(self, **entries: Any) -> Surrogate:
        """The same surrogate with more entries in its card, for instance held-out errors."""
        return Surrogate(self.body, self.frame, self.core, {**self.card, **entries})

    def _checked_columns(self, name: str, columns: ArrayLike) -> Floats:
        array = np.asarray(columns, dtype=np.float64)
        expected = self.body.points.size
        if array.ndim != 2 or array.shape[0] != expected:
            raise ValueError(f"Surrogate.{name}: expected shape ({expected}, k), got {array.shape}.")
        checked_array(f"Surrogate.{name}", array, array.shape)
        self._refuse_idle(name, np.abs(array).reshape(-1, 3 * array.shape[1]).max(axis=1, initial=0.0))
        return array

    def _refuse_idle(self, name: str, sizes: Floats) -> None:
        bad = self._idle[sizes[self._idle] > 0.0]
        if len(bad):
            raise ValueError(
                f"Surrogate.{name}: expected forces at the {len(self.frame.loaded)} nodes that carried load in "
                f"training (surrogate.frame.loaded), got some at {len(bad)} other nodes, first {bad[:5].tolist()}."
            )


def _tangent(core: Core, record: Any, columns: Floats) -> Floats:
    """Core derivative times columns, (e, k), by way of the full derivative where the columns outnumber it."""
    if columns.shape[1] > len(columns):
        return core.push(record, np.eye(len(columns))) @ columns
    return core.push(record, columns)


class Restricted:
    """A surrogate between force coefficients and the displacement of a few nodes, made by `Surrogate.restricted`.

    Args:
        core: the network.
        encode: its coordinates for unit coefficients, (d, k).
        linear: linear displacement for unit coefficients, (3n, k).
        decode: displacement for unit values of the network, (3n, e).
        offset: displacement that is always there, (3n,).
        picked: numbers of the wanted components, (3p,).
    """

    def __init__(
        self, core: Core, encode: Floats, linear: Floats, decode: Floats, offset: Floats, picked: Ints
    ) -> None:
        self._core = core
        self._encode, self._linear, self._decode, self._offset = encode, linear, decode, offset
        self._linear_rows, self._decode_rows, self._offset_rows = linear[picked], decode[picked], offset[picked]

    @property
    def coefficient_count(self) -> int:
        """Number of force coefficients, k."""
        return self._encode.shape[1]

    def solve_coefficients(self, coefficients: ArrayLike) -> Floats:
        """Displacement of the wanted nodes, (p, 3) metres, for force coefficients, (k,)."""
        c = self._checked(coefficients)
        values, _ = self._core.evaluate(self._encode @ c)
        return self._rows(c, values)

    def jacobian(self, coefficients: ArrayLike) -> Floats:
        """Derivative of the wanted displacements with respect to the coefficients, (3p, k), metres per unit."""
        return self.evaluate(coefficients)[1]

    def evaluate(self, coefficients: ArrayLike) -> tuple[Floats, Floats]:
        """Displacement, (p, 3), and its derivative, (3p, k), for little more than the price of the derivative."""
        c = self._checked(coefficients)
        values, record = self._core.evaluate(self._encode @ c)
        jacobian = self._linear_rows + self._decode_rows @ _tangent(self._core, record, self._encode)
        return self._rows(c, values), jacobian

    def gradient(self, coefficients: ArrayLike, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the coefficients, (k,), for one with respect to the wanted displacements, (p, 3)."""
        g = np.asarray(cotangent, dtype=np.float64).ravel()
        _, record = self._core.evaluate(self._encode @ self._checked(coefficients))
        return g @ self._linear_rows + self._core.pull(record, g @ self._decode_rows) @ self._encode

    def full(self, coefficients: ArrayLike) -> Floats:
        """Displacement of all nodes, (n, 3) metres, for force coefficients, (k,)."""
        c = self._checked(coefficients)
        values, _ = self._core.evaluate(self._encode @ c)
        return (self._offset + self._linear @ c + self._decode @ values).reshape(-1, 3)

    def _rows(self, c: Floats, values: Floats) -> Floats:
        return (self._offset_rows + self._linear_rows @ c + self._decode_rows @ values).reshape(-1, 3)

    def _checked(self, coefficients: ArrayLike) -> Floats:
        c = np.asarray(coefficients, dtype=np.float64)
        if c.shape != (self.coefficient_count,):
            raise ValueError(f"coefficients: expected shape ({self.coefficient_count},), got {c.shape}.")
        return c


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
