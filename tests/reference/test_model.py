"""The reference as a forward model, where it differs from others: pressures, loads beside the forces, far starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import IncompressibleNeoHookean, Material, NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.derivatives.model import ReferenceModel, ReferenceState
from softtwin.reference.solve.problem import Loading, NewtonOptions, Problem

EXACT = NewtonOptions(tolerance=1e-11)
INFLATED = Loading(body_force=[0.0, 0.0, -80.0], pressure={"top": 60.0})  # an open surface: an unsymmetric tangent


def tip_force(body: Body, newtons: float = 0.4) -> np.ndarray:
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"], -1] = newtons / len(body.node_sets["tip"])
    return forces


@pytest.fixture(scope="module")
def box() -> Body:
    bare = beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron")
    on_top = np.isclose(bare.points[:, 2], bare.points[:, 2].max())
    surfaces = {"top": bare.boundary[on_top[bare.boundary].all(axis=1)]}
    return Body(bare.points, bare.cells, dict(bare.node_sets), surfaces)


def compressible(body: Body) -> tuple[Body, Material]:
    return body, NeoHookean(5000.0, 0.4)


def incompressible(body: Body) -> tuple[Body, Material]:
    return beam((3, 1, 1), (0.6, 0.2, 0.2), "tetrahedron").quadratic(), IncompressibleNeoHookean.from_elastic(5000.0)


CASES = {
    "open pressure": (compressible, INFLATED),
    "closed pressure": (compressible, Loading(pressure={"boundary": 800.0})),
    "incompressible": (incompressible, Loading()),
    "incompressible under pressure": (incompressible, Loading(pressure={"boundary": 200.0})),
}


@pytest.fixture(params=CASES)
def model(request: pytest.FixtureRequest, box: Body) -> Iterator[ReferenceModel]:
    make, loading = CASES[request.param]
    with Problem(*make(box), EXACT) as problem:
        yield ReferenceModel(problem, loading=loading)


def random_change(model: ReferenceModel, rng: np.random.Generator, newtons: float) -> np.ndarray:
    change = rng.standard_normal(model.body.points.shape)
    change[model.body.fixed] = 0.0
    return newtons / np.linalg.norm(change) * change


def test_push_and_pull_are_differences_of_solves(model: ReferenceModel, rng: np.random.Generator) -> None:
    """With all that a tangent depends on: the pressure of incompressible tissue, pressures that follow a surface."""
    forces = tip_force(model.body)
    state = model.solve(forces)
    assert np.abs(state.displacement).max() > 0.02
    change, cotangent = random_change(model, rng, 1e-3), rng.standard_normal(forces.shape)
    ahead, back = (model.solve(forces + sign * change, near=state).displacement for sign in (1.0, -1.0))
    rate = (ahead - back) / 2
    # Central differences err by the cube of the step: (1e-3 N of 0.4 N)^2 of the rate, and a factor for its bends.
    np.testing.assert_allclose(
        state.jvp(change.reshape(-1, 1)).reshape(-1, 3), rate, atol=1e-4 * np.abs(rate).max(), rtol=0.0
    )
    slope = float((state.vjp(cotangent) * change).sum())
    scale = np.linalg.norm(cotangent) * np.linalg.norm(rate)
    assert slope == pytest.approx(float((cotangent * rate).sum()), abs=1e-4 * scale)


def test_states_used_by_turns_are_right(model: ReferenceModel, rng: np.random.Generator) -> None:
    """Their tangents differ in pressures, too: one is under a following pressure and one is not."""
    bare = ReferenceModel(model.problem)
    forces = tip_force(model.body)
    states = [model.solve(forces), bare.solve(forces), model.solve(0.5 * forces)]
    changes = rng.standard_normal((forces.size, 2))
    first = [state.jvp(changes) for state in states]
    for state, pushed in zip(states[::-1], first[::-1], strict=True):
        np.testing.assert_allclose(state.jvp(changes), pushed, rtol=0.0, atol=1e-11 * np.abs(pushed).max())


def test_near_starts_and_cold_ones_meet(model: ReferenceModel) -> None:
    forces = tip_force(model.body)
    cold = model.solve(forces)
    for share in (0.97, 0.4, 0.0, -1.0):
        warm = model.solve(forces, near=model.solve(share * forces))
        np.testing.assert_allclose(
            warm.displacement, cold.displacement, rtol=0.0, atol=1e-8 * np.abs(cold.displacement).max()
        )


def test_loads_beside_the_forces_are_in_balance(box: Body) -> None:
    forces, weight = tip_force(box), tip_force(box, -0.1)
    loading = replace(INFLATED, forces=weight)
    with Problem(box, NeoHookean(5000.0, 0.4), EXACT) as problem:
        state = ReferenceModel(problem, loading=loading).solve(forces)
        whole = problem.solve(replace(loading, forces=forces + weight))
        np.testing.assert_array_equal(state.displacement, whole.displacement)
        np.testing.assert_array_equal(state.forces, forces)


def test_pivots_of_a_state_are_those_of_its_solve(box: Body) -> None:
    """A pressure all round squeezes; without it in the tangent, the state seems to buckle."""
    loading = Loading(pressure={"boundary": 2000.0})
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        state = ReferenceModel(problem, loading=loading).solve(np.zeros_like(box.points))
        assert problem.solve(loading).negative_pivots == 0 == problem.negative_pivots(state.equilibrium)
        assert state.negative_pivots == 0
        assert problem.negative_pivots(state.displacement) != 0  # a displacement alone is under no pressure


def test_the_stiffness_of_a_state_holds_its_pressures(box: Body, rng: np.random.Generator) -> None:
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        state = problem.solve(INFLATED)
        columns = rng.standard_normal((box.points.size, 2))
        columns.reshape(-1, 3, 2)[box.fixed] = 0.0
        for transpose in (False, True):
            tangent = problem.stiffness(state)
            solved = problem.apply_inverse(columns, state, transpose=transpose)
            np.testing.assert_allclose((tangent.T if transpose else tangent) @ solved, columns, atol=1e-9)


def test_a_displacement_alone_is_no_incompressible_state() -> None:
    body = beam((2, 1, 1), (0.4, 0.2, 0.2), "tetrahedron").quadratic()
    with Problem(body, IncompressibleNeoHookean(1700.0)) as problem:
        state = problem.solve(tip_force(body, 0.05))
        for ask in (problem.negative_pivots, lambda u: problem.apply_inverse(np.zeros(body.points.size), u)):
            with pytest.raises(ValueError, match=r"Problem\.displacement: expected an Equilibrium.*got ndarray"):
                ask(state.displacement)
        assert problem.negative_pivots(state) == 0


def test_a_release_takes_no_iteration_and_a_first_pull_no_more_than_a_cold_one(box: Body) -> None:
    """From far away the tangent leads astray; rest and its warped response are nearer."""
    forces = tip_force(box, 3.0)
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        model = ReferenceModel(problem, patient=False)
        rest, pulled = model.solve(np.zeros_like(forces)), model.solve(forces)
        assert np.abs(pulled.displacement).max() > 0.2
        released, again = model.solve(np.zeros_like(forces), near=pulled), model.solve(forces, near=rest)
    assert released.equilibrium.iterations == 0 and np.abs(released.displacement).max() == 0.0
    assert again.equilibrium.iterations <= pulled.equilibrium.iterations


def test_a_small_step_is_taken_along_the_tangent(box: Body) -> None:
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        model = ReferenceModel(problem)
        state = model.solve(tip_force(box))
        near, cold = model.solve(tip_force(box, 0.401), near=state), model.solve(tip_force(box, 0.401))
    assert near.equilibrium.iterations <= 2 < cold.equilibrium.iterations


def test_a_following_state_is_found_with_the_factorisation_of_the_one_before(box: Body) -> None:
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        model = ReferenceModel(problem)
        state = model.solve(tip_force(box, 0.4))
        state.jvp(tip_force(box).reshape(-1, 1))  # factored there
        near, alone = model.solve(tip_force(box, 0.402), near=state), model.solve(tip_force(box, 0.402))
    assert isinstance(near, ReferenceState)
    assert near.equilibrium.factorisations == 0 < alone.equilibrium.factorisations
    np.testing.assert_allclose(near.displacement, alone.displacement, atol=1e-7)


def test_a_neighbour_is_found_with_whatever_is_factored_where_that_leads_down(box: Body) -> None:
    """Of another neighbour, say; a tangent that is too far off is left aside, and so is a singular one."""
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        model = ReferenceModel(problem)
        first, second = model.solve(tip_force(box, 0.4)), model.solve(tip_force(box, 0.402))
        wanted = model.solve(tip_force(box, 0.404)).displacement
        first.jvp(tip_force(box).reshape(-1, 1))  # factored there, and not at the second
        near = model.solve(tip_force(box, 0.404), near=second)
        assert near.equilibrium.factorisations == 0
        np.testing.assert_allclose(near.displacement, wanted, atol=1e-7)
        far = model.solve(tip_force(box, 1.6))
        far.jvp(tip_force(box).reshape(-1, 1))
        near = model.solve(tip_force(box, 0.404), near=second)
        np.testing.assert_allclose(near.displacement, wanted, atol=1e-7)
        problem.system.tangent.matrix.zeroEntries()
        near = model.solve(tip_force(box, 0.404), near=first)
        np.testing.assert_allclose(near.displacement, wanted, atol=1e-7)


def test_another_models_state_is_a_start(box: Body) -> None:
    """A surrogate's, for instance: all that is asked of it is its displacement."""
    forces = tip_force(box, 0.8)
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem, Problem(box, NeoHookean(5100.0, 0.4)) as stiffer:
        other = ReferenceModel(stiffer).solve(forces)
        model = ReferenceModel(problem)
        cold = model.solve(forces)

        class Guess:
            displacement = other.displacement

        for near in (other, Guess()):
            warm = model.solve(forces, near=near)
            assert isinstance(warm, ReferenceState) and warm.equilibrium.start in ("guess", "proposal")
            assert warm.equilibrium.iterations < cold.equilibrium.iterations
            np.testing.assert_allclose(warm.displacement, cold.displacement, atol=1e-7)


