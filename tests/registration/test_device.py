"""Registration by torch alone: the same states and margins as `Registrar`'s, many clouds at once, on either device."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is absent")

from kept_out import refusing

from softtwin.meshes.body import Body
from softtwin.meshes.triangle_tree import TriangleTree, signed_distances
from softtwin.registration import evidence as one_by_one
from softtwin.registration.device.arrays import DeviceArrays, Start
from softtwin.registration.device.closest import ClosestPoints
from softtwin.registration.device.evidence import Hyperpriors, Sums, eigen, law_of, scale_covariance, scored, slope_of
from softtwin.registration.device.frames import DeviceFrames, Execution
from softtwin.registration.device.from_registration import arrays_of, start_of
from softtwin.registration.hyperparameters import DISCREPANCY, FORCE, NOISE, LogNormalPrior
from softtwin.registration.laplace import posterior
from softtwin.registration.local_model import LocalModel
from softtwin.registration.loss import Tukey
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.policy import ACCURACY, varied
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar
from softtwin.registration.residuals.landmarks import LandmarkPairs
from softtwin.registration.result import Registration
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.uncertainty import uncertainty
from softtwin.surrogate.encoder_decoder import LinearEncoderDecoder
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.reduced import AveragedNetwork, ReducedNetwork

from .conftest import Cantilever, cloud_on

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]
KEPT_OUT = ("vtk", "vtkmodules", "pyvista", "zarr", "meshio", "pydantic", "igl", "dolfinx", "petsc4py")
OWN = [NOISE, FORCE, DISCREPANCY]
NOISE_M = 5e-4
POSES = {
    "none": None,
    "free": PosePrior(Pose.identity(), np.array([0.4, 0.1, 0.1])),
    "said": PosePrior(Pose.identity(), np.array([0.4, 0.1, 0.1]), 0.01, 0.002, is_said=True),
}


def surrogate(body: Body, errs: bool = True) -> Surrogate:
    """Smooth fields over a beam that forces bend it into, by a network with random weights where they are large."""
    x, y, z = (body.points / body.points[:, 0].max()).T
    shapes = [x**2, x**3, x**2 * z, x**2 * y]
    fields = np.stack([np.outer(shape, axis).ravel() for shape in shapes for axis in np.eye(3)], axis=1)
    fields = np.linalg.qr(fields)[0]
    rows = (3 * np.setdiff1d(body.boundary_nodes, body.fixed)[:, None] + np.arange(3)).ravel()
    modes, loaded = fields.shape[1], rows[::3] // 3
    to_coordinates = fields[rows].T
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        plain = ReducedNetwork(torch.full((modes,), 20.0), 0.005, 16, 2)
        network = AveragedNetwork(plain.double(), torch.eye(modes, dtype=torch.float64)[None]).requires_grad_(False)
    modes_of_error = np.zeros((*body.points.shape, 2))
    modes_of_error[:, 2, 0], modes_of_error[:, 1, 1] = 0.05 * np.sin(np.pi * x), 0.12 * x * (1.0 - x)
    modes_of_error[body.fixed] = 0.0
    known = {
        "error_modes": modes_of_error.reshape(-1, 2),
        "error_rest": 1e-3 * (1.0 + x),
    }
    maps = LinearEncoderDecoder(
        loaded,
        np.zeros(body.points.size),
        1.5 * fields,
        to_coordinates,
        to_coordinates,
        fields,
        **(known if errs else {}),
    )
    card = {"architecture": "reduced", "held_out": {"largest_error": {"mean": 2e-3}}}
    return Surrogate(body, maps, network, {**card, **({"discrepancy": {"places": 40.0}} if errs else {})})


def registrar(body: Body, pose: PosePrior | None = None, errs: bool = True) -> Registrar:
    model = surrogate(body, errs)
    every = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.7, minimum=1e-4), 0.1)
    across = np.flatnonzero(np.arange(every.size) % 3 > 0)  # along itself a straight side slides
    forces = every.combined(np.eye(every.size)[:, across])
    options = RegistrationOptions(localisation=SparseLocalisation(rounds=0))
    return Registrar(model, SurfaceDistance(body, body.surfaces["observed"]), forces, options, pose=pose)


def truth_of(body: Body, seed: int, errs: bool = True) -> np.ndarray:
    """A state under some forces at the tip, with errors of the model like those that it was seen to make."""
    chance, tip = np.random.default_rng(seed), body.node_sets["tip"]
    forces = np.zeros_like(body.points)
    forces[tip, 1:] = 0.01 * chance.standard_normal(2) + 0.002 * chance.standard_normal((len(tip), 2))
    model = surrogate(body)
    moved = model.solve(forces).displacement
    size = np.linalg.norm(moved, axis=1).max() if errs else 0.0
    return moved + size * (model.encoder_decoder.error_modes @ chance.standard_normal(2)).reshape(-1, 3)


@pytest.fixture
def closely(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The processor's search ends where nothing is left."""
    monkeypatch.setattr(one_by_one, "_FLAT", 1e-8)
    monkeypatch.setattr(one_by_one, "_GAIN", 1e-16)
    monkeypatch.setattr(one_by_one, "_STEPS", 100)
    with varied("summed", 1e-6):
        yield


