"""Landmarks in files: a start for the camera, and points that pull beside the cloud of each frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import RAS_TO_LPS, ContentError, FileError, read_points
from softtwin.meshes.io.clouds import TABLES
from softtwin.meshes.io.landmarks import SUFFIXES, read_named_points
from softtwin.registration.pose import LandmarkFit, from_landmarks
from softtwin.registration.residuals.landmarks import LandmarkPairs

from .config import ConfigError
from .record import millimetres
from .twin import Twin

Floats = NDArray[np.float64]


def camera_from_landmarks(body: Path, camera: Path, inside: Coordinates, clouds: Coordinates) -> LandmarkFit:
    """The pose that brings landmarks on the body to those that the camera sees.

    Args:
        body: file of the landmarks on the body at rest.
        camera: file of those in the camera's coordinates.
        inside: coordinates of the body's files.
        clouds: of the clouds' files.

    Raises:
        FileError, PoseError: a file that cannot be read, too few landmarks in common, or all in one line.
    """
    return from_landmarks(_read(body, inside), _read(camera, clouds))


def describe_landmarks(fit: LandmarkFit) -> str:
    """One line for a person: how many landmarks were used and what is left at them."""
    worst = max(fit.residuals, key=lambda name: fit.residuals[name])
    line = f"landmarks: {len(fit.residuals)} used, {millimetres(fit.rms, 1)} left, most at {worst} "
    line += f"({millimetres(fit.residuals[worst], 1)})"
    return line + (f"; without a partner: {', '.join(fit.unmatched)}" if fit.unmatched else "")


@dataclass(frozen=True)
class LandmarkFiles:
    """Points of the organ by name, and the files that say where each frame shows some of them.

    The file of a frame is named like its cloud, but for the suffix; a frame without one has its cloud alone.

    Args:
        body: points on the body at rest by name, (3,) each, metres.
        camera: folder of the frames' files, or the file of the only one.
        coordinates: unit and axes of these, the clouds' own.
        option: that they were given by, for messages.
    """

    body: Mapping[str, Floats]
    camera: Path
    coordinates: Coordinates
    option: str = "--frame-landmarks"

    @classmethod
    def read(
        cls,
        body: Path,
        camera: Path,
        inside: Coordinates,
        clouds: Coordinates,
        files: Sequence[Path] | None,
        option: str = "--frame-landmarks",
    ) -> LandmarkFiles:
        """The landmarks of the body; those of each cloud that is there already are read once, too.

        Args:
            body: file of the landmarks on the body at rest.
            camera: folder or file, as above.
            inside: coordinates of the body's files.
            clouds: of the clouds' files.
            files: of all clouds; None where they are yet to come.
            option: as above.

        Raises:
            ConfigError: one file for several clouds, or a folder with none that is named like a cloud.
            FileError: a file cannot be read, or shares no name with the body's.
        """
        found = cls(_read(body, inside), camera, clouds, option)
        if not camera.is_dir() and (files is None or len(files) != 1):
            raise ConfigError(
                f"{option}: expected a folder with a file for each cloud, named like it, got the file "
                f"{camera} for {'clouds that are yet to come' if files is None else f'{len(files)} clouds'}."
            )
        if files is None:
            return found
        if not [file for file in files if found.of(file) is not None]:  # every file is read
            raise ConfigError(
                f"{option}: expected files in {camera} that are named like the clouds, such as "
                f"{files[0].stem}.csv ({', '.join(SUFFIXES)}), found none."
            )
        return found

    def check(self, twin: Twin) -> None:
        """Refuse landmarks that the twin cannot take, before the first frame.

        Args:
            twin: the twin.

        Raises:
            ConfigError: they do not lie on the side that a camera sees; a contact of unknown place is asked for.
        """
        points = np.array(list(self.body.values()))
        try:
            LandmarkPairs.of(twin.observed, points, points)
        except ValueError as error:
            raise ConfigError(f"{self.option}: {error}") from None

    def of(self, cloud: Path) -> tuple[Floats, Floats] | None:
        """Points on the body at rest and where a cloud's frame shows them, (l, 3) each, metres; None: it has no file.

        Args:
            cloud: file of the cloud.

        Raises:
            FileError: the file cannot be read, or shares no name with the body's.
        """
        found = self.named(cloud)
        return None if found is None else found[1:]

    def named(self, cloud: Path) -> tuple[list[str], Floats, Floats] | None:
        """The same with their names.

        Args:
            cloud: file of the cloud.

        Raises:
            FileError: as for `of`.
        """
        file = self.camera
        if file.is_dir():
            named = [file / f"{cloud.stem}{suffix}" for suffix in SUFFIXES]
            present = [path for path in named if path.is_file() and path != cloud]
            if not present:
                return None
            file = present[0]
        found = _read(file, self.coordinates)
        common = [name for name in self.body if name in found]
        if len(self.body) != len(found) and _is_of_rows(self.body) and _is_of_rows(found):
            raise FileError(
                f"{file}: expected as many rows as there are places in the organ at rest, {len(self.body)}, got "
                f"{len(found)}: without names rows are paired in their order."
            )
        if not common:
            raise FileError(
                f"{file}: expected landmarks that the body has ({', '.join(self.body)}), got {', '.join(found)}."
            )
        return common, np.array([self.body[name] for name in common]), np.array([found[name] for name in common])


def _is_of_rows(points: Mapping[str, Floats]) -> bool:
    """Whether names are the numbers of rows."""
    return list(points) == [str(number) for number in range(1, len(points) + 1)]


def _read(path: Path, coordinates: Coordinates) -> dict[str, Floats]:
    """Points by name, on the inner axes; those of a table of numbers alone are named by their rows, from 1."""
    try:
        return _named(path, coordinates)
    except FileError as error:
        if path.suffix.lower() not in (*TABLES, ".npy"):
            raise
        try:
            rows = read_points(path, coordinates.unit, coordinates.axes)
        except (FileError, ContentError):
            raise error from None
        if rows.rows != len(rows.points):
            raise FileError(
                f"{path}: expected three numbers in each row, got {rows.rows - len(rows.points)} of {rows.rows} rows "
                "without a place (NaN, infinite, or zero more than once): rows are paired by their numbers."
            ) from None
        return {str(number): place for number, place in enumerate(rows.points, 1)}


def _named(path: Path, coordinates: Coordinates) -> dict[str, Floats]:
    found = read_named_points(path, coordinates.unit)
    if found.axes is None:
        return {name: coordinates.directions(place) for name, place in found.points.items()}
    turn = RAS_TO_LPS if found.axes == "ras" else np.ones(3)
    return {name: turn * place for name, place in found.points.items()}
