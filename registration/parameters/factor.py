"""One unknown factor of a part of the model: log-normal about 1, a block of one coefficient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .block import check_deviation
from .input_block import InputBlock

Floats = NDArray[np.float64]
_HIGHEST = 50.0  # of the factor's logarithm: far out it grows no further


@dataclass(frozen=True, eq=False)
class Factor(InputBlock):
    """What is known but for its size: exp(s c) times what is expected.

    Args:
        deviation: s, of the factor's logarithm.
    """

    deviation: float = 0.5

    def __post_init__(self) -> None:
        check_deviation(type(self).__name__, self.deviation)

    @property
    def size(self) -> int:
        """1."""
        return 1

    @property
    def stride(self) -> float:
        """Largest change of the factor's logarithm in one step."""
        raise NotImplementedError

    @property
    def strides(self) -> Floats:
        """Largest change of the coefficient in one step."""
        return np.array([self.stride / self.deviation])

    def factor(self, coefficient: float) -> float:
        """How many times what is expected."""
        return float(np.exp(np.clip(self.deviation * coefficient, -_HIGHEST, _HIGHEST)))
