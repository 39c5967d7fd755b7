"""Nonsense is not accepted: each kind of it is doubtful or refused, and says why."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.registration.checks import shared, thickness
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.options import expected_force
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.registrar import Registrar, prepare
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Code, Verdict, checked

from .conftest import Cantilever, cloud_on, tip_forces


@pytest.fixture(scope="module")
def registrar(body: Body) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
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


def test_a_record_says_where_refusal_begins() -> None:
    odd = checked(Code.MISFIT, 2.0, 1.0, "odd", refused=1.5)
    assert odd.verdict is Verdict.REFUSED and odd.figures()["refusal_level"] == 1.5
    assert "refusal_level" not in checked(Code.OUTLIERS, 2.0, 1.0, "odd").figures()


def test_a_line_is_refused(registrar: Registrar) -> None:
    line = np.linspace([0.05, 0.1, 0.2], [0.75, 0.1, 0.2], 200)
    refused(registrar, line, "line")


def test_random_points_match_no_organ(registrar: Registrar, rng) -> None:
    refused(registrar, rng.uniform([-0.1, -0.1, -0.1], [0.9, 0.3, 0.3], (400, 3)), "do not match")


def test_another_organ_does_not_match(registrar: Registrar, rng) -> None:
    """A ball in the middle of the beam: smooth, dense, without noise, and wrong in whole patches."""
    refused(registrar, ball(600, 0.15, np.array([0.4, 0.1, 0.1]), rng), "do not match")


def ball(count: int, radius: float, middle: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    points = rng.standard_normal((count, 3))
    return radius * points / np.linalg.norm(points, axis=1)[:, None] + middle


@pytest.mark.parametrize("share", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("gap", [0.0, 0.03], ids=["touching", "beside"])
@pytest.mark.parametrize("radius", [0.05, 0.15])
def test_two_organs_in_one_cloud_are_no_organ(
    body: Body, registrar: Registrar, rng, share: float, gap: float, radius: float
) -> None:
    """The other's points fit nowhere together, as one surface: no camera's outliers do that."""
    truth = registrar.model.solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    own = cloud_on(body, truth, round(600 * (1.0 - share)), rng, 5e-4)
    beside = np.array([0.4, 0.2 + radius + gap, 0.1])
    judged = registrar.register(np.vstack([own, ball(round(600 * share), radius, beside, rng)])).judgement
    assert judged.verdict is not Verdict.ACCEPTED
    if share == 0.3 and radius == 0.05 and gap == 0.0:  # as many outliers are let pass
        assert any("a surface that is none of this organ's" in reason for reason in judged.reasons), judged.reasons


@pytest.mark.parametrize("share", [0.1, 0.28])
def test_outliers_of_a_camera_are_no_other_organ(body: Body, registrar: Registrar, rng, share: float) -> None:
    truth = registrar.model.solve(tip_forces(body, (0.0, 0.3, -0.8))).displacement
    cloud = cloud_on(body, truth, 600, rng, 5e-4)
    wild = rng.random(600) < share
    cloud += wild[:, None] * rng.uniform(-0.05, 0.05, cloud.shape)
    judged = registrar.register(cloud).judgement
    assert judged.verdict is Verdict.ACCEPTED, judged.reasons


def test_the_thickness_of_a_surface_and_of_a_space(rng) -> None:
    """Of a ball it is what its curvature makes of eight neighbours' reach; of points in space a tenth and more."""
    assert thickness(ball(300, 0.1, np.zeros(3), rng) + 5e-4 * rng.standard_normal((300, 3))) < 0.02
    assert thickness(rng.random((300, 3))) > 0.08
    assert thickness(np.zeros((8, 3))) == 1.0  # too few to tell


def test_a_load_beyond_what_was_learned_is_doubtful(body: Body, registrar: Registrar, rng) -> None:
    truth = registrar.model.solve(tip_forces(body, (0.0, 0.0, -1.4))).displacement
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 2.0, minimum=1e-4))
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
