"""Energy, residual and tangent of a body, and the loads on it: UFL forms, compiled once and assembled many times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.quadrature import quadrature_degree

from ..data.loading import Loading
from ..data.materials import Energy, Material, Parameter, is_same_law
from ..data.springs import Springs, Support, ligaments_of, on_surfaces
from .assembly import CellSum, suits
from .discretisation import Discretisation
from .fenicsx import (
    CellMatrices,
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
    sparsity,
    ufl,
)
from .ligaments import LigamentForms

Floats = NDArray[np.float64]

INSIDE_OUT = 1e250  # energy per volume of what is turned inside out, J/m^3; times any cell's volume it is above
LARGEST_ENERGY = 1e200  # joules


@dataclass(frozen=True, eq=False)
class DiscreteLoad:
    """A load as unknowns.

    Args:
        dead: forces that do not change, this rank's unknowns, newtons.
        lift: prescribed displacements at held unknowns, zero elsewhere, metres.
        pressure: pascals of each surface.
    """

    dead: Floats
    lift: Floats
    pressure: dict[str, float]

    @staticmethod
    def none(space: Discretisation) -> DiscreteLoad:
        """No load."""
        return DiscreteLoad(np.zeros(space.owned), np.zeros(space.owned), {})

    def scaled(self, factor: float) -> DiscreteLoad:
        """The same load, `factor` times as strong, displacements too: no part of a rotation."""
        return DiscreteLoad(
            factor * self.dead, factor * self.lift, {name: factor * p for name, p in self.pressure.items()}
        )


class Forms:
    """What is assembled for one body of one material.

    Args:
        space: the body's discretisation.
        material: strain energy.
        weights: factor of each cell's energy, (cells,), the part of the cell that is filled; None for 1.
        degree: of the quadrature; None for the least that is safe.
        springs: that hold named surfaces.
    """

    def __init__(
        self,
        space: Discretisation,
        material: Material,
        weights: Floats | None = None,
        degree: int | None = None,
        springs: Mapping[str, Support] | None = None,
    ) -> None:
        self.space, self.material = space, material
        self.degree = degree or quadrature_degree(space.body, material.is_mixed)
        self.dx = space.measure(self.degree)
        self.parameters = {name: self.parameter(name, value) for name, value in material.parameters.items()}
        self.weights = 1 if weights is None else space.cell_function(weights, "Problem.weights")
        self._vector = ghosted_vector(space.space)
        self._surfaces: dict[str, _SurfaceForms] = {}
        self.body_force = fem.Constant(space.mesh, np.zeros(space.body.dimension))
        self._body_force_form: Any = None
        self.direction = fem.Function(space.space)
        self.reactions = np.zeros(len(space.fixed))  # at held unknowns, where the residual was last asked for
        self._compile()
        given = springs or {}
        self.springs = [_SpringForms(self, name, each) for name, each in on_surfaces(given).items()]
        self.ligaments = [LigamentForms(space, name, each) for name, each in ligaments_of(given).items()]

    def parameter(self, name: str, value: Parameter) -> Any:
        """A parameter as forms read it: a number that another may replace without compiling, or one for each cell."""
        if np.ndim(value) == 0:
            return constant(self.space.mesh, float(value))
        return self.space.cell_function(value, f"{type(self.material).__name__}.{name}")

    def set_material(self, material: Material) -> None:
        """Other parameters of the same law, without compiling again.

        Raises:
            ValueError: another law, or a number where there was one for each cell, or the reverse.
        """
        if not is_same_law(material, self.material):
            same = " of the same function and parameters" if isinstance(self.material, Energy) else ""
            raise ValueError(f"material: expected another {type(self.material).__name__}{same}, got {material!r}.")
        for name, value in material.parameters.items():
            if np.ndim(value) != np.ndim(self.material.parameters[name]):
                raise ValueError(f"material.{name}: expected the shape that the problem was built with, got {value!r}.")
        for name, value in material.parameters.items():
            if np.ndim(value) == 0:
                self.parameters[name].value = float(value)
            else:
                self.parameters[name].x.array[:] = self.space.cell_function(value, f"material.{name}").x.array
        self.material = material

    def split(self, function: Any) -> tuple[Any, Any]:
        """Displacement and pressure (None where there is none) of a function of the whole space."""
        return ufl.split(function) if self.space.mixed else (function, None)

    def energy_density(self, u: Any, pressure: Any, parameters: dict[str, Any], gradient: Any = None) -> Any:
        """Strain energy per volume of the cell at rest (UFL)."""
        F = self.space.deformation_gradient(u) if gradient is None else gradient
        return self.weights * self.material.energy(F, pressure, SimpleNamespace(**parameters), ufl)

    def _compile(self) -> None:
        u, pressure = self.split(self.space.state)
        psi = self.energy_density(u, pressure, self.parameters)
        guarded = psi
        if not self.material.is_linear:
            # Asked for and not left to NaN, which compilers may take for impossible (-ffast-math).
            is_turned = ufl.le(ufl.det(self.space.deformation_gradient(u)), 0.0)
            guarded = ufl.conditional(is_turned, INSIDE_OUT, psi)
        residual = ufl.derivative(psi * self.dx, self.space.state, ufl.TestFunction(self.space.space))
        tangent = ufl.derivative(residual, self.space.state, ufl.TrialFunction(self.space.space))
        self._energy = form(guarded * self.dx)
        self._residual = form(residual)
        self.tangent_form = form(tangent)
        self._cell_sum: CellSum | None = None
        if self.space.comm.size == 1:
            self.cells = CellMatrices(self.tangent_form, self.space.space)
        if suits(self.space):
            self._cell_sum = CellSum(self.space, self.cells, sparsity(self.tangent_form))
        self._tangent_action: Any = None
        self._tangent_expression = tangent

    # ------------------------------------------------------------------ loads

    def load(self, loading: Loading) -> DiscreteLoad:
        """A load as unknowns."""
        space = self.space
        dead, lift = np.zeros(space.owned), np.zeros(space.owned)
        if loading.forces is not None:
            dead += space.unknowns("Problem.forces", loading.forces)
        if loading.body_force is not None:
            dead += self._body_forces(np.asarray(loading.body_force))
        for surface, traction in loading.traction.items():
            forms = self.surface(surface)
            forms.traction.value[:] = traction
            dead += self.assembled(forms.traction_form)
        dead[space.fixed] = 0.0
        field = np.zeros_like(space.body.points)
        for name, values in loading.displacement.items():
            field[space.body.node_sets[name]] = values
        everywhere = space.unknowns("Loading.displacement", field)
        lift[space.fixed] = everywhere[space.fixed]
        return DiscreteLoad(dead, lift, {name: value for name, value in loading.pressure.items() if value != 0.0})

    def _body_forces(self, force: Floats) -> Floats:
        if self._body_force_form is None:
            v, _ = self._test()
            self._body_force_form = form(self.weights * ufl.inner(self.body_force, v) * self.dx)
        self.body_force.value[:] = force
        return self.assembled(self._body_force_form)

    def _test(self) -> tuple[Any, Any]:
        return ufl.TestFunctions(self.space.space) if self.space.mixed else (ufl.TestFunction(self.space.space), None)

    def surface(self, name: str) -> _SurfaceForms:
        """The forms of a named surface, compiled when it is first loaded."""
        if name not in self._surfaces:
            self._surfaces[name] = _SurfaceForms(self, name)
        return self._surfaces[name]

    # ------------------------------------------------------------------ assembly at a state

    def assembled(self, *compiled: Any) -> Floats:
        """The sum of linear forms at the present state, this rank's unknowns."""
        assemble_vector(self._vector, list(compiled))
        return np.array(self._vector.array_r)

    def _pressed(self, load: DiscreteLoad) -> list[_SurfaceForms]:
        pressed = []
        for name, pascals in load.pressure.items():
            forms = self.surface(name)
            forms.pressure.value = pascals
            pressed.append(forms)
        return pressed

    def residual(self, unknowns: Floats, load: DiscreteLoad) -> Floats:
        """Out-of-balance forces; at held unknowns their distance from where they should be."""
        self.space.set_state(unknowns)
        further = [*(s.force_form for s in self.springs), *(s.pressure_form for s in self._pressed(load))]
        out = self.assembled(self._residual, *further) - load.dead
        for ligament in self.ligaments:
            out += ligament.forces(unknowns)
        fixed = self.space.fixed
        self.reactions = out[fixed]
        out[fixed] = unknowns[fixed] - load.lift[fixed]
        return out

    def internal(self, unknowns: Floats) -> Floats:
        """Derivative of the strain energy, held unknowns included."""
        self.space.set_state(unknowns)
        return self.assembled(self._residual)

    def tangent(self, unknowns: Floats, load: DiscreteLoad, matrix: Any) -> None:
        """The derivative of the residual into a matrix; held rows and columns are the identity's."""
        self.space.set_state(unknowns)
        if self._cell_sum is None:
            assemble_matrix(matrix, self.tangent_form, self.space.conditions)
        else:
            self._cell_sum.assemble(matrix)
        for springs in self.springs:
            add_matrix(matrix, facet_matrix(springs.stiffness_form, self.space.fixed))
        for ligament in self.ligaments:
            ligament.add_to(matrix, unknowns)
        for surface in self._pressed(load):
            add_matrix(matrix, facet_matrix(surface.pressure_tangent, self.space.fixed))

    def tangent_times(self, unknowns: Floats, direction: Floats) -> Floats:
        """The stiffness of body and springs times a direction, held unknowns included."""
        return self._body_tangent_times(unknowns, direction) + self.supports_times(unknowns, direction)

    def supports_times(self, unknowns: Floats, direction: Floats) -> Floats:
        """The stiffness of springs and ligaments, symmetric, times a direction."""
        found = np.zeros(self.space.owned)
        if self.springs:
            self.space.set_state(direction)
            found += self.assembled(*(springs.force_form for springs in self.springs))  # linear
        for ligament in self.ligaments:
            found += ligament.stiffness_times(unknowns, direction)
        return found

    def spring_forces(self, unknowns: Floats, name: str = "") -> Floats:
        """Forces that all springs and ligaments, or those of a name, need to be pulled so far."""
        found = np.zeros(self.space.owned)
        chosen = [springs.force_form for springs in self.springs if name in ("", springs.name)]
        if chosen:
            self.space.set_state(unknowns)
            found += self.assembled(*chosen)
        for ligament in self.ligaments:
            if name in ("", ligament.name):
                found += ligament.forces(unknowns)
        return found

    def set_springs(self, factors: Mapping[str, float]) -> None:
        """How many times as stiff as given the springs on named surfaces are; others as given."""
        for springs in self.springs:
            springs.scale(factors.get(springs.name, 1.0))
        for ligament in self.ligaments:
            ligament.scale(factors.get(ligament.name, 1.0))

    @property
    def spring_factors(self) -> dict[str, float]:
        """How many times as stiff as given springs and ligaments are, by their names."""
        factors = {springs.name: springs.factor for springs in self.springs}
        return factors | {ligament.name: ligament.factor for ligament in self.ligaments}

    def _body_tangent_times(self, unknowns: Floats, direction: Floats) -> Floats:
        if self._tangent_action is None:
            self._tangent_action = form(ufl.action(self._tangent_expression, self.direction))
        self.space.set_state(unknowns)
        self.space.set_function(self.direction, direction)
        return self.assembled(self._tangent_action)

    def energy(self, unknowns: Floats) -> float:
        """Strain energy, joules; infinite where a cell is inside out."""
        self.space.set_state(unknowns)
        energy = scalar(self._energy, self.space.comm)
        return energy if energy < LARGEST_ENERGY else np.inf

    def potential(self, unknowns: Floats, load: DiscreteLoad) -> float:
        """Strain energy, and that of springs, minus the work of dead forces, joules."""
        stored = self.energy(unknowns)
        stored += sum(scalar(springs.energy_form, self.space.comm) for springs in self.springs)
        stored += sum(ligament.energy(unknowns) for ligament in self.ligaments)
        return stored - self.space.dot(load.dead, unknowns)

    def pressed(self, unknowns: Floats, load: DiscreteLoad) -> Floats:
        """What following pressures add to the residual."""
        surfaces = self._pressed(load)
        if not surfaces:
            return np.zeros(self.space.owned)
        self.space.set_state(unknowns)
        return self.assembled(*(s.pressure_form for s in surfaces))

    def pressure_potential(self, unknowns: Floats, load: DiscreteLoad) -> float:
        """Pressure times the volume between a surface, before and after, and the origin, joules."""
        total = 0.0
        for surface in self._pressed(load):
            for state, sign in ((unknowns, 1.0), (np.zeros_like(unknowns), -1.0)):
                self.space.set_state(state)
                total += sign * scalar(surface.volume_form, self.space.comm)
        return total

    def pressure_work(self, start: Floats, step: Floats, load: DiscreteLoad) -> float:
        """Work of the following pressure along the straight way from `start` to `start + step`, joules.

        Simpson's rule is exact: the deformed area is quadratic in the displacement.
        """
        pressed = self._pressed(load)
        if not pressed:
            return 0.0
        work = 0.0
        for share, at in ((1, 0.0), (4, 0.5), (1, 1.0)):
            self.space.set_state(start + at * step)
            work -= share / 6 * self.space.dot(self.assembled(*(s.pressure_form for s in pressed)), step)
        return work

    def is_conservative(self, load: DiscreteLoad) -> bool:
        """True when the tangent of following pressures is symmetric: their surfaces are closed or held all round."""
        pressed = self._pressed(load)
        if not pressed:
            return True
        rng = np.random.default_rng(0)
        self.space.set_state(1e-2 * self.space.body.size * rng.standard_normal(self.space.owned))
        x, y = rng.standard_normal((2, self.space.owned))
        products = []
        for surface in pressed:
            matrix = facet_matrix(surface.pressure_tangent, self.space.fixed)
            a, b, out = matrix.createVecRight(), matrix.createVecRight(), matrix.createVecLeft()
            a.array[:], b.array[:] = x, y
            matrix.mult(a, out)
            products.append((out.dot(b), out.norm() * b.norm()))
            matrix.mult(b, out)
            products[-1] = (products[-1][0] - out.dot(a), products[-1][1])
            for item in (matrix, a, b, out):
                item.destroy()
        gap, scale = np.sum(products, axis=0)
        return bool(abs(gap) <= 1e-10 * scale)

    def create_matrix(self) -> Any:
        """A matrix with the tangent's sparsity."""
        return create_matrix(self.tangent_form) if self._cell_sum is None else self._cell_sum.create_matrix()

    def stiffness_scale(self) -> float:
        """The modulus that resists stretching at rest, pascals: v K(0) v / volume for the field v = (x, 0, 0)."""
        points = self.space.body.points
        stretch = np.zeros_like(points)
        stretch[:, 0] = points[:, 0] - points[:, 0].mean()
        v = self.space.unknowns("stretch", stretch)
        product = self._body_tangent_times(np.zeros(self.space.owned), v)
        return abs(self.space.dot(product, v)) / self.space.body.volume

    def close(self) -> None:
        """Free the PETSc objects."""
        self._vector.destroy()


