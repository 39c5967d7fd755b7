"""Points of a cloud that lie by themselves: told by how near others are, whatever the unit and the sampling."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.registration.cloud import Cloud
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.registrar import Registrar
from softtwin.registration.strategies.cold_start import finish, localise
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import Cantilever, cloud_on

Floats = NDArray[np.float64]
RADIUS, NOISE = 0.1, 1e-3


def on_a_sphere(count: int, rng: np.random.Generator) -> Floats:
    directions = rng.standard_normal((count, 3))
    points = RADIUS * directions / np.linalg.norm(directions, axis=1)[:, None]
    return points + NOISE * rng.standard_normal((count, 3))


def anywhere(count: int, rng: np.random.Generator) -> Floats:
    return rng.uniform(-1.4 * RADIUS, 1.4 * RADIUS, (count, 3))


def grid() -> Floats:
    """As a depth camera that looks straight at a plane has it."""
    return np.stack(np.meshgrid(np.arange(30.0), np.arange(20.0), [0.0]), axis=-1).reshape(-1, 3) * 0.004


@pytest.mark.parametrize("count", [200, 1000, 4000])
def test_points_of_a_surface_stay(count: int, rng: np.random.Generator) -> None:
    assert len(Cloud.of(on_a_sphere(count, rng)).without_isolated) >= 0.995 * count
    half = on_a_sphere(count, rng)
    half = half[half[:, 2] > 0.0]  # the edge has neighbours on one side alone
    assert len(Cloud.of(half).without_isolated) >= 0.99 * len(half)


def test_a_regular_grid_stays_whole() -> None:
    cloud = Cloud.of(grid())
    assert cloud.without_isolated is cloud


@pytest.mark.parametrize("share", [0.05, 0.1, 0.2])
def test_points_anywhere_are_left_out(share: float, rng: np.random.Generator) -> None:
    wrong = int(share * 2000)
    surface, outliers = on_a_sphere(2000 - wrong, rng), anywhere(wrong, rng)
    cloud = Cloud.of(np.vstack([outliers, surface]))
    is_kept = np.isin(cloud.points[:, 0], cloud.without_isolated.points[:, 0])
    assert is_kept[wrong:].mean() > 0.99
    far = np.abs(np.linalg.norm(outliers, axis=1) - RADIUS) > 0.02
    assert is_kept[:wrong][far].mean() < 0.1  # those that happen to lie near the surface do little


def test_the_unit_does_not_matter_and_normals_stay_with_their_points(rng: np.random.Generator) -> None:
    points = np.vstack([on_a_sphere(900, rng), anywhere(100, rng)])
    cloud = np.hstack([points, points / np.linalg.norm(points, axis=1)[:, None]])
    kept = Cloud.of(cloud).without_isolated
    assert kept.normals is not None and len(kept) < len(cloud)
    np.testing.assert_allclose(kept.normals, kept.points / np.linalg.norm(kept.points, axis=1)[:, None])
    np.testing.assert_allclose(Cloud.of(1e3 * points).without_isolated.points, 1e3 * kept.points)


def test_of_few_points_none_is_left_out(rng: np.random.Generator) -> None:
    for count in (1, 3, 6):
        few = Cloud.of(anywhere(count, rng))
        assert few.without_isolated is few


def test_a_place_that_is_there_many_times_leaves_no_other_out(rng: np.random.Generator) -> None:
    """Distances of zero have no logarithm."""
    points = np.vstack([on_a_sphere(500, rng), np.repeat(on_a_sphere(1, rng), 20, axis=0)])
    assert len(Cloud.of(points).without_isolated) >= 0.99 * len(points)


def test_a_search_from_rest_without_gathering_forces_leaves_points_out_once(
    body: Body, rng: np.random.Generator
) -> None:
    """Of what is left of a cloud, too, some would lie by themselves."""
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4))
    options = RegistrationOptions(localisation=SparseLocalisation(rounds=0, points=1000))
    made = Registrar(Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces, options)
    wrong = rng.uniform(body.points.min(axis=0) - 0.1, body.points.max(axis=0) + 0.1, (120, 3))
    cloud = Cloud.of(np.vstack([cloud_on(body, np.zeros_like(body.points), 480, rng, 5e-4), wrong]))
    assert len(cloud.without_isolated.without_isolated) < len(cloud.without_isolated) < len(cloud)
    begun = localise(made.setup, cloud)
    assert len(begun.found.evaluation.cloud) == len(cloud.without_isolated)
    assert len(finish(made.setup, cloud, begun).found.evaluation.cloud) == len(cloud)
