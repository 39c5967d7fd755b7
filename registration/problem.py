"""One cloud, one model, the unknowns: residuals and their derivative as a function of all coefficients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from .cloud import Cloud
from .evidence import Hyperprior, Variances
from .forward import ParametrisedModel, ParametrisedState, ReducedModel, ReducedState
from .hyperparameters import DISCREPANCY, FORCE, LENGTH, NOISE, SHARED, LogNormalPrior
from .landmarks import LandmarkPairs
from .parameter_blocks import ParameterBlocks
from .policy import POLICY
from .pose import Pose
from .priors import ModelError, NodalForces, PosePrior
from .residuals import Correspondence, SurfaceDistance, expected_distance
from .surface_modes import SurfaceModes

Floats = NDArray[np.float64]
_WATCHED = 300  # nodes whose movement limits a step
# Radians, of a measured normal across itself: cameras' are off by some 10 degrees, and flat triangles by some more.
NORMAL_DEVIATION = float(np.deg2rad(10.0))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The problem at one set of coefficients.

    Args:
        coefficients: of forces, pose, conditions, model error, shared noise, (k,).
        state: the body's state as the model has it.
        positions: displacement of the observed nodes with the model's error, (m, 3), metres.
        pose: from the body's coordinates to the cloud's; None where it is not unknown.
        cloud: points in the body's coordinates, (p, 3), metres.
        match: the cloud on the surface.
    """

    coefficients: Floats
    state: ReducedState
    positions: Floats
    pose: Pose | None
    cloud: Floats
    match: Correspondence
    _known: dict[Any, Floats] = field(default_factory=dict, init=False, repr=False)

    def once(self, key: Any, found: Callable[[], Floats]) -> Floats:
        """What depends on this trial alone, found when it is first asked for.

        Args:
            key: names it.
            found: finds it.
        """
        if key not in self._known:
            self._known[key] = found()
        return self._known[key]