class _SpringForms:
    """Energy, forces and stiffness of springs on one named surface."""

    def __init__(self, forms: Forms, name: str, springs: Springs) -> None:
        space = forms.space
        u, _ = forms.split(space.state)
        across = ufl.inner(u, ufl.FacetNormal(space.mesh))
        self.ds = ds = space.facet_measure(name, max(forms.degree, 2 * space.body.kind.degree))
        self.name, self.factor, self._given = name, 1.0, springs
        self.normal = k_n = constant(space.mesh, springs.normal)
        self.tangential = k_t = constant(space.mesh, springs.tangential)
        energy = 0.5 * (k_n * across**2 + k_t * (ufl.inner(u, u) - across**2)) * ds
        force = ufl.derivative(energy, space.state, ufl.TestFunction(space.space))
        self.energy_form, self.force_form = form(energy), form(force)
        self.stiffness_form = form(ufl.derivative(force, space.state, ufl.TrialFunction(space.space)))

    def scale(self, factor: float) -> None:
        """So many times as stiff as they were given."""
        self.factor = factor
        self.normal.value = factor * self._given.normal
        self.tangential.value = factor * self._given.tangential


class _SurfaceForms:
    """Traction and following pressure on one named surface."""

    def __init__(self, forms: Forms, name: str) -> None:
        space = forms.space
        ds = space.facet_measure(name, max(forms.degree, 2 * space.body.kind.degree))
        test, _ = forms._test()
        self.traction = fem.Constant(space.mesh, np.zeros(space.body.dimension))
        self.pressure = constant(space.mesh, 0.0)
        self.ds = ds
        self.traction_form = form(ufl.inner(self.traction, test) * ds)
        u, _ = forms.split(space.state)
        pressed = self.pressure * ufl.inner(deformed_area(space, u), test) * ds
        self.pressure_form = form(pressed)
        x = ufl.SpatialCoordinate(space.mesh) + u
        self.volume_form = form(self.pressure / space.body.dimension * ufl.inner(deformed_area(space, u), x) * ds)
        self.pressure_tangent = form(ufl.derivative(pressed, space.state, ufl.TrialFunction(space.space)))


def deformed_area(space: Discretisation, u: Any, gradient: Any = None) -> Any:
    """Area vector after the deformation per area at rest, cof(F) N (Nanson; Odot 2023, eq. 2.11), in UFL."""
    F = space.deformation_gradient(u) if gradient is None else gradient
    cofactor = ufl.det(F) * ufl.inv(F).T
    N = ufl.FacetNormal(space.mesh)
    dimension = space.body.dimension
    return ufl.as_vector([sum(cofactor[i, j] * N[j] for j in range(dimension)) for i in range(dimension)])
