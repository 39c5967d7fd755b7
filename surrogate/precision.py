"""Single precision that is single on a GPU, and bfloat16 that is no chance on a processor."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def without_tf32(wanted: bool = True) -> Iterator[None]:
    """Products without TF32, whose ten bits are too few, where that is wanted; afterwards all is as it was."""
    kept = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    try:
        if wanted:
            forbid_tf32()
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = kept


def forbid_tf32() -> None:
    """For the rest of the process."""
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False


@contextmanager
def without_onednn(wanted: bool = True) -> Iterator[None]:
    """Products in bfloat16 by torch's own kernels, where that is wanted; afterwards all is as it was.

    Those that oneDNN 3.12 has for AVX-512 and AMX take what lies behind a matrix for a part of it, now and then NaN:
    its issue 5717, pytorch's 169688.
    """
    kept = torch.backends.mkldnn.enabled
    try:
        if wanted:
            forbid_onednn()
        yield
    finally:
        torch.backends.mkldnn.enabled = kept


def forbid_onednn() -> None:
    """For the rest of the process."""
    torch.backends.mkldnn.enabled = False  # type: ignore[assignment]  # a property of the module, which no stub knows
