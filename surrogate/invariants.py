"""Isotropic energies by three invariants of the deformation gradient: what few points cost most is to be called for.

Of I = tr C, II = C : C and J = det F, with C = F^T F, an energy is a function of three numbers at each point. With the
derivatives g_a and H_a of these by F, its stress is sum_a W_a g_a, and its moduli are sum_ab W_ab g_a g_b + sum_a W_a
H_a. Each law stands once, in `reference.data.materials`.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.compiled import IS_COMPILED, compiled
from softtwin.reference.data.materials import Material

Floats = NDArray[np.float64]


class NotIsotropicError(TypeError):
    """An energy that is not written in the invariants."""


@dataclass(frozen=True)
class _Gradient:
    """F, or F^T."""

    is_transposed: bool = False


@dataclass(frozen=True)
class _Symmetric:
    """A number times the unit tensor, and one times C."""

    unit: float
    strain: float

    __array_ufunc__ = None

    def __add__(self, other: _Symmetric) -> _Symmetric:
        return _Symmetric(self.unit + other.unit, self.strain + other.strain)

    def __sub__(self, other: _Symmetric) -> _Symmetric:
        return self + other * -1.0

    def __mul__(self, factor: float) -> _Symmetric:
        return _Symmetric(factor * self.unit, factor * self.strain)

    __rmul__ = __mul__

    def __truediv__(self, factor: float) -> _Symmetric:
        return self * (1.0 / factor)


Part = Floats | float  # a number at each point, or one for all
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class _Scalar:
    """A function of the invariants at each point, with derivatives by them: most of these are zero, and stay so.

    Args:
        value: (p,).
        first: by each invariant.
        second: by each of `_PAIRS`; None where only the first are wanted.
    """

    __array_ufunc__ = None  # an array of NumPy's times a scalar is the scalar's business

    def __init__(self, value: Part, first: list[Part], second: list[Part] | None) -> None:
        self.value, self.first, self.second = value, first, second

    def of(self, value: Part, slope: Part, curvature: Part) -> _Scalar:
        """A function of it, by its value and its two derivatives there."""
        first, second = self.first, None
        if self.second is not None:
            bent = [_times(_times(first[a], first[b]), curvature) for a, b in _PAIRS]
            second = [_plus(_times(part, slope), more) for part, more in zip(self.second, bent, strict=True)]
        return _Scalar(value, [_times(part, slope) for part in first], second)

    def _scaled(self, factor: Part) -> _Scalar:
        second = None if self.second is None else [_times(part, factor) for part in self.second]
        return _Scalar(self.value * factor, [_times(part, factor) for part in self.first], second)

    def __add__(self, other: _Scalar | Part) -> _Scalar:
        if not isinstance(other, _Scalar):
            return _Scalar(self.value + other, self.first, self.second)
        second = None
        if self.second is not None and other.second is not None:
            second = list(map(_plus, self.second, other.second))
        return _Scalar(self.value + other.value, list(map(_plus, self.first, other.first)), second)

    __radd__ = __add__

    def __neg__(self) -> _Scalar:
        return self._scaled(-1.0)

    def __sub__(self, other: _Scalar | Part) -> _Scalar:
        return self + -other

    def __rsub__(self, other: Part) -> _Scalar:
        return -self + other

    def __mul__(self, other: _Scalar | Part) -> _Scalar:
        if not isinstance(other, _Scalar):
            return self._scaled(other)
        first = [
            _plus(_times(p, other.value), _times(q, self.value)) for p, q in zip(self.first, other.first, strict=True)
        ]
        second = None
        if self.second is not None and other.second is not None:
            mixed = [
                _plus(_times(self.first[a], other.first[b]), _times(self.first[b], other.first[a])) for a, b in _PAIRS
            ]
            both = zip(self.second, other.second, mixed, strict=True)
            second = [_plus(_plus(_times(p, other.value), _times(q, self.value)), more) for p, q, more in both]
        return _Scalar(self.value * other.value, first, second)

    __rmul__ = __mul__

    def __truediv__(self, other: _Scalar | Part) -> _Scalar:
        return self * other**-1.0

    def __pow__(self, power: float) -> _Scalar:
        x = self.value
        if power == 2:
            return self.of(x * x, 2.0 * x, 2.0)
        return self.of(x**power, power * x ** (power - 1), power * (power - 1) * x ** (power - 2))


def _times(one: Part, other: Part) -> Part:
    """The product, 0 where one of them is 0 everywhere."""
    is_zero = (isinstance(one, float) and one == 0.0) or (isinstance(other, float) and other == 0.0)
    return 0.0 if is_zero else one * other


def _plus(one: Part, other: Part) -> Part:
    """The sum, of which a zero everywhere is left out."""
    if isinstance(one, float) and one == 0.0:
        return other
    return one if isinstance(other, float) and other == 0.0 else one + other


class _InvariantAlgebra:
    """The tensor functions that energies are written in (`materials.Algebra`), for energies of invariants.

    Args:
        invariants: I, II and J, (p, 3).
        order: 1 or 2: derivatives by them that are carried along.
    """

    def __init__(self, invariants: Floats, order: int) -> None:
        columns = np.ascontiguousarray(invariants.T)
        ways: list[list[Part]] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        self._first, self._second, self._jacobian = (
            _Scalar(value, way, [0.0] * len(_PAIRS) if order == 2 else None)
            for value, way in zip(columns, ways, strict=True)
        )

    def Identity(self, size: int) -> _Symmetric:  # noqa: N802 - UFL's name
        """The unit tensor."""
        return _Symmetric(1.0, 0.0)

    def transpose(self, A: Any) -> Any:
        """A^T."""
        return _Gradient(not A.is_transposed) if isinstance(A, _Gradient) else A

    def dot(self, A: Any, B: Any) -> _Symmetric:
        """The product A B, where that is C."""
        if isinstance(A, _Gradient) and isinstance(B, _Gradient) and A.is_transposed and not B.is_transposed:
            return _Symmetric(0.0, 1.0)
        raise NotIsotropicError("dot: expected F^T F, got another product.")

    def sym(self, A: Any) -> _Symmetric:
        """(A + A^T) / 2, of what is symmetric."""
        if isinstance(A, _Gradient):
            raise NotIsotropicError("sym: expected a symmetric tensor, got F.")
        return A  # type: ignore[no-any-return]

    def tr(self, A: Any) -> Any:
        """The trace."""
        if isinstance(A, _Gradient):
            raise NotIsotropicError("tr: expected a symmetric tensor, got F.")
        return 3.0 * A.unit + A.strain * self._first

    def det(self, A: Any) -> _Scalar:
        """The determinant of F."""
        if isinstance(A, _Gradient):
            return self._jacobian
        raise NotIsotropicError("det: expected F, got another tensor.")

    def inner(self, A: Any, B: Any) -> Any:
        """A : B."""
        if isinstance(A, _Gradient) and A == B:
            return self._first
        if isinstance(A, _Symmetric) and isinstance(B, _Symmetric):
            mixed = A.unit * B.strain + A.strain * B.unit
            return 3.0 * A.unit * B.unit + mixed * self._first + A.strain * B.strain * self._second
        raise NotIsotropicError("inner: expected F : F or symmetric tensors, got others.")

    def ln(self, a: _Scalar) -> _Scalar:
        """The natural logarithm."""
        inverse = 1.0 / a.value
        return a.of(np.log(a.value), inverse, -inverse * inverse)


def has_invariants(law: Material) -> bool:
    """Whether the energy of a law is written in the invariants, and loops over points are compiled.

    Args:
        law: whatever its constants.
    """
    if not IS_COMPILED:
        return False
    try:
        at_rest = _InvariantAlgebra(np.array([[3.0, 3.0, 1.0]]), 1)
        law.energy(_Gradient(), None, SimpleNamespace(**law.parameters), at_rest)
    except (TypeError, AttributeError):  # what these tensors cannot do
        return False
    return True


def densities(law: Material, parameters: Any, F: Floats, invariants: Floats, order: int) -> tuple[Floats, Floats]:
    """Energy at each point, (p,), J/m^3, and a derivative of it by F: stress, (p, 9), or moduli, (p, 9, 9), pascals.

    Args:
        law: whatever its constants.
        parameters: of the law as attributes, (p,) or (1,).
        F: deformation gradients, (p, 9).
        invariants: of these, (p, 3), with determinants that the law takes.
        order: 1 for the stress, 2 for the moduli.
    """
    found: _Scalar = law.energy(_Gradient(), None, parameters, _InvariantAlgebra(invariants, order))
    value = np.broadcast_to(found.value, len(F))
    if found.second is None:
        return value, _stresses(F, _columns(found.first, len(F)))
    return value, _moduli(F, _columns(found.first, len(F)), _columns(found.second, len(F)))


def _columns(parts: list[Part], count: int) -> Floats:
    """Of each point, (p, c)."""
    found = np.empty((count, len(parts)))
    for column, part in enumerate(parts):
        found[:, column] = part
    return found


@compiled
def invariants_of(F: Floats) -> Floats:
    """The trace of C, C : C and the determinant, (p, 3), of deformation gradients, (p, 9)."""
    found = np.empty((len(F), 3))
    for p in range(len(F)):
        trace, square = 0.0, 0.0
        for i in range(3):
            for j in range(3):
                c = F[p, i] * F[p, j] + F[p, 3 + i] * F[p, 3 + j] + F[p, 6 + i] * F[p, 6 + j]
                square += c * c
                if i == j:
                    trace += c
        found[p, 0], found[p, 1] = trace, square
        found[p, 2] = (
            F[p, 0] * (F[p, 4] * F[p, 8] - F[p, 5] * F[p, 7])
            + F[p, 1] * (F[p, 5] * F[p, 6] - F[p, 3] * F[p, 8])
            + F[p, 2] * (F[p, 3] * F[p, 7] - F[p, 4] * F[p, 6])
        )
    return found


@compiled
def _slopes(F: Floats, C: Floats, g: Floats) -> None:
    """Of the invariants by F at a point: F, (9,), gives C, (3, 3), and g, (3, 9)."""
    for i in range(3):
        for j in range(3):
            C[i, j] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j]
    for i in range(3):
        u, v = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            a, b = (j + 1) % 3, (j + 2) % 3
            g[0, 3 * i + j] = 2.0 * F[3 * i + j]
            g[1, 3 * i + j] = 4.0 * (F[3 * i] * C[0, j] + F[3 * i + 1] * C[1, j] + F[3 * i + 2] * C[2, j])
            g[2, 3 * i + j] = F[3 * u + a] * F[3 * v + b] - F[3 * u + b] * F[3 * v + a]


@compiled
def _stresses(F: Floats, first: Floats) -> Floats:
    """Of the derivatives by the invariants, (p, 3): (p, 9)."""
    found, C, g = np.empty((len(F), 9)), np.empty((3, 3)), np.empty((3, 9))
    for p in range(len(F)):
        _slopes(F[p], C, g)
        for i in range(9):
            found[p, i] = first[p, 0] * g[0, i] + first[p, 1] * g[1, i] + first[p, 2] * g[2, i]
    return found


@compiled
def _moduli(F: Floats, first: Floats, second: Floats) -> Floats:
    """Of the derivatives by the invariants, (p, 3), and by their pairs, (p, 6): (p, 9, 9)."""
    found, C, g, bent = np.empty((len(F), 9, 9)), np.empty((3, 3)), np.empty((3, 9)), np.empty((3, 9))
    for p in range(len(F)):
        f, w = F[p], second[p]
        _slopes(f, C, g)
        for n in range(9):
            bent[0, n] = w[0] * g[0, n] + w[1] * g[1, n] + w[2] * g[2, n]
            bent[1, n] = w[1] * g[0, n] + w[3] * g[1, n] + w[4] * g[2, n]
            bent[2, n] = w[2] * g[0, n] + w[4] * g[1, n] + w[5] * g[2, n]
        for m in range(9):
            for n in range(9):
                found[p, m, n] = g[0, m] * bent[0, n] + g[1, m] * bent[1, n] + g[2, m] * bent[2, n]
        for i in range(3):
            for k in range(3):
                left = f[3 * i] * f[3 * k] + f[3 * i + 1] * f[3 * k + 1] + f[3 * i + 2] * f[3 * k + 2]  # F F^T
                for j in range(3):
                    found[p, 3 * i + j, 3 * k + j] += 4.0 * first[p, 1] * left
                    for n in range(3):
                        found[p, 3 * i + j, 3 * k + n] += 4.0 * first[p, 1] * f[3 * i + n] * f[3 * k + j]
            for j in range(3):
                found[p, 3 * i + j, 3 * i + j] += 2.0 * first[p, 0]
                for n in range(3):
                    found[p, 3 * i + j, 3 * i + n] += 4.0 * first[p, 1] * C[j, n]
        for i in range(3):  # of the determinant: e_ikm e_jln F_mn, for the pairs that are not zero
            k, m = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                n, o = (j + 1) % 3, (j + 2) % 3
                size = first[p, 2] * f[3 * m + o]
                found[p, 3 * i + j, 3 * k + n] += size
                found[p, 3 * k + n, 3 * i + j] += size
                found[p, 3 * i + n, 3 * k + j] -= size
                found[p, 3 * k + j, 3 * i + n] -= size
    return found