@pytest.mark.parametrize("patient", [True, False])
@pytest.mark.parametrize("wrong", [-1.0, 40.0], ids=["the other way", "inside out"])
def test_a_proposal_that_is_worse_than_the_linear_response_is_left_aside(
    box: Body, wrong: float, patient: bool
) -> None:
    """A network outside of what it learned must not keep the reference from its equilibrium, nor cost it iterations."""
    forces = tip_force(box, 3.0)
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        model = ReferenceModel(problem, patient)
        cold = model.solve(forces)

        class Proposal:
            displacement = wrong * cold.displacement * [1.0, -1.0, 1.0]

        found = model.solve(forces, near=Proposal())
    np.testing.assert_array_equal(found.displacement, cold.displacement)
    assert found.equilibrium.iterations == cold.equilibrium.iterations


@pytest.mark.parametrize("stability", [True, False])
def test_a_proposal_leads_a_column_to_its_bent_state_and_is_left_where_it_leads_to_the_straight_one(
    stability: bool,
) -> None:
    """Beyond Euler's load the straight column is in balance, too, with two directions in which its energy falls."""
    column = beam((10, 2, 2), (1.0, 0.1, 0.1), "hexahedron")
    pressed, aside = np.zeros_like(column.points), np.zeros_like(column.points)
    pressed[column.node_sets["tip"], 0] = -0.4 / len(column.node_sets["tip"])
    aside[column.node_sets["tip"], 2] = 0.02 / len(column.node_sets["tip"])
    with Problem(column, NeoHookean(5000.0, 0.4)) as problem:
        straight = problem.solve(pressed)
        nearly = straight.displacement * (1.0 + 1e-3 * column.points[:, :1])
        led_back = problem.solve(pressed, proposal=nearly, stability=stability)
        bent = problem.solve(pressed, proposal=problem.solve(pressed + aside).displacement, stability=stability)
        assert straight.negative_pivots == problem.negative_pivots(led_back) == 2
        assert problem.negative_pivots(bent) == 0
    assert led_back.start != "proposal"
    assert bent.start == "proposal" and bent.energy < straight.energy


