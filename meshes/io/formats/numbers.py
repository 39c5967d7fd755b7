"""Numbers in text, of any locale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...body import Floats


def numbers(words: Sequence[str] | Sequence[bytes]) -> Floats:
    """Words as numbers; where some are none, as numbers with decimal commas.

    Args:
        words: of one file, so that either all have points or all have commas.

    Raises:
        ValueError: with the first word that is no number.
    """
    if not words:
        return np.empty(0)
    try:
        return np.array(words, dtype=np.float64)
    except ValueError:
        pass
    text = [word.decode("latin-1") if isinstance(word, bytes) else word for word in words]
    if any("," in word for word in text) and not any("." in word for word in text):
        text = [word.replace(",", ".") for word in text]
    for word in text:
        try:
            float(word)
        except ValueError:
            raise ValueError(f"{word[:40]!r} is no number") from None
    return np.array(text, dtype=np.float64)
