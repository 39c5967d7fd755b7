"""Strain energies of isotropic soft tissue; stress and tangent are derived from them, by UFL or by torch.

Every parameter is a number or an array with one value a cell. A material of one's own is an `Energy`: one function.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType, SimpleNamespace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Parameter = float | Floats


class Algebra(Protocol):
    """The functions of 3 x 3 tensors that energies are written in: the module `ufl`, or torch's of `surrogate`."""

    def Identity(self, size: int) -> Any:  # noqa: N802 - UFL's name
        """The unit tensor."""

    def transpose(self, A: Any) -> Any:
        """A^T."""

    def dot(self, A: Any, B: Any) -> Any:
        """The product A B."""

    def sym(self, A: Any) -> Any:
        """(A + A^T) / 2."""

    def tr(self, A: Any) -> Any:
        """The trace."""

    def det(self, A: Any) -> Any:
        """The determinant."""

    def inner(self, A: Any, B: Any) -> Any:
        """A : B."""

    def ln(self, a: Any) -> Any:
        """The natural logarithm of a scalar."""


class Material(Protocol):
    """What the reference needs to know of a material."""

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Its parameters by name: numbers, or arrays of shape (cells,)."""

    @property
    def is_mixed(self) -> bool:
        """True when the pressure is an unknown of its own."""

    @property
    def is_linear(self) -> bool:
        """True when the energy is quadratic in the displacement, so that no cell is ever inside out."""

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3 (with its multiplier, where mixed).

        Args:
            F: deformation gradient, 3 x 3.
            pressure: unknown pressure, Pa; None where the material is not mixed.
            p: the parameters as attributes.
            m: what F is computed with.
        """


