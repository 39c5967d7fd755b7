"""Derivatives of an equilibrium with respect to everything that made it, by adjoints that UFL derives.

With R(u; m) = 0 and K = dR/du, a functional J(u) with dJ/du = g has dJ/dm = -(dR/dm)^T a where K^T a = g (Odot 2023,
eq. 6.8-6.10). The tangent, the adjoint and the sensitivities share one factorisation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.loading import Loading, checked_array, checked_loading
from ..data.outcome import Equilibrium
from ..fem.discretisation import Discretisation
from ..fem.fenicsx import assemble_vector, cell_space, fem, form, ghosted_vector, scalar, ufl
from ..fem.forms import Forms, Load, deformed_area
from ..solve.problem import Problem

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
    """

    forces: Floats
    parameters: dict[str, Floats]
    displacement: Floats | None = None
    body_force: Floats | None = None
    traction: dict[str, Floats] = field(default_factory=dict)
    pressure: dict[str, float] = field(default_factory=dict)
    points: Floats | None = None


@dataclass(frozen=True, eq=False)
class Change:
    """A direction in which forces, parameters or prescribed displacements change.

    Args:
        forces: (n, 3); none if not given.
        parameters: a number or (cells,) for each name; others stay.
        displacement: (n, 3), its free axes are ignored; none if not given.
    """

    forces: ArrayLike | None = None
    parameters: Mapping[str, ArrayLike] = field(default_factory=dict)
    displacement: ArrayLike | None = None


