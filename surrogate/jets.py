"""Energies with their first and second derivatives by the deformation gradient, point by point and without autograd.

Each law stands once, in `reference.data.materials`; what carries derivatives along is the algebra that it is written in
(second-order forward mode: Griewank and Walther 2008, chapter 13). A tenth of what autograd takes for a few hundred
points; for so few, NumPy's arrays cost less than torch's, and are carried along as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

Array: TypeAlias = Any  # of NumPy or of torch, one of them throughout

_LEVI_CIVITA = torch.zeros(3, 3, 3, dtype=torch.float64)
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, _j, _k], _LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0
# Second derivative of the determinant, which is linear in the matrix: (9, 81), the matrix's components first.
_OF_DETERMINANT = torch.einsum("ikm,jln->mnijkl", _LEVI_CIVITA, _LEVI_CIVITA).reshape(9, 81)
# Of the 9 components, those whose products a b - c d the cofactors are.
_COFACTORS = [
    [3 * ((i + di) % 3) + (j + dj) % 3 for i in range(3) for j in range(3)]
    for di, dj in ((1, 1), (2, 2), (1, 2), (2, 1))
]


@dataclass(frozen=True, eq=False)
class Jet:
    """A scalar, (p,), or a 3 x 3 tensor, (p, 3, 3), at each of p points, with its derivatives by F.

    Args:
        value: (p, ...).
        first: (p, ..., 9), or with 1 in place of p where it is the same everywhere.
        second: (p, ..., 9, 9) likewise, a plain 0 where the value is affine in F; None where only the first is wanted.
    """

    value: Array
    first: Array
    second: Array | None

    __array_ufunc__ = None  # an array of NumPy's times a jet is the jet's business

    def _of(self, value: Array, slope: Array, curvature: Array) -> Jet:
        """A function of a scalar by its value and its two derivatives there."""
        second = None
        if self.second is not None:
            second = slope[..., None, None] * self.second + curvature[..., None, None] * _outer(self.first, self.first)
        return Jet(value, slope[..., None] * self.first, second)

    def _scaled(self, factor: Any) -> Jet:
        """Times a number, or one for each point."""

        def times(part: Array) -> Array:
            is_array = isinstance(factor, (Tensor, np.ndarray))
            return (factor.reshape(-1, *[1] * (part.ndim - 1)) if is_array else factor) * part

        return Jet(times(self.value), times(self.first), self._bent(times))

    def _bent(self, linear: Callable[[Array], Array]) -> Array | None:
        """The second derivative of a linear function of it."""
        return self.second if self.second is None or self.second.ndim == 0 else linear(self.second)

    def __add__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.value + other, self.first, self.second)
        second = None if self.second is None or other.second is None else self.second + other.second
        return Jet(self.value + other.value, self.first + other.first, second)

    __radd__ = __add__

    def __neg__(self) -> Jet:
        return self._scaled(-1.0)

    def __sub__(self, other: Any) -> Jet:
        return self + (-other)

    def __rsub__(self, other: Any) -> Jet:
        return -self + other

    def __mul__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return self._scaled(other)
        second = None
        if self.second is not None and other.second is not None:
            mixed = _outer(self.first, other.first)
            second = self.value[..., None, None] * other.second + other.value[..., None, None] * self.second
            second = second + mixed + mixed.swapaxes(-1, -2)
        first = self.value[..., None] * other.first + other.value[..., None] * self.first
        return Jet(self.value * other.value, first, second)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Jet:
        return self * other**-1.0 if isinstance(other, Jet) else self._scaled(1.0 / other)

    def __pow__(self, power: float) -> Jet:
        x = self.value
        if power == 2:
            return self._of(x * x, 2.0 * x, 2.0 + 0.0 * x)
        return self._of(x**power, power * x ** (power - 1), power * (power - 1) * x ** (power - 2))


def _outer(one: Array, other: Array) -> Array:
    return one[..., :, None] * other[..., None, :]


class JetAlgebra:
    """The tensor functions that energies are written in (`materials.Algebra`), for jets.

    Args:
        order: 1 or 2: derivatives that are carried along.
    """

    def __init__(self, order: int) -> None:
        self.order, self._unit = order, np.eye(3)
        self._arrays: ModuleType = np

    def variable(self, F: Array) -> Jet:
        """Deformation gradients, (p, 3, 3), of NumPy or of torch, as what derivatives are taken by."""
        if isinstance(F, Tensor):
            self._arrays, like = torch, {"dtype": F.dtype, "device": F.device}
        else:
            self._arrays, like = np, {"dtype": F.dtype}
        arrays = self._arrays
        self._unit = arrays.eye(3, **like)
        first = arrays.eye(9, **like).reshape(1, 3, 3, 9)
        return Jet(F, first, arrays.zeros((), **like) if self.order == 2 else None)

    def Identity(self, size: int) -> Array:  # noqa: N802 - UFL's name
        """The unit tensor."""
        return self._unit

    def transpose(self, A: Jet) -> Jet:
        """A^T."""
        return self._each(A, lambda part: part.swapaxes(1, 2))

    def sym(self, A: Jet) -> Jet:
        """(A + A^T) / 2."""
        return self._each(A, lambda part: 0.5 * (part + part.swapaxes(1, 2)))

    def tr(self, A: Jet) -> Jet:
        """The trace."""
        return self._each(A, lambda part: part[:, 0, 0] + part[:, 1, 1] + part[:, 2, 2])

    @staticmethod
    def _each(A: Jet, linear: Callable[[Array], Array]) -> Jet:
        return Jet(linear(A.value), linear(A.first), A._bent(linear))

    def dot(self, A: Jet, B: Jet) -> Jet:
        """The product A B."""
        einsum = self._arrays.einsum
        value = A.value @ B.value
        first = einsum("pij,pjka->pika", A.value, B.first) + einsum("pija,pjk->pika", A.first, B.value)
        if A.second is None or B.second is None:
            return Jet(value, first, None)
        mixed = einsum("pija,pjkb->pikab", A.first, B.first)
        second = mixed + mixed.swapaxes(-1, -2)
        if B.second.ndim:
            second = second + einsum("pij,pjkab->pikab", A.value, B.second)
        if A.second.ndim:
            second = second + einsum("pijab,pjk->pikab", A.second, B.value)
        return Jet(value, first, second)

    def inner(self, A: Jet, B: Jet) -> Jet:
        """A : B."""
        pairs = ((A, B), (B, A))
        value = (A.value * B.value).sum((1, 2))
        ways = [_contracted(one.value, other.first) for one, other in (pairs if A is not B else pairs[:1])]
        first = ways[0] + ways[-1]
        if A.second is None or B.second is None:
            return Jet(value, first, None)
        mixed = _flat(A.first).swapaxes(1, 2) @ _flat(B.first)
        second = mixed + mixed.swapaxes(-1, -2)
        for one, other in pairs:
            if other.second is not None and other.second.ndim:
                second = second + self._arrays.einsum("pij,pijab->pab", one.value, other.second)
        return Jet(value, first, second)

    def det(self, A: Jet) -> Jet:
        """The determinant of 3 x 3, of what derivatives are taken by."""
        F = A.value.reshape(-1, 9)
        a, b, c, d = (F[:, places] for places in _COFACTORS)
        cofactors = a * b - c * d
        second = None
        if self.order == 2:
            by_matrix = _OF_DETERMINANT.to(F) if isinstance(F, Tensor) else _OF_DETERMINANT.numpy()
            second = (F @ by_matrix).reshape(-1, 9, 9)
        return Jet((F[:, :3] * cofactors[:, :3]).sum(1), cofactors, second)

    def ln(self, a: Jet) -> Jet:
        """The natural logarithm; NaN where a cell is inside out."""
        inverse = 1.0 / a.value
        return a._of(self._arrays.log(a.value), inverse, -inverse * inverse)


def _flat(first: Array) -> Array:
    """First derivatives of a tensor, (p, 9, 9): its components first."""
    return first.reshape(-1, 9, 9)


def _contracted(value: Array, first: Array) -> Array:
    """What a tensor, (p, 3, 3), makes of the first derivatives of another, (p, 9)."""
    flat = _flat(first)
    if len(flat) == 1:
        return value.reshape(-1, 9) @ flat[0]
    return (value.reshape(-1, 1, 9) @ flat)[:, 0]
