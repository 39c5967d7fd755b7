"""Where the camera stands: rigid motions from the body at rest to the camera, their files, landmarks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from softtwin.meshes.export import PER_METRE
from softtwin.meshes.io import Axes, FileError, Unit

Floats = NDArray[np.float64]

_ORTHOGONAL = 1e-3  # how far R R^T may be from one: matrices come typed by hand with four digits
_FLAT = 1e-2  # landmarks are in a line when their second extent is below this part of the first
_TURN = np.array([-1.0, -1.0, 1.0])  # from RAS to LPS and back
_ITK = ("AffineTransform", "MatrixOffsetTransformBase")


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
        path: 4 x 4 numbers as TXT, CSV, NPY or JSON (rows, or an object with `matrix`), or an affine `.tfm`.
        unit: unit of the translation in files other than `.tfm`.

    Raises:
        FileError: missing or damaged file, another suffix or kind of transform, or no rigid motion.
    """
    path = _existing(path)
    readers = {".npy": _npy_matrix, ".json": _json_matrix, ".tfm": _itk_matrix, ".txt": _table, ".csv": _table}
    if path.suffix.lower() not in readers:
        raise FileError(f"{path}: expected a matrix as {', '.join(sorted(readers))}, got suffix {path.suffix!r}.")
    is_itk = path.suffix.lower() == ".tfm"
    try:
        matrix = np.array(readers[path.suffix.lower()](path), dtype=np.float64)
        if matrix.shape == (4, 4):
            matrix[:3, 3] /= _per_metre("mm" if is_itk else unit)
        pose = Pose.from_matrix(matrix)
    except FileError:
        raise
    except PoseError as error:
        raise FileError(f"{path}: {error}") from error
    except (ValueError, TypeError, KeyError, OSError, EOFError) as error:
        raise FileError(f"{path}: expected a matrix of 4 x 4 numbers ({error}).") from error
    return pose.inverse() if is_itk else pose


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise FileError(f"{path}: no such file." if not path.exists() else f"{path}: expected a file, got a folder.")
    return path


def _per_metre(unit: str) -> float:
    if unit not in PER_METRE:
        raise FileError(f"unit: expected one of {', '.join(PER_METRE)}, got {unit!r}.")
    return PER_METRE[unit]


def _table(path: Path) -> Any:
    rows = [line.split() for line in path.read_text().replace(",", " ").replace(";", " ").splitlines()]
    return [row for row in rows if row and not row[0].startswith("#")]


def _npy_matrix(path: Path) -> Any:
    return np.load(path, allow_pickle=False)


def _json_matrix(path: Path) -> Any:
    content = json.loads(path.read_text())
    return content["matrix"] if isinstance(content, dict) else content


def _itk_matrix(path: Path) -> Any:
    lines = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line and line[0] != "#")
    kind = lines.get("Transform", "").strip()
    if kind.split("_")[0] not in _ITK or not kind.endswith("_3_3"):
        raise FileError(f"{path}: expected one affine transform in space, got {kind or 'none'!r}; "
                        "save it as a linear transform, or give its 4 x 4 matrix as text.")  # fmt: skip
    numbers = np.array(lines["Parameters"].split(), dtype=np.float64)
    centre = np.array(lines.get("FixedParameters", "0 0 0").split(), dtype=np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = numbers[:9].reshape(3, 3)
    matrix[:3, 3] = numbers[9:12] + centre - matrix[:3, :3] @ centre
    return matrix


def read_landmarks(path: str | Path, unit: Unit = "m", axes: Axes | None = None) -> dict[str, Floats]:
    """Named points of a file, each (3,), metres.

    Args:
        path: TXT or CSV with lines `name,x,y,z`, or points that 3D Slicer marked (`.fcsv`, `.mrk.json`).
        unit: unit of TXT and CSV, and of Slicer's files where they say none other than their millimetres.
        axes: `lps` or `ras` turns the points of a file that says its axes to these; otherwise they stay as they are.

    Raises:
        FileError: missing or damaged file, another suffix, no points, or a name twice; the message names it.
    """
    path = _existing(path)
    try:
        if path.name.lower().endswith(".json"):
            named, own, unit = _markup_points(path)
        elif path.suffix.lower() == ".fcsv":
            named, own, unit = *_fiducials(path), "mm"
        elif path.suffix.lower() in (".csv", ".txt"):
            named, own = _named_rows(path), None
        else:
            raise FileError(f"{path}: expected landmarks as .csv, .txt, .fcsv or .mrk.json, got {path.suffix!r}.")
        points = [(name, np.array(place, dtype=np.float64) / _per_metre(unit)) for name, place in named]
    except FileError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, OSError) as error:
        raise FileError(f"{path}: expected points, each a name with x, y and z ({error}).") from error
    turn = _TURN if axes is not None and own not in (None, axes) else np.ones(3)
    return {name: turn * place for name, place in _checked_points(path, points)}


_Named = list[tuple[str, Sequence[Any]]]


def _named_rows(path: Path) -> _Named:
    lines = [line.strip() for line in path.read_text().replace(";", ",").splitlines()]
    rows = [[word.strip() for word in line.split(",")] for line in lines if line and line[0] != "#"]
    if rows and [word.lower() for word in rows[0][1:]] == ["x", "y", "z"]:
        rows = rows[1:]
    wrong = next((row for row in rows if len(row) != 4), None)
    if wrong is not None:
        raise ValueError(f"got the line {','.join(wrong)!r}")
    return [(row[0], row[1:]) for row in rows]


def _fiducials(path: Path) -> tuple[_Named, Axes]:
    said = "0"
    columns = ["id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label"]
    rows = []
    for line in path.read_text().splitlines():
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            said = value.strip() if key.strip() == "CoordinateSystem" else said
            columns = value.strip().split(",") if key.strip() == "columns" else columns
        elif line.strip():
            rows.append(dict(zip(columns, line.split(","), strict=False)))
    named: _Named = [(row["label"], [row["x"], row["y"], row["z"]]) for row in rows]
    return named, _axes(path, {"0": "RAS", "1": "LPS"}.get(said, said))


def _markup_points(path: Path) -> tuple[_Named, Axes, Unit]:
    markup = json.loads(path.read_text())["markups"][0]
    points = [point for point in markup["controlPoints"] if point.get("positionStatus", "defined") == "defined"]
    units = markup.get("coordinateUnits", "mm")
    unit = _unit(path, units if isinstance(units, str) else units[0])
    return [(p["label"], p["position"]) for p in points], _axes(path, markup.get("coordinateSystem", "LPS")), unit


def _unit(path: Path, said: str) -> Unit:
    if said in ("m", "cm", "mm"):
        return said  # type: ignore[return-value]
    raise FileError(f"{path}: expected points in m, cm or mm, got {said!r}.")


def _axes(path: Path, said: str) -> Axes:
    if said.upper() == "LPS":
        return "lps"
    if said.upper() == "RAS":
        return "ras"
    raise FileError(f"{path}: expected points in LPS or RAS, got {said!r}.")


def _checked_points(path: Path, points: list[tuple[str, Floats]]) -> list[tuple[str, Floats]]:
    if not points:
        raise FileError(f"{path}: expected landmarks, got none.")
    names = [name for name, _ in points]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise FileError(f"{path}: expected each landmark once, got {', '.join(twice)} more than once.")
    wrong = [name for name, place in points if place.shape != (3,) or not np.isfinite(place).all()]
    if wrong:
        raise FileError(f"{path}: expected three finite coordinates, got others for {', '.join(wrong)}.")
    return points


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
