"""Normals measured with a cloud, and distances to planes: exact derivatives, less error, doubt where they are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError
from softtwin.registration.cloud import Cloud, turned
from softtwin.registration.forward import reduce_model
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import RegistrationOptions
from softtwin.registration.parameters.correlated_noise import CorrelatedNoise
from softtwin.registration.parameters.discrepancy import ModelError
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.problem import Problem
from softtwin.registration.registrar import Registrar
from softtwin.registration.residuals.normals import Normals
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.verdict import Verdict

from .conftest import Cantilever, cloud_on, tip_forces
from .test_model_error import patterns

Floats = NDArray[np.float64]
NET = (0.0, 0.3, -0.8)  # across the beam: how it leans says nothing of a pull along it
NOISE, LEANING = 5e-4, np.deg2rad(0.25)


def oriented(body: Body, u: Floats, count: int, seed: int, noise: float = NOISE) -> Floats:
    """A noisy cloud of the observed side with normals that are off by a quarter of a degree, half inward, (p, 6)."""
    rng = np.random.default_rng(seed)
    cloud = cloud_on(body, u, count, rng, 0.0)
    observed = SurfaceDistance(body, body.surfaces["observed"])
    normals = observed.facing(observed.match(u[observed.nodes], cloud), u[observed.nodes])
    normals = normals + LEANING * rng.standard_normal(normals.shape)
    cloud = cloud + noise * rng.standard_normal(cloud.shape)
    return np.hstack([cloud, normals * rng.choice([-2.0, 0.5], len(normals))[:, None]])


@pytest.fixture
def problem(body: Body, rng: np.random.Generator) -> Problem:
    """With forces, a pose far from none, errors and noise that neighbours share as unknowns."""
    model, observed = Cantilever(body), SurfaceDistance(body, body.surfaces["observed"])
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4), smoothness=0.1)
    mean = Pose.identity().moved(np.array([0.1, -0.05, 0.02, 0.01, 0.0, -0.02]), np.zeros(3))
    pose = PosePrior(mean, body.points.mean(axis=0), 0.05, 0.01)
    error = ModelError(patterns(body), observed, 0.1)
    seen = oriented(body, model.solve(tip_forces(body, NET)).displacement, 80, 1)
    seen[3, 3:] = np.nan  # one was not measured
    cloud, reduced = (
        Cloud.of(turned(seen, mean.rotation, mean.translation)),
        reduce_model(model, observed.nodes, forces.basis),
    )
    shared, basis = CorrelatedNoise(observed.modes.leading(10)), cloud.tangent_basis
    assert basis is not None
    blocks = (forces, pose, error, shared)
    return Problem.of(reduced, observed, cloud.points, LogNormalPrior(1e-3, 1.0), blocks, (Normals(basis),))


def test_the_derivative_is_that_of_the_residuals(problem: Problem, rng: np.random.Generator) -> None:
    at = 0.1 * rng.standard_normal(problem.size)
    evaluation = problem.evaluation(at)
    (normals,) = problem.terms
    slopes = normals.slopes(evaluation)
    jacobian = problem.jacobian(evaluation, slopes)
    assert jacobian.shape == (160, problem.size)
    assert not jacobian[6:8].any()  # of the point without a normal
    direction = rng.standard_normal(problem.size)

    def residuals(step: float) -> Floats:  # a point that goes on to the next triangle has another normal: held here
        return normals.values(problem.evaluation(at + step * direction, evaluation), evaluation.match)

    steps = 5e-3 * 0.5 ** np.arange(5)
    errors = [np.linalg.norm(residuals(h) - residuals(0.0) - h * jacobian @ direction) for h in steps]
    assert np.log2(np.divide(errors[:-1], errors[1:])).min() > 1.9
    assert not jacobian[:, problem.moving.stop :].any()  # noise turns no surface
    cotangent = rng.standard_normal(len(jacobian))
    np.testing.assert_allclose(problem.vjp(evaluation, cotangent, slopes), cotangent @ jacobian, rtol=1e-9, atol=1e-9)


def test_planes_have_exact_derivatives(body: Body, rng: np.random.Generator) -> None:
    observed = SurfaceDistance(body, body.surfaces["observed"], "plane")
    cloud = cloud_on(body, np.zeros_like(body.points), 80, rng, noise=5e-3)
    cloud[:3] += [0.0, 0.4, 0.4]  # far beside: measured to the surface
    u = 1e-3 * rng.standard_normal((len(observed.nodes), 3))
    start = observed.match(u, cloud)
    plain = SurfaceDistance(body, body.surfaces["observed"]).match(u, cloud)
    assert (np.abs(start.distances) <= np.abs(plain.distances) + 1e-12).all()
    np.testing.assert_allclose(start.distances[:3], plain.distances[:3])
    direction = rng.standard_normal(u.shape)
    slope = observed.rows(start) @ direction.ravel()
    steps = 2e-4 * 0.5 ** np.arange(5)
    moved = [observed.match(u + h * direction, cloud).distances for h in steps]
    errors = [np.median(np.abs(m - start.distances - h * slope)) for m, h in zip(moved, steps, strict=True)]
    assert np.median(np.log2(np.divide(errors[:-1], errors[1:]))) > 1.9


def registrar(body: Body, **options: object) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4), smoothness=0.2)
    localisation = replace(RegistrationOptions().localisation, rounds=0)
    chosen = RegistrationOptions(localisation=localisation, normal_deviation=LEANING, **options)  # type: ignore[arg-type]
    return Registrar(
        Cantilever(body), SurfaceDistance(body, body.surfaces["observed"], chosen.distance), forces, chosen
    )


def test_normals_tell_what_noisy_points_do_not(body: Body) -> None:
    """Of a bend over 0.8 m a normal good to 0.25 degrees tells what a point good to some 3 mm does; these have 8 mm."""
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    own, errors, covered = registrar(body), [], []
    for seed in range(16):
        seen = oriented(body, u, 400, seed, noise=8e-3)
        for cloud in (seen[:, :3], seen):
            found = own.register(cloud)
            missed = found.displacement - u
            errors.append(np.linalg.norm(missed[:, 1:], axis=1).mean())
            covered.append((np.linalg.norm(missed, axis=1) <= found.uncertainty.margin() + 1e-12).mean())
    assert np.mean(errors[1::2]) < 0.6 * np.mean(errors[::2])
    assert np.mean(covered[1::2]) > 0.75


def test_both_solvers_agree(body: Body) -> None:
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    seen = oriented(body, u, 200, 3, noise=1e-3)
    both = [registrar(body, solver=solver).register(seen) for solver in (GaussNewton(), LBFGS())]
    away = np.linalg.norm(both[0].displacement - both[1].displacement, axis=1)
    assert (away <= both[0].uncertainty.margin()).all()


def test_planes_find_the_same_as_surfaces(body: Body) -> None:
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    cloud = cloud_on(body, u, 400, np.random.default_rng(2), NOISE)
    both = [registrar(body, distance=kind).register(cloud) for kind in ("surface", "plane")]
    assert all(found.judgement.verdict is Verdict.ACCEPTED for found in both)
    away = np.linalg.norm((both[0].displacement - both[1].displacement)[:, 1:], axis=1)
    assert (away <= both[0].uncertainty.margin()).all()


def test_normals_of_another_frame_make_a_doubtful_frame(body: Body) -> None:
    u = Cantilever(body).solve(tip_forces(body, NET)).displacement
    seen = oriented(body, u, 400, 5)
    assert registrar(body).register(seen).judgement.verdict is Verdict.ACCEPTED
    judged = registrar(body).register(np.hstack([seen[:, :3], seen[:, [5, 3, 4]]])).judgement
    assert judged.verdict is not Verdict.ACCEPTED
    assert any("normals do not match" in reason for reason in judged.reasons)


def test_a_large_cloud_is_thinned_with_its_normals(body: Body) -> None:
    seen = oriented(body, np.zeros_like(body.points), 900, 6)
    few = Cloud.of(seen).thinned(50).array()
    assert few.shape == (50, 6)
    assert all((row == seen).all(axis=1).any() for row in few)
    assert Cloud.of(seen[:, :3]).tangent_basis is None
    np.testing.assert_array_equal(Cloud.of(np.repeat(few, 3, axis=0)).distinct().array(), few)


def test_what_is_no_cloud_with_normals_is_refused(body: Body) -> None:
    seen = oriented(body, np.zeros_like(body.points), 60, 7)
    with pytest.raises(CloudError, match="expected normals in its last three columns, got none"):
        registrar(body).register(np.hstack([seen[:, :3], np.zeros((60, 3))]))
    with pytest.raises(CloudError, match=r"expected shape \(p, 3\), got \(60, 5\)"):
        registrar(body).register(seen[:, :5])
    with pytest.raises(ValueError, match="normal_deviation: expected a positive angle, got 0"):
        RegistrationOptions(normal_deviation=0.0)
    with pytest.raises(ValueError, match="distance: expected surface or plane, got 'line'"):
        RegistrationOptions(distance="line")  # type: ignore[arg-type]
