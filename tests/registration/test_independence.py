"""Points that err alike: how many tell what one would, and what registration makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.registration.options import expected_force
from softtwin.registration.registrar import prepare
from softtwin.registration.residual_correlation import variance_inflation

from .conftest import cloud_on

NOISE = 1e-3


def shared_noise(points: np.ndarray, length: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth random field at points, (p, 3), of unit variance: random Fourier features of a Gaussian correlation."""
    waves, phases = rng.standard_normal((300, 3)) / length, rng.uniform(0.0, 2.0 * np.pi, 300)
    features = np.sqrt(2.0 / 300.0) * np.cos(points @ waves.T + phases)
    return features @ rng.standard_normal((300, 3))


def on_a_square(count: int, rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.random((count, 2)), np.zeros(count)])


def test_independent_points_tell_what_they_are_many(rng: np.random.Generator) -> None:
    found = [variance_inflation(on_a_square(800, rng), rng.standard_normal(800), np.ones(800)) for _ in range(20)]
    assert np.median(found) < 1.15
    assert max(found) < 1.6


@pytest.mark.parametrize("length", [0.03, 0.06])
def test_the_variance_of_a_mean_is_that_of_so_many_fewer(rng: np.random.Generator, length: float) -> None:
    """Known: the variance of the mean over the square; measured: n times it, which independent points have as 1."""
    means, found = [], []
    for _ in range(60):
        places = on_a_square(800, rng)
        values = shared_noise(places, length, rng)[:, 0]
        means.append(values.mean())
        found.append(variance_inflation(places, values, np.ones(800)))
    assert np.median(found) == pytest.approx(800.0 * np.mean(np.square(means)), rel=0.45)
    assert np.median(found) > 5.0


def test_small_residuals_and_few_points_are_left_alone(rng: np.random.Generator) -> None:
    places = on_a_square(400, rng)
    smooth = shared_noise(places, 0.2, rng)[:, 0]
    assert variance_inflation(places, 0.05 * smooth, np.ones(400)) == 1.0  # far below what the deviations allow for
    assert variance_inflation(places, np.zeros(400), np.ones(400)) == 1.0
    assert variance_inflation(places[:10], smooth[:10], np.ones(10)) == 1.0
    assert variance_inflation(np.zeros((400, 3)), smooth, np.ones(400)) == 1.0
    assert variance_inflation(places, 5.0 * smooth, np.zeros(400)) == 1.0


@pytest.mark.fenicsx
@pytest.mark.slow
def test_shared_noise_is_no_force(body: Body, rng: np.random.Generator) -> None:
    """With every point believed, its forces were off by five of their deviations; clean clouds change nothing."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    from softtwin.reference.data.materials import NeoHookean
    from softtwin.reference.derivatives.model import ReferenceModel
    from softtwin.reference.solve.problem import Problem

    zone = np.flatnonzero((body.points[:, 2] > 0.199) & (body.points[:, 0] > 0.4))
    with Problem(body, NeoHookean(6500.0, 0.42)) as problem:
        model = ReferenceModel(problem, patient=False)
        registrar = prepare(
            model, zone, body.surfaces["observed"], force_scale=expected_force(body, 6500.0), smoothness=0.1
        )
        scores, alike = {0.0: [], 0.05: []}, {0.0: [], 0.05: []}
        for length, each in scores.items():
            for _ in range(16):
                net, forces = rng.standard_normal(3), np.zeros_like(body.points)
                forces[zone] = net / len(zone)
                cloud = cloud_on(body, model.solve(forces).displacement, 800, rng)
                cloud += NOISE * (shared_noise(cloud, length, rng) if length else rng.standard_normal(cloud.shape))
                found = registrar.register(cloud)
                assert found.judgement.is_usable
                missed = found.net_force - net
                each.append(missed @ np.linalg.solve(found.net_force_covariance, missed) / 3.0)
                alike[length].append(found.inflation_factor)
    assert np.median(alike[0.0]) < 1.3
    assert np.median(alike[0.05]) > 5.0
    assert np.sqrt(np.mean(scores[0.0])) < 1.4
    assert np.sqrt(np.median(scores[0.05])) < 1.4