def two_frames(made: Registrar, body: Body, seed: int, errs: bool) -> tuple[Registration, Registration, np.ndarray]:
    """A registered cloud, the next one of the same state, and the points of that."""
    rng = np.random.default_rng(seed)
    truth = truth_of(body, seed, errs)
    first = made.register(cloud_on(body, truth, 400, rng, NOISE_M))
    cloud = cloud_on(body, 1.02 * truth, 400, rng, NOISE_M)
    return first, made.track(cloud, first), cloud


# ---------------------------------------------------------------------- pieces


@pytest.mark.parametrize("device", DEVICES)
def test_closest_points_are_those_of_the_tree(body: Body, device: str) -> None:
    """About a surface that is twisted, torn apart, or has needles; far away, near, and on it."""
    rng = np.random.default_rng(0)
    observed = SurfaceDistance(body, body.surfaces["observed"])
    surfaces = [observed.rest + spread * rng.standard_normal(observed.rest.shape) for spread in (0.0, 0.02, 0.3)]
    needles = observed.rest.copy()
    needles[observed.triangles[::3, 1]] = needles[observed.triangles[::3, 0]]
    surfaces.append(needles)
    clouds = []
    for surface in surfaces:
        corners = surface[observed.triangles[rng.integers(len(observed.triangles), size=200)]]
        on_it = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), 200), corners)
        clouds.append(np.vstack([on_it + 0.01 * rng.standard_normal(on_it.shape), 2.0 * on_it, on_it[:50]]))
    found = ClosestPoints(torch.from_numpy(observed.triangles), 1e-12, device).match(
        torch.from_numpy(np.array(surfaces)).to(device), torch.from_numpy(np.array(clouds)).to(device)
    )
    tree = TriangleTree(observed.rest, observed.triangles)
    for i, (surface, cloud) in enumerate(zip(surfaces, clouds, strict=True)):
        triangles, weights = tree.closest(surface, cloud, None)
        distances, _ = signed_distances(surface, observed.triangles[triangles], weights, cloud, 1e-12)
        here = found.distances[i].cpu().numpy()
        np.testing.assert_allclose(np.abs(here), np.abs(distances), atol=1e-12)
        corners = surface[observed.triangles[found.triangles[i].cpu().numpy()]]
        foot = np.einsum("pk,pki->pi", found.weights[i].cpu().numpy(), corners)
        np.testing.assert_allclose(np.linalg.norm(foot - cloud, axis=1), np.abs(distances), atol=1e-12)
        off = np.abs(here) > 1e-9
        np.testing.assert_allclose(
            (cloud + here[:, None] * found.directions[i].cpu().numpy())[off], foot[off], atol=1e-9
        )


