"""A frame of an exact model on the tangent of the last one's state: few states, one set of slopes, the same end."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import RegistrationOptions
from softtwin.registration.outcome import Outcome
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.registrar import Registrar
from softtwin.registration.result import Registration
from softtwin.registration.setup import Setup
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import Cantilever, CantileverState, cloud_on, tip_forces

BEFORE, NOISE = -0.6, 2e-4


class Counted(Cantilever):
    """How many states were solved for, and how many of them made derivatives by all unknown forces."""

    def __init__(self, body: Body, refuse: int = 0) -> None:
        super().__init__(body)
        self.solved, self.sloped, self.refuse = 0, 0, refuse

    def solve(self, forces: np.ndarray, near: object = None) -> CantileverState:
        self.solved += 1
        if self.refuse and self.solved == self.refuse:
            raise NotConverged("no state there")
        counted, found = self, super().solve(forces)

        class Sloped(CantileverState):
            def jvp(self, changes: np.ndarray) -> np.ndarray:
                counted.sloped += 1
                return super().jvp(changes)

        return Sloped(found.shape, found.mean, found.reach)


def registrar(model: Cantilever, solver: GaussNewton | LBFGS | None = None) -> Registrar:
    body = model.body
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    options = RegistrationOptions(solver=solver or GaussNewton())
    return Registrar(model, SurfaceDistance(body, body.surfaces["observed"]), forces, options)


def frames(body: Body, rng: np.random.Generator, *pulls: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Clouds and truths under pulls at the tip, newtons."""
    truths = [Cantilever(body).solve(tip_forces(body, (0.0, 0.2, pull))).displacement for pull in pulls]
    return [cloud_on(body, truth, 400, rng, NOISE) for truth in truths], truths


def stepwise(monkeypatch: pytest.MonkeyPatch, made: Registrar, cloud: np.ndarray, last: Registration) -> Registration:
    """The same with derivatives at every state."""
    with monkeypatch.context() as patched:
        patched.setattr(Setup, "is_exact", False)
        return made.track(cloud, last)


@pytest.mark.parametrize("pull", [-0.62, -0.8, -1.0], ids=["near", "farther", "far"])
def test_it_ends_where_steps_with_derivatives_of_every_state_end(
    body: Body, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, pull: float
) -> None:
    (before, cloud), (_, truth) = frames(body, rng, BEFORE, pull)
    model = Counted(body)
    made = registrar(model)
    last = made.register(before)
    model.solved = model.sloped = 0
    found = made.track(cloud, last)
    assert model.solved <= 4 and model.sloped <= 2  # the other set is that of the next frame, or of margins
    wanted = stepwise(monkeypatch, made, cloud, last)
    assert found.outcome is wanted.outcome is Outcome.CONVERGED
    deviation = wanted.uncertainty.deviation.max()
    assert np.linalg.norm(found.displacement - wanted.displacement, axis=1).max() < 0.2 * deviation
    assert np.linalg.norm(found.displacement - truth, axis=1).mean() < 3.0 * deviation
    np.testing.assert_allclose(found.uncertainty.deviation, wanted.uncertainty.deviation, rtol=0.1, atol=1e-7)
    np.testing.assert_allclose([found.noise, wanted.noise], NOISE, rtol=0.12)


def test_what_is_left_of_it_is_an_exact_state(body: Body, rng: np.random.Generator) -> None:
    """Its displacement is the model's own for the forces found, and the next frame starts from it as from any other."""
    clouds, truths = frames(body, rng, BEFORE, -0.65, -0.7, -0.75)
    model = Counted(body)
    made = registrar(model)
    found = made.register(clouds[0])
    for cloud, truth in zip(clouds[1:], truths[1:], strict=True):
        found = made.track(cloud, found)
        np.testing.assert_allclose(found.displacement, Cantilever(body).solve(found.forces).displacement, atol=1e-12)
        assert np.linalg.norm(found.displacement - truth, axis=1).mean() < 5e-4


@pytest.mark.parametrize("refused", [1, 2])
def test_where_a_state_is_refused_the_exact_model_goes_its_own_way(
    body: Body, rng: np.random.Generator, refused: int
) -> None:
    (before, cloud), (_, truth) = frames(body, rng, BEFORE, -0.8)
    model = Counted(body)
    made = registrar(model)
    last = made.register(before)
    model.solved, model.refuse = 0, refused
    found = made.track(cloud, last)
    assert found.judgement.is_usable and np.linalg.norm(found.displacement - truth, axis=1).mean() < 5e-4


def test_lbfgs_goes_without(body: Body, rng: np.random.Generator) -> None:
    (before, cloud), (_, truth) = frames(body, rng, BEFORE, -0.65)
    made = registrar(Cantilever(body), LBFGS())
    found = made.track(cloud, made.register(before))
    assert np.linalg.norm(found.displacement - truth, axis=1).mean() < 1e-3


def test_the_way_to_the_start_tells_what_is_left(body: Body, rng: np.random.Generator) -> None:
    """A step that would be one too many is none where the one before it was so much longer."""
    (before, cloud), _ = frames(body, rng, BEFORE, -0.61)
    made = registrar(Cantilever(body))
    last = made.track(cloud, made.register(before))
    change = rng.standard_normal(len(last.evaluation.coefficients))
    start = last.evaluation.coefficients + 0.3 * change / last.solved.local.length_of(change)
    problem = made.setup.plain(made.setup.checked(cloud), last.prepared)
    alone, known = (
        GaussNewton(is_near=True, length_before=length).directly().solve(problem, start, None, last.eta)
        for length in (np.inf, 30.0)
    )
    assert 0.15 < alone.trace[0].length < 0.4
    assert len(known.trace) == 0 and known.evaluations == 2  # the start, and a last step from there
    assert known.outcome is alone.outcome is Outcome.CONVERGED
