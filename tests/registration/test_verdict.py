"""Nonsense is not accepted: each kind of it is doubtful or refused, and says why."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.registration.evidence import Scale
from softtwin.registration.registrar import Registrar, expected_force, prepare
from softtwin.registration.residuals import SurfaceDistance
from softtwin.registration.unknowns import nodal_forces
from softtwin.registration.verdict import Verdict, shared

from .conftest import Cantilever, cloud_on, tip_forces


@pytest.fixture(scope="module")
def registrar(body: Body) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], Scale(0.05, 2.0, least=1e-4))
    return Registrar(Cantilever(body, learned=2.0), SurfaceDistance(body, body.surfaces["observed"]), forces)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 5e-3])
def test_a_good_cloud_is_accepted_at_any_noise(body: Body, registrar: Registrar, rng, noise: float) -> None:
    truth = registrar.model.solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    judged = registrar.register(cloud_on(body, truth, 400, rng, noise)).judgement
    assert judged.verdict is Verdict.ACCEPTED, judged.reasons


def refused(registrar: Registrar, cloud: np.ndarray, reason: str) -> None:
    judged = registrar.register(cloud).judgement
    assert judged.verdict is not Verdict.ACCEPTED
    assert any(reason in each for each in judged.reasons), judged.reasons


def test_a_line_is_refused(registrar: Registrar) -> None:
    line = np.linspace([0.05, 0.1, 0.2], [0.75, 0.1, 0.2], 200)
    refused(registrar, line, "line")


def test_random_points_match_no_organ(registrar: Registrar, rng) -> None:
    refused(registrar, rng.uniform([-0.1, -0.1, -0.1], [0.9, 0.3, 0.3], (400, 3)), "do not match")


def test_another_organ_does_not_match(registrar: Registrar, rng) -> None:
    """A ball in the middle of the beam: smooth, dense, without noise, and wrong in whole patches."""
    ball = rng.standard_normal((600, 3))
    ball = 0.15 * ball / np.linalg.norm(ball, axis=1)[:, None] + np.array([0.4, 0.1, 0.1])
    refused(registrar, ball, "do not match")


def test_a_load_beyond_what_was_learned_is_doubtful(body: Body, registrar: Registrar, rng) -> None:
    truth = registrar.model.solve(tip_forces(body, (0.0, 0.0, -1.4))).displacement
    forces = nodal_forces(body, body.node_sets["tip"], Scale(0.05, 2.0, least=1e-4))
    small = Registrar(Cantilever(body, learned=0.5), SurfaceDistance(body, body.surfaces["observed"]), forces)
    refused(small, cloud_on(body, truth, 400, rng), "the surrogate has learned")


def test_few_points_tell_little(body: Body, registrar: Registrar, rng) -> None:
    refused(registrar, cloud_on(body, np.zeros_like(body.points), 8, rng), "8 points")


def test_noise_is_shared_by_no_neighbours(rng) -> None:
    cloud = rng.random((2000, 3)) * [1.0, 1.0, 0.0]
    white = rng.standard_normal(2000)
    assert shared(cloud, white, np.ones(2000)) < 0.05
    assert shared(cloud, np.sin(6.0 * cloud[:, 0]), np.ones(2000)) > 0.95
    assert shared(cloud, np.zeros(2000), np.ones(2000)) == 0.0


@pytest.mark.fenicsx
@pytest.mark.parametrize(("newtons", "verdict"), [(0.03, Verdict.ACCEPTED), (0.5, Verdict.DOUBTFUL)])
def test_a_linear_law_is_believed_where_little_turns(
    body: Body, rng: np.random.Generator, newtons: float, verdict: Verdict
) -> None:
    """The organ is Neo-Hookean: bent far, the linear beam explains the cloud well, and is wrong."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    from softtwin.reference.data.materials import LinearElastic, NeoHookean
    from softtwin.reference.derivatives.model import ReferenceModel
    from softtwin.reference.solve.problem import Problem

    with Problem(body, NeoHookean(5000.0, 0.42)) as problem:
        truth = problem.solve(tip_forces(body, (0.0, 0.0, -newtons))).displacement
    with Problem(body, LinearElastic(5000.0, 0.42)) as problem:
        made = prepare(
            ReferenceModel(problem),
            body.node_sets["tip"],
            body.surfaces["observed"],
            force_scale=expected_force(body, 5000.0),
            smoothness=0.1,
        )
        found = made.register(cloud_on(body, truth, 500, rng, 5e-4))
    assert found.judgement.verdict is verdict, found.judgement.reasons
    if verdict is Verdict.DOUBTFUL:
        assert any("its law is linear" in reason for reason in found.judgement.reasons)