class Linearisation:
    """Derivatives at one equilibrium.

    Args:
        problem: body and material; stays owned by the caller and is used by each call.
        load: the load in balance.
        state: the equilibrium it led to.
    """

    def __init__(self, problem: Problem, load: Loading | ArrayLike, state: Equilibrium) -> None:
        self.problem = problem
        self._space: Discretisation = problem._space
        self._derivatives = _derivatives(problem._forms)
        self._loading = checked_loading(load, problem.body, problem.held)
        self._load = problem._forms.load(self._loading)
        self._state = problem._unknowns(state)

    # ------------------------------------------------------------------ first order

    def adjoint(self, cotangent: ArrayLike) -> Floats:
        """K^-T g, (n, 3), zero on held axes, for the derivative g of a functional by the displacement, (n, 3)."""
        return self._space.field(self._adjoint(self._space.unknowns("Linearisation.cotangent", cotangent)))

    def _adjoint(self, cotangent: Floats) -> Floats:
        return self._solve(cotangent, transpose=True)

    def _solve(self, right: Floats, transpose: bool = False) -> Floats:
        right = right.copy()
        right[self._space.fixed] = 0.0
        newton = self.problem._newton
        newton.linearise(self._state, self._load)
        return newton.linear.solve(right[None], transpose)[0]

    def tangent(self, change: Change) -> Floats:
        """How the displacement changes, (n, 3), metres per unit of a change."""
        return self._space.field(self._tangent(change))

    def _tangent(self, change: Change) -> Floats:
        lift = np.zeros(self._space.owned)
        right = self._forces_of(change)
        right -= self._derivatives.by_parameters(self._state, self._parameters_of(change))
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
        """
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
        )

    # ------------------------------------------------------------------ second order

    def hessian_product(self, cotangent: ArrayLike, change: Change, curvature: ArrayLike | None = None) -> Gradient:
        """The Hessian of J(u(forces, parameters)) times a change of forces and parameters.

        Args:
            cotangent: derivative g of J by the displacement, (n, 3).
            change: direction; prescribed displacements must stay.
            curvature: second derivative of J times `tangent(change)`, (n, 3); zero if not given, as for a linear J.
        """
        if change.displacement is not None:
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


def _derivatives(forms: Forms) -> _Derivatives:
    """The derivative forms of a problem, compiled when they are first needed and kept with it."""
    if forms.derivatives is None:
        forms.derivatives = _Derivatives(forms)
    found: _Derivatives = forms.derivatives
    return found


class _Derivatives:
    """Forms of dR/dm and of the second derivatives of a . R, where parameters are functions constant on each cell."""

    def __init__(self, forms: Forms) -> None:
        self.forms, self.space = forms, forms.space
        self._fields = {name: fem.Function(cell_space(self.space.mesh)) for name in forms.parameters}
        self._directions = {name: fem.Function(f.function_space) for name, f in self._fields.items()}
        self._adjoint, self._rate = fem.Function(self.space.space), fem.Function(self.space.space)
        self._shape = fem.Function(self.space.displacements)
        u, pressure = forms.split(self.space.state)
        self._energy = forms.energy_density(u, pressure, self._fields) * forms.dx
        self._lagrangian = ufl.derivative(self._energy, self.space.state, self._adjoint)
        self._compiled: dict[Any, Any] = {}

    def _form(self, key: Any, expression: Any) -> Any:
        """A compiled form, made once; `expression` is called if it was not made yet."""
        if key not in self._compiled:
            self._compiled[key] = form(expression())
        return self._compiled[key]

    def _set(self, state: Floats, a: Floats | None = None, rate: Floats | None = None) -> None:
        self.space.set_state(state)
        if a is not None:
            self.space.set_function(self._adjoint, a)
        if rate is not None:
            self.space.set_function(self._rate, rate)
        for name, value in self.forms.material.parameters.items():
            self._fields[name].x.array[:] = (
                value if np.ndim(value) == 0 else self.space.cell_function(value, name).x.array
            )

    def _set_directions(self, directions: Mapping[str, Floats]) -> list[str]:
        for name, values in directions.items():
            self._directions[name].x.array[:] = self.space.cell_function(values, name).x.array
        return sorted(directions)

    def _test(self) -> Any:
        return ufl.TestFunction(self.space.space)

    def _pressed(self, load: Load) -> list[tuple[str, Any]]:
        """The following pressures' part of a . R."""
        u, _ = self.forms.split(self.space.state)
        a, _ = self.forms.split(self._adjoint)
        found = []
        for name in load.pressure:
            surface = self.forms.surface(name)
            surface.pressure.value = load.pressure[name]
            found.append((name, surface.pressure * ufl.inner(deformed_area(self.space, u), a) * surface.ds))
        return found

    # ------------------------------------------------------------------ first order

    def by_parameters(self, state: Floats, directions: Mapping[str, Floats]) -> Floats:
        """dR/dm times a change of the parameters."""
        self._set(state)
        names = self._set_directions(directions)
        if not names:
            return np.zeros(self.space.owned)
        parts = [
            self._form(
                ("R m", name),
                lambda name=name: ufl.derivative(
                    ufl.derivative(self._energy, self.space.state, self._test()),
                    self._fields[name],
                    self._directions[name],
                ),
            )
            for name in names
        ]
        return self.forms.assembled(*parts)

    def of_parameters(self, state: Floats, a: Floats) -> dict[str, Floats]:
        """-(dR/dm)^T a for each parameter, (cells,)."""
        self._set(state, a)

        def by_field(f: Any) -> Any:
            return ufl.derivative(self._lagrangian, f, _cell_test(f))

        return {name: -self._by_cells(("L m", name), by_field, name) for name in self._fields}

    def _by_cells(self, key: Any, expression: Any, name: str) -> Floats:
        field_ = self._fields[name]
        compiled = self._form(key, lambda: expression(field_))
        vector = ghosted_vector(field_.function_space)
        assemble_vector(vector, [compiled])
        values = self.space.cell_values(vector, field_.function_space)
        vector.destroy()
        return values

    def tangent_times(self, state: Floats, direction: Floats, load: Load) -> Floats:
        """K times a direction, held unknowns included."""
        total = self.forms.tangent_times(state, direction)
        if not load.pressure:
            return total
        self._set(state, rate=direction)
        u, _ = self.forms.split(self.space.state)
        v = self._test() if not self.space.mixed else ufl.TestFunctions(self.space.space)[0]
        parts = []
        for name, value in load.pressure.items():
            surface = self.forms.surface(name)
            surface.pressure.value = value
            pressed = surface.pressure * ufl.inner(deformed_area(self.space, u), v) * surface.ds
            parts.append(
                self._form(("K", name), lambda pressed=pressed: ufl.derivative(pressed, self.space.state, self._rate))
            )
        return total + self.forms.assembled(*parts)

    def transpose_times(self, state: Floats, a: Floats, load: Load) -> Floats:
        """K^T a, held unknowns included."""
        self._set(state, a)
        parts = [self._form("L u", lambda: ufl.derivative(self._lagrangian, self.space.state, self._test()))]
        for name, pressed in self._pressed(load):
            parts.append(
                self._form(
                    ("L u", name),
                    lambda pressed=pressed: ufl.derivative(pressed, self.space.state, self._test()),
                )
            )
        return self.forms.assembled(*parts)

    def by_loads(
        self, state: Floats, a: Floats, loading: Loading
    ) -> tuple[Floats | None, dict[str, Floats], dict[str, float]]:
        """Integrals of the adjoint that are gradients by body force, tractions and pressures."""
        self._set(state, a)
        adjoint, _ = self.forms.split(self._adjoint)
        u, _ = self.forms.split(self.space.state)
        axes, comm = range(self.space.body.dimension), self.space.comm
        body_force = None
        if loading.body_force is not None:
            weights, dx = self.forms.weights, self.forms.dx
            parts = [self._form(("b", i), lambda i=i: weights * adjoint[i] * dx) for i in axes]
            body_force = np.array([scalar(part, comm) for part in parts])
        traction, pressure = {}, {}
        for name in loading.traction:
            ds = self.forms.surface(name).ds
            parts = [self._form(("t", name, i), lambda i=i, ds=ds: adjoint[i] * ds) for i in axes]
            traction[name] = np.array([scalar(part, comm) for part in parts])
        for name in loading.pressure:
            ds = self.forms.surface(name).ds
            part = self._form(("p", name), lambda ds=ds: ufl.inner(deformed_area(self.space, u), adjoint) * ds)
            pressure[name] = -scalar(part, comm)
        return body_force, traction, pressure

    # ------------------------------------------------------------------ second order

    def curvature(self, state: Floats, a: Floats, rate: Floats, directions: Mapping[str, Floats], load: Load) -> Floats:
        """The derivative of K^T a along a change of state and parameters."""
        self._set(state, a, rate)
        names = self._set_directions(directions)
        along = lambda part: ufl.derivative(  # noqa: E731
            ufl.derivative(part, self.space.state, self._rate), self.space.state, self._test()
        )
        parts = [self._form("L u u", lambda: along(self._lagrangian))]
        for name in names:
            parts.append(
                self._form(
                    ("L m u", name),
                    lambda name=name: ufl.derivative(
                        ufl.derivative(self._lagrangian, self._fields[name], self._directions[name]),
                        self.space.state,
                        self._test(),
                    ),
                )
            )
        for name, pressed in self._pressed(load):
            parts.append(self._form(("L u u", name), lambda pressed=pressed: along(pressed)))
        return self.forms.assembled(*parts)

    def curvature_of_parameters(
        self, state: Floats, a: Floats, rate: Floats, directions: Mapping[str, Floats]
    ) -> dict[str, Floats]:
        """The derivative of -(dR/dm)^T a along a change of state and parameters, (cells,)."""
        self._set(state, a, rate)
        names = self._set_directions(directions)
        found = {}
        for name in self._fields:
            total = self._by_cells(
                ("L u m", name),
                lambda f: ufl.derivative(
                    ufl.derivative(self._lagrangian, self.space.state, self._rate), f, _cell_test(f)
                ),
                name,
            )
            for other in names:
                total = total + self._by_cells(
                    ("L m m", other, name),
                    lambda f, other=other: ufl.derivative(
                        ufl.derivative(self._lagrangian, self._fields[other], self._directions[other]), f, _cell_test(f)
                    ),
                    name,
                )
            found[name] = -total
        return found

    # ------------------------------------------------------------------ the shape at rest

    def by_points(self, state: Floats, a: Floats, loading: Loading) -> Floats:
        """-(dR/dX)^T a, (n, 3): all integrals pulled back by X + V, differentiated by V at V = 0."""
        self._set(state, a)
        space = self.space
        shape_test = ufl.TestFunction(space.displacements)
        parts = [self._form("L X", lambda: ufl.derivative(self._pulled_energy(), self._shape, shape_test))]
        for key, pulled, constant_, value in self._pulled_loads(loading):
            constant_.value = value
            parts.append(self._form(key, lambda pulled=pulled: ufl.derivative(pulled, self._shape, shape_test)))
        vector = ghosted_vector(space.displacements)
        assemble_vector(vector, parts)
        found = space.nodal(np.array(vector.array_r))
        vector.destroy()
        return -found

    def _moved(self) -> tuple[Any, Any]:
        """G = I + grad V, and F = I + grad u G^-1."""
        u, _ = self.forms.split(self.space.state)
        G = self.space.deformation_gradient(self._shape)
        return G, ufl.Identity(3) + self.space.gradient(u) * ufl.inv(G)

    def _pulled_energy(self) -> Any:
        u, pressure = self.forms.split(self.space.state)
        G, F = self._moved()
        energy = self.forms.energy_density(u, pressure, self._fields, F) * ufl.det(G) * self.forms.dx
        return ufl.derivative(energy, self.space.state, self._adjoint)

    def _pulled_loads(self, loading: Loading) -> list[tuple[Any, Any, Any, Any]]:
        """Loads' parts of a . R after the nodes have moved: key, form, the constant in it and its value."""
        space, forms = self.space, self.forms
        u, _ = forms.split(space.state)
        a, _ = forms.split(self._adjoint)
        G, _ = self._moved()
        found: list[tuple[Any, Any, Any, Any]] = []
        if loading.body_force is not None:
            pulled = -forms.weights * ufl.inner(forms.body_force, a) * ufl.det(G) * forms.dx
            found.append(("X b", pulled, forms.body_force, loading.body_force))
        for name, traction in loading.traction.items():
            surface = forms.surface(name)
            area = deformed_area(space, u, G)
            pulled = -ufl.inner(surface.traction, a) * ufl.sqrt(ufl.inner(area, area)) * surface.ds
            found.append((("X t", name), pulled, surface.traction, traction))
        for name, pascals in loading.pressure.items():
            surface = forms.surface(name)
            total = G + space.gradient(u)
            pulled = surface.pressure * ufl.inner(deformed_area(space, u, total), a) * surface.ds
            found.append((("X p", name), pulled, surface.pressure, pascals))
        return found


def _cell_test(function: Any) -> Any:
    return ufl.TestFunction(function.function_space)
