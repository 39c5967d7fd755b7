"""Under a budget the answer is the best so far: more time never makes it worse, and it says that time was over."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from softtwin.meshes.body import Body
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.outcome import Outcome
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.registrar import Registrar
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Verdict

from .conftest import Cantilever, CantileverState, cloud_on, tip_forces


class Ticking(Cantilever):
    """A model of which each state takes a second of a clock that nothing else moves."""

    now = 0.0

    def solve(self, forces: ArrayLike, near: Any = None) -> CantileverState:
        self.now += 1.0
        return super().solve(forces, near)


@pytest.fixture
def model(body: Body, monkeypatch: pytest.MonkeyPatch) -> Ticking:
    made = Ticking(body)
    monkeypatch.setattr(time, "monotonic", lambda: made.now)
    return made


@pytest.mark.parametrize("solver", ["gauss-newton", "l-bfgs"])
def test_more_time_gives_no_worse_an_answer(body: Body, model: Ticking, rng, solver: str) -> None:
    """By the seconds of a model that counts them; what two answers in noise may differ by is their own doubt."""
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    cloud = cloud_on(body, truth, 400, rng, 5e-4)
    options = RegistrationOptions(localisation=SparseLocalisation(rounds=0))
    if solver == "l-bfgs":
        options = RegistrationOptions(localisation=SparseLocalisation(rounds=0), solver=LBFGS())
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    registrar = Registrar(model, SurfaceDistance(body, body.surfaces["observed"]), forces, options)
    model.now = 0.0
    whole = registrar.register(cloud)
    needed, doubt = model.now, float(whole.uncertainty.deviation.mean())
    assert whole.outcome is Outcome.CONVERGED and needed > 6.0
    errors, solved = [], []
    for budget in (0.0, 1.0, 2.0, 3.0, 5.0, 8.0, needed, 2.0 * needed):
        model.now = 0.0
        found = registrar.limited(budget).register(cloud)
        errors.append(float(np.linalg.norm(found.displacement - truth, axis=1).mean()))
        solved.append(found.evaluations)
        is_over = found.outcome is Outcome.OUT_OF_TIME
        assert is_over == (found.judgement.verdict is not Verdict.ACCEPTED), found.judgement.reasons
        assert not is_over or "the time for it was over" in found.judgement.reasons[0]
    assert (np.diff(errors) <= 0.5 * doubt).all(), errors
    assert errors[0] > 10.0 * errors[-1] and errors[-1] < 2.0 * doubt
    assert (np.diff(solved) >= 0).all() and solved[0] < 0.5 * solved[-1]
    assert found.outcome is Outcome.CONVERGED


def test_a_search_from_rest_that_has_no_time_leaves_the_frame_that_followed(
    body: Body, model: Ticking, rng, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise that jumps may mean that forces act elsewhere now, which only a search from rest would tell."""
    truth = Cantilever(body).solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
    registrar = Registrar(model, SurfaceDistance(body, body.surfaces["observed"]), forces, RegistrationOptions())
    quiet, loud = (cloud_on(body, truth, 400, rng, noise) for noise in (3e-4, 1e-3))
    last = registrar.register(quiet)
    model.now = 0.0
    searches, cold = [], Registrar._cold
    monkeypatch.setattr(Registrar, "_cold", lambda *given: (searches.append(given), cold(*given))[1])
    registrar.register(loud, last)
    needed = model.now
    assert len(searches) == 1 and needed > 10.0  # whichever of both ends is the better one
    for budget in range(3, int(needed)):
        model.now = 0.0
        found = registrar.limited(float(budget)).register(loud, last)
        assert model.now <= budget + 2.0  # the state that was begun, and what stands at the end of each search
        if budget > 4:
            assert found.judgement.verdict is Verdict.ACCEPTED, found.judgement.reasons
            error = float(np.linalg.norm(found.displacement - truth, axis=1).mean())
            assert error < 2.0 * found.uncertainty.deviation.mean()
