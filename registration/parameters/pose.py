"""An unknown pose of the camera: a turn and a shift about an expected one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..evaluation import Evaluation, Slopes
from ..expectations import Expectations
from ..pose import Pose
from ..verdict import Check, Code, checked, largest_normal, normal_level
from .block import BlockPosterior, ParameterBlock

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PosePrior(ParameterBlock):
    """An unknown pose near an expected one.

    Args:
        mean: the pose expected.
        centre: of the turn, in the body's coordinates, (3,), metres.
        rotation_deviation: standard deviation of the turn about each axis, radians.
        translation_deviation: standard deviation of the shift along each axis, metres.
        is_said: the expected pose is the one that results are told in: what is found beside it counts as displacement.
    """

    has_own_figures: ClassVar[bool] = True

    mean: Pose
    centre: Floats
    rotation_deviation: float = np.deg2rad(5.0)
    translation_deviation: float = 0.01
    is_said: bool = False

    def __post_init__(self) -> None:
        for name in ("rotation_deviation", "translation_deviation"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"PosePrior.{name}: expected a positive deviation, got {getattr(self, name)}.")

    @property
    def size(self) -> int:
        """6: turn and shift."""
        return 6

    @property
    def deviations(self) -> Floats:
        """Of turn and shift, (6,)."""
        return np.repeat([self.rotation_deviation, self.translation_deviation], 3)

    def pose(self, coefficients: Floats) -> Pose:
        """The pose for coefficients of unit variance, (6,)."""
        return self.mean.moved(self.deviations * coefficients, self._pivot)

    def seen_jacobian(self, coefficients: Floats, points: Floats) -> Floats:
        """Derivative of where the camera sees points by the coefficients, (p, 3, 6), metres, on the camera's axes.

        Args:
            coefficients: of unit variance, (6,).
            points: in the body's coordinates, (p, 3), metres.
        """
        moved = self.mean.moved_jacobian(points, self.deviations * coefficients, self._pivot)
        return moved.reshape(-1, 3, 6) * self.deviations

    @property
    def _pivot(self) -> Floats:
        """The centre of the turn where the expected pose puts it, (3,)."""
        return self.mean.apply(self.centre[None])[0]

    def jacobian(self, at: Evaluation, coefficients: Floats, slopes: Slopes) -> Floats:
        """See `ParameterBlock.jacobian`.

        What the camera sees stays where it is: in the body's coordinates it moves against the pose.
        """
        along = slopes.along @ at.rotation.T  # in the camera's axes
        found: Floats = np.einsum("pi,pij->pj", along, self.seen_jacobian(coefficients, slopes.places))
        if slopes.are_directions:
            found -= np.einsum("pi,pij->pj", along, self.seen_jacobian(coefficients, np.zeros_like(slopes.places)))
        return found

    def moved(self, at: Evaluation, change: Floats, every: int) -> Floats:
        """See `ParameterBlock.moved`: the observed side as the camera sees it, on the body's axes."""
        twist = self.deviations * change
        arm = (at.observed.body.points[at.observed.nodes[::every]] - self.centre) @ at.rotation.T
        found: Floats = (np.cross(twist[:3], arm) + twist[3:]) @ at.rotation
        return found

    def checks(self, found: BlockPosterior, expected: Expectations) -> Iterator[Check]:
        """Whether the pose lies where it was expected."""
        values = np.abs(found.mean)
        largest = float(values.max())
        advice = "say --pose unknown" if self.is_said else "give a better start"
        far = f"the pose lies {largest:.1f} deviations from where it was expected; {advice}"
        law = largest_normal(largest, len(values))
        level = normal_level(expected.unlikely, len(values))
        yield checked(Code.POSE, largest, level, far, unit="deviations", law=law)
