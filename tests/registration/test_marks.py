"""Landmarks pull beside the cloud: exact derivatives, less error where it tells little, doubt where one is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.registration.forward import reduce_model
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.loss import Square
from softtwin.registration.options import RegistrationOptions
from softtwin.registration.parameters.correlated_noise import CorrelatedNoise
from softtwin.registration.parameters.discrepancy import ModelError
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.problem import Problem
from softtwin.registration.registrar import Registrar
from softtwin.registration.residuals.landmarks import LandmarkPairs
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Verdict

from .conftest import Cantilever, cloud_on, tip_forces
from .test_model_error import patterns

NET = (0.3, 0.3, -0.8)
DEVIATION = 1e-3


def marks_on(body: Body, observed: SurfaceDistance, count: int, deviation: float = DEVIATION) -> LandmarkPairs:
    """Some nodes of the surface, found where they are."""
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    nodes = np.random.default_rng(3).choice(observed.nodes, count, replace=False)
    return LandmarkPairs.of(observed, body.points[nodes], body.points[nodes] + u[nodes], deviation)


@pytest.fixture
def problem(body: Body) -> Problem:
    """With all kinds of unknowns that the test model has: forces, pose, errors, noise that neighbours share."""
    model, observed = Cantilever(body), SurfaceDistance(body, body.surfaces["observed"])
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4), smoothness=0.1)
    turned = Pose.identity().moved(np.array([0.1, -0.05, 0.02, 0.01, 0.0, -0.02]), np.zeros(3))
    pose = PosePrior(turned, body.points.mean(axis=0), 0.05, 0.01)
    error = ModelError(patterns(body), observed, 0.1)
    cloud = pose.mean.apply(body.points[observed.nodes][::3] + 0.002)
    marks = marks_on(body, observed, 4)
    marks = replace(marks, places=pose.mean.apply(marks.places))
    reduced = reduce_model(model, observed.nodes, forces.basis)
    noise, shared = LogNormalPrior(1e-3, 1.0), CorrelatedNoise(observed.modes.leading(10))
    return Problem.of(reduced, observed, cloud, noise, (forces, pose, error, shared), (marks,))


def test_the_derivative_is_that_of_the_residuals(problem: Problem, rng: np.random.Generator) -> None:
    at = 0.1 * rng.standard_normal(problem.size)
    evaluation = problem.evaluation(at)
    (marks,), step = problem.terms, 1e-6
    slopes = marks.slopes(evaluation)
    jacobian = problem.jacobian(evaluation, slopes)
    for column in range(problem.size):
        change = np.zeros(problem.size)
        change[column] = step
        ahead, behind = (marks.values(problem.evaluation(at + sign * change)) for sign in (1.0, -1.0))
        wanted = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(jacobian[:, column], wanted, atol=1e-6 * np.abs(jacobian).max())
    assert not jacobian[:, problem.moving.stop :].any()  # noise moves no mark
    cotangent = rng.standard_normal(len(jacobian))
    np.testing.assert_allclose(problem.vjp(evaluation, cotangent, slopes), cotangent @ jacobian, rtol=1e-9, atol=1e-9)


def test_at_the_truth_nothing_is_left(body: Body) -> None:
    observed = SurfaceDistance(body, body.surfaces["observed"])
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    marks = marks_on(body, observed, 5)
    np.testing.assert_allclose(
        observed.moved_closest_points(marks.closest_points, u[observed.nodes]), marks.places, atol=1e-12
    )


def registrar(body: Body, solver: GaussNewton | LBFGS) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4), smoothness=0.2)
    options = RegistrationOptions(solver=solver, localisation=replace(RegistrationOptions().localisation, rounds=0))
    return Registrar(Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces, options)


@pytest.mark.parametrize("solver", [GaussNewton(), LBFGS()])
def test_they_tell_what_the_cloud_does_not(body: Body, solver: GaussNewton | LBFGS) -> None:
    """A straight beam slides along itself: its cloud shows little of a pull along the axis."""
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    cloud = cloud_on(body, u, 400, np.random.default_rng(1), 5e-4)
    own = registrar(body, solver)
    few = cloud[cloud[:, 0] < 0.8 * cloud[:, 0].max()]  # the end is not seen
    without = own.register(few)
    with_marks = own.with_terms(marks_on(body, own.observed, 6, 2e-4)).register(few)
    errors = [np.linalg.norm(result.displacement - u, axis=1).mean() for result in (without, with_marks)]
    assert errors[1] < 0.5 * errors[0]
    assert with_marks.uncertainty.deviation.mean() < without.uncertainty.deviation.mean()
    assert with_marks.judgement.verdict is not Verdict.REFUSED


def test_one_that_was_taken_for_another_makes_a_doubtful_frame(body: Body) -> None:
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    cloud = cloud_on(body, u, 400, np.random.default_rng(1), 5e-4)
    own = registrar(body, GaussNewton())
    right = marks_on(body, own.observed, 4)
    places = right.places.copy()
    places[2] += 0.03
    result = own.with_terms(replace(right, places=places)).register(cloud)
    assert result.judgement.verdict is not Verdict.ACCEPTED
    assert any("landmark 2 lies" in reason for reason in result.judgement.reasons)


def test_none_change_nothing(body: Body) -> None:
    cloud = cloud_on(
        body, Cantilever(body).solve(tip_forces(body, NET)).displacement, 300, np.random.default_rng(2), 5e-4
    )
    own = registrar(body, GaussNewton((Square(),)))
    plain, marked = own.register(cloud), own.with_terms().register(cloud)
    np.testing.assert_array_equal(plain.displacement, marked.displacement)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"points": np.zeros((2, 2))}, r"LandmarkPairs.points: expected shape \(l, 3\)"),
        ({"points": np.zeros((0, 3)), "places": np.zeros((0, 3))}, r"LandmarkPairs.points: expected shape \(l, 3\)"),
        ({"places": np.zeros((3, 3))}, r"LandmarkPairs.places: expected shape \(l, 3\), as many of both"),
        ({"places": np.full((2, 3), np.nan)}, "LandmarkPairs.places: expected finite numbers"),
        ({"deviation": 0.0}, "LandmarkPairs.deviation: expected a positive number"),
        ({"points": np.full((2, 3), 9.0)}, "expected points on the observed surface; point 0 lies"),
    ],
)
def test_what_are_no_landmarks_is_refused(body: Body, change: dict[str, object], words: str) -> None:
    observed = SurfaceDistance(body, body.surfaces["observed"])
    points = body.points[observed.nodes[:2]]
    given = {"points": points, "places": points, "deviation": 1e-3} | change
    with pytest.raises(ValueError, match=words):
        LandmarkPairs.of(observed, **given)  # type: ignore[arg-type]
