"""The linear maps around a network: from nodal forces to its coordinates, from its values to displacements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.dataset import LinearResponse

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LinearMaps:
    """The linear maps around a network N: u = offset + left right b + decode N(encode b).

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


def response_parts(response: LinearResponse) -> tuple[Floats, Floats | None]:
    """Left and right matrix of a linear response; one matrix and None where that is cheaper to apply."""
    left, right = response.left, response.right
    return (left @ right, None) if len(right) >= right.shape[1] else (left, right)
