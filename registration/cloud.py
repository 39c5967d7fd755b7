"""An observed cloud: points, and the directions in which the surface was seen to face there, where these are known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.clouds import CloudError

from .thinning import is_isolated, thinned

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_POINTS, _ORIENTED = 3, 6  # columns


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with or without normals.

    Args:
        points: (p, 3), metres.
        normals: of any length and of either sign, (p, 3); a row of zeros where none was measured. None for none at all.
        missing: rows that were passed over, since they are places where a camera has measured nothing.
    """

    points: Floats
    normals: Floats | None = None
    missing: int = 0

    @classmethod
    def of(cls, cloud: ArrayLike) -> Cloud:
        """The cloud in an array; what is no cloud is left for `check_cloud` to refuse.

        Depth cameras write NaN or zeros for pixels without a measurement. Of measured numbers no two are the origin to
        the last bit: rows of zeros that come more than once are none, and one alone is taken as it is.

        Args:
            cloud: points, (p, 3), metres; with normals behind their coordinates (p, 6), NaN where none was measured.

        Raises:
            CloudError: six columns of which the last three tell no direction at all.
        """
        table = np.asarray(cloud, dtype=np.float64)
        if table.ndim != 2 or table.shape[1] not in (_POINTS, _ORIENTED) or not len(table):
            return cls(table)
        is_zero = ~table[:, :3].any(axis=1)
        gone = ~np.isfinite(table[:, :3]).all(axis=1) | (is_zero if is_zero.sum() > 1 else False)
        if np.isnan(table[:, :3]).all():
            return cls(table[:, :3])  # nothing was measured: that is for `check_cloud`, too
        missing, table = int(gone.sum()), table[~gone]
        if table.shape[1] == _POINTS or not len(table):
            return cls(table[:, :3], None, missing)
        points, normals = np.ascontiguousarray(table[:, :3]), table[:, 3:].copy()
        normals[~np.isfinite(normals).all(axis=1)] = 0.0
        if not normals.any():
            raise CloudError("cloud: expected normals in its last three columns, got none that is not zero or NaN.")
        return cls(points, normals, missing)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def is_finite(self) -> bool:
        """Whether it has the shape of a cloud, and all coordinates are numbers."""
        return self.points.ndim == 2 and self.points.shape[1] == _POINTS and bool(np.isfinite(self.points).all())

    def thinned(self, maximum: int) -> Cloud:
        """So many points at most, spread evenly; the same where there are no more.

        Args:
            maximum: points wanted.
        """
        if len(self) <= maximum:
            return self
        return self._of(thinned(self.points, maximum))

    def distinct(self) -> Cloud:
        """Each place once: a point that is there again tells nothing more. The same where none is."""
        along = np.sort(self.points[:, 0])
        if (along[1:] != along[:-1]).all():
            return self
        order = np.lexsort(self.points.T)
        is_again = (np.diff(self.points[order], axis=0) == 0.0).all(axis=1)
        if not is_again.any():
            return self
        return self._of(np.setdiff1d(np.arange(len(self)), order[1:][is_again]))

    @cached_property
    def without_isolated(self) -> Cloud:
        """Without points that lie by themselves, which are hardly of a surface; the same where there are none."""
        isolated = is_isolated(self.points)
        return self._of(np.flatnonzero(~isolated)) if isolated.any() else self

    def _of(self, kept: Ints) -> Cloud:
        """Some of the points, by their numbers."""
        return replace(self, points=self.points[kept], normals=None if self.normals is None else self.normals[kept])

    @cached_property
    def tangent_basis(self) -> Floats | None:
        """Two unit vectors across each normal and each other, (p, 2, 3); zeros where none was measured."""
        if self.normals is None:
            return None
        lengths = np.linalg.norm(self.normals, axis=1)
        known = lengths > 0.0
        axis = np.eye(3)[np.abs(self.normals).argmin(axis=1)]  # the one that is farthest from the normal
        first = np.cross(self.normals, axis)
        first[known] /= np.linalg.norm(first[known], axis=1)[:, None]
        second = np.cross(self.normals, first)
        second[known] /= lengths[known, None]
        return np.stack([first, second], axis=1)

    def array(self) -> Floats:
        """The same as an array: (p, 3), or (p, 6) with normals."""
        return self.points if self.normals is None else np.hstack([self.points, self.normals])


def turned(cloud: ArrayLike, rotation: Floats, translation: Floats) -> Floats:
    """A cloud, (p, 3), or (p, 6) with normals, moved rigidly: normals turn, and are not shifted.

    Args:
        cloud: metres.
        rotation: (3, 3).
        translation: (3,), metres.
    """
    table = np.asarray(cloud, dtype=np.float64)
    moved: Floats = table[..., :3] @ rotation.T + translation
    if table.ndim != 2 or table.shape[1] != _ORIENTED:
        return moved if table.shape[-1:] == (_POINTS,) else table
    return np.hstack([moved, table[:, 3:] @ rotation.T])
