"""Physics in the loss: each term is what it says, and energy alone finds equilibria that nobody labelled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.surrogate.architecture import Architecture
from softtwin.surrogate.checkpoint import CheckpointError
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.physics import Physics, PhysicsObjective
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.residual import ElasticBody
from softtwin.surrogate.train import train

MATERIAL = {"material": "neo-hookean", "young_modulus": 20.0, "poisson_ratio": 0.4}  # as stiff as the closed form
KINDS: dict[str, Architecture] = {"reduced": Reduced(modes=6, width=32, depth=2), "mlp": Perceptron(width=40)}


@pytest.fixture
def soft(data: DataSet, monkeypatch: pytest.MonkeyPatch) -> DataSet:
    """The data set of the closed form, said to be of a material that has physics."""
    same = DataSet(data.path)
    monkeypatch.setitem(same.header, "plan", {**same.header["plan"], **MATERIAL})
    return same


@pytest.fixture(params=KINDS)
def objective(request: pytest.FixtureRequest, soft: DataSet) -> Any:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return KINDS[request.param].objective(soft, soft.samples("train"), soft.samples("validation"))


def test_the_terms_are_those_of_the_body(objective: Any, soft: DataSet) -> None:
    """Against the body in double precision; the weight of each term is the one asked for."""
    batch = torch.tensor([0, 3, 5])
    displacement, forces = (fields.detach().double() for fields in objective.fields(batch))
    truth = ElasticBody(soft.body, soft.material)
    free = displacement * truth.free
    loaded = soft.response.loaded
    work = np.array([0.5 * np.vdot(b, soft.response.apply(b[None])[0][loaded]) for b in forces[:, loaded].numpy()])
    every = objective.fields(torch.arange(min(objective.sample_count, 256)))[1].double().numpy()[:, loaded]
    usual = np.mean([0.5 * np.vdot(b, soft.response.apply(b[None])[0][loaded]) for b in every])
    energies = truth.potential(free, forces).numpy() / (np.sqrt(work * usual) + 0.01 * usual)
    residuals = truth.residual(free, forces).numpy() ** 2
    moved = soft.response.apply(every)
    held = float((displacement - free).square().mean()) / (moved**2).mean()
    own = float(objective.loss(batch).detach())

    def loss(**weights: float) -> float:
        return float(PhysicsObjective(objective, soft, Physics(**weights)).loss(batch).detach())

    assert min(truth.jacobians(free).min(), 1.0) > 0.1, "the loss is the body's own where no cell is nearly inside out"
    assert loss(data=2.0) == pytest.approx(2.0 * own, rel=1e-6)
    assert loss(energy=1.0, data=0.0) == pytest.approx(energies.mean() + held, rel=1e-4)
    assert loss(residual=1.0, data=0.0) == pytest.approx(residuals.mean() + held, rel=1e-4)
    first = float((displacement - free)[:1].square().mean()) / (moved**2).mean()
    mixed = own + 0.5 * energies[0] + 0.1 * residuals[0] + first  # beside data, of an eighth of the batch
    assert loss(energy=0.5, residual=0.1) == pytest.approx(mixed, rel=1e-4)


def test_a_fresh_network_that_turns_cells_inside_out_still_learns(objective: Any, soft: DataSet) -> None:
    wild = PhysicsObjective(objective, soft, Physics(energy=1.0, residual=1.0, data=0.0))
    with torch.no_grad():
        for weights in wild.network.parameters():
            weights.mul_(8.0)
    batch = torch.arange(8)
    displacement = objective.fields(batch)[0].detach()
    assert float(wild.body.jacobians(displacement * wild.body.free).min()) < 0.0
    loss = wild.loss(batch)
    loss.backward()
    assert math.isfinite(loss.item())
    assert all(bool(weights.grad.isfinite().all()) for weights in wild.network.parameters() if weights.grad is not None)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_energy_alone_brings_the_network_nearer_to_balance(kind: str, soft: DataSet) -> None:
    """The labels are of another law: whoever learns from them ends at a higher energy."""
    samples = soft.samples("train")
    forces = np.zeros((len(samples), *soft.body.points.shape))
    forces[:, soft.response.loaded] = samples.forces
    truth = ElasticBody(soft.body, soft.material)

    def energy(physics: Physics | None) -> float:
        plan = TrainingPlan(KINDS[kind], epochs=30, batch=16, physics=physics)
        surrogate = train(soft, plan)
        found = torch.from_numpy(np.stack([surrogate.solve(b).displacement for b in forces]))
        return float(truth.potential(found * truth.free, torch.from_numpy(forces)).mean())

    taught, untold = energy(None), energy(Physics(energy=1.0, data=0.0))
    assert untold < taught and untold < 0.0


def test_the_plan_says_what_was_asked(soft: DataSet, tmp_path: Any) -> None:
    plan = TrainingPlan(KINDS["reduced"], epochs=2, physics=Physics(energy=0.5))
    assert plan.entries()["physics"] == {"energy": 0.5, "residual": 0.0, "data": 1.0}
    surrogate = train(soft, plan, tmp_path)
    assert surrogate.card["plan"]["physics"]["energy"] == 0.5
    with pytest.raises(CheckpointError, match=r"another plan \(differs in physics\)"):
        train(soft, TrainingPlan(KINDS["reduced"], epochs=2), tmp_path)


@pytest.mark.parametrize("weights", [{"energy": -1.0}, {"residual": math.inf}, {"data": math.nan}, {"data": 0.0}])
def test_weights_that_teach_nothing_are_refused(weights: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="Physics"):
        Physics(**weights)


def test_data_that_do_not_say_their_material_have_no_physics(data: DataSet) -> None:
    with pytest.raises(DataSetError, match=r"expected a known material in the header"):
        train(data, TrainingPlan(KINDS["mlp"], epochs=1, physics=Physics(energy=1.0)))
