"""One cloud, one model, the unknowns: residuals and their derivative as a function of all coefficients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from .cloud import Cloud
from .conditions import Conditions
from .correlated import CorrelatedNoise, Linear
from .evidence import Scale
from .forward import ConditionedModel, ConditionedState, ReducedModel, ReducedState
from .marks import Marks
from .pose import Pose
from .residuals import Match, SurfaceDistance
from .unknowns import Forces, ModelError, PosePrior

Floats = NDArray[np.float64]
_COUNTED = 0.2  # weight: points with less are outliers
_WATCHED = 300  # nodes whose movement limits a step
# Radians, of a measured normal across itself: cameras' are off by some 10 degrees, and flat triangles by some more.
NORMAL_DEVIATION = float(np.deg2rad(10.0))


@dataclass(frozen=True, eq=False)
class Trial:
    """The problem at one set of coefficients.

    Args:
        coefficients: of forces, pose, conditions, correlated noise and model error, (k,).
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
    match: Match


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
        conditions: unknowns beside the forces, which the model takes; None where there are none.
        marks: landmarks that pull beside the cloud; None where there are none.
        across: two unit vectors across each point's measured normal, in the cloud's coordinates, (p, 2, 3): how far the
            surface leans towards them pulls, too; None for a cloud without normals.
        leaning: standard deviation of that, radians.
        correlated: noise that neighbouring points share, as unknowns; None where each point errs by itself.
    """

    model: ReducedModel
    observed: SurfaceDistance
    forces: Forces
    pose: PosePrior | None
    cloud: Floats
    noise: Scale
    error: ModelError | None = None
    conditions: Conditions | None = None
    marks: Marks | None = None
    across: Floats | None = None
    leaning: float = NORMAL_DEVIATION
    correlated: CorrelatedNoise | None = None

    @classmethod
    def seen(cls, cloud: Cloud, **given: Any) -> Problem:
        """The problem of a cloud with its normals, where it has some.

        Args:
            cloud: points with or without normals.
            given: all other arguments.
        """
        return cls(cloud=cloud.points, across=cloud.across, **given)

    @property
    def size(self) -> int:
        """Number of coefficients: of the forces, the pose, conditions, correlated noise and the model's error."""
        return self.noise_part.stop + (0 if self.error is None else self.error.count)

    @cached_property
    def force_part(self) -> slice:
        """Where the force coefficients are."""
        return slice(0, self.forces.size)

    @cached_property
    def pose_part(self) -> slice:
        """Where those of the pose are."""
        return slice(self.forces.size, self.forces.size + (0 if self.pose is None else 6))

    @cached_property
    def condition_part(self) -> slice:
        """Where those of the conditions are."""
        begin = self.pose_part.stop
        return slice(begin, begin + (0 if self.conditions is None else self.conditions.count))

    @cached_property
    def noise_part(self) -> slice:
        """Where those of the correlated noise are."""
        begin = self.condition_part.stop
        return slice(begin, begin + (0 if self.correlated is None else self.correlated.count))

    @cached_property
    def error_part(self) -> slice:
        """Where those of the model's error are."""
        return slice(self.noise_part.stop, None)

    @cached_property
    def _near(self) -> Floats:
        """How much noise the points have in common with those that carry it, (p, q)."""
        assert self.correlated is not None
        return self.correlated.near(self.cloud)

    def normals(self, trial: Trial) -> Floats:
        """Of the surface at the points, (p, 3), on the cloud's axes."""
        directions = trial.match.directions
        return directions if trial.pose is None else directions @ trial.pose.rotation.T

    def shared_noise(self, trial: Trial) -> Floats:
        """The part of the distances that is taken for noise that neighbours share, (p,), metres."""
        if self.correlated is None:
            return np.zeros(len(self.cloud))
        return self.correlated.shifts(trial.coefficients[self.noise_part], self._near, self.normals(trial))

    def _by_noise(self, trial: Trial) -> Floats | None:
        """Derivative of the residuals by its coefficients, (p, q)."""
        return None if self.correlated is None else -self.correlated.patterns(self._near, self.normals(trial))

    def carried(self, coefficients: Floats, before: Problem) -> Floats:
        """Coefficients of another problem for a start of this one, (k,); what it did not have is zero.

        Args:
            coefficients: of the other problem.
            before: that problem, of the same kinds of forces, pose and conditions.
        """
        start = np.zeros(self.size)
        start[: self.condition_part.stop] = coefficients[: before.condition_part.stop]
        mine, other = self.correlated, before.correlated
        if mine is not None and other is not None and mine.centres is other.centres:
            start[self.noise_part] = coefficients[before.noise_part]
        errors = coefficients[before.error_part]
        if len(errors) == self.size - self.noise_part.stop:
            start[self.error_part] = errors
        return start

    def linear(self, trial: Trial, jacobian: Floats, noise: float, weights: Floats) -> Linear:
        """The distances, linear in the unknowns about a trial, without correlated noise.

        Args:
            trial: where.
            jacobian: derivative of the distances there, (p, k).
            noise: standard deviation of a point's distance, metres.
            weights: of the points, (p,); those with little are left out.
        """
        kept, coefficients = weights > _COUNTED, trial.coefficients.copy()
        coefficients[self.noise_part] = 0.0
        distances = self.residuals(trial, noise) + self.shared_noise(trial)
        columns = np.arange(self.size)
        others = np.setdiff1d(columns[self.force_part.stop :], columns[self.noise_part])
        return Linear(
            self.cloud[kept],
            self.normals(trial)[kept],
            (jacobian @ coefficients - distances)[kept],
            jacobian[kept][:, self.force_part],
            jacobian[kept][:, others],
            self.left_out(trial)[kept],
            weights[kept],
        )

    def trial(self, coefficients: Floats, near: Trial | None = None, *, anew: bool = False) -> Trial:
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

    def begun(self, coefficients: Floats, near: Trial | None = None) -> Trial:
        """The same for another cloud than the trial's: closest points by the nearest vertices, good for a start.

        Args:
            coefficients: (k,).
            near: a trial to start the model from.

        Raises:
            NotConverged: the model found no state.
        """
        return self._at(coefficients, near, self.observed.match_nearby)

    def _at(self, coefficients: Floats, near: Trial | None, matched: Callable[[Floats, Floats], Match]) -> Trial:
        state = self._state(coefficients, None if near is None else near.state)
        positions = state.positions
        if self.error is not None:
            positions = positions + self.error.observed_field(coefficients[self.error_part])
        pose = None if self.pose is None else self.pose.pose(coefficients[self.pose_part])
        cloud = self.cloud if pose is None else pose.inverse().apply(self.cloud)
        return Trial(coefficients, state, positions, pose, cloud, matched(positions, cloud))

    def _state(self, coefficients: Floats, near: ReducedState | None) -> ReducedState:
        forces = coefficients[self.force_part]
        if self.conditions is None:
            return self.model.solve(forces, near)
        conditioned = cast(ConditionedModel, self.model)
        return conditioned.solve(forces, near, coefficients[self.condition_part])

    def correction(self, trial: Trial) -> Floats:
        """What the model's error adds to the displacement of all nodes, (n, 3), metres."""
        if self.error is None:
            return np.zeros_like(self.observed.body.points)
        return self.error.field(trial.coefficients[self.error_part])

    def left_out(self, trial: Trial) -> Floats:
        """Standard deviation of each distance by what the patterns of the model's error leave out, (p,), metres.

        Neighbours share it: many points tell no more of it than there are places where it is independent.
        """
        if self.error is None:
            return np.zeros(len(self.cloud))
        alike = max(len(self.cloud) / self.error.discrepancy.places, 1.0)
        return np.sqrt(alike) * self.observed.at_points(trial.match, self.error.rest)

    def residuals(self, trial: Trial, noise: float) -> Floats:
        """Distances less what they are in the mean for points of some noise, and less shared noise, (p,), metres.

        Args:
            trial: at some coefficients.
            noise: standard deviation of each coordinate of a point, metres.
        """
        expected = self.observed.expected(trial.match, noise)
        return trial.match.distances - expected - self.shared_noise(trial)

    def again(self, trial: Trial, beyond: float = 0.0) -> Trial:
        """The same trial with closest points searched anew.

        Args:
            trial: at some coefficients.
            beyond: only of points further than this from the surface, metres.
        """
        return replace(trial, match=self.observed.match_beyond(trial.positions, trial.cloud, trial.match, beyond))

    def jacobian(self, trial: Trial) -> Floats:
        """Derivative of the residuals by the coefficients, (p, k), exact."""
        rows = self.observed.rows(trial.match)
        by_pose = self._by_pose(trial, trial.match.directions, trial.cloud)
        return self._by_coefficients(trial, rows, by_pose, self._by_noise(trial))

    def pulled(self, trial: Trial, cotangent: Floats) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the residuals, (p,): J^T g with the adjoint."""
        rows = self.observed.rows(trial.match)
        by_pose = self._by_pose(trial, trial.match.directions, trial.cloud)
        return self._pulled(trial, rows, by_pose, cotangent, self._by_noise(trial))

    def mark_residuals(self, trial: Trial) -> Floats:
        """Coordinates of the landmarks less where they were found, over their deviation, (3l,), body's axes."""
        if self.marks is None:
            return np.zeros(0)
        off = self.observed.moved_feet(self.marks.feet, trial.positions) - self._found_marks(trial)
        return (off / self.marks.deviation).ravel()

    def mark_jacobian(self, trial: Trial) -> Floats:
        """Derivative of these by the coefficients, (3l, k), exact."""
        if self.marks is None:
            return np.zeros((0, self.size))
        rows = self.marks.rows(self.observed) / self.marks.deviation
        return self._by_coefficients(trial, rows, self._marks_by_pose(trial))

    def marks_pulled(self, trial: Trial, cotangent: Floats) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the landmarks' residuals, (3l,), with the adjoint."""
        if self.marks is None:
            return np.zeros(self.size)
        rows = self.marks.rows(self.observed) / self.marks.deviation
        return self._pulled(trial, rows, self._marks_by_pose(trial), cotangent)

    def normal_residuals(self, trial: Trial, held: Match | None = None) -> Floats:
        """How far the surface leans from the normals measured, over its deviation, (2p,): two directions a point.

        A normal counts up to its sign. A surface that is turned by an angle leans by its sine.

        Args:
            trial: at some coefficients.
            held: a match whose triangles are looked at; the trial's if not given. Where closest points go on to the
                next triangle these residuals jump: who compares two trials holds them.
        """
        if self.across is None:
            return np.zeros(0)
        facing = self.observed.facing(held or trial.match, trial.positions)
        return np.einsum("pqi,pi->pq", self._across(trial), facing).ravel() / self.leaning

    def normal_jacobian(self, trial: Trial) -> Floats:
        """Derivative of these by the coefficients, (2p, k), exact for triangles that are held."""
        if self.across is None:
            return np.zeros((0, self.size))
        match = trial.match
        return self._by_coefficients(trial, self._normal_rows(trial, match), self._normals_by_pose(trial, match))

    def normals_pulled(self, trial: Trial, cotangent: Floats, held: Match | None = None) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the normals' residuals, (2p,), with the adjoint."""
        if self.across is None:
            return np.zeros(self.size)
        match = held or trial.match
        return self._pulled(trial, self._normal_rows(trial, match), self._normals_by_pose(trial, match), cotangent)

    def _across(self, trial: Trial) -> Floats:
        """In the body's coordinates."""
        assert self.across is not None
        return self.across if trial.pose is None else self.across @ trial.pose.rotation

    def _normal_rows(self, trial: Trial, match: Match) -> csr_array:
        return self.observed.facing_rows(match, trial.positions, self._across(trial) / self.leaning)

    def _normals_by_pose(self, trial: Trial, match: Match) -> Floats | None:
        """A direction of the body turns with the pose, and is not shifted: a point's derivative less the origin's."""
        facing = np.repeat(self.observed.facing(match, trial.positions), 2, axis=0)
        along = (self._across(trial) / self.leaning).reshape(-1, 3)
        turned = self._by_pose(trial, along, facing)
        at_origin = self._by_pose(trial, along, np.zeros_like(facing))
        return None if turned is None or at_origin is None else turned - at_origin

    def _found_marks(self, trial: Trial) -> Floats:
        """Where the landmarks were found, in the body's coordinates, (l, 3)."""
        assert self.marks is not None
        return self.marks.places if trial.pose is None else trial.pose.inverse().apply(self.marks.places)

    def _marks_by_pose(self, trial: Trial) -> Floats | None:
        assert self.marks is not None
        axes = np.tile(np.eye(3) / self.marks.deviation, (len(self.marks), 1))
        return self._by_pose(trial, axes, np.repeat(self._found_marks(trial), 3, axis=0))

    def _by_coefficients(
        self, trial: Trial, rows: csr_array, by_pose: Floats | None, by_noise: Floats | None = None
    ) -> Floats:
        """Derivative of linear functions of the observed nodes' displacement, (q, k), for rows (q, 3m)."""
        blocks = [trial.state.jacobian(rows)]
        if by_pose is not None:
            blocks.append(by_pose)
        if self.conditions is not None:
            blocks.append(cast(ConditionedState, trial.state).rows_by_conditions(rows))
        if self.correlated is not None:
            blocks.append(np.zeros((rows.shape[0], self.correlated.count)) if by_noise is None else by_noise)
        if self.error is not None:
            blocks.append(self.error.jacobian(rows))
        return np.hstack(blocks)

    def _pulled(
        self, trial: Trial, rows: csr_array, by_pose: Floats | None, cotangent: Floats, by_noise: Floats | None = None
    ) -> Floats:
        """The same, transposed and applied, (k,)."""
        by_nodes = (rows.T @ cotangent).reshape(-1, 3)
        full = np.zeros_like(self.observed.body.points)
        full[self.observed.nodes] = by_nodes
        blocks = [self.growth(trial)[0] * (trial.state.full.pull(full).ravel() @ self.forces.basis)]
        if by_pose is not None:
            blocks.append(cotangent @ by_pose)
        if self.conditions is not None:
            blocks.append(full.ravel() @ cast(ConditionedState, trial.state).by_conditions())
        if self.correlated is not None:
            blocks.append(np.zeros(self.correlated.count) if by_noise is None else cotangent @ by_noise)
        if self.error is not None:
            blocks.append(self.error.jacobian(by_nodes.ravel()))
        return np.concatenate(blocks)

    def _by_pose(self, trial: Trial, directions: Floats, points: Floats) -> Floats | None:
        """Of distances along directions, (p, 3), to points of the body's coordinates, (p, 3): (p, 6), if it is unknown.

        What the camera sees stays where it is: in the body's coordinates it moves against the pose.
        """
        if self.pose is None:
            return None
        assert trial.pose is not None
        in_camera = self.pose.jacobian(trial.coefficients[self.pose_part], points)
        along = directions @ trial.pose.rotation.T  # directions in the camera's axes
        return np.einsum("pi,pij->pj", along, in_camera)

    def moved(self, trial: Trial, change: Floats) -> Floats:
        """How far some hundred nodes, spread over those observed, move for a change, first order, (m,), metres."""
        every = max(1, len(self.observed.nodes) // _WATCHED)
        shifted = trial.state.moved(change[self.force_part], every)
        if self.pose is not None:
            twist = self.pose.deviations * change[self.pose_part]
            arm = self.observed.body.points[self.observed.nodes[::every]] - self.pose.centre
            shifted = shifted + (np.cross(twist[:3], arm) + twist[3:])
        if self.conditions is not None:
            pushed = cast(ConditionedState, trial.state).by_conditions().reshape(-1, 3, self.conditions.count)
            shifted = shifted + pushed[self.observed.nodes[::every]] @ change[self.condition_part]
        if self.error is not None:
            shifted = shifted + self.error.observed_field(change[self.error_part], every)
        return np.sqrt(np.einsum("pi,pi->p", shifted, shifted))

    def growth(self, trial: Trial) -> tuple[float, Floats]:
        """Factor by which forces grow with the body's stiffness, and its derivative by the conditions' coefficients."""
        if self.conditions is None:
            return 1.0, np.zeros(0)
        return self.conditions.growth(trial.coefficients[self.condition_part])

    def nodal_forces(self, trial: Trial) -> Floats:
        """All that is unknown of the nodal forces, (n, 3), newtons."""
        found = self.growth(trial)[0] * self.forces.forces(trial.coefficients[self.force_part])
        if self.conditions is not None:
            found = found + self.conditions.forces(trial.coefficients[self.condition_part])
        return found

    def net_forces(self, trial: Trial) -> Floats:
        """Derivative of their net force by the coefficients, (3, k), newtons."""
        whole = np.zeros((3, self.size))
        growth, slopes = self.growth(trial)
        whole[:, self.force_part] = growth * self.forces.net_basis
        if self.conditions is not None:
            net = self.forces.net_basis @ trial.coefficients[self.force_part]
            own = self.conditions.net_forces(trial.coefficients[self.condition_part])
            whole[:, self.condition_part] = own + net[:, None] * slopes
        return whole

    def is_too_far(self, change: Floats) -> bool:
        """Whether a change of the coefficients is more than one step may make, however little it moves."""
        return self.conditions is not None and self.conditions.is_too_far(change[self.condition_part])
