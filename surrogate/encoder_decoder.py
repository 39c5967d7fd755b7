"""The linear maps around a network: from nodal forces to its coordinates, from its values to displacements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.dataset import LinearResponse

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LinearEncoderDecoder:
    """The linear maps around a network N: u = offset + left right b + decode N(encode b).

    Args:
        loaded: numbers of the nodes that may carry force, (l,); b are the forces there, (3l,).
        offset: (3n,), m.
        left: of the linear response, (3n, r), m; r = 0 for none.
        right: of the linear response, (r, 3l), 1/N; None for the identity.
        encode: (d, 3l); None for the identity.
        decode: (3n, e), m; None for the identity.
        spread: root mean square of each coordinate over the training loads, (d,); None where it was not measured.
        load_modes: directions that the training loads spread in, each as long as they do, (3l, q), N; None likewise.
        load_rest: mean square of a component of force that these leave out, (1,), N^2; None likewise.
        error_modes: modes of `Discrepancy`, (3n, m); None where they were not measured.
        error_rest: its rest, (n,).
    """

    loaded: Ints
    offset: Floats
    left: Floats
    right: Floats | None = None
    encode: Floats | None = None
    decode: Floats | None = None
    spread: Floats | None = None
    load_modes: Floats | None = None
    load_rest: Floats | None = None
    error_modes: Floats | None = None
    error_rest: Floats | None = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What to store."""
        named = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {name: array for name, array in named.items() if array is not None}

    def rounded(self) -> LinearEncoderDecoder:
        """The same in single precision, for half of the memory traffic."""
        single: dict[str, Any] = {
            name: array.astype(np.float32) for name, array in self.arrays().items() if name != "loaded"
        }
        return replace(self, **single)

    def encoded(self, columns: Floats) -> Floats:
        """Coordinates, (d, ...), for forces at the loaded nodes, (3l, ...)."""
        return columns if self.encode is None else self.encode @ columns

    def encoded_adjoint(self, gradient: Floats) -> Floats:
        """Gradient by the forces at the loaded nodes, (3l,), for one by the coordinates, (d,)."""
        return gradient if self.encode is None else gradient @ self.encode

    def decoded(self, values: Floats) -> Floats:
        """Displacements, (3n, ...), for values of the network, (e, ...)."""
        return values if self.decode is None else self.decode @ values

    def decoded_adjoint(self, cotangent: Floats) -> Floats:
        """Gradient by the network's values, (e,), for one by the displacement, (3n,)."""
        return cotangent if self.decode is None else cotangent @ self.decode

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


def no_response(size: int, inputs: int) -> tuple[Floats, Floats]:
    """Left and right matrix of no linear response.

    Args:
        size: components of the displacement, 3n.
        inputs: components of the forces, 3l.
    """
    return np.zeros((size, 0)), np.zeros((0, inputs))
