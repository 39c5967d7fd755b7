"""Forms of the derivatives of equilibrium, derived from the energy by UFL; each is compiled when it is first needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.loading import Loading
from ..fem.fenicsx import assemble_vector, cell_space, fem, form, ghosted_vector, scalar, ufl
from ..fem.forms import DiscreteLoad, Forms, deformed_area

Floats = NDArray[np.float64]


class DerivativeForms:
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

    def _pressed(self, load: DiscreteLoad) -> list[tuple[str, Any]]:
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

    def tangent_times(self, state: Floats, direction: Floats, load: DiscreteLoad) -> Floats:
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

    def transpose_times(self, state: Floats, a: Floats, load: DiscreteLoad) -> Floats:
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
        return self.forms.assembled(*parts) + self.forms.supports_times(state, a)

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

    def curvature(
        self, state: Floats, a: Floats, rate: Floats, directions: Mapping[str, Floats], load: DiscreteLoad
    ) -> Floats:
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
