"""Rigid motions: the one that fits a set of nodes best, and the way there on which it turns about one fixed axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

_FLAT = 1e-6  # of the spread of a set squared: one a thousandth as wide as it is long still tells its rotation
_NUDGE = 1e-9  # towards no rotation where a set does not tell one; any small number picks the same
_HALF_TURN = 1e-6  # radians: so near to half a turn rounding would choose the side
_SMALL_ANGLE = 1e-4  # radians: below, the next term of the series is below rounding


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """The motion x -> R x + t.

    Args:
        rotation: R, (d, d), in space or in the plane.
        translation: t, (d,), metres.
    """

    rotation: Floats
    translation: Floats

    @staticmethod
    def none(dimension: int) -> RigidMotion:
        """No motion."""
        return RigidMotion(np.eye(dimension), np.zeros(dimension))

    @property
    def is_none(self) -> bool:
        """Whether nothing moves, to the last bit."""
        return not self.translation.any() and np.array_equal(self.rotation, np.eye(len(self.rotation)))

    def of(self, points: Floats) -> Floats:
        """Where points, (n, d), metres, are moved."""
        return points @ self.rotation.T + self.translation

    def back(self, points: Floats) -> Floats:
        """Where moved points, (n, d), metres, come from."""
        return (points - self.translation) @ self.rotation

    @property
    def screw(self) -> tuple[Floats, Floats]:
        """Angle about the axis, (3,), radians, and velocity of the origin, (3,), metres, over the whole motion.

        The screw turns by at most half a turn, about one axis of space whatever the origin is (the geodesic of SE(3)).
        Half a turn goes the way on which the first coordinate of the axis that is not zero is positive.
        """
        dimension = len(self.translation)
        rotation, translation = np.eye(3), np.zeros(3)
        rotation[:dimension, :dimension], translation[:dimension] = self.rotation, self.translation
        angle = _rotation_vector(rotation)
        return angle, np.linalg.solve(_mean_rotation(angle), translation)

    def part(self, factor: float) -> RigidMotion:
        """So much of the motion, along its screw.

        Args:
            factor: 0 for rest, 1 for the whole.
        """
        dimension = len(self.translation)
        angle, velocity = (factor * part for part in self.screw)
        rotation = Rotation.from_rotvec(angle).as_matrix()[:dimension, :dimension]
        return RigidMotion(rotation, (_mean_rotation(angle) @ velocity)[:dimension])


def screwed(points: Floats, angles: Floats, velocities: Floats) -> Floats:
    """Points, (n, 3), metres, each moved by a screw of its own, as `RigidMotion.screw` gives it, (n, 3) both."""
    moved = Rotation.from_rotvec(angles).apply(points)
    return np.asarray(moved + np.einsum("nij,nj->ni", _mean_rotation(angles), velocities))


def fitted(points: Floats, moved: Floats) -> tuple[RigidMotion, bool]:
    """The rigid motion that takes points nearest to where they were moved, and whether they tell its rotation.

    The rotation is the polar factor of sum (y - y') (x - x')^T, with x', y' the means (Kabsch 1976). Where the set does
    not tell one (a node, nodes on a line, what is folded onto itself), it is the least of those that fit.

    Args:
        points: at rest, (n, d), metres.
        moved: where they are prescribed to be, (n, d), metres.
    """
    centre, end = points.mean(axis=0), moved.mean(axis=0)
    arms, turned = points - centre, moved - end
    moments = turned.T @ arms
    scale = float(np.linalg.norm(arms) * np.linalg.norm(turned))
    rotation, gap = _polar(moments)
    is_told = gap > _FLAT * scale
    if not is_told:
        rotation, _ = _polar(moments + _NUDGE * (scale or 1.0) * np.eye(len(centre)))
    return RigidMotion(rotation, end - rotation @ centre), is_told


def _polar(moments: Floats) -> tuple[Floats, float]:
    """The rotation nearest to a matrix, and how far the matrix is from one that is as near to other rotations."""
    left, sizes, right = np.linalg.svd(moments)
    signs = np.ones(len(sizes))
    signs[-1] = np.sign(np.linalg.det(left @ right))
    return (left * signs) @ right, float(sizes[-2] + signs[-1] * sizes[-1])


def _rotation_vector(rotation: Floats) -> Floats:
    """Axis times angle, (3,), radians; of half a turn always the same."""
    vector = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    if angle > np.pi - _HALF_TURN and vector[np.abs(vector) > _HALF_TURN * angle][0] < 0.0:
        vector = vector * (1.0 - 2.0 * np.pi / angle)
    return np.asarray(vector)


def _mean_rotation(vector: Floats) -> Floats:
    """Mean of the rotations by s times a vector, (..., 3), over s in [0, 1]: takes velocity to translation."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    cross = np.cross(np.eye(3), vector[..., None, :])
    safe = np.maximum(angle, _SMALL_ANGLE)
    second = np.where(angle < _SMALL_ANGLE, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    first = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)
