"""Strain energies of isotropic soft tissue; stress and tangent are derived from them by UFL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import ufl

Constant = Callable[[float], Any]


class Material(Protocol):
    """What the reference needs to know of a material."""

    @property
    def young_modulus(self) -> float:
        """Young's modulus, pascals."""

    @property
    def poisson_ratio(self) -> float:
        """Poisson's ratio, in (0, 0.5)."""

    def energy(self, F: Any, constant: Constant) -> Any:
        """Strain energy per volume at rest, J/m^3, for a deformation gradient F (UFL).

        Args:
            F: deformation gradient.
            constant: wraps a number so that another value needs no new compilation.
        """


def _check(name: str, young_modulus: float, poisson_ratio: float) -> None:
    if not young_modulus > 0.0:
        raise ValueError(f"{name}.young_modulus: expected a positive number of pascals, got {young_modulus}.")
    if not 0.0 < poisson_ratio < 0.5:
        raise ValueError(
            f"{name}.poisson_ratio: expected a number in (0, 0.5), got {poisson_ratio}; "
            "nearly incompressible tissue is 0.45 to 0.49."
        )


def lame(young_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Lamé parameters (mu, lambda), pascals."""
    mu = young_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


@dataclass(frozen=True)
class NeoHookean:
    """Compressible Neo-Hookean: psi = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2 (Odot 2023, eq. 2.27).

    Args:
        young_modulus: Young's modulus, pascals.
        poisson_ratio: Poisson's ratio, in (0, 0.5).
    """

    young_modulus: float
    poisson_ratio: float

    def __post_init__(self) -> None:
        _check("NeoHookean", self.young_modulus, self.poisson_ratio)

    def energy(self, F: Any, constant: Constant) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        mu, lmbda = map(constant, lame(self.young_modulus, self.poisson_ratio))
        ln_J = ufl.ln(ufl.det(F))
        return mu / 2 * (ufl.inner(F, F) - 3) - mu * ln_J + lmbda / 2 * ln_J**2


@dataclass(frozen=True)
class SaintVenantKirchhoff:
    """Saint-Venant-Kirchhoff: psi = lambda/2 (tr E)^2 + mu E : E with the Green-Lagrange strain E.

    Args:
        young_modulus: Young's modulus, pascals.
        poisson_ratio: Poisson's ratio, in (0, 0.5).
    """

    young_modulus: float
    poisson_ratio: float

    def __post_init__(self) -> None:
        _check("SaintVenantKirchhoff", self.young_modulus, self.poisson_ratio)

    def energy(self, F: Any, constant: Constant) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        mu, lmbda = map(constant, lame(self.young_modulus, self.poisson_ratio))
        E = (F.T * F - ufl.Identity(3)) / 2
        return lmbda / 2 * ufl.tr(E) ** 2 + mu * ufl.inner(E, E)


MATERIALS: dict[str, type[NeoHookean] | type[SaintVenantKirchhoff]] = {
    "neo-hookean": NeoHookean,
    "saint-venant-kirchhoff": SaintVenantKirchhoff,
}
