"""Energies with their first and second derivatives by the deformation gradient, point by point and without autograd.

Each law stands once, in `reference.data.materials`; what carries derivatives along is the algebra that it is written in
(second-order forward mode: Griewank and Walther 2008, chapter 13). A tenth of what autograd takes for a few hundred
points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

_LEVI_CIVITA = torch.zeros(3, 3, 3, dtype=torch.float64)
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, _j, _k], _LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0
# Second derivative of the determinant, which is linear in the matrix: (9, 9, 9), the matrix's components first.
_OF_DETERMINANT = torch.einsum("ikm,jln->mnijkl", _LEVI_CIVITA, _LEVI_CIVITA).reshape(9, 9, 9)


@dataclass(frozen=True, eq=False)
class Jet:
    """A scalar, (p,), or a 3 x 3 tensor, (p, 3, 3), at each of p points, with its derivatives by F.

    Args:
        value: (p, ...).
        first: (p, ..., 9), or with 1 in place of p where it is the same everywhere.
        second: (p, ..., 9, 9) likewise, a plain 0 where the value is affine in F; None where only the first is wanted.
    """

    value: Tensor
    first: Tensor
    second: Tensor | None

    def _of(self, value: Tensor, slope: Tensor, curvature: Tensor) -> Jet:
        """A function of a scalar by its value and its two derivatives there."""
        second = None
        if self.second is not None:
            second = slope[..., None, None] * self.second + curvature[..., None, None] * _outer(self.first, self.first)
        return Jet(value, slope[..., None] * self.first, second)

    def _scaled(self, factor: Any) -> Jet:
        """Times a number, or one for each point."""

        def times(part: Tensor) -> Tensor:
            wide = factor.reshape(-1, *[1] * (part.ndim - 1)) if isinstance(factor, Tensor) else factor
            found: Tensor = wide * part
            return found

        return Jet(times(self.value), times(self.first), self._bent(times))

    def _bent(self, linear: Callable[[Tensor], Tensor]) -> Tensor | None:
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
            second = second + mixed + mixed.mT
        first = self.value[..., None] * other.first + other.value[..., None] * self.first
        return Jet(self.value * other.value, first, second)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Jet:
        return self * other**-1.0 if isinstance(other, Jet) else self._scaled(1.0 / other)

    def __pow__(self, power: float) -> Jet:
        x = self.value
        if power == 2:
            return self._of(x * x, 2.0 * x, torch.full_like(x, 2.0))
        return self._of(x**power, power * x ** (power - 1), power * (power - 1) * x ** (power - 2))


def _outer(one: Tensor, other: Tensor) -> Tensor:
    return one[..., :, None] * other[..., None, :]


class JetAlgebra:
    """The tensor functions that energies are written in (`materials.Algebra`), for jets.

    Args:
        order: 1 or 2: derivatives that are carried along.
    """

    def __init__(self, order: int) -> None:
        self.order, self._unit = order, torch.eye(3, dtype=torch.float64)

    def variable(self, F: Tensor) -> Jet:
        """Deformation gradients, (p, 3, 3), as what derivatives are taken by."""
        self._unit = torch.eye(3, dtype=F.dtype, device=F.device)
        first = torch.eye(9, dtype=F.dtype, device=F.device).reshape(1, 3, 3, 9)
        return Jet(F, first, F.new_zeros(()) if self.order == 2 else None)

    def Identity(self, size: int) -> Tensor:  # noqa: N802 - UFL's name
        """The unit tensor."""
        return self._unit

    def transpose(self, A: Jet) -> Jet:
        """A^T."""
        return self._each(A, lambda part: part.transpose(1, 2))

    def sym(self, A: Jet) -> Jet:
        """(A + A^T) / 2."""
        return self._each(A, lambda part: 0.5 * (part + part.transpose(1, 2)))

    def tr(self, A: Jet) -> Jet:
        """The trace."""
        return self._each(A, lambda part: part[:, 0, 0] + part[:, 1, 1] + part[:, 2, 2])

    @staticmethod
    def _each(A: Jet, linear: Callable[[Tensor], Tensor]) -> Jet:
        return Jet(linear(A.value), linear(A.first), A._bent(linear))

    def dot(self, A: Jet, B: Jet) -> Jet:
        """The product A B."""
        value = A.value @ B.value
        first = torch.einsum("pij,pjka->pika", A.value, B.first) + torch.einsum("pija,pjk->pika", A.first, B.value)
        if A.second is None or B.second is None:
            return Jet(value, first, None)
        mixed = torch.einsum("pija,pjkb->pikab", A.first, B.first)
        second = mixed + mixed.mT
        if B.second.ndim:
            second = second + torch.einsum("pij,pjkab->pikab", A.value, B.second)
        if A.second.ndim:
            second = second + torch.einsum("pijab,pjk->pikab", A.second, B.value)
        return Jet(value, first, second)

    def inner(self, A: Jet, B: Jet) -> Jet:
        """A : B."""
        value = (A.value * B.value).sum(dim=(1, 2))
        first = torch.einsum("pij,pija->pa", A.value, B.first) + torch.einsum("pij,pija->pa", B.value, A.first)
        if A.second is None or B.second is None:
            return Jet(value, first, None)
        mixed = torch.einsum("pija,pijb->pab", A.first, B.first)
        second = mixed + mixed.mT
        for one, other in ((A, B), (B, A)):
            if other.second is not None and other.second.ndim:
                second = second + torch.einsum("pij,pijab->pab", one.value, other.second)
        return Jet(value, first, second)

    def det(self, A: Jet) -> Jet:
        """The determinant of 3 x 3, of what derivatives are taken by."""
        F = A.value
        cofactors = torch.stack([torch.linalg.cross(F[:, i - 2], F[:, i - 1]) for i in range(3)], dim=1)
        value = (F[:, 0] * cofactors[:, 0]).sum(dim=1)
        second = None
        if self.order == 2:
            second = (F.reshape(-1, 9) @ _OF_DETERMINANT.to(F).reshape(9, 81)).reshape(-1, 9, 9)
        return Jet(value, cofactors.reshape(-1, 9), second)

    def ln(self, a: Jet) -> Jet:
        """The natural logarithm; NaN where a cell is inside out."""
        inverse = 1.0 / a.value
        return a._of(a.value.log(), inverse, -inverse * inverse)