@pytest.mark.parametrize("proposal", [np.zeros((3, 3)), np.nan], ids=["shape", "nan"])
def test_a_proposal_is_checked(box: Body, proposal: object) -> None:
    given = np.full_like(box.points, np.nan) if proposal is np.nan else proposal
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem, pytest.raises(ValueError, match=r"Problem\.proposal"):
        problem.solve(tip_force(box), proposal=given)


def test_an_impatient_model_refuses_without_load_steps(box: Body) -> None:
    with Problem(box, NeoHookean(5000.0, 0.4), NewtonOptions(max_iterations=6)) as problem:
        model = ReferenceModel(problem, patient=False)
        state = model.solve(tip_force(box))
        with pytest.raises(NotConverged, match=r"no equilibrium near the guess .*Try a smaller change of the load"):
            model.solve(-1e4 * tip_force(box)[:, [2, 0, 1]], near=state)


def test_a_state_of_another_material_has_no_derivatives_here(box: Body) -> None:
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        state = ReferenceModel(problem).solve(tip_force(box))
        problem.set_material(NeoHookean(6000.0, 0.4))
        with pytest.raises(RuntimeError, match=r"expected the material that it was found with.*solve again"):
            state.vjp(state.displacement)


def test_a_closed_problem_says_so(box: Body) -> None:
    """PETSc would end the process."""
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        state = ReferenceModel(problem).solve(tip_force(box))
    problem.close()
    assert problem.body is box
    for use in (
        lambda: state.jvp(np.zeros((box.points.size, 1))),
        lambda: state.vjp(state.displacement),
        lambda: state.jvp_inputs([Change(parameters={"young_modulus": 1.0})]),
        lambda: state.negative_pivots,
        lambda: problem.solve(tip_force(box)),
        lambda: problem.set_material(NeoHookean(6000.0, 0.4)),
    ):
        with pytest.raises(RuntimeError, match="expected an open problem, got one that was closed"):
            use()