def problems() -> tuple[Sums, Hyperpriors, list[one_by_one.Evidence]]:
    """Three problems with two groups of points and six unknowns, in both forms."""
    rng = np.random.default_rng(1)
    believed = [
        LogNormalPrior(1e-3, 1.5, 1e-4),
        LogNormalPrior(0.5, 0.7, 1e-3),
        LogNormalPrior(1.0, 0.25, 0.3, spread_below=1.0),
    ]
    prior = one_by_one.Hyperprior.of(believed)
    slopes, logs = np.zeros((3, 6)), np.array([0.0, 0.0, 0.0, 0.0, -1.0, -2.0])
    slopes[1, :3] = slopes[2, 3:] = 2.0
    sums, every = [], []
    for _ in range(3):
        error = rng.uniform(5e-4, 2e-3, 2)
        parts = [
            (rng.standard_normal((40, 6)), 1.5e-3 * rng.standard_normal(40), rng.uniform(0.3, 1.0, 40)) for _ in error
        ]
        parts = [(b, y + b @ (0.001 * rng.standard_normal(6)), w) for b, y, w in parts]
        linear = one_by_one.LinearProblem(
            np.array([b.T @ (w[:, None] * b) for b, _, w in parts]),
            np.array([b.T @ (w * y) for b, y, w in parts]),
            np.array([y @ (w * y) for _, y, w in parts]),
            np.array([w.sum() for *_, w in parts]),
            rng.uniform(1e-6, 2e-6, 2),
        )

        def noise(eta: np.ndarray, error: np.ndarray = error) -> tuple[np.ndarray, np.ndarray]:
            own, beside = np.exp(2.0 * eta[0]), np.exp(2.0 * eta[2]) * error**2
            by = np.zeros((3, 2))
            by[0], by[2] = 2.0 * own / (own + beside), 2.0 * beside / (own + beside)
            return np.log(own + beside), by

        every.append(one_by_one.Evidence(linear, noise, lambda eta: (eta @ slopes + logs, slopes), prior))
        sums.append((linear.information, linear.projection, linear.square, linear.count, linear.tail, error))
    stacked = Sums(*(torch.from_numpy(np.array(each)) for each in zip(*sums, strict=True)))
    arrays = (prior.median, prior.spread, prior.below, prior.lowest, prior.highest, slopes, logs)
    return stacked, Hyperpriors(*map(torch.from_numpy, arrays)), every


