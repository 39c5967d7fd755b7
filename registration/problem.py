"""One cloud, one model, the unknowns: residuals and their derivative as a function of all coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .evidence import Scale
from .forward import ReducedModel, ReducedState
from .pose import Pose
from .residuals import Match, SurfaceDistance
from .unknowns import Forces, PosePrior

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trial:
    """The problem at one set of coefficients.

    Args:
        coefficients: of forces and pose, (k,) or (k + 6,).
        state: the body's state.
        pose: from the body's coordinates to the cloud's; None where it is not unknown.
        cloud: points in the body's coordinates, (p, 3), metres.
        match: the cloud on the surface.
    """

    coefficients: Floats
    state: ReducedState
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
    """

    model: ReducedModel
    observed: SurfaceDistance
    forces: Forces
    pose: PosePrior | None
    cloud: Floats
    noise: Scale

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.forces.size + (0 if self.pose is None else 6)

    @cached_property
    def force_part(self) -> slice:
        """Where the force coefficients are."""
        return slice(0, self.forces.size)

    def trial(self, coefficients: Floats, near: Trial | None = None, *, anew: bool = False) -> Trial:
        """The problem at some coefficients.

        Args:
            coefficients: (k,).
            near: a trial to start the model from and to walk the closest points from.
            anew: search the closest points anew all the same.

        Raises:
            NotConverged: the model found no state.
        """
        state = self.model.solve(coefficients[self.force_part], None if near is None else near.state)
        pose = None if self.pose is None else self.pose.pose(coefficients[self.forces.size :])
        cloud = self.cloud if pose is None else pose.inverse().apply(self.cloud)
        match = self.observed.match(state.positions, cloud, None if near is None or anew else near.match)
        return Trial(coefficients, state, pose, cloud, match)

    def again(self, trial: Trial) -> Trial:
        """The same trial with its closest points searched anew."""
        return Trial(
            trial.coefficients,
            trial.state,
            trial.pose,
            trial.cloud,
            self.observed.match(trial.state.positions, trial.cloud),
        )

    def jacobian(self, trial: Trial) -> Floats:
        """Derivative of the distances by the coefficients, (p, k), exact."""
        by_forces = trial.state.jacobian(self.observed.rows(trial.match))
        if self.pose is None:
            return by_forces
        return np.hstack([by_forces, self._by_pose(trial)])

    def pulled(self, trial: Trial, cotangent: Floats) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the distances, (p,): J^T g with the adjoint."""
        by_nodes = (self.observed.rows(trial.match).T @ cotangent).reshape(-1, 3)
        full = np.zeros_like(self.observed.body.points)
        full[self.observed.nodes] = by_nodes
        by_forces = trial.state.full.pull(full).ravel() @ self.forces.basis
        if self.pose is None:
            return by_forces
        return np.concatenate([by_forces, cotangent @ self._by_pose(trial)])

    def _by_pose(self, trial: Trial) -> Floats:
        """A point of the cloud stays where it is: in the body's coordinates it moves against the pose."""
        assert self.pose is not None and trial.pose is not None
        twist = self.pose.deviations * trial.coefficients[self.forces.size :]
        centre = self.pose.mean.apply(self.pose.centre[None])[0]
        in_camera = self.pose.mean.moved_jacobian(trial.cloud, twist, centre).reshape(-1, 3, 6)
        along = trial.match.directions @ trial.pose.rotation.T  # directions in the camera's axes
        return np.einsum("pi,pij->pj", along, in_camera) * self.pose.deviations

    def moved(self, trial: Trial, change: Floats) -> Floats:
        """How far the observed nodes move towards or from the cloud for a change, first order, (m,), metres."""
        shifted = trial.state.moved(change[self.force_part])
        if self.pose is not None:
            twist = self.pose.deviations * change[self.forces.size :]
            arm = self.observed.rest - self.pose.centre
            shifted = shifted + (np.cross(twist[:3], arm) + twist[3:])
        return np.sqrt(np.einsum("pi,pi->p", shifted, shifted))