class _Parameters:
    """A frozen dataclass whose fields are its parameters."""

    is_mixed = False
    is_linear = False

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Its parameters by name: numbers, or arrays of shape (cells,)."""
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]

    def _freeze(self, name: str) -> Floats:
        """A parameter as a number or a read-only array, and its values for a check."""
        given = getattr(self, name)
        values = np.asarray(given, dtype=np.float64)
        if values.ndim > 1 or values.size == 0:
            raise ValueError(
                f"{type(self).__name__}.{name}: expected a number or one value for each cell, shape (cells,), "
                f"got shape {values.shape}."
            )
        if values.ndim == 1:
            values = values.copy()
            values.flags.writeable = False
        object.__setattr__(self, name, values if values.ndim else float(values))
        return values

    def _positive(self, *names: str, unit: str = "pascals", zero: bool = False) -> None:
        for name in names:
            values = self._freeze(name)
            good = values >= 0.0 if zero else values > 0.0
            if not good.all():
                raise ValueError(
                    f"{type(self).__name__}.{name}: expected a {'number >= 0' if zero else 'positive number'} of "
                    f"{unit}, got {_first(values, ~good)}."
                )

    def _below_half(self, name: str, mixed: str) -> None:
        values = self._freeze(name)
        bad = ~((values >= 0.0) & (values < 0.5))
        if bad.any():
            worst = _first(values, bad)
            advice = (
                f"; incompressible tissue needs the pressure as an unknown: {mixed}"
                if np.max(values) >= 0.5
                else "; nearly incompressible tissue is 0.45 to 0.49"
            )
            raise ValueError(f"{type(self).__name__}.{name}: expected a number in [0, 0.5), got {worst}{advice}.")


def _first(values: Floats, bad: NDArray[np.bool_]) -> str:
    if values.ndim == 0:
        return str(float(values))
    cells = np.flatnonzero(bad)
    return f"{values[cells[0]]} in cell {cells[0]} ({len(cells)} of {len(values)} cells)"


def lame(young_modulus: Any, poisson_ratio: Any) -> tuple[Any, Any]:
    """Lamé parameters (mu, lambda), pascals."""
    mu = young_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


def bulk(young_modulus: Any, poisson_ratio: Any) -> Any:
    """Bulk modulus E / (3 (1 - 2 nu)), pascals."""
    return young_modulus / (3.0 * (1.0 - 2.0 * poisson_ratio))


@dataclass(frozen=True, eq=False)
class _Elastic(_Parameters):
    """Two constants: Young's modulus, pascals, and Poisson's ratio, in [0, 0.5)."""

    young_modulus: Parameter
    poisson_ratio: Parameter

    def __post_init__(self) -> None:
        self._positive("young_modulus")
        self._below_half("poisson_ratio", mixed="IncompressibleNeoHookean")

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        raise NotImplementedError


class LinearElastic(_Elastic):
    """Linear elasticity: psi = lambda/2 (tr e)^2 + mu e : e with the small strain e (Odot 2023, eq. 2.14)."""

    is_linear = True

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        mu, lmbda = lame(p.young_modulus, p.poisson_ratio)
        e = m.sym(F) - m.Identity(3)
        return lmbda / 2 * m.tr(e) ** 2 + mu * m.inner(e, e)


class SaintVenantKirchhoff(_Elastic):
    """Saint-Venant-Kirchhoff: psi = lambda/2 (tr E)^2 + mu E : E with the Green-Lagrange strain E (Odot 2023, 2.4)."""

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        mu, lmbda = lame(p.young_modulus, p.poisson_ratio)
        E = (m.dot(m.transpose(F), F) - m.Identity(3)) / 2
        return lmbda / 2 * m.tr(E) ** 2 + mu * m.inner(E, E)


class NeoHookean(_Elastic):
    """Compressible Neo-Hookean: psi = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2 (Odot 2023, 2.4)."""

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        mu, lmbda = lame(p.young_modulus, p.poisson_ratio)
        ln_J = m.ln(m.det(F))
        return mu / 2 * (m.inner(F, F) - 3) - mu * ln_J + lmbda / 2 * ln_J**2


def _isochoric_invariants(F: Any, m: Algebra) -> tuple[Any, Any, Any]:
    """J_1 and J_2 of C / J^(2/3) (Odot 2023, eq. 2.23), and J."""
    C, J = m.dot(m.transpose(F), F), m.det(F)
    I1 = m.tr(C)
    return J ** (-2 / 3) * I1, J ** (-4 / 3) * (I1**2 - m.inner(C, C)) / 2, J


class IsochoricNeoHookean(_Elastic):
    """Neo-Hookean with the isochoric-volumetric split: psi = mu/2 (J_1 - 3) + k/2 (J - 1)^2 (Odot 2023, eq. 2.27)."""

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        mu, _ = lame(p.young_modulus, p.poisson_ratio)
        J_1, _, J = _isochoric_invariants(F, m)
        return mu / 2 * (J_1 - 3) + bulk(p.young_modulus, p.poisson_ratio) / 2 * (J - 1) ** 2


@dataclass(frozen=True, eq=False)
class MooneyRivlin(_Parameters):
    """Mooney-Rivlin with the split: psi = c1 (J_1 - 3) + c2 (J_2 - 3) + k/2 (J - 1)^2 (Odot 2023, eq. 2.24).

    Args:
        c1: first constant, pascals; 2 (c1 + c2) is the shear modulus at rest.
        c2: second constant, pascals; 0 gives Neo-Hookean.
        bulk_modulus: k, pascals.
    """

    c1: Parameter
    c2: Parameter
    bulk_modulus: Parameter

    def __post_init__(self) -> None:
        self._positive("c1", "bulk_modulus")
        self._positive("c2", zero=True)
        if not np.isfinite(self.bulk_modulus).all():
            raise ValueError(
                "MooneyRivlin.bulk_modulus: expected a finite number of pascals, got infinity; "
                "incompressible tissue needs the pressure as an unknown: IncompressibleMooneyRivlin."
            )

    @classmethod
    def from_elastic(cls, young_modulus: Parameter, poisson_ratio: Parameter, share: float = 0.5) -> MooneyRivlin:
        """The constants that agree with Young's modulus and Poisson's ratio for small strains.

        Args:
            young_modulus: pascals.
            poisson_ratio: in [0, 0.5).
            share: c1 / (c1 + c2).
        """
        checked = IsochoricNeoHookean(young_modulus, poisson_ratio)
        half = lame(checked.young_modulus, checked.poisson_ratio)[0] / 2
        return cls(share * half, (1 - share) * half, bulk(checked.young_modulus, checked.poisson_ratio))

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        J_1, J_2, J = _isochoric_invariants(F, m)
        return p.c1 * (J_1 - 3) + p.c2 * (J_2 - 3) + p.bulk_modulus / 2 * (J - 1) ** 2


@dataclass(frozen=True, eq=False)
class IncompressibleMooneyRivlin(_Parameters):
    """Mooney-Rivlin with the pressure as an unknown: psi = c1 (J_1 - 3) + c2 (J_2 - 3) - p (J - 1) - c p^2 / 2.

    p is positive in compression (Odot 2023, eq. 2.23-2.26). Without compressibility J = 1; otherwise eliminating
    p = -k (J - 1) gives `MooneyRivlin` with k = 1 / c, without its locking.

    Args:
        c1: first constant, pascals.
        c2: second constant, pascals.
        compressibility: c = 1 / k, 1/pascals; 0 is fully incompressible.
    """

    c1: Parameter
    c2: Parameter
    compressibility: Parameter = 0.0
    is_mixed = True

    def __post_init__(self) -> None:
        self._positive("c1")
        self._positive("c2", zero=True)
        self._positive("compressibility", unit="1/pascals", zero=True)

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest with its multiplier, J/m^3."""
        J_1, J_2, J = _isochoric_invariants(F, m)
        constraint = pressure * (J - 1) + p.compressibility / 2 * pressure**2
        return p.c1 * (J_1 - 3) + p.c2 * (J_2 - 3) - constraint


