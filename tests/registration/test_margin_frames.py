"""A margin stands in the coordinates in which the position is written: the body's, or the camera's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import embed
from softtwin.meshes.shapes import beam
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.laplace import posterior
from softtwin.registration.local_model import LocalModel
from softtwin.registration.loss import Square
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.parameters.nodal_forces import NodalForces, nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar
from softtwin.registration.result import Registration
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import Cantilever, cloud_on

NOISE, FORCE = 1e-3, 0.01
TRANSLATION = 4e-3  # prior deviation of the pose's shift, metres
LOST = 1e-9  # radians: a turn as good as known
CAMERA = Pose(Rotation.from_rotvec([0.3, -0.9, 1.4]).as_matrix(), np.array([0.05, -0.1, 0.4]))


@dataclass(frozen=True, eq=False)
class Shifted:
    """A body that a force moves as a whole, by a metre for a newton: what it does to a cloud, a pose does as well."""

    body: Body
    displacement: np.ndarray
    error: float = 0.0
    discrepancy: None = None
    negative_pivots: int = 0
    extrapolation_ratio: None = None

    def solve(self, forces: ArrayLike, near: Any = None) -> Shifted:
        return replace(self, displacement=np.ones_like(self.body.points) * np.asarray(forces).sum(axis=0))

    def jvp(self, changes: ArrayLike) -> np.ndarray:
        moved = np.asarray(changes).reshape(len(self.body.points), 3, -1).sum(axis=0)
        return np.tile(moved, (len(self.body.points), 1))

    def vjp(self, cotangent: ArrayLike) -> np.ndarray:
        return np.ones_like(self.body.points) * np.asarray(cotangent).sum(axis=0)


def options(distance: str = "surface") -> RegistrationOptions:
    """Noise known, least squares: the posterior is the normal law of the linearised problem."""
    return RegistrationOptions(
        noise=LogNormalPrior(NOISE, 0.0),
        solver=GaussNewton(losses=(Square(),)),
        localisation=SparseLocalisation(rounds=0),
        distance=distance,  # type: ignore[arg-type]
        correlated=False,
    )


def independent(found: Registration) -> Registration:
    """The same with the posterior of the derivatives at its own state, not at the one a last short step before."""
    local = found.local
    assert local is not None
    there = LocalModel(
        found.problem, found.evaluation, Square(), local.noise, starts=[local.eta], point_noise=local.point_noise
    )
    return replace(found, solved=replace(found.solved, posterior=posterior(there), local=there))


@pytest.mark.parametrize("force", [1e-3, 5e-3, 1e-1])
def test_what_a_shift_and_a_force_share_is_the_cameras_alone(rng: np.random.Generator, force: float) -> None:
    """a + t is seen, a and t are not: their posterior is known in closed form for every axis of a box.

    Points of noise s on the n faces across an axis tell a + t with variance s^2 / n. With prior variances A and T
    the camera's variance is 1 / (1 / (A + T) + n / s^2), and the body's A - A^2 / (A + T + s^2 / n).
    """
    box = beam((2, 2, 2), (0.3, 0.2, 0.1), "tetrahedron")
    body = replace(box, node_sets={})
    one = NodalForces(np.array([0]), np.eye(3), len(body.points), LogNormalPrior(force, 0.0))
    pose = PosePrior(CAMERA, body.points.mean(axis=0), LOST, TRANSLATION)
    observed = SurfaceDistance(body, None, "plane")
    made = Registrar(Shifted(body, np.zeros_like(body.points)), observed, one, options("plane"), pose=pose)
    corners = body.points[body.boundary]
    cloud = corners.mean(axis=1).repeat(20, axis=0) + NOISE * rng.standard_normal((20 * len(corners), 3))
    found = independent(made.register(CAMERA.apply(cloud)))
    normals = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    scales = found.posterior.scales  # those of a grid that are next to the ones known
    force = scales.force
    shares = scales.noise**2 / (20 * np.bincount(normals.argmax(axis=1), minlength=3))
    seen = 1.0 / (1.0 / (force**2 + TRANSLATION**2) + 1.0 / shares)
    own = force**2 - force**4 / (force**2 + TRANSLATION**2 + shares)
    camera = CAMERA.rotation @ np.diag(seen) @ CAMERA.rotation.T
    for node in (0, -1):
        np.testing.assert_allclose(found.uncertainty.covariances()[node], np.diag(own), atol=1e-6 * own.max())
        np.testing.assert_allclose(found.camera_uncertainty.covariances()[node], camera, atol=1e-6 * seen.max())


@pytest.fixture(scope="module")
def free(body: Body) -> Registrar:
    """A pose that is unknown, far from the identity."""
    return posed(body, is_said=False)


def posed(body: Body, *, is_said: bool) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(FORCE, 0.0), 0.1)
    prior = PosePrior(CAMERA, body.points.mean(axis=0), np.deg2rad(2.0), 5e-3, is_said)
    return Registrar(Cantilever(body), SurfaceDistance(body), forces, options(), pose=prior)


def drawn(made: Registrar, seed: int) -> tuple[np.ndarray, Pose, np.ndarray]:
    """A displacement and a pose as the priors have them, and a cloud of 200 points."""
    rng = np.random.default_rng(seed)
    assert made.pose is not None
    moved = made.model.solve(made.forces.forces(FORCE * rng.standard_normal(made.forces.size))).displacement
    pose = made.pose.pose(rng.standard_normal(6))
    surface = replace(made.model.body, surfaces={"observed": made.model.body.boundary})
    return moved, pose, pose.apply(cloud_on(surface, moved, 200, rng, NOISE))


def differences(found: Registration, places: Any) -> np.ndarray:
    """Derivative of places by all coefficients by central differences, (3n, k)."""
    steps, columns = 1e-5 / np.sqrt(found.local.precision), []  # type: ignore[union-attr]
    for number, step in enumerate(steps):
        change = step * np.eye(len(steps))[number]
        ahead, behind = (
            places(found.problem.evaluation(found.coefficients + sign * change, found.evaluation)) for sign in (1, -1)
        )
        columns.append((ahead - behind).ravel() / (2.0 * step))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("is_said", [False, True])
def test_each_frame_has_the_covariance_of_the_joint_posterior(body: Body, is_said: bool) -> None:
    """Against a dense computation: positions differentiated by differences, the posterior by an inverse."""
    made = posed(body, is_said=is_said)
    found = independent(made.register(drawn(made, 3)[2]))
    assert found.local is not None and made.pose is not None
    rest = body.points

    def in_body(at: Any) -> np.ndarray:
        return rest + at.state.full.displacement

    def in_camera(at: Any) -> np.ndarray:
        return at.pose.apply(in_body(at))

    slopes = found.problem.jacobian(found.evaluation) / found.noise  # has Taylor tests of its own
    joint = np.linalg.inv(slopes.T @ slopes + np.diag(found.local.precision))
    told = (lambda at: made.pose.mean.inverse().apply(in_camera(at))) if is_said else in_body  # type: ignore[union-attr]
    for law, places in ((found.uncertainty, told), (found.camera_uncertainty, in_camera)):
        by_unknowns = differences(found, places).reshape(len(rest), 3, -1)
        expected = by_unknowns @ joint @ by_unknowns.transpose(0, 2, 1)
        np.testing.assert_allclose(law.covariances(), expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(rest + found.displacement, told(found.evaluation), atol=1e-12)
    seen = found.pose.apply(rest + found.displacement)
    np.testing.assert_allclose(seen, in_camera(found.evaluation), atol=1e-12)


def test_margins_hold_in_both_frames(free: Registrar) -> None:
    """Truths from the priors, 80 clouds: a binomial share's three deviations, and two points for what is not linear.

    With the pose's part in it the margin of the camera's coordinates would hold hardly any place in the body's.
    """
    rest, inner = free.model.body.points, embed(free.model.body, np.array([[0.6, 0.1, 0.1]]))
    held: dict[str, list[bool]] = {"body": [], "camera": [], "mixed": []}
    for seed in range(80):
        moved, pose, cloud = drawn(free, seed)
        found = free.register(cloud)
        off = np.linalg.norm(inner.displace(found.displacement - moved)[0])
        seen = found.pose.apply(rest + found.displacement) - pose.apply(rest + moved)
        held["body"].append(off <= found.uncertainty.margin(inner)[0])
        held["camera"].append(np.linalg.norm(inner.displace(seen)[0]) <= found.camera_uncertainty.margin(inner)[0])
        held["mixed"].append(off <= found.camera_uncertainty.margin(inner)[0])
    doubt = 3.0 * np.sqrt(0.95 * 0.05 / 80) + 0.02
    assert np.mean(held["body"]) > 0.95 - doubt and np.mean(held["camera"]) > 0.95 - doubt
    assert np.mean(held["mixed"]) < 0.6


def test_an_exact_pose_only_turns_the_axes(body: Body, rng: np.random.Generator) -> None:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(FORCE, 0.0), 0.1)
    made = Registrar(Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces, options())
    found = made.register(cloud_on(body, np.zeros_like(body.points), 200, rng, NOISE)).seen_from(CAMERA)
    turned = CAMERA.rotation @ found.uncertainty.covariances() @ CAMERA.rotation.T
    np.testing.assert_allclose(found.camera_uncertainty.covariances(), turned, atol=1e-12 * turned.max())
    np.testing.assert_allclose(found.camera_uncertainty.margin(), found.uncertainty.margin(), rtol=1e-9)


def test_points_that_pull_nothing_are_in_no_figure_of_the_fit(body: Body, rng: np.random.Generator) -> None:
    """Twenty points a quarter of a metre above the body: the distance is that of the others, and they are counted."""
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(FORCE, 0.0), 0.1)
    made = Registrar(Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces)
    cloud = cloud_on(body, np.zeros_like(body.points), 400, rng, NOISE)
    alone = made.register(cloud)
    both = made.register(np.vstack([cloud, cloud[:20] + np.array([0.0, 0.0, 0.25])]))
    assert both.left_out == 20 and alone.left_out == 0 and len(both.explained) == 400
    assert both.rms_distance == pytest.approx(alone.rms_distance, rel=1e-2)
    assert both.evaluation.match.rms > 20.0 * both.rms_distance
