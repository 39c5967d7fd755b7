"""Landmarks: points of the organ's surface whose positions were measured in the camera's frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, chdtri

from ..evaluation import Evaluation, Slopes
from ..loss import Huber, Loss
from ..policy import POLICY
from ..surface_distance import Correspondence, SurfaceDistance
from ..verdict import Check, Code, checked, of_several, one_of_several
from .term import ResidualTerm

Floats = NDArray[np.float64]
_LOSS = Huber()  # a landmark may have been taken for another
_REACH = 0.05  # of the body's size: further off the observed side a point is none of it


@dataclass(frozen=True, eq=False)
class LandmarkPairs(ResidualTerm):
    """Points of the observed side at rest, and where each of them is now.

    Args:
        closest_points: where they lie on the observed side at rest.
        places: where they were found, in the clouds' coordinates, (l, 3), metres.
        deviation: standard deviation of each coordinate of a place, metres.
    """

    closest_points: Correspondence
    places: Floats
    deviation: float

    @classmethod
    def of(
        cls, observed: SurfaceDistance, points: ArrayLike, places: ArrayLike, deviation: float = 2e-3
    ) -> LandmarkPairs:
        """Landmarks of a body, each taken at the closest point of the observed side.

        Args:
            observed: the observed side.
            points: on the body at rest, (l, 3), metres.
            places: where the same points were found, in the clouds' coordinates, (l, 3), metres.
            deviation: standard deviation of each coordinate of a place, metres.

        Raises:
            ValueError: other shapes, no points, numbers that are not finite, a deviation that is not positive, points
                that do not lie on the observed side.
        """
        given = np.asarray(points, dtype=np.float64), np.asarray(places, dtype=np.float64)
        for name, values in zip(("points", "places"), given, strict=True):
            if values.ndim != 2 or values.shape[1] != 3 or not len(values) or len(values) != len(given[0]):
                raise ValueError(f"LandmarkPairs.{name}: expected shape (l, 3), as many of both, got {values.shape}.")
            if not np.isfinite(values).all():
                raise ValueError(f"LandmarkPairs.{name}: expected finite numbers, got NaN or infinity.")
        if not 0.0 < deviation < np.inf:
            raise ValueError(f"LandmarkPairs.deviation: expected a positive number of metres, got {deviation}.")
        closest_points = observed.match(np.zeros((len(observed.nodes), 3)), given[0])
        far = np.abs(closest_points.distances)
        if far.max() > _REACH * observed.body.size:
            raise ValueError(
                f"LandmarkPairs.points: expected points on the observed surface; point {int(far.argmax())} lies "
                f"{1e3 * far.max():.0f} mm from it (in metres, and in the body's coordinates?)."
            )
        return cls(closest_points, given[1], deviation)

    def __len__(self) -> int:
        return len(self.places)

    @property
    def loss(self) -> Loss:
        """See `ResidualTerm.loss`."""
        return _LOSS

    def values(self, at: Evaluation, held: Correspondence | None = None) -> Floats:
        """Coordinates of the landmarks less where they were found, over their deviation, (3l,), body's axes."""
        off = at.observed.moved_closest_points(self.closest_points, at.positions) - at.in_body(self.places)
        return (off / self.deviation).ravel()

    def slopes(self, at: Evaluation, held: Correspondence | None = None) -> Slopes:
        """See `ResidualTerm.slopes`."""
        axes = np.tile(np.eye(3) / self.deviation, (len(self), 1))
        rows = at.observed.rows_by_axes(self.closest_points) / self.deviation
        return Slopes(rows, axes, np.repeat(at.in_body(self.places), 3, axis=0))

    def checks(self, at: Evaluation) -> Iterator[Check]:
        """Landmarks that lie far from where they were found: one was taken for another, or the state is another."""
        off = np.linalg.norm(self.values(at).reshape(-1, 3), axis=1)
        number, largest = int(off.argmax()), float(off.max())
        away = f"landmark {number} lies {1e3 * self.deviation * largest:.1f} mm from where it was found"
        law = (
            f"largest of {len(off)} lengths of three normal deviations",
            of_several(float(chdtrc(3, largest**2)), len(off)),
        )
        subject, level = f"landmark {number}", float(np.sqrt(chdtri(3, one_of_several(POLICY.unlikely, len(off)))))
        yield checked(Code.LANDMARKS, largest, level, away, unit="deviations", law=law, subject=subject)
