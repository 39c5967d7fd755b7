"""A surrogate in a folder, enough to predict on another machine: weights (safetensors) and card (JSON)."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from softtwin.meshes.body import Body

from .encoder_decoder import LinearEncoderDecoder
from .model import Surrogate
from .registry import ARCHITECTURES

WEIGHTS = "surrogate.safetensors"
CARD = "surrogate.json"
FORMAT = 2
_READ = (1, FORMAT)
_MAPS, _NETWORK = "maps.", "core."  # what their tensors' names begin with
_MAPS_BEFORE = "frame."  # of twins that were saved when that was their name
NOTICE = "Research software, not a medical device: not for diagnosis or treatment."


class TwinError(ValueError):
    """A twin that cannot be used: missing, truncated, changed, or of another body."""


def packed(surrogate: Surrogate, single: bool = False) -> tuple[bytes, dict[str, Any]]:
    """Weights, as the bytes of a safetensors file, and the card that goes with them: what `unpacked` takes.

    Args:
        surrogate: what to pack.
        single: as for `save`.
    """
    tensors = {f"{_MAPS}{name}": array for name, array in surrogate.encoder_decoder.arrays().items()}
    tensors |= {f"{_NETWORK}{name}": tensor.numpy() for name, tensor in surrogate.network.state_dict().items()}
    if single:
        tensors = {name: _as(array, np.float64, np.float32) for name, array in tensors.items()}
    weights = save_tensors({name: np.ascontiguousarray(array) for name, array in tensors.items()})
    card = {
        **{name: entry for name, entry in surrogate.card.items() if name != "stored"},
        "format": FORMAT,
        "body": surrogate.body.fingerprint,
        "weights": hashlib.sha256(weights).hexdigest(),
        **({"stored": "single"} if single else {}),
        "notice": NOTICE,
    }
    return weights, card


def save(surrogate: Surrogate, folder: Path | str, single: bool = False) -> None:
    """Write weights (safetensors) and card (JSON) into a folder; the body is written apart, with `meshes.io`.

    Both are written before either takes the place of a file of its name: a full disk leaves what was there.

    Args:
        surrogate: what to save.
        folder: made if it is not there; files of the same names are replaced.
        single: round all numbers to single precision, for half of the size; `load` gives them back in double.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    weights, card = packed(surrogate, single)
    contents = {WEIGHTS: weights, CARD: json.dumps(card, indent=2, allow_nan=False).encode()}
    try:
        for name, content in contents.items():
            (folder / f"{name}.partial").write_bytes(content)
    except OSError:
        for name in contents:
            (folder / f"{name}.partial").unlink(missing_ok=True)
        raise
    for name in contents:
        os.replace(folder / f"{name}.partial", folder / name)


def _as(array: NDArray[Any], kind: type[np.number[Any]], wanted: type[np.number[Any]]) -> NDArray[Any]:
    """An array of one kind as another; others as they are."""
    return array.astype(wanted) if array.dtype == kind else array


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
    return _revived(str(folder), _read_weights(folder / WEIGHTS, card["weights"]), card, body)


def unpacked(weights: bytes, card: dict[str, Any], body: Body) -> Surrogate:
    """The surrogate that `packed` has packed.

    Args:
        weights: of a safetensors file.
        card: that goes with them.
        body: the body that it was trained on.

    Raises:
        TwinError: another format than this program's.
    """
    return _revived("the bytes given", load_tensors(weights), card, body)


def _revived(place: str, tensors: dict[str, NDArray[Any]], card: dict[str, Any], body: Body) -> Surrogate:
    if card.get("stored") == "single":
        tensors = {name: _as(array, np.float32, np.float64) for name, array in tensors.items()}
    encoder_decoder: dict[str, Any] = {
        name.removeprefix(prefix): array
        for name, array in tensors.items()
        for prefix in (_MAPS, _MAPS_BEFORE)
        if name.startswith(prefix)
    }
    weights = {
        name.removeprefix(_NETWORK): torch.tensor(array) for name, array in tensors.items() if name.startswith(_NETWORK)
    }
    with torch.random.fork_rng(devices=[]):  # the weights are given: the caller's chance is left alone
        try:
            network = ARCHITECTURES[card["architecture"]].from_state_dict(weights)
        except ValueError as error:
            raise TwinError(
                f"load.folder: the network in {place} is of a newer version of this program: {error}"
            ) from error
    return Surrogate(body, LinearEncoderDecoder(**encoder_decoder), network, card)


def _read_card(path: Path) -> dict[str, Any]:
    try:
        card: dict[str, Any] = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise TwinError(f"load.folder: expected a twin with {path.name} in {path.parent}, found none.") from error
    except (ValueError, OSError) as error:
        raise TwinError(f"load.folder: {path} cannot be read ({error}); is it truncated?") from error
    if not isinstance(card, dict) or card.get("format") not in _READ:
        raise TwinError(f"load.folder: expected a card of format {FORMAT} in {path}.")
    missing = [name for name in ("architecture", "body", "weights") if name not in card]
    if missing or card["architecture"] not in ARCHITECTURES:
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
