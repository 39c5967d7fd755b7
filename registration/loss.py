"""What a distance costs: squares for clean noise, Huber's and Tukey's functions where some points are wrong."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
REJECTED = 0.05  # weight of a point; with less it pulled nothing, and no figure of the fit counts it
_QUADRATURE = np.linspace(-8.0, 8.0, 4001)  # standard deviations


class Loss(Protocol):
    """A cost rho(x) of residuals x in standard deviations, x^2 / 2 near zero."""

    def value(self, x: Floats) -> Floats:
        """rho(x)."""

    def weight(self, x: Floats) -> Floats:
        """rho'(x) / x, between 0 and 1: the weight of a residual in the next least-squares problem."""

    @property
    def consistency(self) -> float:
        """E[w x^2] / E[w] for normal x: what a weighted mean of squares must be divided by."""

    @property
    def shrinkage(self) -> float:
        """E[(w x)^2] / E[w] for normal x: what weights make of the variance of a sum of residuals."""


def _expected(loss: Loss, power: int) -> float:
    """E[w^power x^2] / E[w] for normal x."""
    density, weight = np.exp(-0.5 * _QUADRATURE**2), loss.weight(_QUADRATURE)
    return float((weight**power * _QUADRATURE**2 * density).sum() / (weight * density).sum())


@dataclass(frozen=True)
class Square:
    """x^2 / 2: the likelihood of normal noise."""

    def value(self, x: Floats) -> Floats:
        """rho(x)."""
        return 0.5 * x * x

    def weight(self, x: Floats) -> Floats:
        """1."""
        return np.ones_like(x)

    @property
    def consistency(self) -> float:
        """1."""
        return 1.0

    @property
    def shrinkage(self) -> float:
        """1."""
        return 1.0


@dataclass(frozen=True)
class Huber:
    """Quadratic up to k standard deviations, linear beyond (Huber 1964): no point pulls more than one at k.

    Args:
        k: 1.345 keeps 95 % of the efficiency under normal noise.
    """

    k: float = 1.345

    def __post_init__(self) -> None:
        _check("Huber.k", self.k)

    def value(self, x: Floats) -> Floats:
        """rho(x)."""
        size = np.abs(x)
        return np.where(size <= self.k, 0.5 * x * x, self.k * (size - 0.5 * self.k))

    def weight(self, x: Floats) -> Floats:
        """1 up to k, k / |x| beyond."""
        return self.k / np.maximum(np.abs(x), self.k)

    @cached_property
    def consistency(self) -> float:
        """E[w x^2] / E[w]."""
        return _expected(self, 1)

    @cached_property
    def shrinkage(self) -> float:
        """E[(w x)^2] / E[w]."""
        return _expected(self, 2)


@dataclass(frozen=True)
class Tukey:
    """Tukey's biweight (Beaton and Tukey 1974): a point beyond c standard deviations pulls nothing.

    Args:
        c: 4.685 keeps 95 % of the efficiency under normal noise.
    """

    c: float = 4.685

    def __post_init__(self) -> None:
        _check("Tukey.c", self.c)

    def value(self, x: Floats) -> Floats:
        """rho(x), at most c^2 / 6."""
        inside = np.maximum(1.0 - (x / self.c) ** 2, 0.0)
        return self.c**2 / 6.0 * (1.0 - inside**3)

    def weight(self, x: Floats) -> Floats:
        """(1 - (x / c)^2)^2, 0 beyond c."""
        inside: Floats = np.maximum(1.0 - (x / self.c) ** 2, 0.0)
        return inside * inside

    @cached_property
    def consistency(self) -> float:
        """E[w x^2] / E[w]."""
        return _expected(self, 1)

    @cached_property
    def shrinkage(self) -> float:
        """E[(w x)^2] / E[w]."""
        return _expected(self, 2)


def _check(name: str, value: float) -> None:
    if not 0.0 < value < np.inf:
        raise ValueError(f"{name}: expected a positive number of standard deviations, got {value}.")


def robust_deviation(residuals: Floats) -> float:
    """Standard deviation from the median of the absolute residuals (1.4826 MAD about zero)."""
    return 1.4826 * float(np.median(np.abs(residuals)))
