"""Where the camera stands: rigid motions from the body at rest to the camera, their files, landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from softtwin.meshes.io import RAS_TO_LPS, Axes, FileError, Unit
from softtwin.meshes.io.landmarks import read_named_points
from softtwin.meshes.io.transforms import read_transform

Floats = NDArray[np.float64]

_ORTHOGONAL = 1e-3  # how far R R^T may be from one: matrices come typed by hand with four digits
_FLAT = 1e-2  # landmarks are in a line when their second extent is below this part of the first


class PoseError(ValueError):
    """A pose that is no rigid motion, or that landmarks do not determine."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion from the coordinates of the body at rest to those of the camera: y = R x + t.

    Args:
        rotation: R, (3, 3); brought to the nearest rotation when it is one up to 1e-3.
        translation: t, (3,), metres.

    Raises:
        PoseError: wrong shapes, numbers that are not finite, no rotation, or a mirror.
    """

    rotation: Floats
    translation: Floats

    def __post_init__(self) -> None:
        rotation = _checked("Pose.rotation", self.rotation, (3, 3))
        translation = _checked("Pose.translation", self.translation, (3,))
        object.__setattr__(self, "rotation", _frozen(_nearest_rotation(rotation)))
        object.__setattr__(self, "translation", _frozen(translation))

    @classmethod
    @cache
    def identity(cls) -> Pose:
        """The pose of a camera whose coordinates are the body's."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """The pose of a homogeneous matrix, (4, 4), metres.

        Raises:
            PoseError: another shape, not finite, a last row other than 0 0 0 1, scale, shear, or a mirror.
        """
        checked = _checked("matrix", matrix, (4, 4))
        if np.abs(checked[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
            raise PoseError(f"matrix: expected the last row 0 0 0 1, got {_words(checked[3])}; "
                            "is the matrix transposed?")  # fmt: skip
        return cls(checked[:3, :3], checked[:3, 3])

    @cached_property
    def matrix(self) -> Floats:
        """The homogeneous matrix, (4, 4), metres."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return _frozen(matrix)

    def apply(self, points: ArrayLike) -> Floats:
        """Points of the body, (..., 3), in the camera's coordinates, metres."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def inverse(self) -> Pose:
        """The motion back: from the camera's coordinates to the body's."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def then(self, other: Pose) -> Pose:
        """The motion that does this one first and the other one after it."""
        return Pose(other.rotation @ self.rotation, other.apply(self.translation))

    def moved(self, twist: ArrayLike, centre: ArrayLike) -> Pose:
        """The pose turned about a centre and shifted, both in the camera's coordinates: c + exp(w) (y - c) + v.

        Args:
            twist: rotation vector w, radians, then shift v, metres, (6,).
            centre: c, in the camera's coordinates, (3,), metres; near the cloud, the two halves hardly couple.
        """
        (w, v), centre = _halves(twist), np.asarray(centre, dtype=np.float64)
        turn = Rotation.from_rotvec(w).as_matrix()
        return Pose(turn @ self.rotation, turn @ (self.translation - centre) + centre + v)

    def moved_jacobian(self, points: ArrayLike, twist: ArrayLike, centre: ArrayLike) -> Floats:
        """Derivative of `moved(twist, centre).apply(points)` with respect to the twist, (3p, 6), exact at any twist.

        d(exp(w) z) = -[exp(w) z]x J_l(w) dw, J_l the left Jacobian of the rotations (Sola et al. 2018, eq. 145).

        Args:
            points: points of the body, (p, 3), metres.
            twist: where the derivative is taken, (6,).
            centre: as in `moved`.
        """
        w, v = _halves(twist)
        arms = self.moved(twist, centre).apply(points) - np.asarray(centre) - v
        turned = -_cross_matrices(arms) @ _left_jacobian(w)
        both = np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], axis=2)
        return both.reshape(-1, 6)

    def angle_to(self, other: Pose) -> float:
        """Angle of the rotation between two poses, radians."""
        return float(Rotation.from_matrix(other.rotation @ self.rotation.T).magnitude())

    def distance_to(self, other: Pose, points: ArrayLike) -> float:
        """Mean distance between the places that two poses give to points of the body, (p, 3), metres."""
        return float(np.linalg.norm(self.apply(points) - other.apply(points), axis=-1).mean())


def _checked(name: str, array: ArrayLike, shape: tuple[int, ...]) -> Floats:
    checked = np.asarray(array, dtype=np.float64)
    if checked.shape != shape:
        raise PoseError(f"{name}: expected shape {shape}, got {checked.shape}.")
    if not np.isfinite(checked).all():
        raise PoseError(f"{name}: expected finite numbers, got NaN or infinity.")
    return checked


def _frozen(array: Floats) -> Floats:
    array = np.array(array, dtype=np.float64)
    array.flags.writeable = False
    return array


