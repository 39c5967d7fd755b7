"""Margins of where things are: they cover the truth as often as they say, and grow with what is not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import embed
from softtwin.registration.forward import reduce_model
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.outcome import Outcome
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar, prepare
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.uncertainty import Uncertainty, unseen_response

from .conftest import Cantilever, cloud_on

NOISE, FORCE = 2e-3, 0.03


def registrar(body: Body, pose: PosePrior | None = None, maximum_points: int = 1000) -> Registrar:
    observed = SurfaceDistance(body, body.surfaces["observed"])
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(FORCE, 0.0))
    options = RegistrationOptions(
        noise=LogNormalPrior(NOISE, 0.0), localisation=SparseLocalisation(rounds=0), maximum_points=maximum_points
    )
    return Registrar(Cantilever(body), observed, forces, options, pose=pose)


@pytest.fixture(scope="module")
def found_again(body: Body) -> list[tuple[Uncertainty, np.ndarray]]:
    """Forces as the prior has them, 150 clouds: what is told of each, and its error, (n, 3), metres."""
    made, out = registrar(body), []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        forces = made.forces.forces(FORCE * rng.standard_normal(made.forces.size))
        truth = made.model.solve(forces).displacement
        result = made.register(cloud_on(body, truth, 200, rng, NOISE))
        out.append((result.uncertainty, result.displacement - truth))
    return out


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95])
def test_margins_cover_the_truth_as_often_as_they_say(
    body: Body, found_again: list[tuple[Uncertainty, np.ndarray]], confidence: float
) -> None:
    """Three standard deviations of a binomial share.

    Along itself the beam's surface tells only to second order how far it went, which Laplace's law does not know: there
    margins are too wide, by how much hangs on where the search ends. They are never to be too narrow.
    """
    inner = embed(body, np.array([[0.6, 0.1, 0.1]]))
    kept, wide, off = [], [], []
    for uncertainty, error in found_again:
        away = np.linalg.norm(inner.displace(error)[0])
        kept.append(away <= uncertainty.margin(inner, confidence)[0])
        wide.append(np.trace(uncertainty.covariances(inner)[0]))
        off.append(away**2)
    assert np.mean(kept) > confidence - 3.0 * np.sqrt(confidence * (1.0 - confidence) / 150) - 0.02
    assert 0.4 < np.mean(off) / np.mean(wide) < 1.3 and np.mean(wide) < 1.3e-4  # as wide as when errors were larger


def test_the_margin_of_a_normal_law_is_its_quantile(rng: np.random.Generator) -> None:
    factor = rng.standard_normal((3, 4)) * np.array([3.0, 1.0, 0.3])[:, None]
    law = Uncertainty(factor, np.array([0.2]))
    drawn = rng.standard_normal((200_000, 4)) @ factor.T + 0.2 * rng.standard_normal((200_000, 3))
    lengths = np.linalg.norm(drawn, axis=1)
    for confidence in (0.5, 0.9, 0.95, 0.99):
        assert law.margin(confidence=confidence)[0] == pytest.approx(np.quantile(lengths, confidence), rel=0.05)
    assert law.deviation[0] == pytest.approx(np.sqrt((lengths**2).mean()), rel=0.01)
    with pytest.raises(ValueError, match=r"confidence: expected a number in \(0, 1\), got 1\.0"):
        law.margin(confidence=1.0)


@pytest.mark.parametrize("free", [1, 2, 3])
def test_the_margin_of_an_even_law_is_that_of_chi_square(free: int) -> None:
    law = Uncertainty(2e-3 * np.eye(3)[:, :free], np.zeros(1))
    for confidence in (0.05, 0.5, 0.95, 0.999):
        assert law.margin(confidence=confidence)[0] == pytest.approx(2e-3 * chi.ppf(confidence, free), rel=1e-7)


def test_what_is_not_known_has_no_margin(body: Body, rng: np.random.Generator) -> None:
    made = registrar(body)
    found = made.register(cloud_on(body, np.zeros_like(body.points), 100, rng, NOISE))
    broken = replace(found.posterior, covariance=np.full_like(found.posterior.covariance, np.nan))
    unknown = replace(found, solved=replace(found.solved, posterior=broken)).uncertainty
    assert np.isinf(unknown.deviation).all() and np.isinf(unknown.margin()).all()
    inner = embed(body, np.array([[0.6, 0.1, 0.1]]))
    assert np.isinf(unknown.margin(inner)).all()


def test_what_cannot_move_is_certain(body: Body, rng: np.random.Generator) -> None:
    made = registrar(body)
    truth = made.model.solve(made.forces.forces(FORCE * rng.standard_normal(made.forces.size))).displacement
    known = made.register(cloud_on(body, truth, 200, rng, NOISE)).uncertainty
    assert known.deviation[body.fixed].max() == 0.0 and known.margin()[body.fixed].max() == 0.0
    assert known.deviation[body.node_sets["tip"]].min() > 0.0


def test_more_points_and_less_noise_make_it_surer(body: Body) -> None:
    made = registrar(body)
    truth = made.model.solve(made.forces.forces(np.full(made.forces.size, 0.5 * FORCE))).displacement
    seeds = [np.random.default_rng(seed) for seed in range(6)]  # one frame's hangs on how far the beam has bent
    sizes = [
        np.mean([made.register(cloud_on(body, truth, count, rng, NOISE)).uncertainty.deviation.mean() for rng in seeds])
        for count in (50, 800)
    ]
    assert sizes[1] < 0.7 * sizes[0]  # what no point tells stays as it was believed


def test_a_dense_cloud_tells_no_more_than_a_thinned_one(body: Body) -> None:
    """50,000 points, each with its own noise: they count as the thousand that are used."""
    made = registrar(body)
    truth = made.model.solve(made.forces.forces(np.full(made.forces.size, 0.5 * FORCE))).displacement
    told = []
    for count in (1_000, 50_000):
        result = made.register(cloud_on(body, truth, count, np.random.default_rng(1), NOISE))
        assert result.points == 1_000 and result.rms_distance == pytest.approx(NOISE, rel=0.07)
        told.append(np.trace(np.linalg.inv(result.posterior.covariance)))
    assert told[1] == pytest.approx(told[0], rel=0.2)


@pytest.mark.slow
def test_a_dense_cloud_promises_no_more_than_its_patches_allow(body: Body) -> None:
    """50,000 points, all used, whose noise is a smooth field: as many tell what one would as share a patch.

    Noise of correlation exp(-d^2 / 2 s^2) is independent from one patch of 2 pi s^2 to the next: of the 0.32 m^2 seen
    there are some 57. So many points with noise of their own are the floor. Half of it (a quarter of the information)
    is let pass: forces have explained a part of what points share before that is looked at. Of so few points
    some clouds tell a state well and as many badly, so that the middle one is chance: means are compared.
    """
    length, count = 0.03, 50_000
    patches = round(2 * 0.8 * 0.2 / (2.0 * np.pi * length**2))
    dense, sparse = registrar(body, maximum_points=count), registrar(body)
    truth = sparse.model.solve(sparse.forces.forces(np.full(sparse.forces.size, 0.5 * FORCE))).displacement
    doubt: dict[str, list[float]] = {"floor": [], "shared": [], "dense": [], "believed": []}
    for seed in range(40):  # of few points, what is told differs much from cloud to cloud
        few = sparse.register(cloud_on(body, truth, patches, np.random.default_rng(seed), NOISE))
        doubt["floor"].append(float(few.uncertainty.deviation.mean()))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        cloud = cloud_on(body, truth, count, rng)
        found = dense.register(cloud + NOISE * smooth_field(cloud, length, rng))
        assert found.points == count
        doubt["shared"].append(0.0 if found.shared_noise is None else found.shared_noise[0])
        doubt["dense"].append(float(found.uncertainty.deviation.mean()))
        believed = dense.register(cloud + NOISE * rng.standard_normal(cloud.shape))
        doubt["believed"].append(float(believed.uncertainty.deviation.mean()))
    assert np.median(doubt["shared"]) > 0.5 * NOISE
    assert np.mean(doubt["dense"]) > 0.5 * np.mean(doubt["floor"])
    assert np.mean(doubt["believed"]) < 0.2 * np.mean(doubt["floor"])  # noise of their own is told from it


def smooth_field(points: np.ndarray, length: float, rng: np.random.Generator) -> np.ndarray:
    """Random Fourier features of a Gaussian correlation, (p, 3), of unit variance, a part of the points at a time."""
    waves, begun = rng.standard_normal((3, 400)) / length, 2.0 * np.pi * rng.random(400)
    weights = np.sqrt(2.0 / 400) * rng.standard_normal((400, 3))
    parts = np.array_split(points, max(1, len(points) // 2000))
    return np.concatenate([np.cos(part @ waves + begun) @ weights for part in parts])


def test_an_unknown_pose_adds_to_it(body: Body, rng: np.random.Generator) -> None:
    prior = PosePrior(Pose.identity(), body.points.mean(axis=0), np.deg2rad(5.0), 0.01)
    plain, posed = registrar(body), registrar(body, prior)
    truth = plain.model.solve(plain.forces.forces(np.full(plain.forces.size, 0.5 * FORCE))).displacement
    cloud = cloud_on(body, truth, 300, rng, NOISE)
    known, unknown = (made.register(cloud) for made in (plain, posed))
    assert unknown.uncertainty.deviation[body.fixed].max() == 0.0  # in the body's frame they lie still
    assert unknown.camera_uncertainty.deviation[body.fixed].min() > 0.0
    for law in (unknown.uncertainty, unknown.camera_uncertainty):
        assert law.deviation.mean() > known.uncertainty.deviation.mean()


def test_directions_that_were_left_out_are_doubted_still(body: Body, rng: np.random.Generator) -> None:
    """Half of the directions are left out: with what they would do, the covariance at rest is that of all."""
    model, observed = Cantilever(body), SurfaceDistance(body, body.surfaces["observed"])
    every = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(FORCE, 0.0), 0.05)
    turned, _ = np.linalg.qr(rng.standard_normal((every.size, every.size)))
    some = every.combined(turned[:, : every.size // 2])
    response = unseen_response(reduce_model(model, observed.nodes, some.basis), some)
    at_rest = model.solve(np.zeros_like(body.points))
    whole = at_rest.jvp(every.basis)
    both = np.hstack([at_rest.jvp(some.basis), response])
    np.testing.assert_allclose(both @ both.T, whole @ whole.T, atol=1e-12 * np.abs(whole @ whole.T).max())
    fewer = some.combined(np.eye(some.size)[:, :2])
    response = unseen_response(reduce_model(model, observed.nodes, fewer.basis), fewer)
    both = np.hstack([at_rest.jvp(fewer.basis), response])
    np.testing.assert_allclose(both @ both.T, whole @ whole.T, atol=1e-12 * np.abs(whole @ whole.T).max())
    assert unseen_response(reduce_model(model, observed.nodes, every.basis), every).shape == (body.points.size, 0)


def test_many_directions_are_stood_for_by_random_ones(body: Body) -> None:
    model, observed = Cantilever(body), SurfaceDistance(body, body.surfaces["observed"])
    every = nodal_forces(body, body.boundary_nodes, LogNormalPrior(FORCE, 0.0))
    assert every.size > 200
    few = every.combined(np.eye(every.size)[:, :3])
    response = unseen_response(reduce_model(model, observed.nodes, few.basis), few)
    assert response.shape == (body.points.size, 64)
    exact = model.solve(np.zeros_like(body.points)).jvp(few.unseen)
    ratio = np.trace(response @ response.T) / np.trace(exact @ exact.T)
    assert 0.5 < ratio < 1.6


def test_prepared_registrations_have_it(body: Body, rng: np.random.Generator) -> None:
    made = prepare(Cantilever(body), body.boundary_nodes, body.surfaces["observed"], force_scale=0.01)
    made = replace_options(made)
    truth = made.model.solve(made.forces.forces(np.full(made.forces.size, 0.02))).displacement
    result = made.register(cloud_on(body, truth, 300, rng, 1e-3))
    assert np.isfinite(result.uncertainty.deviation).all() and result.uncertainty.deviation.max() > 0.0


def replace_options(made: Registrar) -> Registrar:
    options = replace(made.options, localisation=replace(made.options.localisation, rounds=1))
    return Registrar(made.model, made.observed, made.forces, options)


def test_who_is_called_converged_has_no_step_left(body: Body) -> None:
    """Closest points that are searched anew at the end may ask for another step: it is taken."""
    made = registrar(body)
    made.setup = replace(made.setup, noise=LogNormalPrior(NOISE, 1.5, minimum=1e-4))
    for seed in range(40):
        rng = np.random.default_rng(seed)
        forces = made.forces.forces(FORCE * rng.standard_normal(made.forces.size))
        truth = made.model.solve(forces).displacement
        result = made.register(cloud_on(body, truth, 200, rng, 1e-4))
        assert result.outcome is Outcome.CONVERGED and result.local is not None
        assert result.local.length < 0.3
