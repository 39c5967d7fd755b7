"""Single precision that is single on a GPU, too."""

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
