"""One suite over all forward models: the reference and both surrogates, trained on equilibria of the same beam."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.meshes.body import Body
from softtwin.reference.adjoint import ReferenceModel
from softtwin.reference.dataset import DataSet
from softtwin.reference.equilibrium import NewtonOptions, Problem
from softtwin.reference.generate import Plan, generate
from softtwin.reference.loads import LoadPlan
from softtwin.reference.outcome import NotConverged
from softtwin.registration.control import nodal_control
from softtwin.registration.forward import ForwardModel, restrict
from softtwin.surrogate.train import TrainingPlan, train

pytestmark = pytest.mark.fenicsx
PLAN = Plan(loads=LoadPlan(modes=6, displacement=0.1), samples={"train": 32, "validation": 4, "test": 4}, block=4)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, hexahedral_beam: Body) -> DataSet:
    made = generate(tmp_path_factory.mktemp("forward") / "data.zarr", hexahedral_beam, PLAN)
    assert made is not None
    return made


@pytest.fixture(scope="module", params=["reference", "reduced", "mlp"])
def model(request: pytest.FixtureRequest, data: DataSet) -> Iterator[ForwardModel]:
    if request.param != "reference":
        yield train(data, TrainingPlan(architecture=request.param, epochs=40, modes=16, width=32))
        return
    with Problem(data.body, PLAN.build_material(), NewtonOptions(tolerance=1e-11)) as problem:
        yield ReferenceModel(problem)


@pytest.fixture
def load(data: DataSet) -> np.ndarray:
    """A held-out load."""
    forces = np.zeros_like(data.body.points)
    forces[data.response.loaded] = data.samples("test").forces[0]
    return forces


def is_perceptron(model: ForwardModel) -> bool:
    """The thesis's yardstick: no exact zeros by construction, and kinks between its linear pieces."""
    return getattr(model, "card", {}).get("architecture") == "mlp"


def test_no_load_is_no_displacement(model: ForwardModel) -> None:
    if is_perceptron(model):
        pytest.skip("the thesis's perceptron does not vanish by construction")
    model.reset()
    assert np.abs(model.solve(np.zeros_like(model.body.points))).max() == 0.0


def test_fixed_nodes_stay(model: ForwardModel, load: np.ndarray) -> None:
    moved = model.solve(load)
    assert moved.shape == load.shape and np.abs(moved).max() > 0.0
    if is_perceptron(model):
        pytest.skip("the thesis's perceptron does not vanish by construction")
    assert np.abs(moved[model.body.fixed]).max() == 0.0


def test_pullback_passes_the_taylor_test(model: ForwardModel, load: np.ndarray, data: DataSet, rng) -> None:
    target = data.samples("test").displacements[1]
    direction = np.zeros_like(load)
    direction[data.response.loaded] = rng.standard_normal((len(data.response.loaded), 3))
    direction *= 0.2 * np.linalg.norm(load) / np.linalg.norm(direction)
    misfit = lambda forces: 0.5 * float(((model.solve(forces) - target) ** 2).sum())  # noqa: E731
    slope = float((model.pullback(model.solve(load) - target) * direction).sum())
    start = misfit(load)
    # Between two kinks of the perceptron the misfit is quadratic: steps short enough not to cross one.
    steps = (1e-4 if is_perceptron(model) else 1.0) * 0.5 ** np.arange(1, 5)
    errors = [abs(misfit(load + h * direction) - start - h * slope) for h in steps]
    assert np.log2(np.divide(errors[:-1], errors[1:])).min() > 1.8


def test_pullback_and_sensitivity_are_transposes(model: ForwardModel, load: np.ndarray, data: DataSet, rng) -> None:
    model.solve(load)
    forces = np.zeros_like(load)
    forces[data.response.loaded] = rng.standard_normal((len(data.response.loaded), 3))
    cotangent = rng.standard_normal(load.shape)
    cotangent[model.body.fixed] = 0.0
    pushed = model.sensitivity(forces.reshape(-1, 1)).reshape(-1, 3)
    left, right = float((pushed * cotangent).sum()), float((model.pullback(cotangent) * forces).sum())
    assert left == pytest.approx(right, rel=1e-8)


def test_restricted_agrees_with_the_whole(model: ForwardModel, load: np.ndarray, data: DataSet, rng) -> None:
    control = nodal_control(model.body, data.response.loaded, force_scale=0.02, smoothness=0.1)
    rows = model.body.node_sets["tip"]
    restricted = restrict(model, rows, control.basis)
    c = rng.standard_normal(control.basis.shape[1])
    whole = model.solve(control.forces(c))
    np.testing.assert_allclose(restricted.solve_coefficients(c), whole[rows], atol=1e-8)
    np.testing.assert_allclose(restricted.full(c), whole, atol=1e-8)
    model.solve(control.forces(c))
    expected = model.sensitivity(control.basis).reshape(-1, 3, len(c))[rows].reshape(-1, len(c))
    np.testing.assert_allclose(restricted.jacobian(c), expected, atol=1e-8 * np.abs(expected).max())


def test_the_reference_turns_back_to_a_state_it_knows(data: DataSet, load: np.ndarray) -> None:
    with Problem(data.body, PLAN.build_material()) as problem:
        model = ReferenceModel(problem)
        first = model.solve(load)
        model.solve(0.5 * load)
        assert np.array_equal(model.solve(load), first)
        assert model.state().negative_pivots == 0


def test_a_step_that_fails_keeps_the_last_state(data: DataSet, load: np.ndarray) -> None:
    with Problem(data.body, PLAN.build_material(), NewtonOptions(max_iterations=8)) as problem:
        model = ReferenceModel(problem, patient=False)
        first = model.solve(load)
        with pytest.raises(NotConverged):
            model.solve(-1e4 * load)
        assert model.last is not None and np.array_equal(model.last.displacement, first)
        assert np.isfinite(model.pullback(first)).all()


def test_the_surrogate_is_close_to_the_reference_on_held_out_loads(data: DataSet) -> None:
    """Better than the linear response it starts from, on equilibria it has not seen."""
    surrogate = train(data, TrainingPlan(epochs=200, modes=16, width=64))
    test = data.samples("test")
    for forces, truth in zip(test.forces, test.displacements, strict=True):
        load = np.zeros_like(truth)
        load[data.response.loaded] = forces
        linear = data.response.apply(forces[None])[0]
        assert np.linalg.norm(surrogate.solve(load) - truth) < 0.9 * np.linalg.norm(linear - truth) + 1e-6
