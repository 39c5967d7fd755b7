"""One suite over all forward models: the reference, from rest and from a network, torch's solver, and three surrogates.

The thesis's perceptron is the yardstick: it vanishes nowhere by construction and has kinks between its linear pieces.
Tests of what it cannot do name the models that they are for.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.generate import Plan, generate
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.registration.forward import ForwardModel
from softtwin.surrogate.equilibria import Equilibria
from softtwin.surrogate.equilibria_model import EquilibriaModel
from softtwin.surrogate.galerkin import Galerkin
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

pytestmark = pytest.mark.fenicsx
EXACT = ("reference", "hybrid", "torch", "reduced", "galerkin")
ALL = (*EXACT, "mlp")
PLAN = Plan(loads=LoadPlan(modes=6, displacement=0.1), samples={"train": 32, "validation": 4, "test": 4}, block=4)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, hexahedral_beam: Body) -> DataSet:
    made = generate(tmp_path_factory.mktemp("forward") / "data.zarr", hexahedral_beam, PLAN)
    assert made is not None
    return made


EPOCHS = 120  # that the networks have learned what is not linear
_NETWORKS = {"reduced": Reduced(modes=16, width=32), "galerkin": Galerkin(), "mlp": Perceptron()}


@pytest.fixture(scope="module", params=ALL)
def model(request: pytest.FixtureRequest, data: DataSet) -> Iterator[ForwardModel]:
    if request.param in _NETWORKS:
        yield train(data, TrainingPlan(_NETWORKS[request.param], epochs=EPOCHS))
        return
    if request.param == "torch":
        yield EquilibriaModel(Equilibria(data.body, PLAN.build_material()))
        return
    predictor = train(data, TrainingPlan(_NETWORKS["reduced"], epochs=EPOCHS)) if request.param == "hybrid" else None
    with Problem(data.body, PLAN.build_material(), NewtonOptions(tolerance=1e-11)) as problem:
        yield ReferenceModel(problem, predictor=predictor)


exact = pytest.mark.parametrize("model", EXACT, indirect=True)  # zero where it has to be, smooth everywhere


@pytest.fixture
def load(data: DataSet) -> np.ndarray:
    """A held-out load."""
    return whole(data, data.samples("test").forces[0])


@pytest.fixture
def other(data: DataSet) -> np.ndarray:
    """Another one."""
    return whole(data, data.samples("test").forces[1])


def whole(data: DataSet, forces: np.ndarray) -> np.ndarray:
    """Forces at the loaded nodes as forces at all nodes."""
    out = np.zeros_like(data.body.points)
    out[data.response.loaded] = forces
    return out


@pytest.fixture
def direction(data: DataSet, load: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random change of the forces, a fifth of the load."""
    change = whole(data, rng.standard_normal((len(data.response.loaded), 3)))
    return 0.2 * np.linalg.norm(load) / np.linalg.norm(change) * change


def orders(errors: list[float]) -> np.ndarray:
    """Observed orders of errors at steps that halve."""
    return np.log2(np.divide(errors[:-1], errors[1:]))


# ---------------------------------------------------------------------- values


@exact
def test_no_load_is_no_displacement(model: ForwardModel) -> None:
    assert np.abs(model.solve(np.zeros_like(model.body.points)).displacement).max() == 0.0


@exact
def test_fixed_nodes_stay_and_feel_nothing(model: ForwardModel, load: np.ndarray, rng) -> None:
    state = model.solve(load)
    assert np.abs(state.displacement[model.body.fixed]).max() == 0.0
    assert np.abs(state.vjp(rng.standard_normal(load.shape))[model.body.fixed]).max() == 0.0


def test_a_state_is_of_its_forces_alone(model: ForwardModel, load: np.ndarray, other: np.ndarray) -> None:
    """Whatever was solved before, and wherever the search started: what 1e-11 of the forces can move is left."""
    cold = model.solve(load).displacement
    assert cold.shape == load.shape and np.isfinite(cold).all() and np.abs(cold).max() > 0.0
    far = model.solve(other)
    for near in (far, model.solve(0.9 * load), model.solve(np.zeros_like(load))):
        np.testing.assert_allclose(model.solve(load, near=near).displacement, cold, atol=1e-8 * np.abs(cold).max())


def some_changes(data: DataSet, count: int, rng: np.random.Generator) -> np.ndarray:
    """Changes of the forces, (3n, count), at nodes that a surrogate has seen loaded; it refuses others."""
    loaded = len(data.response.loaded)
    return np.stack([whole(data, rng.standard_normal((loaded, 3))).ravel() for _ in range(count)], axis=1)


