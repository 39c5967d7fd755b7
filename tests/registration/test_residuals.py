"""Distances of a cloud to a moving surface: closest, one-sided, with exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import outer_nodes
from softtwin.meshes.grid import gridded
from softtwin.meshes.shapes import beam
from softtwin.registration.forward import reduce_model
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.local_model import LocalModel
from softtwin.registration.loss import Huber
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.problem import Problem
from softtwin.registration.registrar import prepare
from softtwin.registration.surface_distance import SurfaceDistance, expected_distance
from softtwin.registration.thinning import thinned

from .conftest import Cantilever, cloud_on, tip_forces


@pytest.fixture(scope="module")
def observed(body: Body) -> SurfaceDistance:
    return SurfaceDistance(body, body.surfaces["observed"])


@pytest.fixture(scope="module")
def carried(body: Body) -> Body:
    """The same organ carried by the cells of a regular grid."""
    return gridded(body, 0.09)


def test_a_surface_that_cells_carry_is_where_it_was(body: Body, carried: Body, observed, rng) -> None:
    cloud = cloud_on(body, np.zeros_like(body.points), 80, rng, noise=5e-3)
    skin = SurfaceDistance(carried, carried.surfaces["observed"])
    rest = observed.match(np.zeros((len(observed.nodes), 3)), cloud)
    same = skin.match(np.zeros((len(skin.nodes), 3)), cloud)
    assert np.allclose(same.distances, rest.distances, atol=1e-12)
    height = carried.points[skin.nodes, 2]
    assert np.allclose(skin.at_points(same, height), skin.closest_points(same)[:, 2], atol=1e-12)


def test_forces_on_a_grid_are_found_from_a_cloud_of_its_skin(carried: Body, rng) -> None:
    model = Cantilever(carried)
    forces = np.zeros_like(carried.points)
    tip = np.flatnonzero(carried.points[:, 0] > 0.75)
    forces[np.intersect1d(tip, outer_nodes(carried)), 1] = 0.02
    truth = model.solve(forces).displacement
    cloud = partial_view(carried, truth, (0.0, 1.0, 1.0), 300, 0.0, rng, "observed")
    result = prepare(model, tip, carried.surfaces["observed"], force_scale=0.02).register(cloud)
    errors = np.linalg.norm(result.displacement - truth, axis=1)
    assert errors.mean() < 0.02 * np.linalg.norm(truth, axis=1).mean()


@pytest.mark.parametrize("on_a_grid", [False, True])
def test_rows_are_the_derivative_of_the_distances(on_a_grid: bool, body: Body, carried: Body, observed, rng) -> None:
    if on_a_grid:
        observed = SurfaceDistance(carried, carried.surfaces["observed"])
    cloud = cloud_on(body, np.zeros_like(body.points), 80, rng, noise=5e-3)
    u = 1e-3 * rng.standard_normal((len(observed.nodes), 3))
    direction = rng.standard_normal(u.shape)
    start = observed.match(u, cloud)
    slope = observed.rows(start) @ direction.ravel()
    steps = 2e-4 * 0.5 ** np.arange(5)
    moved = [observed.match(u + h * direction, cloud).distances for h in steps]
    errors = [np.median(np.abs(m - start.distances - h * slope)) for m, h in zip(moved, steps, strict=True)]
    assert np.median(np.log2(np.divide(errors[:-1], errors[1:]))) > 1.9


def test_all_coefficients_pass_the_taylor_test(body: Body, observed: SurfaceDistance, rng) -> None:
    """Forces and pose together, at a state and a pose that are far from rest."""
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 1.0))
    prior = PosePrior(Pose.identity(), body.points.mean(axis=0))
    model = reduce_model(Cantilever(body), observed.nodes, forces.basis)
    cloud = cloud_on(body, np.zeros_like(body.points), 80, rng, noise=5e-3)
    problem = Problem.of(model, observed, cloud, LogNormalPrior(1e-3, 1.0), (forces, prior))
    here = np.concatenate([0.02 * rng.standard_normal(forces.size), rng.standard_normal(6)])
    along = np.concatenate([0.02 * rng.standard_normal(forces.size), rng.standard_normal(6)])
    start = problem.evaluation(here)
    slope = problem.jacobian(start) @ along
    steps = 0.02 * 0.5 ** np.arange(4)
    moved = [problem.evaluation(here + h * along, start).match.distances for h in steps]
    errors = [np.median(np.abs(m - start.match.distances - h * slope)) for m, h in zip(moved, steps, strict=True)]
    assert np.median(np.log2(np.divide(errors[:-1], errors[1:]))) > 1.9
    cotangent = rng.standard_normal(len(cloud))
    np.testing.assert_allclose(problem.vjp(start, cotangent), cotangent @ problem.jacobian(start), rtol=1e-9)


def _ball(radius: float = 0.05) -> Body:
    """A ball of hexahedra: a cube whose shells are blown up to spheres."""
    cube = beam((10, 10, 10), (2.0, 2.0, 2.0), "hexahedron")
    place = cube.points - 1.0
    around = np.abs(place).max(axis=1) / np.maximum(np.linalg.norm(place, axis=1), 1e-300)
    made = Body(radius * place * around[:, None], cube.cells, cube.node_sets)
    return Body(made.points, made.cells, made.node_sets, {"observed": made.boundary})


@pytest.mark.parametrize("noise", [3e-3, 8e-3])
def test_noisy_points_of_a_round_body_are_expected_outside(noise: float, rng) -> None:
    """Of a sphere of radius r by sigma^2 / r in the mean: were they not, noise would blow the body up."""
    ball = _ball()
    observed, rest = SurfaceDistance(ball), np.zeros_like(ball.points)
    cloud = cloud_on(ball, rest, 20_000, rng, noise=noise)
    match = observed.match(rest[observed.nodes], cloud)
    mean, doubt = float(match.distances.mean()), noise / np.sqrt(len(cloud))
    assert mean < -5.0 * doubt
    expected = expected_distance(observed.curvature(match), noise)
    assert float(expected.mean()) == pytest.approx(mean, abs=3.0 * doubt)
    assert float(expected.mean()) == pytest.approx(-(noise**2) / 0.05, rel=0.15)


def test_a_tip_is_expected_no_further_off_than_a_point(rng) -> None:
    """Points about a single point with noise of all directions lie sigma sqrt(8 / pi) from it in the mean."""
    ball = _ball(radius=1e-6)
    observed, rest = SurfaceDistance(ball), np.zeros_like(ball.points)
    cloud = 1e-3 * rng.standard_normal((4000, 3))
    match = observed.match(rest[observed.nodes], cloud)
    expected = expected_distance(observed.curvature(match), 1e-3)
    assert float(expected.mean()) == pytest.approx(match.distances.mean(), rel=0.05)


def test_what_is_yet_to_be_explained_is_no_noise_of_the_points(body: Body, observed: SurfaceDistance, rng) -> None:
    """At rest a moved surface looks like noise; as much of it would put every round place where it is not."""
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 1.0))
    cantilever = Cantilever(body)
    model = reduce_model(cantilever, observed.nodes, forces.basis)
    cloud = cloud_on(body, cantilever.solve(tip_forces(body, (0.0, 0.4, 0.8))).displacement, 200, rng, noise=1e-3)
    problem = Problem.of(model, observed, cloud, LogNormalPrior(1e-3, 1.5), (forces,))
    rest = problem.evaluation(np.zeros(forces.size))
    local = LocalModel(problem, rest, Huber(), rest.match.rms, graduation=1.0)
    assert local.is_graduated and local.point_noise < 0.5 * local.noise


def test_closest_points_are_the_closest(body: Body, observed: SurfaceDistance, rng) -> None:
    cloud = cloud_on(body, np.zeros_like(body.points), 40, rng, noise=2e-2)
    found = np.abs(observed.match(np.zeros((len(observed.nodes), 3)), cloud).distances)
    weights = rng.dirichlet(np.ones(3), size=4000)
    dense = np.einsum("qk,tki->tqi", weights, body.points[body.surfaces["observed"]]).reshape(-1, 3)
    brute = np.linalg.norm(cloud[:, None] - dense[None], axis=2).min(axis=1)
    assert (found <= brute + 1e-12).all() and (brute - found).max() < 5e-3  # sampling finds nothing nearer


def test_what_is_not_seen_pulls_nothing(body: Body, observed: SurfaceDistance, rng) -> None:
    """Points of one corner of the observed side touch no other node."""
    corner = cloud_on(body, np.zeros_like(body.points), 400, rng, noise=1e-3)
    corner = corner[corner[:, 0] < 0.15]
    match = observed.match(np.zeros((len(observed.nodes), 3)), corner)
    pull = (observed.rows(match).T @ match.distances).reshape(-1, 3)
    assert np.abs(pull[observed.rest[:, 0] > 0.3]).max() == 0.0
    assert np.abs(pull).max() > 0.0


def test_thinning_leaves_the_noise_as_it_was(rng) -> None:
    """A plane, twice as dense on one side: the spread across it is that of all, and both sides count alike."""
    plane = rng.random((75_000, 3)) * [1.0, 1.0, 0.0]
    plane = plane[(plane[:, 0] < 0.5) | (rng.random(len(plane)) < 0.5)]
    noise = 0.01 * rng.standard_normal(len(plane))
    plane[:, 2] += noise
    kept = thinned(plane, 1000)
    assert plane[kept, 2].std() == pytest.approx(0.01, rel=0.07)  # three standard deviations of a thousand
    assert (plane[kept, 0] < 0.5).mean() == pytest.approx(0.5, abs=0.06)


def test_thinning_leaves_outliers_out_rather_than_in(rng) -> None:
    """One point in eleven lies anywhere: of those kept, fewer do."""
    plane = rng.random((20_000, 3)) * [1.0, 1.0, 0.001]
    wrong = rng.random((2_000, 3))
    kept = thinned(np.concatenate([plane, wrong]), 1000)
    assert (kept >= len(plane)).mean() < 0.7 / 11.0


def test_thinning_keeps_points_and_spreads_them(rng) -> None:
    cloud = np.concatenate([rng.random((20_000, 3)), 0.01 * rng.random((20_000, 3))])
    kept = thinned(cloud, 1000)
    assert 600 < len(kept) <= 1000 and len(np.unique(kept)) == len(kept)
    assert (cloud[kept].max(axis=1) < 0.011).mean() < 0.05  # half of the points lie in that corner
    assert np.array_equal(thinned(cloud[:50], 100), np.arange(50))
    with pytest.raises(ValueError, match=r"thinned\.maximum: expected at least 1"):
        thinned(cloud, 0)