@dataclass(frozen=True, eq=False)
class Problem:
    """What forces, and what pose, bring the observed side to a cloud.

    Args:
        model: reduced forward model between the force coefficients and the observed nodes.
        observed: the observed side.
        forces: the forces and their prior.
        pose: the pose and its prior; None where the cloud is in the body's coordinates.
        cloud: points, (p, 3), metres.
        noise: what is believed of the standard deviation of a point's distance, metres.
        error: what the model may get wrong; None where it is not known in patterns.
        parameter_blocks: unknowns beside the forces, which the model takes; None where there are none.
        landmarks: landmarks that pull beside the cloud; None where there are none.
        tangent_basis: two unit vectors across each point's measured normal, in the cloud's axes, (p, 2, 3): how far the
            surface leans towards them pulls, too; None for a cloud without normals.
        normal_deviation: standard deviation of that, radians.
        shared: modes of the noise that neighbouring points share; None where each point errs by itself.
    """

    model: ReducedModel
    observed: SurfaceDistance
    forces: NodalForces
    pose: PosePrior | None
    cloud: Floats
    noise: LogNormalPrior
    error: ModelError | None = None
    parameter_blocks: ParameterBlocks | None = None
    landmarks: LandmarkPairs | None = None
    tangent_basis: Floats | None = None
    normal_deviation: float = NORMAL_DEVIATION
    shared: SurfaceModes | None = None

    @classmethod
    def seen(cls, cloud: Cloud, **given: Any) -> Problem:
        """The problem of a cloud with its normals, where it has some.

        Args:
            cloud: points with or without normals.
            given: all other arguments.
        """
        return cls(cloud=cloud.points, tangent_basis=cloud.tangent_basis, **given)

    @property
    def size(self) -> int:
        """Number of coefficients: of forces, pose, conditions, model error and shared noise."""
        return self.noise_part.stop

    @cached_property
    def force_part(self) -> slice:
        """Where the force coefficients are."""
        return slice(0, self.forces.size)

    @cached_property
    def pose_part(self) -> slice:
        """Where those of the pose are."""
        return slice(self.forces.size, self.forces.size + (0 if self.pose is None else 6))

    @cached_property
    def parameter_part(self) -> slice:
        """Where those of the conditions are."""
        begin = self.pose_part.stop
        return slice(begin, begin + (0 if self.parameter_blocks is None else self.parameter_blocks.count))

    @cached_property
    def error_part(self) -> slice:
        """Where those of the model's error are."""
        begin = self.parameter_part.stop
        return slice(begin, begin + (0 if self.error is None else self.error.count))

    @cached_property
    def rest_part(self) -> slice:
        """Where those of what its patterns leave out are."""
        begin = self.error_part.stop
        return slice(begin, begin + (0 if self.error is None else len(self.error.rest_modes.values)))

    @cached_property
    def noise_part(self) -> slice:
        """Where those of the noise that neighbours share are."""
        begin = self.rest_part.stop
        return slice(begin, begin + (0 if self.shared is None else 3 * len(self.shared.values)))

    @cached_property
    def unshared(self) -> Problem:
        """The same without noise that neighbours share: its coefficients are the first of these."""
        return self if self.shared is None else replace(self, shared=None)

    def sized(self, coefficients: Floats) -> Floats:
        """Coefficients of the same with or without shared noise for this one, (k,): those of that noise come last."""
        if len(coefficients) == self.size:
            return coefficients
        found = np.zeros(self.size)
        found[: len(coefficients)] = coefficients[: self.size]
        return found

    def normals(self, evaluation: Evaluation) -> Floats:
        """Of the surface at the points, (p, 3), on the cloud's axes."""
        directions = evaluation.match.directions
        return directions if evaluation.pose is None else directions @ evaluation.pose.rotation.T

    def shared_noise(self, evaluation: Evaluation) -> Floats:
        """The part of the distances that is taken for noise that neighbours share, (p,), metres."""
        if self.shared is None:
            return np.zeros(len(self.cloud))
        field = self.shared.modes @ evaluation.coefficients[self.noise_part].reshape(3, -1).T
        shifts = self.observed.vectors_at(evaluation.match, field)
        found: Floats = np.einsum("pi,pi->p", shifts, evaluation.match.directions)
        return found

    def left_out(self, evaluation: Evaluation) -> Floats:
        """The part of the distances that is taken for what patterns of the model's error leave out, (p,), metres."""
        if self.error is None:
            return np.zeros(len(self.cloud))
        field = self.error.rest_modes.modes @ evaluation.coefficients[self.rest_part]
        return self.rough(evaluation) * self.observed.at_vertices(evaluation.match, field)

    def rough(self, evaluation: Evaluation) -> Floats:
        """Standard deviation of each distance by what the model gets wrong from point to point, (p,), metres.

        What its patterns leave out changes over some edges of the mesh, less than points of a cloud lie apart.
        """
        if self.error is None:
            return np.zeros(len(self.cloud))
        deviation = self.error.distance_deviation
        return evaluation.once((self.error, "rough"), lambda: self.observed.at_points(evaluation.match, deviation))

    def _by_distances(self, evaluation: Evaluation) -> Floats:
        """Derivative of the residuals by the coefficients that change the distances alone, (p, q)."""
        match, columns = evaluation.match, [np.zeros((len(self.cloud), 0))]
        if self.error is not None:
            corners = self.observed.triangles[match.triangles]
            columns.append(-self.rough(evaluation)[:, None] * self.error.rest_modes.at(corners, match.weights))
        if self.shared is not None:
            columns.append(self.by_shared_noise(evaluation))
        return np.hstack(columns)

    def by_shared_noise(self, evaluation: Evaluation) -> Floats:
        """Derivative of the residuals by the coefficients of the noise that neighbours share, (p, 3 q)."""
        assert self.shared is not None
        match = evaluation.match
        modes = self.shared.at(self.observed.triangles[match.triangles], match.weights)
        return np.hstack([-along[:, None] * modes for along in match.directions.T])

    def carried(self, coefficients: Floats, before: Problem) -> Floats:
        """Coefficients of another problem for a start of this one, (k,); what it did not have is zero.

        Args:
            coefficients: of the other problem.
            before: that problem, of the same kinds of forces, pose and conditions.
        """
        start = np.zeros(self.size)
        start[: self.parameter_part.stop] = coefficients[: before.parameter_part.stop]
        for mine, other in ((self.error_part, before.error_part), (self.noise_part, before.noise_part)):
            if mine.stop - mine.start == other.stop - other.start:
                start[mine] = coefficients[other]
        if self.rest_part.stop - self.rest_part.start == before.rest_part.stop - before.rest_part.start:
            start[self.rest_part] = coefficients[before.rest_part]
        return start

    @cached_property
    def hyperprior(self) -> Hyperprior:
        """What is believed of the hyperparameters, in their order."""
        one, scale = LogNormalPrior(1.0, 0.0), self.forces.scale
        none = LogNormalPrior(POLICY.shared_size, 0.0)
        priors = [self.noise, scale if self.forces.size else replace(scale, spread=0.0), none, one, one]
        if self.shared is not None:
            least = POLICY.shared_length_minimum * self.observed.edge
            median = max(POLICY.shared_length * np.sqrt(self.shared.area), least)
            longest = POLICY.shared_length_maximum * median
            priors[SHARED] = LogNormalPrior(
                POLICY.shared_size, POLICY.shared_size_spread, maximum=POLICY.shared_size_maximum
            )
            priors[LENGTH] = LogNormalPrior(median, POLICY.shared_length_spread, least, longest)
        if self.error is not None:
            priors[DISCREPANCY] = LogNormalPrior(
                1.0,
                POLICY.discrepancy_spread,
                POLICY.discrepancy_minimum,
                POLICY.discrepancy_maximum,
                POLICY.discrepancy_spread_below,
            )
        return Hyperprior.of(priors)

    def noise_variances(self, rough: Floats) -> Variances:
        """Of points beside which the model's error changes from one to the next.

        Args:
            rough: standard deviation of a distance by that, (g,), metres; see `rough`.
        """

        def found(eta: Floats) -> tuple[Floats, Floats]:
            own, beside = np.exp(2.0 * eta[NOISE]), np.exp(2.0 * eta[DISCREPANCY]) * rough**2
            slopes = np.zeros((len(eta), len(rough)))
            slopes[NOISE], slopes[DISCREPANCY] = 2.0 * own / (own + beside), 2.0 * beside / (own + beside)
            return np.log(own + beside), slopes

        return found

    def prior_variances(self, eta: Floats) -> tuple[Floats, Floats]:
        """Logarithms of the coefficients' variances beforehand, (k,), and their derivatives by eta, (5, k)."""
        logs, slopes = np.zeros(self.size), np.zeros((len(eta), self.size))
        logs[self.force_part], slopes[FORCE, self.force_part] = 2.0 * eta[FORCE], 2.0
        if self.error is not None:
            logs[self.error_part], logs[self.rest_part] = 2.0 * eta[DISCREPANCY], 2.0 * eta[DISCREPANCY]
            logs[self.rest_part] += self.error.rest_logs
            slopes[DISCREPANCY, self.error_part], slopes[DISCREPANCY, self.rest_part] = 2.0, 2.0
        if self.shared is not None:
            spread, by_length = self.shared.spread(float(np.exp(eta[LENGTH])))
            logs[self.noise_part] = 2.0 * eta[SHARED] + np.tile(spread, 3)
            slopes[SHARED, self.noise_part], slopes[LENGTH, self.noise_part] = 2.0, np.tile(by_length, 3)
        return logs, slopes

    def evaluation(self, coefficients: Floats, near: Evaluation | None = None, *, anew: bool = False) -> Evaluation:
        """The problem at some coefficients.

        Args:
            coefficients: (k,).
            near: a trial to start the model from and to walk the closest points from.
            anew: search the closest points anew all the same.

        Raises:
            NotConverged: the model found no state.
        """
        from_match = None if near is None or anew else near.match
        return self._at(coefficients, near, lambda moved, cloud: self.observed.match(moved, cloud, from_match))

    def nearby(self, coefficients: Floats, near: Evaluation) -> Evaluation:
        """The same so near a trial that each point's closest one stays on its triangle.

        Args:
            coefficients: (k,).
            near: the trial.

        Raises:
            NotConverged: the model found no state.
        """
        return self._at(coefficients, near, lambda moved, cloud: self.observed.match_held(moved, cloud, near.match))

    def begun(self, coefficients: Floats, near: Evaluation | None = None) -> Evaluation:
        """The same for another cloud than the trial's: closest points by the nearest vertices, good for a start.

        Args:
            coefficients: (k,).
            near: a trial to start the model from.

        Raises:
            NotConverged: the model found no state.
        """
        return self._at(coefficients, near, self.observed.match_nearby)

    def _at(
        self, coefficients: Floats, near: Evaluation | None, matched: Callable[[Floats, Floats], Correspondence]
    ) -> Evaluation:
        state = self._state(coefficients, None if near is None else near.state)
        positions = state.positions
        if self.error is not None:
            positions = positions + self.error.observed_field(coefficients[self.error_part])
        pose = None if self.pose is None else self.pose.pose(coefficients[self.pose_part])
        cloud = self.cloud if pose is None else pose.inverse().apply(self.cloud)
        return Evaluation(coefficients, state, positions, pose, cloud, matched(positions, cloud))

    def _state(self, coefficients: Floats, near: ReducedState | None) -> ReducedState:
        forces = coefficients[self.force_part]
        if self.parameter_blocks is None:
            return self.model.solve(forces, near)
        conditioned = cast(ParametrisedModel, self.model)
        return conditioned.solve(forces, near, coefficients[self.parameter_part])

    def correction(self, evaluation: Evaluation) -> Floats:
        """What the model's error adds to the displacement of all nodes, (n, 3), metres."""
        if self.error is None:
            return np.zeros_like(self.observed.body.points)
        return self.error.field(evaluation.coefficients[self.error_part])

    def residuals(self, evaluation: Evaluation, noise: float) -> Floats:
        """Distances less what they are in the mean for points of some noise, and what neighbours share, (p,), metres.

        Args:
            evaluation: at some coefficients.
            noise: standard deviation of each coordinate of a point, metres.
        """
        curvature = evaluation.once("curvature", lambda: self.observed.curvature(evaluation.match))
        unexplained = evaluation.once(
            self, lambda: evaluation.match.distances - self.shared_noise(evaluation) - self.left_out(evaluation)
        )
        return unexplained - expected_distance(curvature, noise)

    def again(self, evaluation: Evaluation, beyond: float = 0.0) -> Evaluation:
        """The same trial with closest points searched anew.

        Args:
            evaluation: at some coefficients.
            beyond: only of points further than this from the surface, metres.
        """
        return replace(
            evaluation,
            match=self.observed.match_beyond(evaluation.positions, evaluation.cloud, evaluation.match, beyond),
        )

    def jacobian(self, evaluation: Evaluation) -> Floats:
        """Derivative of the residuals by the coefficients, (p, k), exact."""
        rows = self.observed.rows(evaluation.match)
        by_pose = self._by_pose(evaluation, evaluation.match.directions, evaluation.cloud)
        return self._by_coefficients(evaluation, rows, by_pose, self._by_distances(evaluation))

    def vjp(self, evaluation: Evaluation, cotangent: Floats) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the residuals, (p,): J^T g with the adjoint."""
        rows = self.observed.rows(evaluation.match)
        by_pose = self._by_pose(evaluation, evaluation.match.directions, evaluation.cloud)
        return self._pulled(evaluation, rows, by_pose, cotangent, self._by_distances(evaluation))

    def landmark_residuals(self, evaluation: Evaluation) -> Floats:
        """Coordinates of the landmarks less where they were found, over their deviation, (3l,), body's axes."""
        if self.landmarks is None:
            return np.zeros(0)
        off = self.observed.moved_closest_points(
            self.landmarks.closest_points, evaluation.positions
        ) - self._found_marks(evaluation)
        return (off / self.landmarks.deviation).ravel()

    def landmark_jacobian(self, evaluation: Evaluation) -> Floats:
        """Derivative of these by the coefficients, (3l, k), exact."""
        if self.landmarks is None:
            return np.zeros((0, self.size))
        rows = self.landmarks.rows(self.observed) / self.landmarks.deviation
        return self._by_coefficients(evaluation, rows, self._marks_by_pose(evaluation))

    def landmarks_vjp(self, evaluation: Evaluation, cotangent: Floats) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the landmarks' residuals, (3l,), with the adjoint."""
        if self.landmarks is None:
            return np.zeros(self.size)
        rows = self.landmarks.rows(self.observed) / self.landmarks.deviation
        return self._pulled(evaluation, rows, self._marks_by_pose(evaluation), cotangent)

    def normal_residuals(self, evaluation: Evaluation, held: Correspondence | None = None) -> Floats:
        """How far the surface leans from the normals measured, over its deviation, (2p,): two directions a point.

        A normal counts up to its sign. A surface that is turned by an angle leans by its sine.

        Args:
            evaluation: at some coefficients.
            held: a match whose triangles are looked at; the trial's if not given. Where closest points go on to the
                next triangle these residuals jump: who compares two trials holds them.
        """
        if self.tangent_basis is None:
            return np.zeros(0)
        facing = self.observed.facing(held or evaluation.match, evaluation.positions)
        return np.einsum("pqi,pi->pq", self._across(evaluation), facing).ravel() / self.normal_deviation

    def normal_jacobian(self, evaluation: Evaluation) -> Floats:
        """Derivative of these by the coefficients, (2p, k), exact for triangles that are held."""
        if self.tangent_basis is None:
            return np.zeros((0, self.size))
        match = evaluation.match
        return self._by_coefficients(
            evaluation, self._normal_rows(evaluation, match), self._normals_by_pose(evaluation, match)
        )

    def normals_vjp(self, evaluation: Evaluation, cotangent: Floats, held: Correspondence | None = None) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the normals' residuals, (2p,), with the adjoint."""
        if self.tangent_basis is None:
            return np.zeros(self.size)
        match = held or evaluation.match
        return self._pulled(
            evaluation, self._normal_rows(evaluation, match), self._normals_by_pose(evaluation, match), cotangent
        )

    def _across(self, evaluation: Evaluation) -> Floats:
        """In the body's coordinates."""
        assert self.tangent_basis is not None
        return self.tangent_basis if evaluation.pose is None else self.tangent_basis @ evaluation.pose.rotation

    def _normal_rows(self, evaluation: Evaluation, match: Correspondence) -> csr_array:
        return self.observed.facing_rows(match, evaluation.positions, self._across(evaluation) / self.normal_deviation)

    def _normals_by_pose(self, evaluation: Evaluation, match: Correspondence) -> Floats | None:
        """A direction of the body turns with the pose, and is not shifted: a point's derivative less the origin's."""
        facing = np.repeat(self.observed.facing(match, evaluation.positions), 2, axis=0)
        along = (self._across(evaluation) / self.normal_deviation).reshape(-1, 3)
        turned = self._by_pose(evaluation, along, facing)
        at_origin = self._by_pose(evaluation, along, np.zeros_like(facing))
        return None if turned is None or at_origin is None else turned - at_origin

    def _found_marks(self, evaluation: Evaluation) -> Floats:
        """Where the landmarks were found, in the body's coordinates, (l, 3)."""
        assert self.landmarks is not None
        return (
            self.landmarks.places if evaluation.pose is None else evaluation.pose.inverse().apply(self.landmarks.places)
        )

    def _marks_by_pose(self, evaluation: Evaluation) -> Floats | None:
        assert self.landmarks is not None
        axes = np.tile(np.eye(3) / self.landmarks.deviation, (len(self.landmarks), 1))
        return self._by_pose(evaluation, axes, np.repeat(self._found_marks(evaluation), 3, axis=0))

    def _by_coefficients(
        self, evaluation: Evaluation, rows: csr_array, by_pose: Floats | None, by_distances: Floats | None = None
    ) -> Floats:
        """Derivative of linear functions of the observed nodes' displacement, (q, k), for rows (q, 3m)."""
        blocks = [evaluation.state.jacobian(rows)]
        if by_pose is not None:
            blocks.append(by_pose)
        if self.parameter_blocks is not None:
            blocks.append(cast(ParametrisedState, evaluation.state).rows_by_parameters(rows))
        if self.error is not None:
            blocks.append(self.error.jacobian(rows))
        alone = self.size - self.error_part.stop
        blocks.append(np.zeros((rows.shape[0], alone)) if by_distances is None else by_distances)
        return np.hstack(blocks)

    def _pulled(
        self,
        evaluation: Evaluation,
        rows: csr_array,
        by_pose: Floats | None,
        cotangent: Floats,
        by_distances: Floats | None = None,
    ) -> Floats:
        """The same, transposed and applied, (k,)."""
        by_nodes = (rows.T @ cotangent).reshape(-1, 3)
        full = np.zeros_like(self.observed.body.points)
        full[self.observed.nodes] = by_nodes
        blocks = [self.stiffness_scaling(evaluation)[0] * (evaluation.state.full.vjp(full).ravel() @ self.forces.basis)]
        if by_pose is not None:
            blocks.append(cotangent @ by_pose)
        if self.parameter_blocks is not None:
            blocks.append(full.ravel() @ cast(ParametrisedState, evaluation.state).by_parameters())
        if self.error is not None:
            blocks.append(self.error.jacobian(by_nodes.ravel()))
        alone = self.size - self.error_part.stop
        blocks.append(np.zeros(alone) if by_distances is None else cotangent @ by_distances)
        return np.concatenate(blocks)

    def _by_pose(self, evaluation: Evaluation, directions: Floats, points: Floats) -> Floats | None:
        """Of distances along directions, (p, 3), to points of the body's coordinates, (p, 3): (p, 6), if it is unknown.

        What the camera sees stays where it is: in the body's coordinates it moves against the pose.
        """
        if self.pose is None:
            return None
        assert evaluation.pose is not None
        in_camera = self.pose.jacobian(evaluation.coefficients[self.pose_part], points)
        along = directions @ evaluation.pose.rotation.T  # directions in the camera's axes
        return np.einsum("pi,pij->pj", along, in_camera)

    def moved(self, evaluation: Evaluation, change: Floats) -> Floats:
        """How far some hundred nodes, spread over those observed, move for a change, first order, (m,), metres."""
        every = max(1, len(self.observed.nodes) // _WATCHED)
        shifted = evaluation.state.moved(change[self.force_part], every)
        if self.pose is not None:
            twist = self.pose.deviations * change[self.pose_part]
            arm = self.observed.body.points[self.observed.nodes[::every]] - self.pose.centre
            shifted = shifted + (np.cross(twist[:3], arm) + twist[3:])
        if self.parameter_blocks is not None:
            pushed = (
                cast(ParametrisedState, evaluation.state).by_parameters().reshape(-1, 3, self.parameter_blocks.count)
            )
            shifted = shifted + pushed[self.observed.nodes[::every]] @ change[self.parameter_part]
        if self.error is not None:
            shifted = shifted + self.error.observed_field(change[self.error_part], every)
        return np.sqrt(np.einsum("pi,pi->p", shifted, shifted))

    def stiffness_scaling(self, evaluation: Evaluation) -> tuple[float, Floats]:
        """Factor by which forces grow with the body's stiffness, and its derivative by the conditions' coefficients."""
        if self.parameter_blocks is None:
            return 1.0, np.zeros(0)
        return self.parameter_blocks.stiffness_scaling(evaluation.coefficients[self.parameter_part])

    def nodal_forces(self, evaluation: Evaluation) -> Floats:
        """All that is unknown of the nodal forces, (n, 3), newtons."""
        found = self.stiffness_scaling(evaluation)[0] * self.forces.forces(evaluation.coefficients[self.force_part])
        if self.parameter_blocks is not None:
            found = found + self.parameter_blocks.forces(evaluation.coefficients[self.parameter_part])
        return found

    def net_forces(self, evaluation: Evaluation) -> Floats:
        """Derivative of their net force by the coefficients, (3, k), newtons."""
        whole = np.zeros((3, self.size))
        stiffness_scaling, slopes = self.stiffness_scaling(evaluation)
        whole[:, self.force_part] = stiffness_scaling * self.forces.net_basis
        if self.parameter_blocks is not None:
            net = self.forces.net_basis @ evaluation.coefficients[self.force_part]
            own = self.parameter_blocks.net_forces(evaluation.coefficients[self.parameter_part])
            whole[:, self.parameter_part] = own + net[:, None] * slopes
        return whole

    def is_too_far(self, change: Floats) -> bool:
        """Whether a change of the coefficients is more than one step may make, however little it moves."""
        return self.parameter_blocks is not None and self.parameter_blocks.is_too_far(change[self.parameter_part])
