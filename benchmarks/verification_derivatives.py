"""Studies of derivatives: tangent, frame indifference, Taylor tests of every sensitivity. Used by verification.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from verification_cases import Floats, box, incompressible, shaken
from verification_solutions import TIGHT, Row, Waves, orders

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change
from softtwin.reference.data.materials import Energy, Material
from softtwin.reference.data.outcome import Equilibrium
from softtwin.reference.derivatives.linearisation import Gradient, Linearisation
from softtwin.reference.fem.forms import DiscreteLoad
from softtwin.reference.solve.problem import Loading, Problem

DIFFERENCES = 1e-2 * 0.5 ** np.arange(4)  # of the largest displacement, and of the pressure
STEPS = 0.5 ** np.arange(2, 6)
ROUND_OFF = 1e-10  # of J: a hundred times the solver's tolerance; remainders below it have no order
QUADRATURE = 4  # one for all, since bodies whose nodes were moved are curved and would take another


# ---------------------------------------------------------------------- the tangent


def tangent(material: Material, kind: str) -> Row:
    """The tangent of a strongly deformed body against central differences of the residual, and its asymmetry.

    The problem's own forms are used, so that the rows of the pressure are seen too.
    """
    body = box(kind, 2, shaken)
    rng = np.random.default_rng(1)
    with Problem(body, material, TIGHT, held={"x0": "xyz"[: body.dimension]}) as problem:
        space, forms = problem.system.space, problem.system.forms
        state = space.unknowns(
            "u", Waves(body.dimension, 0.2).displacement(body.points), rng.normal(size=len(body.points))
        )
        state[space.fixed] = 0.0
        direction = rng.standard_normal(space.owned)
        direction[space.fixed] = 0.0
        slope = forms.tangent_times(state, direction)
        gaps = []
        for h in DIFFERENCES:
            difference = (forms.internal(state + h * direction) - forms.internal(state - h * direction)) / (2 * h)
            gaps.append(float(np.linalg.norm(difference - slope) / np.linalg.norm(slope)))
        matrix = _assembled(problem, state)
    product = matrix @ direction
    free = np.setdiff1d(np.arange(len(state)), space.fixed)
    return {
        "gaps": gaps,
        "orders": orders(DIFFERENCES, gaps),
        "assembled_error": float(np.abs(product - slope)[free].max() / np.abs(slope).max()),
        "asymmetry": float(abs(matrix - matrix.T).max() / abs(matrix).max()),
    }


def _assembled(problem: Problem, state: Floats) -> csr_matrix:
    tangent = problem.system.tangent
    tangent.assemble(state, DiscreteLoad.none(problem.system.space))
    matrix = tangent.matrix
    indptr, indices, values = matrix.getValuesCSR()
    return csr_matrix((values, indices, indptr), shape=matrix.getSize())


# ---------------------------------------------------------------------- frame indifference


def rotation(dimension: int, degrees: float = 110.0) -> Floats:
    """A large rotation: in the plane, or about an axis off all others."""
    angle = np.radians(degrees)
    if dimension == 2:
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    x, y, z = np.array([1.0, 2.0, -1.5]) / np.linalg.norm([1.0, 2.0, -1.5])
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * W + (1 - np.cos(angle)) * W @ W


def frame(material: Material, kind: str) -> Row:
    """A rotation after the deformation: relative change of the energy, and of the forces turned back."""
    body = box(kind, 2, shaken)
    ends = {"x0": "xyz"[: body.dimension], "x1": "xyz"[: body.dimension]}
    moved = Waves(body.dimension, 0.15).displacement(body.points[body.node_sets["x1"]])
    Q = rotation(body.dimension)
    with Problem(body, material, TIGHT, held=ends) as problem:
        state = problem.solve(Loading(displacement={"x1": moved}), stability=False)
        turned = replace(state, displacement=body.points @ (Q - np.eye(len(Q))).T + state.displacement @ Q.T)
        energies = problem.energy(state), problem.energy(turned)
        forces = problem.internal_forces(state) @ Q.T, problem.internal_forces(turned)
    return {
        "energy_change": float(abs(energies[1] / energies[0] - 1)),
        "force_change": float(np.abs(forces[1] - forces[0]).max() / np.abs(forces[0]).max()),
    }


# ---------------------------------------------------------------------- Taylor tests

LOADS = ("forces", "body force", "traction", "pressure", "displacement", "points")


@dataclass(frozen=True, eq=False)
class Inputs:
    """Everything that makes an equilibrium, as arrays that a Taylor test moves.

    Args:
        body: its points count.
        material: its parameters count.
        forces: (n, d).
        body_force: (d,).
        traction: on the side x1, (d,).
        pressure: on the side y1.
        displacement: of the nodes of x0, (k, d).
    """

    body: Body
    material: Material
    forces: Floats
    body_force: Floats
    traction: Floats
    pressure: float
    displacement: Floats

    @property
    def loading(self) -> Loading:
        """The loads together."""
        return Loading(
            self.forces, self.body_force, {"x1": self.traction}, {"y1": self.pressure}, {"x0": self.displacement}
        )

    def moved(self, name: str, direction: Any, step: float) -> Inputs:
        """One input changed by a step in a direction."""
        change = step * np.asarray(direction)
        if name == "points":
            return replace(self, body=replace(self.body, points=self.body.points + change))
        if name in LOADS:
            key = name.replace(" ", "_")
            return replace(self, **{key: getattr(self, key) + change})
        return replace(self, material=with_parameter(self.material, name, self.material.parameters[name] + change))


def with_parameter(material: Material, name: str, value: Any) -> Material:
    """The same law with another value of one parameter."""
    parameters = {**material.parameters, name: value}
    return Energy(material.function, parameters) if isinstance(material, Energy) else type(material)(**parameters)


def inputs(material: Material, kind: str, size: float) -> Inputs:
    """Loads of every sort on a small box held at x0, in proportion to a size; 1 is a large deformation."""
    body = box(kind, 2, shaken)
    rng = np.random.default_rng(11)
    d = body.dimension
    forces = 0.01 * rng.standard_normal(body.points.shape)
    forces[body.node_sets["x0"]] = 0.0
    held = Waves(d, 0.1).displacement(body.points[body.node_sets["x0"]])
    return Inputs(
        body,
        material,
        size * forces,
        size * np.array([0.02, -0.05, 0.03])[:d],
        size * np.array([0.05, 0.06, -0.04])[:d],
        0.06 * size,
        size * held,
    )


def spread(material: Material, kind: str) -> Material:
    """The material with one value of each parameter for each cell, up to 20 % from the number."""
    cells = len(box(kind, 2, shaken).cells)
    rng = np.random.default_rng(2)
    for name, value in material.parameters.items():
        material = with_parameter(material, name, value * rng.uniform(0.8, 1.2, cells))
    return material


@dataclass(eq=False)
class Functional:
    """J(u) = w . u + |u|^2 / 2 of the equilibrium that inputs make; problems are kept as long as the points are."""

    start: Inputs
    problem: Problem = field(init=False)
    weights: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.problem = self._problem(self.start)
        self.weights = 0.1 * np.random.default_rng(4).standard_normal(self.start.body.points.shape)

    def _problem(self, given: Inputs) -> Problem:
        axes = {"x0": "xyz"[: given.body.dimension]}
        return Problem(given.body, given.material, TIGHT, held=axes, quadrature=QUADRATURE)

    def value(self, state: Equilibrium) -> float:
        """J."""
        return float((self.weights * state.displacement).sum() + (state.displacement**2).sum() / 2)

    def cotangent(self, state: Equilibrium) -> Floats:
        """dJ/du; the second derivative is the identity."""
        return self.weights + state.displacement

    def solve(self, given: Inputs, guess: Equilibrium | None = None) -> Equilibrium:
        """The equilibrium of inputs."""
        if given.body is self.start.body:
            self.problem.set_material(given.material)
            return self.problem.solve(given.loading, guess, stability=False)
        with self._problem(given) as other:
            return other.solve(given.loading, guess, stability=False)


def direction(given: Inputs, name: str, gradient: Any) -> Any:
    """A direction for one input; a full step is up to a fifth of the input, or a twentieth of a cell for points.

    Half of it is random, half is the gradient's, so that the first derivative does not vanish by chance.
    """
    now = given.material.parameters[name] if name not in LOADS else _now(given, name)
    if np.ndim(now) == 0:
        return 0.2 * now
    rng = np.random.default_rng(sum(map(ord, name)))
    leaning = (rng.uniform(-1, 1, np.shape(now)) + gradient / np.abs(gradient).max()) / 2
    if name == "points":
        return 0.025 * leaning
    if name == "forces":
        leaning[given.body.node_sets["x0"]] = 0.0
    return 0.2 * (np.abs(now).max() if name in LOADS else now) * leaning


def _now(given: Inputs, name: str) -> Any:
    return given.body.points if name == "points" else getattr(given, name.replace(" ", "_"))


def by_input(gradient: Gradient, given: Inputs, name: str) -> Any:
    """The part of a gradient that belongs to one input, in its shape."""
    if name == "displacement":
        assert gradient.displacement is not None
        return gradient.displacement[given.body.node_sets["x0"]]
    parts: dict[str, Any] = {
        "forces": gradient.forces,
        "body force": gradient.body_force,
        "traction": gradient.traction.get("x1"),
        "pressure": gradient.pressure.get("y1"),
        "points": gradient.points,
    }
    return np.asarray(parts[name] if name in LOADS else gradient.parameters[name])


def taylor(material: Material, kind: str, size: float, names: Sequence[str] = ()) -> dict[str, Row]:
    """Remainders of J along each input without, with one and with two derivatives, and their orders as steps halve.

    Args:
        material: its parameters are inputs too.
        kind: of cells.
        size: of the deformation, 1 is large.
        names: inputs to test; all if none is given. Second derivatives exist by forces and by parameters.
    """
    given = inputs(material, kind, size)
    functional = Functional(given)
    with functional.problem as problem:
        state = functional.solve(given)
        around = Linearisation(problem, given.loading, state)
        gradient = around.gradient(functional.cotangent(state), points=not names or "points" in names)
        largest = float(np.abs(state.displacement).max())
        found: dict[str, Row] = {}
        for name in names or (*LOADS, *material.parameters):
            part = by_input(gradient, given, name)
            change = direction(given, name, part)
            problem.set_material(given.material)
            curvature = _curvature(around, functional, state, name, change)
            values = [functional.value(functional.solve(given.moved(name, change, h), state)) for h in STEPS]
            gains = np.array(values) - functional.value(state)
            found[name] = {"largest_displacement": largest, "J": functional.value(state)}
            found[name] |= _remainders(gains, float(np.sum(part * change)), curvature, abs(functional.value(state)))
    return found


def _curvature(
    around: Linearisation, functional: Functional, state: Equilibrium, name: str, change: Any
) -> float | None:
    if name in LOADS and name != "forces":
        return None
    step = Change(forces=change) if name == "forces" else Change(parameters={name: change})
    bend = around.tangent(step)  # J's own second derivative is the identity
    product = around.hessian_product(functional.cotangent(state), step, bend)
    return float(np.sum(product.forces * change if name == "forces" else product.parameters[name] * change))


def _remainders(gains: Floats, slope: float, curvature: float | None, scale: float) -> Row:
    rests = {"0": gains, "1": gains - STEPS * slope}
    if curvature is not None:
        rests["2"] = rests["1"] - STEPS**2 * curvature / 2
    row: Row = {}
    for derivatives, rest in rests.items():
        above = np.abs(rest) > ROUND_OFF * scale
        row[f"rest_{derivatives}"] = np.abs(rest).tolist()
        row[f"orders_{derivatives}"] = orders(STEPS[above], np.abs(rest[above]))
    return row


def taylor_cases(materials: Mapping[str, Material]) -> dict[str, tuple[Material, str]]:
    """Pairs of material and element whose gradients are tested, by name; parameters are numbers or one a cell."""
    neo, mooney, own = (materials[name] for name in ("Neo-Hookean", "Mooney-Rivlin", "own energy (Demiray)"))
    svk = materials["Saint-Venant-Kirchhoff"]
    mixed = incompressible(0.05)
    return {
        "Neo-Hookean, numbers, tetra": (neo, "tetra"),
        "Neo-Hookean, one a cell, hexahedron": (spread(neo, "hexahedron"), "hexahedron"),
        "Saint-Venant-Kirchhoff, numbers, triangle": (svk, "triangle"),
        "Mooney-Rivlin, one a cell, quad9": (spread(mooney, "quad9"), "quad9"),
        "own energy (Demiray), numbers, tetra10": (own, "tetra10"),
        "incompressible Neo-Hookean, numbers, triangle6": (mixed["incompressible Neo-Hookean"], "triangle6"),
        "incompressible Mooney-Rivlin, one a cell, tetra10": (
            spread(mixed["incompressible Mooney-Rivlin"], "tetra10"),
            "tetra10",
        ),
    }