def test_the_evidence_is_the_same(closely: None) -> None:
    sums, priors, every = problems()
    eta = torch.from_numpy(np.random.default_rng(2).normal(priors.median.numpy(), 0.3, (3, 3)))
    law = law_of(sums, priors, eta)
    slopes = slope_of(sums, priors, eta, law)
    for i, each in enumerate(every):
        at = eta[i].numpy()
        np.testing.assert_allclose(slopes[i], each.value(at)[1], rtol=1e-9, atol=1e-9)
        there = each.conditional(at)
        assert there is not None
        np.testing.assert_allclose(law.inverse[i], there.inverse, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(law.mean[i], there.mean, rtol=1e-9, atol=1e-12)


def test_scoring_ends_at_the_maximum(closely: None) -> None:
    sums, priors, every = problems()
    eta = priors.median.expand(3, 3)
    for _ in range(60):
        eta, left = scored(sums, priors, eta, law_of(sums, priors, eta))
    assert (left < 1e-7).all()
    found = scale_covariance(sums, priors, eta)
    for i, each in enumerate(every):
        best = each.maximum([priors.median.numpy()])
        np.testing.assert_allclose(eta[i], best, atol=1e-6)
        np.testing.assert_allclose(found[i], each.covariance(best), rtol=1e-4, atol=1e-8)


def test_eigenvectors_of_three_by_three() -> None:
    rng = np.random.default_rng(0)
    made = rng.standard_normal((20, 3, 3)) * 10.0 ** rng.uniform(-3.0, 3.0, (20, 1, 1))
    made = made + made.transpose(0, 2, 1)
    made[0], made[1] = np.eye(3), np.diag([2.0, 2.0, 1.0])
    values, vectors = (each.numpy() for each in eigen(torch.from_numpy(made)))
    np.testing.assert_allclose(vectors @ (values[:, :, None] * vectors.transpose(0, 2, 1)), made, atol=1e-10)
    sizes = np.abs(made).max(axis=(1, 2))
    np.testing.assert_allclose(np.sort(values) / sizes[:, None], np.linalg.eigvalsh(made) / sizes[:, None], atol=1e-12)


# ---------------------------------------------------------------------- the whole


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("errs", [True, False])
@pytest.mark.parametrize("pose", POSES)
def test_the_objective_is_the_registrars(body: Body, closely: None, device: str, pose: str, errs: bool) -> None:
    """Where the device has ended, the processor finds the same model of it, the same scales, and no way on."""
    made = registrar(body, POSES[pose], errs)
    for seed in range(3):
        first, second, cloud = two_frames(made, body, seed, errs)
        frames = DeviceFrames(arrays_of(made.setup, first), 1, 500, device)
        found = frames.register([cloud], start_of(first))
        assert found.has_converged[0]
        there, problem = frames._search.local, second.problem.unshared
        at, eta = there.at[0].cpu().numpy(), second.eta.copy()
        eta[OWN] = there.eta[0].cpu().numpy()
        noise = float(there.point_noise[0])
        evaluation = problem.evaluation(at)
        local = LocalModel(problem, evaluation, Tukey(), noise, starts=[eta], point_noise=noise, is_held=True)
        np.testing.assert_allclose(there.weights[0, : len(cloud)].cpu(), local.weights, atol=1e-4)
        np.testing.assert_allclose(float(there.value[0]), local.value, rtol=1e-4)
        inverse = there.inverse[0].cpu().numpy()
        np.testing.assert_allclose(inverse, local.inverse, atol=3e-3 * np.abs(local.inverse).max())
        step = -inverse @ there.gradient[0].cpu().numpy()
        np.testing.assert_allclose(step, -local.inverse @ local.gradient, atol=1e-3 * np.sqrt(np.diag(inverse)).max())
        told = uncertainty(
            problem,
            problem.evaluation(found.start.coefficients[0]),
            posterior(local),
            second.prepared.unseen,
            second.frame,
        )
        margin = told.margin()
        np.testing.assert_allclose(found.margin[0], margin, atol=3e-3 * margin.max())
        sought = LocalModel(problem, evaluation, Tukey(), noise, starts=[eta], point_noise=noise)
        spread = np.sqrt(np.maximum(np.diag(sought.evidence.covariance(sought.eta)), 1e-6))
        assert (np.abs(sought.eta - eta) < 0.3 * spread).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("errs", [True, False])
@pytest.mark.parametrize("pose", POSES)
def test_states_and_margins_are_the_registrars(body: Body, device: str, pose: str, errs: bool) -> None:
    made = registrar(body, POSES[pose], errs)
    for seed in range(3):
        first, second, cloud = two_frames(made, body, seed, errs)
        frames = DeviceFrames(arrays_of(made.setup, first), 1, 500, device)
        found = frames.register([cloud], start_of(first))
        assert not second.solved.has_shared_noise
        margin, seen = second.uncertainty.margin(), second.camera_uncertainty.margin()
        off = np.linalg.norm(found.displacement[0] - second.displacement, axis=1)
        assert off.mean() < 0.2 * margin.mean()  # searches end where no more is left
        assert found.margin[0].mean() == pytest.approx(margin.mean(), rel=0.2)
        assert found.rms_distance[0] == pytest.approx(second.rms_distance, rel=0.02)
        local = second.solved.local  # its scales are those before the registrar's last step
        renewed = LocalModel(
            local.problem, local.evaluation, Tukey(), local.noise, starts=[local.eta], point_noise=local.point_noise
        )
        assert found.noise[0] == pytest.approx(renewed.noise, rel=0.02)
        posed, told = second.evaluation.pose or Pose.identity(), Pose(found.rotation[0], found.translation[0])
        assert told.distance_to(posed, body.points) < 0.5 * seen.mean()


def batch_of(body: Body, count: int = 4) -> tuple[Registrar, list[np.ndarray], list[np.ndarray]]:
    rng = np.random.default_rng(5)
    truths = [truth_of(body, seed) for seed in range(count)]
    clouds = [cloud_on(body, u, 300 + 50 * i, rng, NOISE_M) for i, u in enumerate(truths)]
    return registrar(body), truths, clouds


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("execution", ["graphs", "compiled"])
def test_a_gpu_that_replays_gives_the_same(body: Body, execution: Execution) -> None:
    made, _, clouds = batch_of(body, 1)
    arrays = arrays_of(made.setup, made.register(clouds[0]))
    every = [DeviceFrames(arrays, 1, 400, "cuda", execution=each) for each in ("eager", execution)]  # type: ignore[arg-type]
    for _ in range(2):
        one, other = (frames.register(clouds) for frames in every)
        np.testing.assert_allclose(other.displacement, one.displacement, atol=1e-8)
        np.testing.assert_allclose(other.margin, one.margin, atol=1e-8)


def test_all_of_it_can_be_compiled(body: Body) -> None:
    """As one graph without breaks, by what compilers are given; the operations stay those of torch here."""
    made, _, clouds = batch_of(body, 1)
    arrays = arrays_of(made.setup, made.register(clouds[0]))
    plain, traced = (DeviceFrames(arrays, 1, 400) for _ in range(2))
    for name in ("_iteration", "_concluded"):
        setattr(traced, name, torch.compile(getattr(traced, name), backend="eager", fullgraph=True, dynamic=False))
    one, other = (frames.register(clouds) for frames in (plain, traced))
    np.testing.assert_allclose(other.displacement, one.displacement, atol=1e-10)


@pytest.mark.parametrize("device", DEVICES)
def test_a_cloud_in_a_batch_is_registered_as_if_alone(body: Body, device: str) -> None:
    """Clouds of different numbers of points, from rest and then tracked."""
    made, truths, clouds = batch_of(body)
    arrays = arrays_of(made.setup, made.register(clouds[0]))
    many, one = (DeviceFrames(arrays, size, 500, device) for size in (len(clouds), 1))
    together = many.register(clouds)
    tracked = many.register(clouds, together.start)
    for i, cloud in enumerate(clouds):
        alone = one.register([cloud])
        after = one.register([cloud], alone.start)
        for found, single in ((together, alone), (tracked, after)):
            np.testing.assert_allclose(found.displacement[i], single.displacement[0], atol=1e-8)
            np.testing.assert_allclose(found.margin[i], single.margin[0], atol=1e-8)
            assert found.has_converged[i]
        missed = np.linalg.norm(together.displacement[i] - truths[i], axis=1)
        assert np.mean(missed <= together.margin[i] + 1e-12) > 0.8


def test_outliers_pull_nothing(body: Body) -> None:
    made, truths, clouds = batch_of(body, 1)
    rng = np.random.default_rng(0)
    off = rng.uniform(body.points.min(axis=0) - 0.05, body.points.max(axis=0) + 0.05, (60, 3))
    arrays, cloud = arrays_of(made.setup, made.register(clouds[0])), np.vstack([clouds[0], off])
    found, other = DeviceFrames(arrays, 1, 400).register([cloud]), made.register(cloud)
    assert 0.08 < found.outliers[0] < 0.2  # those that the search began without, too
    assert found.outliers[0] == pytest.approx(other.outliers, abs=0.02)
    missed = np.linalg.norm(found.displacement[0] - truths[0], axis=1)
    assert np.mean(missed <= found.margin[0] + 1e-12) > 0.8


def test_where_a_search_has_not_ended_no_last_step_is_taken(body: Body) -> None:
    """It would be as long as any, and nobody has looked whether it leads to anything better."""
    made, _, clouds = batch_of(body, 1)
    arrays = arrays_of(made.setup, made.register(clouds[0]))
    with varied("iterations", 0.01):
        frames = DeviceFrames(arrays, 1, 400)
        found = frames.register(clouds)
    assert not found.has_converged[0]
    np.testing.assert_array_equal(found.start.coefficients, frames._search.local.at.numpy())
    with varied("points", 0.4):
        assert DeviceFrames(arrays).points == ACCURACY.points == 400


def test_noise_that_neighbours_share_is_named(body: Body) -> None:
    made, _, clouds = batch_of(body)
    arrays = arrays_of(made.setup, made.register(clouds[0]))
    frames = DeviceFrames(arrays, len(clouds), 500)
    plain = frames.register(clouds)
    assert not plain.may_share_noise.any()
    waves = [0.004 * np.sin(25.0 * cloud[:, :1] + phase) * np.ones(3) for phase, cloud in enumerate(clouds)]
    shared = frames.register([cloud + wave for cloud, wave in zip(clouds, waves, strict=True)], plain.start)
    assert shared.may_share_noise.all()


def test_arrays_come_back_from_a_file(body: Body, tmp_path: Path) -> None:
    made, _, clouds = batch_of(body, 1)
    arrays = arrays_of(made.setup, made.register(clouds[0]))
    arrays.save(tmp_path / "arrays.safetensors")
    read = DeviceArrays.load(tmp_path / "arrays.safetensors")
    one, other = (DeviceFrames(each, 1, 400).register(clouds) for each in (arrays, read))
    np.testing.assert_array_equal(one.displacement, other.displacement)
    np.testing.assert_array_equal(one.margin, other.margin)


def test_a_machine_with_torch_alone_registers(body: Body, tmp_path: Path) -> None:
    """In a process that refuses to import what such a machine lacks."""
    made, _, clouds = batch_of(body, 1)
    arrays_of(made.setup, made.register(clouds[0])).save(tmp_path / "arrays.safetensors")
    np.save(tmp_path / "cloud.npy", clouds[0])
    program = f"""{refusing(KEPT_OUT)}
import numpy as np
from softtwin.registration.device.arrays import DeviceArrays
from softtwin.registration.device.frames import DeviceFrames

frames = DeviceFrames(DeviceArrays.load({str(tmp_path / "arrays.safetensors")!r}), 1, 400)
print(bool(frames.register([np.load({str(tmp_path / "cloud.npy")!r})]).has_converged[0]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == "True"


# ---------------------------------------------------------------------- bad input


def test_what_is_not_registered_on_a_device_is_refused(body: Body) -> None:
    made, _, clouds = batch_of(body, 1)
    places = made.observed.rest[:3]
    with_marks = made.with_terms(LandmarkPairs.of(made.observed, places, places))
    with pytest.raises(ValueError, match="landmarks or normals"):
        arrays_of(made.setup, with_marks.register(clouds[0]))
    exact = Registrar(Cantilever(body), made.observed, made.forces)
    with pytest.raises(ValueError, match="a trained network with few values"):
        arrays_of(exact.setup, exact.register(clouds[0]))


@pytest.mark.parametrize(
    ("clouds", "match"),
    [
        ([np.zeros((100, 3))] * 2, "clouds: expected 1, got 2"),
        ([np.zeros((100, 2))], r"clouds\[0\]: expected \(p, 3\)"),
        ([np.zeros((5, 3))], "with 30 to 400 points"),
        ([np.zeros((500, 3))], "with 30 to 400 points"),
        ([np.full((100, 3), np.nan)], "expected finite numbers"),
    ],
)
def test_other_clouds_are_refused(body: Body, clouds: list[np.ndarray], match: str) -> None:
    made, _, good = batch_of(body, 1)
    frames = DeviceFrames(arrays_of(made.setup, made.register(good[0])), 1, 400)
    with pytest.raises(ValueError, match=match):
        frames.register(clouds)


def test_other_arguments_are_refused(body: Body) -> None:
    made, _, clouds = batch_of(body, 1)
    arrays = arrays_of(made.setup, made.register(clouds[0]))
    with pytest.raises(ValueError, match="expected a batch of 1"):
        DeviceFrames(arrays, 0)
    with pytest.raises(ValueError, match="confidence"):
        DeviceFrames(arrays, confidence=1.0)
    with pytest.raises(ValueError, match="execution"):
        DeviceFrames(arrays, execution="fast")  # type: ignore[arg-type]
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="expected a GPU that torch can use"):
            DeviceFrames(arrays, device="cuda")
    start: Start = DeviceFrames(arrays, 1, 400).register(clouds).start
    with pytest.raises(ValueError, match=r"start\.coefficients"):
        DeviceFrames(arrays, 1, 400).register(clouds, Start(start.coefficients[:, 1:], start.eta, start.moved))


@pytest.mark.parametrize("kind", ["empty", "short", "other"])
def test_other_files_are_refused(body: Body, tmp_path: Path, kind: str) -> None:
    made, _, clouds = batch_of(body, 1)
    path = tmp_path / "arrays.safetensors"
    arrays_of(made.setup, made.register(clouds[0])).save(path)
    if kind == "other":
        from safetensors.numpy import save_file

        save_file({"a": np.zeros(3)}, path)
    else:
        path.write_bytes(b"" if kind == "empty" else path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"DeviceArrays\.load"):
        DeviceArrays.load(path)


def test_a_cloud_that_is_nowhere_near_is_refused(body: Body) -> None:
    """Millimetres, another place, one point again and again: no search is begun that could call itself converged."""
    made, _, clouds = batch_of(body, 1)
    frames = DeviceFrames(arrays_of(made.setup, made.register(clouds[0])), 1, 400)
    start = frames.register(clouds).start
    for begin in (None, start):
        for wrong in (1000.0 * clouds[0], clouds[0] + np.array([0.0, 0.0, 50.0])):
            with pytest.raises(ValueError, match="is it in metres"):
                frames.register([wrong], begin)
        with pytest.raises(ValueError, match="got 1 places"):
            frames.register([np.repeat(clouds[0][:1], 100, axis=0)], begin)
