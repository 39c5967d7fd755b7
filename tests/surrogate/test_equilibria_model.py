"""Torch's solver as a forward model and as a layer: derivatives by forces and material, twice, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import IsochoricNeoHookean, Material, NeoHookean, SaintVenantKirchhoff
from softtwin.reference.data.outcome import NotConverged
from softtwin.surrogate.equilibria import Equilibria, NewtonSettings
from softtwin.surrogate.equilibria_layer import EquilibriaLayer
from softtwin.surrogate.equilibria_model import EquilibriaModel

from .test_equilibria import some_loads

SHARP = NewtonSettings(tolerance=1e-12)
E, NU = 4500.0, 0.42


@pytest.fixture(scope="module")
def bar() -> Body:
    return beam((4, 1, 1), (1.0, 0.25, 0.25))


@pytest.fixture(scope="module")
def solver(bar: Body) -> Equilibria:
    return Equilibria(bar, NeoHookean(E, NU), settings=SHARP)


@pytest.fixture
def loads(bar: Body, rng: np.random.Generator) -> Tensor:
    return some_loads(bar, 2, 4.0, rng)


# ---------------------------------------------------------------------- parameters


def test_other_parameters_are_those_of_a_new_solver(bar: Body, solver: Equilibria, loads: Tensor) -> None:
    cells = np.linspace(1.0, 3.0, len(bar.cells)) * E
    for values in ({"young_modulus": 2.0 * E}, {"poisson_ratio": 0.3}, {"young_modulus": cells, "poisson_ratio": 0.3}):
        other = solver.with_parameters(**values).solve(loads).displacement
        anew = Equilibria(bar, NeoHookean(**{"young_modulus": E, "poisson_ratio": NU, **values}), settings=SHARP)
        torch.testing.assert_close(other, anew.solve(loads).displacement, rtol=0.0, atol=1e-10)
    before = solver.solve(loads).displacement
    assert (before - other).abs().max() > 1e-3  # the solver itself stays as it was
    with pytest.raises(ValueError, match=r"expected parameters among .*, got \['c1'\]"):
        solver.with_parameters(c1=1.0)


# ---------------------------------------------------------------------- the layer


def function_of(solver: Equilibria, loads: Tensor) -> Callable[..., Tensor]:
    """A few displacements as a function of sizes of the loads, stiffness and Poisson's ratio."""
    layer = EquilibriaLayer(solver)
    chosen = slice(-3, None)
    return lambda sizes, stiffness, ratio: layer(
        sizes[:, None, None] * loads, young_modulus=E * stiffness, poisson_ratio=ratio
    )[:, chosen]


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


LAWS = {"Neo-Hookean": NeoHookean, "isochoric": IsochoricNeoHookean, "Saint-Venant": SaintVenantKirchhoff}


@pytest.mark.parametrize("law", LAWS)
def test_gradients_and_second_derivatives_are_exact(law: str, bar: Body, loads: Tensor) -> None:
    function = function_of(Equilibria(bar, LAWS[law](E, NU), settings=SHARP), loads)
    at = (numbers(0.9, 1.2), numbers(1.1), numbers(0.4))
    assert function(*at).abs().max() > 0.02
    assert torch.autograd.gradcheck(function, at, eps=1e-5, atol=1e-8, rtol=1e-5)
    assert torch.autograd.gradgradcheck(function, at, eps=1e-5, atol=1e-7, rtol=1e-4)


def test_stiffness_of_each_cell_has_a_gradient(bar: Body, solver: Equilibria, loads: Tensor) -> None:
    layer = EquilibriaLayer(solver)
    stiffness = torch.full((len(bar.cells),), E, dtype=torch.float64, requires_grad=True)
    one = torch.tensor(E, dtype=torch.float64, requires_grad=True)
    for values in (stiffness, one):
        layer(loads, young_modulus=values).square().sum().backward()
    assert stiffness.grad is not None and one.grad is not None
    assert stiffness.grad.shape == (len(bar.cells),) and (stiffness.grad < 0.0).all()  # all of it, and it moves less
    torch.testing.assert_close(stiffness.grad.sum(), one.grad)


def test_the_layer_says_what_it_does_not_take(solver: Equilibria, loads: Tensor) -> None:
    layer = EquilibriaLayer(solver)
    with pytest.raises(TypeError, match=r"expected parameters among .*, got \['stiffness'\]"):
        layer(loads, stiffness=1.0)
    with pytest.raises(NotConverged, match=r"no equilibrium was found for 1 of 2 loads, first \[1\]"):
        EquilibriaLayer(Equilibria(solver.body, solver.material, settings=NewtonSettings(iterations=2, load_steps=1)))(
            torch.cat([0.0 * loads[:1], 50.0 * loads[1:]])
        )


# ---------------------------------------------------------------------- the forward model


