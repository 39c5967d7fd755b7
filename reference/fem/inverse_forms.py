"""Equilibrium written on the loaded shape, with the unloaded one as the unknown (Govindjee and Mihalic 1996)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.loading import Loading
from .fenicsx import (
    add_matrix,
    assemble_matrix,
    assemble_vector,
    constant,
    create_matrix,
    facet_matrix,
    fem,
    form,
    ghosted_vector,
    scalar,
    ufl,
)
from .forms import INSIDE_OUT, LARGEST_ENERGY, Forms, deformed_area

Floats = NDArray[np.float64]


class InverseForms:
    """Residual and tangent by U = X - x: where each point of the loaded shape x was without the load.

    With f = dX/dx the deformation gradient is F = f^-1, and what is integrated over the unloaded shape is integrated
    over the loaded one with det f: the same numbers, point by point, as `Forms` on the unloaded body. Pressures follow
    the loaded surface, which is known: here they are dead.

    Args:
        forms: of the loaded shape taken as a body; gives material, quadrature, springs; stays owned by the caller.
        loading: checked, what acts on the loaded shape.
    """

    def __init__(self, forms: Forms, loading: Loading) -> None:
        self.space = space = forms.space
        self._forms, self._test, self._trial = forms, ufl.TestFunction(space.space), ufl.TrialFunction(space.space)
        U, pressure = forms.split(space.state)
        f = space.deformation_gradient(U)
        self._share = constant(space.mesh, 1.0)  # of the load
        self._vector = ghosted_vector(space.space)
        lift = forms.load(Loading(displacement=loading.displacement)).lift
        self._lift, self._nodal = -lift, np.zeros(space.owned)
        if loading.forces is not None:
            self._nodal = forms.load(Loading(forces=loading.forces)).dead
        residual = self._stresses(f, pressure) - self._body_force(f, loading)
        by_area = [*self._springs(f, U), *self._tractions(f, loading)]
        psi = forms.energy_density(None, pressure, forms.parameters, ufl.inv(f))
        guarded = ufl.conditional(ufl.le(ufl.det(f), 0.0), INSIDE_OUT, ufl.det(f) * psi)
        self._energy = form(guarded * forms.dx)
        self._residual = [form(part) for part in (residual, *by_area, *self._pressures(loading))]
        self._tangent = form(ufl.derivative(residual, space.state, self._trial))
        self._facet_tangents = [form(ufl.derivative(part, space.state, self._trial)) for part in by_area]

    def _stresses(self, f: Any, pressure: Any) -> Any:
        forms, dx = self._forms, self._forms.dx
        test, test_pressure = forms.split(self._test)
        F = ufl.variable(ufl.inv(f))
        p = None if pressure is None else ufl.variable(pressure)
        psi = forms.weights * forms.material.energy(F, p, SimpleNamespace(**forms.parameters), ufl)
        work = ufl.inner(ufl.diff(psi, F), self.space.gradient(test) * F)
        if p is not None:
            work += ufl.diff(psi, p) * test_pressure
        return ufl.det(f) * work * dx

    def _springs(self, f: Any, U: Any) -> list[Any]:
        """Forces -k u on the unloaded area, with u = -U."""
        test, _ = self._forms.split(self._test)
        parts = []
        for springs in self._forms.springs:
            area = deformed_area(self.space, None, f)
            size = ufl.sqrt(ufl.inner(area, area))
            across = ufl.inner(U, area) / size * area / size
            parts.append(
                -ufl.inner(springs.normal * across + springs.tangential * (U - across), test) * size * springs.ds
            )
        return parts

    def _tractions(self, f: Any, loading: Loading) -> list[Any]:
        """Dead tractions, which are given per unloaded area."""
        test, _ = self._forms.split(self._test)
        area = deformed_area(self.space, None, f)
        size = ufl.sqrt(ufl.inner(area, area))
        return [
            -self._share * ufl.inner(self._vector_of(given), test) * size * self._forms.surface(name).ds
            for name, given in loading.traction.items()
        ]

    def _pressures(self, loading: Loading) -> list[Any]:
        test, _ = self._forms.split(self._test)
        inward = ufl.inner(ufl.FacetNormal(self.space.mesh), test)
        return [
            self._share * constant(self.space.mesh, pascals) * inward * self._forms.surface(name).ds
            for name, pascals in loading.pressure.items()
        ]

    def _body_force(self, f: Any, loading: Loading) -> Any:
        """A force per unloaded volume, as weight is."""
        forms = self._forms
        test, _ = forms.split(self._test)
        given = self._vector_of(
            np.zeros(self.space.body.dimension) if loading.body_force is None else loading.body_force
        )
        return self._share * forms.weights * ufl.det(f) * ufl.inner(given, test) * forms.dx

    def _vector_of(self, values: ArrayLike) -> Any:
        return fem.Constant(self.space.mesh, np.array(values, dtype=np.float64))

    def set_share(self, share: float) -> None:
        """Which part of the load acts."""
        self._share.value = share

    def residual(self, unknowns: Floats) -> Floats:
        """Out-of-balance forces, newtons; at held unknowns their distance from where they should be; NaN inside out."""
        space, share = self.space, float(self._share.value)
        space.set_state(unknowns)
        if not scalar(self._energy, space.comm) < LARGEST_ENERGY:
            return np.full(space.owned, np.nan)
        assemble_vector(self._vector, self._residual)
        out = np.array(self._vector.array_r) - share * self._nodal
        out[space.fixed] = unknowns[space.fixed] - share * self._lift[space.fixed]
        return out

    def create_matrix(self) -> Any:
        """A matrix with the tangent's sparsity; the caller's."""
        return create_matrix(self._tangent)

    def tangent(self, unknowns: Floats, matrix: Any) -> None:
        """The derivative of the residual into a matrix, not symmetric; held rows and columns are the identity's."""
        self.space.set_state(unknowns)
        assemble_matrix(matrix, self._tangent, self.space.conditions)
        for part in self._facet_tangents:
            add_matrix(matrix, facet_matrix(part, self.space.fixed))

    def close(self) -> None:
        """Free the PETSc objects."""
        self._vector.destroy()
