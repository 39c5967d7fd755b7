"""Derivatives of an equilibrium with respect to everything that made it, by adjoints that UFL derives.

With R(u; m) = 0 and K = dR/du, a functional J(u) with dJ/du = g has dJ/dm = -(dR/dm)^T a where K^T a = g (Odot 2023,
eq. 6.8-6.10). The tangent, the adjoint and the sensitivities share one factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.inputs import Change
from ..data.loading import Loading, checked_array, checked_loading
from ..data.outcome import Equilibrium
from ..solve.problem import Problem
from ..solve.system import System
from .derivative_forms import DerivativeForms

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gradient:
    """Derivatives of a functional; arrays have the shape of what they are derivatives by.

    Args:
        forces: by nodal forces, (n, 3); zero on held axes.
        parameters: by the material's parameters: a number for a number, (cells,) for one a cell.
        displacement: by prescribed displacements, (n, 3); zero on free axes.
        body_force: by the body force, (3,).
        traction: by the traction on each loaded surface, (3,).
        pressure: by the pressure on each loaded surface.
        points: by node positions at rest, (n, 3), with nodal forces kept; None where it was not asked for.
        springs: by how many times as stiff springs are, by the surface that they hold.
    """

    forces: Floats
    parameters: dict[str, Floats]
    displacement: Floats | None = None
    body_force: Floats | None = None
    traction: dict[str, Floats] = field(default_factory=dict)
    pressure: dict[str, float] = field(default_factory=dict)
    points: Floats | None = None
    springs: dict[str, float] = field(default_factory=dict)


class Linearisation:
    """Derivatives at one equilibrium.

    Args:
        problem: body and material; stays owned by the caller and is used by each call.
        load: the load in balance.
        state: the equilibrium it led to.
    """

    def __init__(self, problem: Problem, load: Loading | ArrayLike, state: Equilibrium) -> None:
        self.problem = problem
        self._system, self._space = problem.system, problem.system.space
        self._derivatives = _derivative_forms(problem.system)
        self._loading = checked_loading(load, problem.body, problem.held)
        self._load = problem.system.forms.load(self._loading)
        self._state = problem.system.unknowns(state)

    # ------------------------------------------------------------------ first order

    def adjoint(self, cotangent: ArrayLike) -> Floats:
        """K^-T g, (n, 3), zero on held axes, for the derivative g of a functional by the displacement, (n, 3)."""
        return self._space.field(self._adjoint(self._space.unknowns("Linearisation.cotangent", cotangent)))

    def _adjoint(self, cotangent: Floats) -> Floats:
        return self._solve(cotangent, transpose=True)

    def _solve(self, right: Floats, transpose: bool = False) -> Floats:
        return self._system.tangent.solve(self._state, self._load, right[None], transpose)[0]

    def tangent(self, change: Change) -> Floats:
        """How the displacement changes, (n, 3), metres per unit of a change."""
        return self._space.field(self._tangent(change))

    def _tangent(self, change: Change) -> Floats:
        lift = np.zeros(self._space.owned)
        right = self._forces_of(change)
        right -= self._derivatives.by_parameters(self._state, self._parameters_of(change))
        for name, rate in change.springs.items():
            right -= rate * self._by_springs(name)
        if change.displacement is not None:
            values = self._space.unknowns("Change.displacement", change.displacement)
            lift[self._space.fixed] = values[self._space.fixed]
            right -= self._derivatives.tangent_times(self._state, lift, self._load)
        return lift + self._solve(right)

    def gradient(self, cotangent: ArrayLike, *, points: bool = False) -> Gradient:
        """The gradient of a functional J(u) with respect to all that made the equilibrium.

        What J depends on by itself (a regularisation of the forces, say) is the caller's to add.

        Args:
            cotangent: derivative of J by the displacement, (n, 3).
            points: also with respect to the node positions at rest.

        Raises:
            ValueError: node positions of a body on springs, which turn with the surface at rest.
        """
        if points and self._system.springs:
            raise ValueError(
                "Linearisation.gradient.points: expected a body without springs, got springs; ask without."
            )
        g = self._space.unknowns("Linearisation.cotangent", cotangent)
        a = self._adjoint(g)
        return self._gradient(g, a, points)

    def _gradient(self, g: Floats, a: Floats, points: bool) -> Gradient:
        space, derivatives = self._space, self._derivatives
        held = np.zeros(space.owned)
        held[space.fixed] = (g - derivatives.transpose_times(self._state, a, self._load))[space.fixed]
        body_force, traction, pressure = derivatives.by_loads(self._state, a, self._loading)
        by_cells = derivatives.of_parameters(self._state, a)
        return Gradient(
            forces=space.field(a),
            parameters=self._like_parameters(by_cells),
            displacement=space.field(held),
            body_force=body_force,
            traction=traction,
            pressure=pressure,
            points=derivatives.by_points(self._state, a, self._loading) if points else None,
            springs={name: -space.dot(a, self._by_springs(name)) for name in self._system.springs},
        )

    # ------------------------------------------------------------------ second order

    def hessian_product(self, cotangent: ArrayLike, change: Change, curvature: ArrayLike | None = None) -> Gradient:
        """The Hessian of J(u(forces, parameters)) times a change of forces and parameters.

        Args:
            cotangent: derivative g of J by the displacement, (n, 3).
            change: direction; prescribed displacements must stay.
            curvature: second derivative of J times `tangent(change)`, (n, 3); zero if not given, as for a linear J.
        """
        if self._system.forms.ligaments:
            raise ValueError(
                "Linearisation.hessian_product: expected a body without ligaments, whose curvature is not known here."
            )
        if change.displacement is not None or change.springs:
            raise ValueError("Linearisation.hessian_product: expected a change of forces and parameters alone.")
        rate, a = self._tangent(change), self._adjoint(self._space.unknowns("Linearisation.cotangent", cotangent))
        directions = self._parameters_of(change)
        bend = np.zeros_like(rate) if curvature is None else self._space.unknowns("Linearisation.curvature", curvature)
        bend = bend - self._derivatives.curvature(self._state, a, rate, directions, self._load)
        a_rate = self._adjoint(bend)
        by_cells = self._derivatives.curvature_of_parameters(self._state, a, rate, directions)
        first = self._derivatives.of_parameters(self._state, a_rate)
        return Gradient(
            forces=self._space.field(a_rate),
            parameters=self._like_parameters({name: by_cells[name] + first[name] for name in first}),
        )

    def _by_springs(self, name: str) -> Floats:
        """Derivative of the residual by the factor of springs."""
        forms = self._system.forms
        factors = forms.spring_factors
        if name not in factors:
            raise ValueError(f"Change.springs: expected surfaces with springs, {sorted(factors)}, got {name!r}.")
        return forms.spring_forces(self._state, name) / factors[name]

    # ------------------------------------------------------------------ shapes

    def _forces_of(self, change: Change) -> Floats:
        if change.forces is None:
            return np.zeros(self._space.owned)
        return self._space.unknowns("Change.forces", change.forces)

    def _parameters_of(self, change: Change) -> dict[str, Floats]:
        known = self.problem.material.parameters
        cells = len(self.problem.body.cells)
        found = {}
        for name, values in change.parameters.items():
            if name not in known:
                raise ValueError(f"Change.parameters: expected names among {sorted(known)}, got {name!r}.")
            whole = np.broadcast_to(np.asarray(values, dtype=np.float64), (cells,)) if np.ndim(values) == 0 else values
            found[name] = checked_array(f"Change.parameters[{name!r}]", whole, (cells,))
        return found

    def _like_parameters(self, by_cells: dict[str, Floats]) -> dict[str, Floats]:
        given = self.problem.material.parameters
        return {name: values if np.ndim(given[name]) else values.sum() for name, values in by_cells.items()}


_FORMS: WeakKeyDictionary[System, DerivativeForms] = WeakKeyDictionary()


def _derivative_forms(system: System) -> DerivativeForms:
    """The forms of a system, compiled when they are first needed and kept as long as it."""
    if system not in _FORMS:
        _FORMS[system] = DerivativeForms(system.forms)
    return _FORMS[system]
