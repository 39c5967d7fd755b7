"""A new residual term and a new parameter block, each from this file alone: exact derivatives, estimates, checks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array

from softtwin.meshes.body import Body
from softtwin.registration.evaluation import Evaluation, Slopes
from softtwin.registration.forward import reduce_model
from softtwin.registration.hyperparameters import LogNormalPrior
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import RegistrationOptions, SparseLocalisation
from softtwin.registration.parameters.block import Estimate, FieldBlock, ParameterBlock, estimate
from softtwin.registration.parameters.nodal_forces import nodal_forces
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose
from softtwin.registration.problem import Problem
from softtwin.registration.registrar import Registrar
from softtwin.registration.residuals.term import ResidualTerm
from softtwin.registration.surface_distance import Correspondence, SurfaceDistance
from softtwin.registration.verdict import Code, Verdict

from .conftest import Cantilever, cloud_on, tip_forces

Floats = NDArray[np.float64]
NET = (0.3, 0.3, -0.8)
TRUE_GROWTH, NOISE = 0.02, 5e-4


@dataclass(frozen=True, eq=False)
class KnownPlane(ResidualTerm):
    """Observed nodes that are known to lie on a plane of the camera's coordinates: a wall that the organ leans on.

    Args:
        nodes: their places among the observed nodes, (q,).
        normal: of the plane, a unit vector, (3,).
        offset: of the plane from the origin along it, metres.
        deviation: standard deviation of a node's distance, metres.
    """

    nodes: NDArray[np.int64]
    normal: Floats
    offset: float
    deviation: float

    def _places(self, at: Evaluation) -> Floats:
        return at.observed.body.points[at.observed.nodes[self.nodes]] + at.positions[self.nodes]

    def values(self, at: Evaluation, held: Correspondence | None = None) -> Floats:
        places = self._places(at)
        seen = places if at.pose is None else at.pose.apply(places)
        return (seen @ self.normal - self.offset) / self.deviation

    def slopes(self, at: Evaluation, held: Correspondence | None = None) -> Slopes:
        count, along = len(self.nodes), self.normal @ at.rotation / self.deviation
        columns = (3 * self.nodes[:, None] + np.arange(3)).ravel()
        shape = (count, 3 * len(at.observed.nodes))
        rows = csr_array((np.tile(along, count), columns, np.arange(0, 3 * count + 1, 3)), shape=shape)
        return Slopes(rows, np.tile(along, (count, 1)), self._places(at))


class Growth(FieldBlock):
    """The organ has grown about its middle since it was segmented, all of it alike.

    Args:
        observed: the observed side.
        deviation: standard deviation of the growth, relative.
    """

    def __init__(self, observed: SurfaceDistance, deviation: float) -> None:
        points = observed.body.points
        super().__init__((points - points.mean(axis=0)).reshape(-1, 1), observed, deviation)

    def estimates(self, mean: Floats, covariance: Floats) -> tuple[Estimate, ...]:
        return (estimate("growth", "", lambda c: self.amplitude * c, float(mean[0]), float(covariance[0, 0])),)


class Tilt(FieldBlock):
    """Two bends of which nothing is said beyond what they do."""

    def __init__(self, observed: SurfaceDistance) -> None:
        along = observed.body.points[:, 0]
        modes = np.zeros((len(along), 3, 2))
        modes[:, 1, 0], modes[:, 2, 1] = along, along
        super().__init__(modes.reshape(-1, 2), observed, 0.01)


def registrar(body: Body, *, pose: PosePrior | None = None, blocks: tuple[ParameterBlock, ...] = ()) -> Registrar:
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5, minimum=1e-4))
    options = RegistrationOptions(localisation=SparseLocalisation(rounds=0))
    return Registrar(
        Cantilever(body), SurfaceDistance(body, body.surfaces["observed"]), forces, options, pose=pose, blocks=blocks
    )


def wall(observed: SurfaceDistance, pose: Pose, offset: float = 0.0) -> KnownPlane:
    """The plane on which the fixed end stands, as the camera has it."""
    at_root = np.flatnonzero(observed.body.points[observed.nodes, 0] < 1e-9)
    normal = pose.rotation @ np.array([1.0, 0.0, 0.0])
    return KnownPlane(at_root, normal, float(normal @ pose.apply(np.zeros((1, 3)))[0]) + offset, 2e-4)


TURNED = Pose.identity().moved(np.array([0.1, -0.05, 0.02, 0.01, 0.0, -0.02]), np.zeros(3))


def test_derivatives_of_both_are_exact(body: Body, rng: np.random.Generator) -> None:
    model, observed = Cantilever(body), SurfaceDistance(body, body.surfaces["observed"])
    forces = nodal_forces(body, body.node_sets["tip"], LogNormalPrior(0.05, 0.5), smoothness=0.1)
    prior = PosePrior(TURNED, body.points.mean(axis=0), 0.05, 0.01)
    cloud = TURNED.apply(cloud_on(body, model.solve(tip_forces(body, NET)).displacement, 60, rng, 1e-3))
    reduced, plane = reduce_model(model, observed.nodes, forces.basis), wall(observed, TURNED)
    blocks = (forces, prior, Growth(observed, 0.05))
    problem = Problem.of(reduced, observed, cloud, LogNormalPrior(1e-3, 1.0), blocks, (plane,))
    assert problem.size == forces.size + 6 + 1 and problem.moving.stop == problem.size
    at = 0.1 * rng.standard_normal(problem.size)
    evaluation, step = problem.evaluation(at), 1e-6
    slopes = plane.slopes(evaluation)
    jacobian = problem.jacobian(evaluation, slopes)
    for column in range(problem.size):
        change = step * np.eye(problem.size)[column]
        ahead, behind = (problem.evaluation(at + sign * change, evaluation) for sign in (1.0, -1.0))
        wanted = (plane.values(ahead) - plane.values(behind)) / (2.0 * step)
        np.testing.assert_allclose(jacobian[:, column], wanted, atol=1e-6 * np.abs(jacobian).max())
    cotangent = rng.standard_normal(len(jacobian))
    np.testing.assert_allclose(problem.vjp(evaluation, cotangent, slopes), cotangent @ jacobian, rtol=1e-9, atol=1e-9)
    of_points = problem.jacobian(evaluation)
    pulled = rng.standard_normal(len(cloud))
    np.testing.assert_allclose(problem.vjp(evaluation, pulled), pulled @ of_points, rtol=1e-9, atol=1e-9)
    direction = np.eye(problem.size)[-1]  # growth moves the distances, too
    ahead, behind = (problem.evaluation(at + sign * step * direction, evaluation) for sign in (1.0, -1.0))
    stays = (ahead.match.triangles == evaluation.match.triangles) & (
        behind.match.triangles == evaluation.match.triangles
    )
    wanted = (ahead.match.distances - behind.match.distances) / (2.0 * step)
    np.testing.assert_allclose(of_points[stays, -1], wanted[stays], rtol=1e-4, atol=1e-6)


def test_a_known_plane_tells_what_the_cloud_does_not(body: Body) -> None:
    """How far the beam stands along itself: points of two long sides hardly say it."""
    pose = PosePrior(Pose.identity(), body.points.mean(axis=0), 0.1, 0.03)
    made, truth = registrar(body, pose=pose), Cantilever(body).solve(tip_forces(body, NET)).displacement
    far, near, doubt = [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        cloud = TURNED.apply(cloud_on(body, truth, 200, rng, 2e-3))
        plain, told = made.register(cloud), made.with_terms(wall(made.observed, TURNED)).register(cloud)
        middle = body.points.mean(axis=0, keepdims=True)
        off = [
            abs(((found.pose.apply(middle) - TURNED.apply(middle)) @ TURNED.rotation)[0, 0]) for found in (plain, told)
        ]
        far.append(off[0])
        near.append(off[1])
        along = TURNED.rotation @ np.array([1.0, 0.0, 0.0])
        at_root = body.fixed[0]
        doubt.append([along @ found.camera_uncertainty.covariances()[at_root] @ along for found in (plain, told)])
        (check,) = (each for each in told.judgement.checks if each.code is Code.RESIDUAL_TERM)
        assert told.judgement.is_usable and check.is_passed and check.subject == "KnownPlane"
    assert np.mean(near) < 0.3 * np.mean(far)
    assert all(known < 0.1 * unknown for unknown, known in doubt)


def test_a_plane_where_there_is_none_is_doubtful(body: Body, rng: np.random.Generator) -> None:
    made = registrar(body)
    cloud = cloud_on(body, Cantilever(body).solve(tip_forces(body, NET)).displacement, 400, rng, NOISE)
    found = made.with_terms(wall(made.observed, Pose.identity(), 0.02)).register(cloud)
    (check,) = (each for each in found.judgement.checks if each.code is Code.RESIDUAL_TERM)
    assert not check.is_passed and check.p_value is not None and check.p_value < 1e-5
    assert found.judgement.verdict is not Verdict.ACCEPTED
    assert any(reason.startswith("KnownPlane: residuals are") for reason in found.judgement.reasons)


@pytest.mark.parametrize("solver", ["gauss-newton", "lbfgs"])
def test_growth_is_found_beside_the_forces(body: Body, rng: np.random.Generator, solver: str) -> None:
    moved = Cantilever(body).solve(tip_forces(body, NET)).displacement
    truth = moved + TRUE_GROWTH * (body.points - body.points.mean(axis=0))
    cloud = cloud_on(body, truth, 600, rng, NOISE)
    observed = SurfaceDistance(body, body.surfaces["observed"])
    plain, made = registrar(body), registrar(body, blocks=(Growth(observed, 0.05),))
    if solver == "lbfgs":
        options = RegistrationOptions(solver=LBFGS(), localisation=SparseLocalisation(rounds=0))
        made.setup = replace(made.setup, options=options)
    without, found = plain.register(cloud), made.register(cloud)
    (growth,) = found.estimates
    assert growth.name == "growth" and found.judgement.is_usable
    assert growth.value == pytest.approx(TRUE_GROWTH, abs=0.002)
    assert growth.interval[0] < TRUE_GROWTH < growth.interval[1] and growth.variance_reduction > 0.9
    error = np.linalg.norm(found.displacement - truth, axis=1)
    assert error.mean() < 0.3 * np.linalg.norm(without.displacement - truth, axis=1).mean()
    assert np.mean(error < found.uncertainty.margin()) > 0.8
    assert (found.uncertainty.deviation > 0.0).sum() >= len(body.points) - 1  # the middle alone does not grow
    again = made.register(cloud_on(body, truth, 600, rng, NOISE), found)  # the next frame starts from it
    assert again.estimates[0].value == pytest.approx(growth.value, abs=0.002)


def test_a_block_that_says_nothing_of_itself_is_told_and_checked(body: Body, rng: np.random.Generator) -> None:
    """Each coefficient in deviations, under the name of its class; far off, it makes a result doubtful."""
    observed = SurfaceDistance(body, body.surfaces["observed"])
    made = registrar(body, blocks=(Tilt(observed),))
    still = made.register(cloud_on(body, np.zeros_like(body.points), 600, rng, NOISE))
    assert [known.name for known in still.estimates] == ["Tilt 1", "Tilt 2"]
    assert {known.unit for known in still.estimates} == {"deviations"}
    told = [each for each in still.judgement.checks if each.code is Code.PARAMETER]
    assert [each.subject for each in told] == ["Tilt 1", "Tilt 2"] and all(each.is_passed for each in told)
    tilted = np.zeros_like(body.points)
    tilted[:, 2] = 0.08 * body.points[:, 0]
    found = made.register(cloud_on(body, tilted, 600, rng, NOISE))
    assert found.estimates[1].deviations > 3.0
    assert [each.subject for each in found.judgement.checks if each.code is Code.PARAMETER and not each.is_passed] == [
        "Tilt 2"
    ]
    assert found.judgement.verdict is not Verdict.ACCEPTED


def test_growth_that_nobody_expects_is_doubtful(body: Body, rng: np.random.Generator) -> None:
    truth = 0.1 * (body.points - body.points.mean(axis=0))
    made = registrar(body, blocks=(Growth(SurfaceDistance(body, body.surfaces["observed"]), 0.01),))
    found = made.register(cloud_on(body, truth, 600, rng, NOISE))
    (check,) = (each for each in found.judgement.checks if each.code is Code.PARAMETER)
    assert check.subject == "growth" and check.verdict is Verdict.DOUBTFUL
    assert found.judgement.verdict is not Verdict.ACCEPTED