def _nearest_rotation(matrix: Floats) -> Floats:
    left, stretches, right = np.linalg.svd(matrix)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _ORTHOGONAL:
        raise PoseError(f"rotation: expected an orthogonal matrix (to {_ORTHOGONAL}), got stretches of "
                        f"{_words(stretches)}; a pose has no scale and no shear.")  # fmt: skip
    if np.linalg.det(matrix) < 0:
        raise PoseError("rotation: expected determinant +1, got -1: the matrix mirrors; "
                        "one axis is swapped or its sign is wrong.")  # fmt: skip
    return left @ right


def _words(numbers: Floats) -> str:
    return " ".join(f"{number:.6g}" for number in numbers)


def _halves(twist: ArrayLike) -> tuple[Floats, Floats]:
    checked = _checked("twist", twist, (6,))
    return checked[:3], checked[3:]


def _cross_matrices(vectors: Floats) -> Floats:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _left_jacobian(w: Floats) -> Floats:
    angle, cross = float(np.linalg.norm(w)), _cross_matrices(w[None])[0]
    # (1 - cos a) / a^2 = sinc(a / 2)^2 / 2; the other quotient needs its series where a^3 cancels.
    first = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    second = (angle - np.sin(angle)) / angle**3 if angle > 1e-2 else 1 / 6 - angle**2 / 120
    return np.eye(3) + first * cross + second * cross @ cross


# --- Files.


def read_matrix(path: str | Path, unit: Unit = "m") -> Pose:
    """The pose in a file: the motion that takes the body at rest to where the camera sees it.

    A transform of ITK or 3D Slicer (`.tfm`) is in millimetres and LPS, and its matrix leads from where the body is
    shown back to where it rests: it is inverted here, so that the transform that moves the model in Slicer is the pose.

    Args:
        path: 4 x 4 numbers as TXT, CSV, NPY or JSON, or a linear `.tfm` (see `transforms.read_transform`).
        unit: unit of the translation in files other than `.tfm`.

    Raises:
        FileError: missing or damaged file, another suffix or kind of transform, or no rigid motion.
    """
    matrix = read_transform(path, unit)
    try:
        pose = Pose.from_matrix(matrix)
    except PoseError as error:
        raise FileError(f"{path}: {error}") from error
    return pose.inverse() if Path(path).suffix.lower() == ".tfm" else pose


def read_landmarks(path: str | Path, unit: Unit = "m", axes: Axes | None = None) -> dict[str, Floats]:
    """Named points of a file, each (3,), metres.

    Args:
        path: see `landmarks.read_named_points`.
        unit: of files that state none.
        axes: `lps` or `ras` turns the points of a file that says its axes to these; otherwise they stay as they are.

    Raises:
        FileError: missing or damaged file, another suffix, no points, or a name twice; the message names it.
    """
    found = read_named_points(path, unit)
    turn = RAS_TO_LPS if axes is not None and found.axes not in (None, axes) else np.ones(3)
    return {name: turn * place for name, place in found.points.items()}


# --- Landmarks.


@dataclass(frozen=True, eq=False)
class LandmarkFit:
    """The pose that brings landmarks of the body to those that the camera sees.

    Args:
        pose: the pose.
        residuals: distance that is left at each landmark, by name, metres.
        unmatched: names that only one of the two sides has.
    """

    pose: Pose
    residuals: Mapping[str, float]
    unmatched: tuple[str, ...]

    @property
    def rms(self) -> float:
        """Root of the mean squared residual, metres."""
        return float(np.sqrt(np.mean(np.square(list(self.residuals.values())))))


def from_landmarks(body: Mapping[str, ArrayLike], camera: Mapping[str, ArrayLike]) -> LandmarkFit:
    """The pose of least squares between landmarks of the same name (Kabsch 1976).

    Args:
        body: places on the body at rest by name, each (3,), metres.
        camera: places in the camera's coordinates by name, each (3,), metres.

    Raises:
        PoseError: fewer than three names in common, or landmarks in one line.
    """
    names = [name for name in body if name in camera]
    unmatched = tuple(sorted(set(body) ^ set(camera)))
    if len(names) < 3:
        shared, alone = ", ".join(names) or "none", ", ".join(unmatched) or "none"
        raise PoseError(f"landmarks: expected at least three names that body and camera share, got {len(names)} "
                        f"({shared}); only one side has {alone}.")  # fmt: skip
    x, y = (np.array([_checked(f"landmarks[{name!r}]", side[name], (3,)) for name in names]) for side in (body, camera))
    for side, points in (("body", x), ("camera", y)):
        extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not extents[1] > _FLAT * extents[0]:
            raise PoseError(f"landmarks: expected three that are not in one line, got {', '.join(names)} "
                            f"in one line on the side of the {side}; the turn about it is open.")  # fmt: skip
    pose = _kabsch(x, y)
    left = np.linalg.norm(pose.apply(x) - y, axis=1)
    return LandmarkFit(pose, dict(zip(names, left.tolist(), strict=True)), unmatched)


def _kabsch(x: Floats, y: Floats) -> Pose:
    left, _, right = np.linalg.svd((y - y.mean(axis=0)).T @ (x - x.mean(axis=0)))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))  # a rotation, where a mirror would fit better
    rotation = left @ right
    return Pose(rotation, y.mean(axis=0) - rotation @ x.mean(axis=0))