def test_derivatives_by_material_are_those_of_differences(bar: Body, solver: Equilibria, loads: Tensor) -> None:
    model, load, step = EquilibriaModel(solver), loads[0].numpy(), 1e-5
    region = np.where(np.arange(len(bar.cells)) % 2, E, 2.0 * E)
    other = EquilibriaModel(Equilibria(bar, NeoHookean(region, NU), settings=SHARP))
    for one, values, change in (
        (model, {"young_modulus": E, "poisson_ratio": NU}, {"poisson_ratio": 1.0}),
        (model, {"young_modulus": 1.5 * E, "poisson_ratio": 0.3}, {"young_modulus": E, "poisson_ratio": 0.5}),
        (other, {"young_modulus": region}, {"young_modulus": 0.5 * region}),
    ):
        state = one.solve(load, inputs=Inputs(parameters=values))
        more = 0.1 * load
        pushed = state.jvp_inputs([Change(parameters=change), Change(forces=more, parameters=change)])
        ahead, behind = (
            one.solve(load, inputs=Inputs(parameters={
                name: value + sign * step * change.get(name, 0.0) for name, value in values.items()
            })).displacement
            for sign in (1.0, -1.0)
        )  # fmt: skip
        wanted = (ahead - behind).ravel() / (2.0 * step)
        np.testing.assert_allclose(pushed[:, 0], wanted, atol=1e-5 * np.abs(wanted).max())
        np.testing.assert_allclose(pushed[:, 1] - pushed[:, 0], state.jvp(more.reshape(-1, 1))[:, 0], atol=1e-12)
    again = model.solve(load)  # parameters that were lent are given back
    np.testing.assert_array_equal(again.displacement, EquilibriaModel(solver).solve(load).displacement)


def test_forces_that_act_at_all_times_are_added(solver: Equilibria, loads: Tensor) -> None:
    first, second = loads.numpy()
    alone, beside = EquilibriaModel(solver), EquilibriaModel(solver, forces=second)
    np.testing.assert_allclose(beside.solve(first).displacement, alone.solve(first + second).displacement, atol=1e-10)
    with_more = alone.solve(first, inputs=Inputs(forces=second)).displacement
    np.testing.assert_allclose(with_more, alone.solve(first + second).displacement, atol=1e-10)


def test_what_it_does_not_know_is_said(solver: Equilibria, loads: Tensor) -> None:
    model, load = EquilibriaModel(solver), loads[0].numpy()
    state = model.solve(load)
    moved = {"left": np.zeros((4, 3))}
    for call, message in (
        (
            lambda: model.solve(load, inputs=Inputs(displacement=moved)),
            r"got displacements of \['left'\]",
        ),
        (lambda: model.solve(load, inputs=Inputs(parameters={"c1": 1.0})), "expected parameters among"),
        (lambda: model.solve(load[:-1]), "EquilibriaModel.forces"),
        (lambda: model.solve(np.full_like(load, np.nan)), "EquilibriaModel.forces"),
        (lambda: state.jvp(load), r"EquilibriaState.jvp: expected shape \(60, k\), got \(20, 3\)"),
        (lambda: state.vjp(load[:-1]), r"EquilibriaState.vjp: expected shape \(20, 3\)"),
        (lambda: state.jvp_inputs([Change(displacement=load)]), "expected forces and material parameters"),
        (lambda: state.jvp_inputs([Change(parameters={"c1": 1.0})]), r"got \['c1'\]"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    hasty = EquilibriaModel(
        Equilibria(solver.body, solver.material, settings=NewtonSettings(iterations=2, load_steps=1))
    )
    with pytest.raises(NotConverged, match=r"no equilibrium was found in 1 load steps; out-of-balance"):
        hasty.solve(50.0 * load)


def test_a_state_that_is_not_stable_is_told_and_has_derivatives(bar: Body) -> None:
    """A straight strut under more than Euler's load stays straight by symmetry: it would rather bend, to two sides."""
    strut = beam((8, 1, 1), (1.0, 0.1, 0.1))
    material: Material = SaintVenantKirchhoff(1e5, 0.0)
    solver = Equilibria(strut, material, settings=NewtonSettings(tolerance=1e-9))
    end = np.flatnonzero(strut.points[:, 0] > 1.0 - 1e-9)
    force = np.zeros_like(strut.points)
    force[end, 0] = -60.0 / len(end)  # Euler: pi^2 E I / (4 l^2) = 2 N, locking makes it some 30
    squeezed = np.zeros_like(strut.points)
    for _ in range(30):  # along the axis alone
        at = torch.from_numpy(squeezed)
        missing = force - solver.elastic.internal_forces(at[None])[0].numpy()
        axial = 3 * np.flatnonzero(strut.points[:, 0] > 1e-9)
        stiffness = solver.elastic.stiffness(at)[axial][:, axial]
        step = np.linalg.solve(stiffness.toarray(), missing.ravel()[axial])
        squeezed.ravel()[axial] += step
    found = EquilibriaModel(solver).solve(force, near=type("Start", (), {"displacement": squeezed})())
    np.testing.assert_allclose(found.displacement, squeezed, atol=1e-9)
    free = (3 * np.flatnonzero(strut.points[:, 0] > 1e-9)[:, None] + np.arange(3)).ravel()
    dense = solver.elastic.stiffness(torch.from_numpy(squeezed))[free][:, free].toarray()
    directions = int((np.linalg.eigvalsh(dense) < 0.0).sum())
    assert found.negative_pivots == directions >= 2 and directions % 2 == 0
    change = np.zeros((strut.points.size, 1))
    change[free, 0] = np.random.default_rng(0).standard_normal(len(free))
    np.testing.assert_allclose(found.jvp(change)[free, 0], np.linalg.solve(dense, change[free, 0]), rtol=1e-6)
