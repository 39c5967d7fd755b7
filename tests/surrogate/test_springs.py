"""Springs in torch: matrices of cells that are the reference's, equilibria with nothing else that holds, symmetries."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.springs import Ligament, Springs, Support, cell_springs
from softtwin.reference.derivatives.linearisation import Linearisation
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.equilibria_model import EquilibriaModel
from softtwin.surrogate.residual import ElasticBody
from softtwin.surrogate.symmetry import symmetries

pytestmark = pytest.mark.fenicsx
CORDS: dict[str, Support] = {
    "taut": Ligament((0.25, 0.05, 0.1), (0.25, 0.2, 0.4), 30.0, slack=0.3),
    "slack": Ligament((0.3, 0.05, 0.05), (0.3, 0.05, -0.3), 50.0, slack=0.36),
    "as it is": Ligament((0.13, 0.0, 0.06), (0.1, -0.2, 0.2), 20.0),
}
SPRINGS: dict[str, Support] = {"start": Springs(4e4, 1e4), "side": Springs(tangential=2e3)}
MATERIAL = NeoHookean(3000.0, 0.4)
Cell = Literal["tetrahedron", "hexahedron"]


def bar(cell: Cell, quadratic: bool = False, curved: bool = False) -> Body:
    """A bar that nothing holds but springs; curved cells have their middles moved."""
    made = beam((4, 2, 2), (0.3, 0.1, 0.1), cell)
    made = made.quadratic() if quadratic else made
    at = made.points[made.boundary]
    surfaces = {
        "start": made.boundary[np.isclose(at[..., 0], 0.0).all(axis=1)],
        "side": made.boundary[np.isclose(at[..., 2], made.points[:, 2].min()).all(axis=1)],
    }
    points = made.points + (0.004 * np.sin(60.0 * made.points[:, ::-1]) if curved else 0.0)
    return Body(points, made.cells, {}, surfaces)


def forces_on(body: Body) -> np.ndarray:
    forces = np.zeros_like(body.points)
    end = np.isclose(body.points[:, 0], body.points[:, 0].max(), atol=0.01)
    forces[end] = np.array([0.02, 0.05, -0.1]) / end.sum()
    return forces


@pytest.mark.parametrize(
    ("cell", "quadratic", "curved"),
    [
        ("tetrahedron", False, False),
        ("hexahedron", False, False),
        ("hexahedron", False, True),
        ("tetrahedron", True, False),
        ("hexahedron", True, True),
    ],
)
def test_energy_forces_and_stiffness_are_the_references(cell: Cell, quadratic: bool, curved: bool) -> None:
    body, rng = bar(cell, quadratic, curved), np.random.default_rng(0)
    displacement = 1e-3 * rng.standard_normal(body.points.shape)
    held = SPRINGS if curved else SPRINGS | CORDS  # places are found in straight cells alone
    with Problem(body, MATERIAL, springs=held) as problem:
        wanted = problem.stiffness(displacement)
    elastic = ElasticBody(body, MATERIAL, springs=held)
    state = torch.from_numpy(displacement)
    found = elastic.stiffness(state)
    assert abs(found - wanted).max() < 1e-9 * abs(wanted).max()
    energy, forces = elastic.energy_and_forces(state[None])
    np.testing.assert_allclose(energy, elastic.energy(state[None]))
    np.testing.assert_allclose(forces, elastic.internal_forces(state[None]))
    at = state[None].clone().requires_grad_()
    (slope,) = torch.autograd.grad(elastic.energy(at).sum(), at)
    np.testing.assert_allclose(forces, slope, atol=1e-10 * float(forces.abs().max()))


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_equilibria_are_the_references(cell: Cell) -> None:
    body = bar(cell)
    forces = forces_on(body)
    with Problem(body, MATERIAL, NewtonOptions(tolerance=1e-12), springs=SPRINGS | CORDS) as problem:
        state = problem.solve(forces)
        change = problem.apply_inverse(forces.reshape(-1, 1), state).reshape(-1, 3)
    solver = Equilibria(body, MATERIAL, springs=SPRINGS | CORDS)
    found = solver.solve(forces[None])
    assert bool(found.is_converged[0])
    size = np.abs(state.displacement).max()
    assert size > 0.02
    np.testing.assert_allclose(found.displacement[0], state.displacement, atol=1e-8 * size)
    pushed = solver.tangent(found.displacement).inverse(forces[None, :, :, None])[0, :, :, 0]
    np.testing.assert_allclose(pushed, change, atol=1e-7 * np.abs(change).max())


def test_a_body_that_floats_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a body that something holds"):
        Equilibria(bar("tetrahedron"), MATERIAL)
    with pytest.raises(ValueError, match="got 'roof'"):
        cell_springs(bar("tetrahedron"), {"roof": Springs(1.0)})


def test_a_symmetry_moves_no_spring() -> None:
    body = bar("hexahedron")
    loaded = np.arange(len(body.points))
    free, held = symmetries(body, loaded), symmetries(body, loaded, springs=["start", "side"])
    assert len(free) > len(held) == 2  # what swaps ends, or top and bottom, is none any more


def times(each: Support, factor: float) -> Support:
    """So many times as stiff."""
    if isinstance(each, Springs):
        return Springs(factor * each.normal, factor * each.tangential)
    return replace(each, stiffness=factor * each.stiffness)


@pytest.mark.parametrize("engine", ["reference", "torch"])
def test_stiffness_is_an_input_with_its_derivative(engine: str) -> None:
    """States move with the factor as the derivative says, and stay what they were when the model goes on."""
    body = bar("tetrahedron")
    forces, step, held = forces_on(body), 1e-4, SPRINGS | CORDS
    with Problem(body, MATERIAL, NewtonOptions(tolerance=1e-12), springs=held) as problem:
        model: Any = ReferenceModel(problem)
        if engine == "torch":
            model = EquilibriaModel(Equilibria(body, MATERIAL, springs=held))
        at = {"start": 0.5, "side": 3.0, "taut": 2.0}
        state = model.solve(forces, None, Inputs(springs=at))
        for name, factor in at.items():
            ahead, behind = (
                model.solve(forces, state, Inputs(springs={**at, name: factor + sign * step})).displacement
                for sign in (1.0, -1.0)
            )
            wanted = (ahead - behind).ravel() / (2.0 * step)
            found = state.jvp_inputs([Change(springs={name: 1.0})])[:, 0]
            np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())
        plain = model.solve(forces).displacement
        assert np.abs(plain - state.displacement).max() > 1e-4
    scaled = {name: times(each, at.get(name, 1.0)) for name, each in held.items()}
    for springs, displacement in ((held, plain), (scaled, state.displacement)):
        with Problem(body, MATERIAL, NewtonOptions(tolerance=1e-12), springs=springs) as other:
            truth = other.solve(forces).displacement
        np.testing.assert_allclose(displacement, truth, atol=1e-7 * np.abs(truth).max())


def test_the_gradient_by_stiffness_is_a_difference() -> None:
    body, step = bar("tetrahedron"), 1e-4
    forces, rng = forces_on(body), np.random.default_rng(1)
    weights = rng.standard_normal(body.points.shape)
    with Problem(body, MATERIAL, NewtonOptions(tolerance=1e-12), springs=SPRINGS) as problem:
        state = problem.solve(forces)
        found = Linearisation(problem, forces, state).gradient(weights).springs
        values = []
        for sign in (1.0, -1.0):
            problem.set_springs({"start": 1.0 + sign * step})
            values.append(float((problem.solve(forces, state).displacement * weights).sum()))
        assert found["start"] == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=1e-5)
        with pytest.raises(ValueError, match="got 'roof'"):
            problem.set_springs({"roof": 2.0})
        with pytest.raises(ValueError, match=r"expected a factor above 0, got -1"):
            problem.set_springs({"start": -1.0})