def test_states_keep_what_they_are(
    model: ForwardModel, load: np.ndarray, other: np.ndarray, data: DataSet, rng: np.random.Generator
) -> None:
    """Two states of one model used by turns, while the caller writes into the forces that made them."""
    forces, cotangent = load.copy(), rng.standard_normal(load.shape)
    changes = some_changes(data, 2, rng)
    first = model.solve(forces)
    before = (first.displacement.copy(), first.jvp(changes), first.vjp(cotangent))
    forces[:] = 0.0
    second = model.solve(2.0 * other, near=first)  # so far that its derivatives differ, whichever load was drawn
    apart = (second.displacement.copy(), second.jvp(changes), second.vjp(cotangent))
    again = (first.displacement, first.jvp(changes), first.vjp(cotangent))
    for was, now, elsewhere in zip(before, again, apart, strict=True):
        np.testing.assert_allclose(now, was, rtol=0.0, atol=1e-12 * np.abs(was).max())
        assert np.abs(elsewhere - was).max() > 1e-3 * np.abs(was).max()


def test_pivots_are_counted_or_not_known(model: ForwardModel, load: np.ndarray) -> None:
    assert model.solve(load).negative_pivots in (0, None)


# ---------------------------------------------------------------------- derivatives


@exact
def test_push_passes_the_taylor_test(model: ForwardModel, load: np.ndarray, direction: np.ndarray) -> None:
    state = model.solve(load)
    rate = state.jvp(direction.reshape(-1, 1)).reshape(-1, 3)
    errors = [
        float(
            np.linalg.norm(model.solve(load + h * direction, near=state).displacement - state.displacement - h * rate)
        )
        for h in 0.5 ** np.arange(1, 5)
    ]
    assert orders(errors).min() > 1.8


def test_pull_passes_the_taylor_test(
    model: ForwardModel, load: np.ndarray, direction: np.ndarray, data: DataSet, request: pytest.FixtureRequest
) -> None:
    target = data.samples("test").displacements[1]
    misfit = lambda forces: 0.5 * float(((model.solve(forces).displacement - target) ** 2).sum())  # noqa: E731
    state = model.solve(load)
    slope = float((state.vjp(state.displacement - target) * direction).sum())
    start = misfit(load)
    # Between two kinks of the perceptron the misfit is quadratic: steps short enough not to cross one.
    steps = (1e-4 if "mlp" in request.node.name else 1.0) * 0.5 ** np.arange(1, 5)
    assert orders([abs(misfit(load + h * direction) - start - h * slope) for h in steps]).min() > 1.8


def test_push_and_pull_are_transposes(model: ForwardModel, load: np.ndarray, data: DataSet, rng) -> None:
    state = model.solve(load)
    forces = np.stack([whole(data, rng.standard_normal((len(data.response.loaded), 3))) for _ in range(3)])
    cotangents = rng.standard_normal((2, *load.shape))
    cotangents[:, model.body.fixed] = 0.0
    pushed = state.jvp(forces.reshape(3, -1).T)
    pulled = state.vjp(cotangents)
    assert pushed.shape == (load.size, 3) and pulled.shape == cotangents.shape
    left, right = cotangents.reshape(2, -1) @ pushed, pulled.reshape(2, -1) @ forces.reshape(3, -1).T
    np.testing.assert_allclose(left, right, atol=1e-8 * np.abs(left).max())


def test_many_at_once_are_each_alone(model: ForwardModel, load: np.ndarray, data: DataSet, rng) -> None:
    state = model.solve(load)
    cotangents, changes = rng.standard_normal((3, *load.shape)), some_changes(data, 3, rng)
    pulled, pushed = state.vjp(cotangents), state.jvp(changes)
    for i in range(3):
        np.testing.assert_allclose(state.vjp(cotangents[i]), pulled[i], rtol=0.0, atol=1e-9 * np.abs(pulled).max())
        alone = state.jvp(changes[:, i : i + 1])[:, 0]
        np.testing.assert_allclose(alone, pushed[:, i], rtol=0.0, atol=1e-9 * np.abs(pushed).max())


# ---------------------------------------------------------------------- one model beside another


def test_a_solve_that_fails_leaves_earlier_states_as_they_are(data: DataSet, load: np.ndarray) -> None:
    with Problem(data.body, PLAN.build_material(), NewtonOptions(max_iterations=8)) as problem:
        model = ReferenceModel(problem, patient=False)
        state = model.solve(load)
        moved, pulled = state.displacement.copy(), state.vjp(state.displacement)
        with pytest.raises(NotConverged):
            model.solve(-1e4 * load, near=state)
        assert np.array_equal(state.displacement, moved)
        np.testing.assert_allclose(state.vjp(moved), pulled, rtol=0.0, atol=1e-12 * np.abs(pulled).max())
        assert state.negative_pivots == 0


def test_the_surrogate_is_close_to_the_reference_on_held_out_loads(data: DataSet) -> None:
    """Better than the linear response it starts from, on equilibria it has not seen."""
    surrogate = train(data, TrainingPlan(Reduced(modes=16, width=64), epochs=200))
    test = data.samples("test")
    for forces, truth in zip(test.forces, test.displacements, strict=True):
        linear = data.response.apply(forces[None])[0]
        gap = np.linalg.norm(surrogate.solve(whole(data, forces)).displacement - truth)
        assert gap < 0.9 * np.linalg.norm(linear - truth) + 1e-6