@dataclass(frozen=True, eq=False)
class IncompressibleNeoHookean(_Parameters):
    """Neo-Hookean with the pressure as an unknown: psi = mu/2 (J_1 - 3) - p (J - 1) - c p^2 / 2 (Odot 2023, eq. 2.27).

    Args:
        shear_modulus: mu, pascals; a third of Young's modulus.
        compressibility: c = 1 / k, 1/pascals; 0 is fully incompressible.
    """

    shear_modulus: Parameter
    compressibility: Parameter = 0.0
    is_mixed = True

    def __post_init__(self) -> None:
        self._positive("shear_modulus")
        self._positive("compressibility", unit="1/pascals", zero=True)

    @classmethod
    def from_elastic(cls, young_modulus: Parameter, poisson_ratio: Parameter = 0.5) -> IncompressibleNeoHookean:
        """The constants that agree with Young's modulus and Poisson's ratio (0.5 allowed) for small strains."""
        mu = np.asarray(young_modulus) / (2 * (1 + np.asarray(poisson_ratio)))
        return cls(mu, 3 * (1 - 2 * np.asarray(poisson_ratio)) / np.asarray(young_modulus))

    def energy(self, F: Any, pressure: Any, p: Any, m: Algebra) -> Any:
        """Strain energy per volume at rest with its multiplier, J/m^3."""
        J_1, _, J = _isochoric_invariants(F, m)
        return p.shear_modulus / 2 * (J_1 - 3) - pressure * (J - 1) - p.compressibility / 2 * pressure**2


@dataclass(frozen=True, eq=False)
class Energy:
    """A strain energy of one's own.

    `Energy(lambda F, mu: mu / 2 * (ufl.inner(F, F) - 3 - 2 * ufl.ln(ufl.det(F))), {"mu": 1000.0})`

    Args:
        function: from the deformation gradient (UFL, 3 x 3) and the parameters (by name) to J/m^3.
        parameters: numbers, or arrays of shape (cells,), by name.
        is_linear: the energy is quadratic in the displacement.
    """

    function: Callable[..., Any]
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    is_linear: bool = False
    is_mixed = False

    def __post_init__(self) -> None:
        checked = {}
        for name, given in self.parameters.items():
            values = np.asarray(given, dtype=np.float64)
            if values.ndim > 1 or not np.isfinite(values).all():
                raise ValueError(
                    f"Energy.parameters[{name!r}]: expected a finite number or one for each cell, got {given!r}."
                )
            checked[name] = values if values.ndim else float(values)
        object.__setattr__(self, "parameters", MappingProxyType(checked))

    def energy(self, F: Any, pressure: Any, p: SimpleNamespace, m: Algebra) -> Any:
        """Strain energy per volume at rest, J/m^3."""
        return self.function(F, **vars(p))


def is_same_law(one: Material, other: Material) -> bool:
    """Whether two materials differ in the values of their parameters alone."""
    if type(one) is not type(other) or set(one.parameters) != set(other.parameters):
        return False
    if isinstance(one, Energy) and isinstance(other, Energy):
        return one.function is other.function and one.is_linear == other.is_linear
    return True


def with_parameters(material: Material, values: Mapping[str, Parameter]) -> Material:
    """The same law with other values of some parameters."""
    if isinstance(material, Energy):
        return replace(material, parameters={**material.parameters, **values})
    return replace(material, **values)  # type: ignore[type-var]


# Materials that Young's modulus and Poisson's ratio define, by the name they have in configuration files.
MATERIALS: dict[str, type[_Elastic]] = {
    "linear-elastic": LinearElastic,
    "saint-venant-kirchhoff": SaintVenantKirchhoff,
    "neo-hookean": NeoHookean,
    "isochoric-neo-hookean": IsochoricNeoHookean,
}
