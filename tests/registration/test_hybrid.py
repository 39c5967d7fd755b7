"""Newton's method from a network's prediction: the reference's states, whatever the network says."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.inputs import Inputs
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.generate import Plan, generate
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

pytestmark = pytest.mark.fenicsx
PLAN = Plan(loads=LoadPlan(modes=6, displacement=0.25), samples={"train": 128, "validation": 16, "test": 16}, block=16)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, hexahedral_beam: Body) -> DataSet:
    made = generate(tmp_path_factory.mktemp("hybrid") / "data.zarr", hexahedral_beam, PLAN)
    assert made is not None
    return made


@pytest.fixture(scope="module")
def network(data: DataSet) -> Surrogate:
    return train(data, TrainingPlan(Reduced(modes=24, width=48), epochs=200))


@pytest.fixture(scope="module")
def problem(data: DataSet) -> Iterator[Problem]:
    with Problem(data.body, PLAN.build_material()) as opened:
        yield opened


def held_out(data: DataSet) -> Iterator[np.ndarray]:
    for forces in data.samples("test").forces:
        load = np.zeros_like(data.body.points)
        load[data.response.loaded] = forces
        yield load


def stepped(problem: Problem, load: np.ndarray) -> np.ndarray:
    """The state that 20 careful load steps lead to: each from the displacement before, and from nowhere else."""
    reached = np.zeros_like(load)
    for part in np.linspace(0.05, 1.0, 20):
        reached = problem.solve(part * load, reached, fallback=False).displacement
    return reached


def with_random_weights(network: Surrogate) -> Surrogate:
    other = Surrogate(network.body, network.encoder_decoder, copy.deepcopy(network.network), network.card)
    chance = np.random.default_rng(0)
    for weights in other.network.parameters():
        drawn = weights.numpy().std() * chance.standard_normal(tuple(weights.shape))
        weights.copy_(weights.new_tensor(drawn))
    return other


@pytest.mark.parametrize("size", [1.0, 2.0])
@pytest.mark.slow
def test_a_network_saves_factorisations_and_changes_no_state(
    problem: Problem, network: Surrogate, data: DataSet, size: float
) -> None:
    cold, hybrid = ReferenceModel(problem), ReferenceModel(problem, predictor=network)
    spent = {"cold": 0, "hybrid": 0}
    for load in held_out(data):
        plain, found = cold.solve(size * load), hybrid.solve(size * load)
        spent["cold"] += plain.equilibrium.factorisations
        spent["hybrid"] += found.equilibrium.factorisations
        largest = np.abs(plain.displacement).max()
        np.testing.assert_allclose(found.displacement, stepped(problem, size * load), atol=1e-6 * largest)
        assert found.equilibrium.start in ("proposal", "linear response")
    assert spent["hybrid"] < spent["cold"]


def test_random_weights_change_no_state_and_no_iteration(problem: Problem, network: Surrogate, data: DataSet) -> None:
    cold = ReferenceModel(problem)
    random = ReferenceModel(problem, predictor=with_random_weights(network))
    for load in held_out(data):
        plain, found = cold.solve(load), random.solve(load)
        np.testing.assert_array_equal(found.displacement, plain.displacement)
        assert found.equilibrium.iterations == plain.equilibrium.iterations
        assert found.equilibrium.start == "linear response"


@pytest.mark.parametrize("size", [1.0, 1.5, 2.0])
def test_random_weights_lead_to_the_states_of_careful_load_steps(
    problem: Problem, network: Surrogate, data: DataSet, size: float
) -> None:
    """Beyond the range, too, where what they propose is at times of less energy than the linear response."""
    model = ReferenceModel(problem, predictor=with_random_weights(network))
    for load in held_out(data):
        found = model.solve(size * load)
        largest = np.abs(found.displacement).max()
        np.testing.assert_allclose(found.displacement, stepped(problem, size * load), atol=1e-6 * largest)


class Counted:
    """A network, and how often it was asked."""

    def __init__(self, network: Surrogate) -> None:
        self.network, self.asked = network, 0
        self.body, self.learned_material = network.body, network.learned_material

    def propose(self, forces: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
        self.asked += 1
        return self.network.propose(forces, linear)


def test_a_network_that_is_never_right_is_asked_ever_more_seldom(
    problem: Problem, network: Surrogate, data: DataSet
) -> None:
    hybrid = ReferenceModel(problem, predictor=network)
    load = next(load for load in held_out(data) if hybrid.solve(load).equilibrium.start == "proposal")
    random = Counted(with_random_weights(network))
    model = ReferenceModel(problem, predictor=random)
    for _ in range(8):
        model.solve(load)
    assert random.asked == 8
    for _ in range(1 + 1 + 2 + 1 + 4 + 1):  # pauses of one, two and four solves
        model.solve(load)
    assert random.asked == 11
    random.network = network  # it has learned something meanwhile
    for _ in range(8 + 1):
        found = model.solve(load)
    assert random.asked == 12 and found.equilibrium.start == "proposal"
    model.solve(load)
    assert random.asked == 13


def test_a_network_that_is_right_is_always_asked(problem: Problem, network: Surrogate, data: DataSet) -> None:
    hybrid, counted = ReferenceModel(problem, predictor=network), Counted(network)
    right = [load for load in held_out(data) if hybrid.solve(load).equilibrium.start == "proposal"]
    model = ReferenceModel(problem, predictor=counted)
    for load in right * 3:
        model.solve(load)
    assert counted.asked == 3 * len(right) > 0


@pytest.mark.parametrize("kind", ["inside out", "not finite"])
def test_nonsense_from_a_network_is_left_aside(problem: Problem, data: DataSet, kind: str) -> None:
    load = next(held_out(data))
    plain = ReferenceModel(problem).solve(load)

    class Nonsense:
        body, learned_material = data.body, None

        def propose(self, forces: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
            return -3.0 * data.body.points if kind == "inside out" else np.full_like(data.body.points, np.nan)

    found = ReferenceModel(problem, predictor=Nonsense()).solve(load)
    np.testing.assert_array_equal(found.displacement, plain.displacement)


def test_a_load_where_the_network_has_never_seen_one_is_solved_without_it(data: DataSet, network: Surrogate) -> None:
    inner = np.setdiff1d(np.arange(len(data.body.points)), np.union1d(data.response.loaded, data.body.fixed))
    load = np.zeros_like(data.body.points)
    load[inner[0]] = [0.0, 0.0, 0.05]
    with Problem(data.body, PLAN.build_material()) as problem:
        found = ReferenceModel(problem, predictor=network).solve(load)
    assert found.equilibrium.start == "linear response" and found.equilibrium.residual < 1e-9


@pytest.mark.parametrize(("sideways", "pivots"), [(1e-3, 0), (0.0, 2)], ids=["pushed", "symmetric"])
def test_a_proposal_that_is_no_minimum_is_given_up(sideways: float, pivots: int) -> None:
    """A column pressed beyond its buckling load may stand straight in balance; pushed a little it bends.

    Symmetric, every start without a proposal stands straight, too, as careful load steps do: that is the state then,
    and it says that it is unstable.
    """
    column = beam((8, 1, 1), (1.0, 0.1, 0.1), "hexahedron")
    tip, load = column.node_sets["tip"], np.zeros_like(column.points)
    load[tip] = [-0.5 / len(tip), 0.0, sideways / len(tip)]
    with Problem(column, NeoHookean(5000.0, 0.3), NewtonOptions(search="full")) as problem:
        straight = problem.solve(load, np.zeros_like(load), fallback=False)
    assert straight.negative_pivots == 2  # it bends either way
    with Problem(column, NeoHookean(5000.0, 0.3)) as problem:
        found, plain = problem.solve(load, proposal=straight.displacement), problem.solve(load)
    assert found.start == plain.start != "proposal" and found.negative_pivots == pivots
    largest = np.abs(plain.displacement).max()
    np.testing.assert_allclose(found.displacement, plain.displacement, atol=1e-6 * largest)
    if pivots == 0:
        assert found.energy < 10.0 * straight.energy and np.abs(found.displacement[tip, 2]).min() > 0.5


def test_a_proposal_takes_the_linear_response_that_is_known(
    network: Surrogate, data: DataSet, problem: Problem
) -> None:
    load = next(held_out(data))
    linear = problem.apply_inverse(load.ravel()).reshape(-1, 3)
    expected = network.solve(load).displacement
    largest = np.abs(expected).max()
    np.testing.assert_allclose(network.propose(load), expected, atol=1e-6 * largest)
    np.testing.assert_allclose(network.propose(load, linear), expected, atol=1e-6 * largest)
    np.testing.assert_allclose(network.propose(load, 0.0 * linear), expected - linear, atol=1e-6 * largest)


def test_a_network_of_another_body_is_refused(network: Surrogate) -> None:
    other = beam((4, 2, 2), (0.6, 0.2, 0.2), "hexahedron")
    refused = pytest.raises(ValueError, match="predictor: expected a network of this body")
    with Problem(other, PLAN.build_material()) as problem, refused:
        ReferenceModel(problem, predictor=network)


def test_a_network_of_another_material_is_refused(data: DataSet, network: Surrogate) -> None:
    refused = pytest.raises(ValueError, match=r"predictor: expected a network of NeoHookean.*got one that has learned")
    with Problem(data.body, NeoHookean(5000.0, 0.4)) as problem, refused:
        ReferenceModel(problem, predictor=network)


def test_a_network_is_not_asked_while_the_problem_has_another_material(data: DataSet, network: Surrogate) -> None:
    """Given after the model was made; asked again when the problem has its own back, or an equal one."""
    load, counted = next(held_out(data)), Counted(network)
    softer = NeoHookean(4000.0, PLAN.poisson_ratio)
    with Problem(data.body, PLAN.build_material()) as problem, Problem(data.body, softer) as other:
        model = ReferenceModel(problem, predictor=counted)
        model.solve(load)
        assert counted.asked == 1
        problem.set_material(softer)
        found, expected = model.solve(load), other.solve(load)
        assert counted.asked == 1 and found.equilibrium.start == "linear response"
        largest = np.abs(expected.displacement).max()
        np.testing.assert_allclose(found.displacement, expected.displacement, atol=1e-6 * largest)
        model.solve(load, inputs=Inputs({"young_modulus": 4500.0}))
        model.solve(load)  # the softer one again, which inputs had taken the place of
        assert counted.asked == 1 and problem.material is softer
        problem.set_material(PLAN.build_material())
        model.solve(load)
        assert counted.asked == 2