def test_inputs_are_a_models_own_again_when_none_are_given(box: Body) -> None:
    """And states found with others keep their derivatives."""
    with Problem(box, NeoHookean(5000.0, 0.4), EXACT) as problem:
        model, forces = ReferenceModel(problem), tip_force(box)
        own = model.solve(forces)
        soft = model.solve(forces, own, Inputs({"young_modulus": 2500.0}))
        with Problem(box, NeoHookean(2500.0, 0.4), EXACT) as other:
            alone = ReferenceModel(other).solve(forces)
            np.testing.assert_allclose(soft.displacement, alone.displacement, atol=1e-9)
            wanted = alone.vjp(alone.displacement)
        again = model.solve(forces)
        np.testing.assert_allclose(again.displacement, own.displacement, atol=1e-9)
        np.testing.assert_allclose(soft.vjp(soft.displacement), wanted, atol=1e-6 * np.abs(wanted).max())
        np.testing.assert_allclose(model.solve(forces).displacement, own.displacement, atol=1e-9)
        with pytest.raises(ValueError, match=r"ReferenceModel\.inputs: expected parameters among .*stiffness"):
            model.solve(forces, None, Inputs({"stiffness": 1.0}))
        problem.set_material(NeoHookean(6000.0, 0.4))
        with pytest.raises(RuntimeError, match="expected the material that it was found with"):
            soft.vjp(soft.displacement)


@pytest.mark.liver
@pytest.mark.parametrize("name", ["s1", "s2", "s3"])
def test_a_tool_that_lets_go_of_the_liver_and_takes_it_again_is_no_long_way(liver_folder, name: str) -> None:
    """Counted in factorisations: 15 to 55 where the tangent alone decides."""
    from liver import POISSON_RATIO, YOUNG_MODULUS, liver, sequence

    data, body = sequence(name), liver()
    forces = np.zeros_like(body.points)
    forces[data.tool] = data.net_forces[49] / len(data.tool)
    options = NewtonOptions(tolerance=1e-5, max_iterations=15)
    with Problem(body, NeoHookean(YOUNG_MODULUS, POISSON_RATIO), options) as problem:
        model = ReferenceModel(problem, patient=False)
        pulled = model.solve(forces)
        released = model.solve(0.0 * forces, near=pulled)
        again = model.solve(forces, near=released)
        halved = model.solve(0.5 * forces, near=pulled)
    assert released.equilibrium.iterations == 0
    for state in (again, halved):
        assert state.equilibrium.factorisations <= 10 and state.equilibrium.load_steps == 1
    np.testing.assert_allclose(again.displacement, data.positions[49] - body.points, atol=1e-5)


@pytest.mark.parametrize("shape", [(3,), (81, 1), (2, 4, 3)])
def test_cotangents_of_another_shape_are_refused(box: Body, shape: tuple[int, ...]) -> None:
    with Problem(box, NeoHookean(5000.0, 0.4)) as problem:
        state = ReferenceModel(problem).solve(tip_force(box))
        with pytest.raises(ValueError, match=r"State\.vjp: expected a cotangent of shape"):
            state.vjp(np.zeros(shape))
