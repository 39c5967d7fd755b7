"""A surrogate made small enough to travel with a package: fewer directions, numbers in single precision."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .encoder_decoder import LinearEncoderDecoder
from .model import Surrogate

Floats = NDArray[np.float64]


def compressed(surrogate: Surrogate, rank: int, load_modes: int) -> Surrogate:
    """The surrogate with the leading directions of its linear response alone, and numbers that single precision holds.

    It predicts otherwise than the one it was made from, if little: what was measured of that one (held-out errors,
    certificate, patterns of error) is to be measured of it anew, and is left out of its card.

    Args:
        surrogate: a trained surrogate.
        rank: directions of the linear response that are kept.
        load_modes: directions of the training loads that are kept; what the others hold is spread evenly.

    Raises:
        ValueError: a number below 1.
    """
    for name, value in (("rank", rank), ("load_modes", load_modes)):
        if value < 1:
            raise ValueError(f"compacted.{name}: expected at least 1, got {value}.")
    encoder_decoder = _fewer_load_modes(_of_rank(surrogate.encoder_decoder, rank), load_modes)
    network = copy.deepcopy(surrogate.network).float().double()
    measured = ("held_out", "certificate", "discrepancy")
    card = {name: entry for name, entry in surrogate.card.items() if name not in measured}
    return Surrogate(
        surrogate.body, _single(replace(encoder_decoder, error_modes=None, error_rest=None)), network, card
    )


def _of_rank(encoder_decoder: LinearEncoderDecoder, rank: int) -> LinearEncoderDecoder:
    whole = encoder_decoder.left if encoder_decoder.right is None else encoder_decoder.left @ encoder_decoder.right
    left, sizes, right = np.linalg.svd(whole, full_matrices=False)
    return replace(encoder_decoder, left=left[:, :rank] * sizes[:rank], right=right[:rank])


def _fewer_load_modes(encoder_decoder: LinearEncoderDecoder, count: int) -> LinearEncoderDecoder:
    if encoder_decoder.load_modes is None or encoder_decoder.load_rest is None:
        return encoder_decoder
    squares = np.square(encoder_decoder.load_modes).sum(axis=0)
    order = np.argsort(-squares)
    left_out = squares[order[count:]].sum() / len(encoder_decoder.load_modes)
    return replace(
        encoder_decoder,
        load_modes=encoder_decoder.load_modes[:, order[:count]],
        load_rest=encoder_decoder.load_rest + left_out,
    )


def _single(encoder_decoder: LinearEncoderDecoder) -> LinearEncoderDecoder:
    """Each number as single precision holds it, in double precision."""
    numbers: dict[str, Any] = {
        name: array.astype(np.float32).astype(np.float64)
        for name, array in encoder_decoder.arrays().items()
        if name != "loaded"
    }
    return replace(encoder_decoder, **numbers)
