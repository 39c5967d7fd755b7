"""Clouds in files to states of a twin: read them, register frame after frame, write what was found."""

from __future__ import annotations

import glob
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError
from softtwin.meshes.compiled import said_when_compiling
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import Axes, ContentError, FileError, Unit, is_companion, read_points
from softtwin.meshes.io.clouds import TABLES
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose, read_matrix

from . import twin as twins
from .arguments import RegisterArguments
from .config import ConfigError
from .export import WRITTEN, Exporter
from .landmarks import LandmarkFiles, camera_from_landmarks, describe_landmarks
from .parameters import priors_taken
from .record import NOTICE as NOTICE
from .record import Recorder, counts, describe, notes_on
from .schema import option_of
from .twin import Camera, Frame, Twin, coordinates_of

Floats = NDArray[np.float64]
CLOUDS = (".npy", *TABLES, ".ply", ".stl", ".obj", ".vtk", ".vtp", ".vtu", ".pcd")
_FAR_OFF = 0.25  # body sizes that fixed nodes of a truth may be off on average


@dataclass(frozen=True)
class CloudFile:
    """A cloud that is read when its turn comes.

    Args:
        path: its file.
        coordinates: unit and axes of the file.
        normals: whether the normals in it are wanted.
    """

    path: Path
    coordinates: Coordinates
    normals: bool = False

    def read(self) -> Floats:
        """The points, (p, 3), metres, or with their normals (p, 6).

        Raises:
            FileError: the file is missing, damaged, or of no known kind.
        """
        return self.measured()[0]

    def measured(self) -> tuple[Floats, int]:
        """The same, and how many rows of the file have no measurement and were left out.

        Raises:
            FileError: as `read`.
        """
        found = read_points(self.path, self.coordinates.unit, self.coordinates.axes, self.normals)
        points = found.points if found.normals is None else np.hstack([found.points, found.normals])
        return points, found.rows - len(found.points)


def find_clouds(names: Sequence[Path | str], coordinates: Coordinates, normals: bool = False) -> list[CloudFile]:
    """The clouds that files, folders and patterns name; those of a folder or a pattern in the order of their numbers.

    Every file is read once, so that one that cannot be read is said before the first is registered; one that can be
    but holds no points, or NaN, has its frame refused when its turn comes.

    Args:
        names: files, folders, or patterns such as `clouds/*.ply`.
        coordinates: unit and axes of the files.
        normals: whether the normals in them are wanted.

    Raises:
        FileError: nothing is there, or a file cannot be read.
    """
    files = [CloudFile(path, coordinates, normals) for name in names for path in _files_of(str(name))]
    for file in tqdm(files, desc="reading", unit="cloud", disable=None if len(files) > 1 else True, leave=False):
        try:
            file.read()
        except ContentError:
            continue
    return files


def _files_of(name: str) -> list[Path]:
    path = Path(name)
    if path.is_file():
        return [path]
    if path.is_dir():
        found = [file for file in path.iterdir() if file.suffix.lower() in CLOUDS and not is_companion(file)]
        if not found:
            raise FileError(f"{path}: expected clouds in this folder ({', '.join(CLOUDS)}), found none.")
    elif glob.has_magic(name):
        within = glob.escape(str(path.parent)) if path.parent.is_dir() else str(path.parent)
        found = [Path(file) for file in glob.glob(f"{within}/{path.name}", recursive=True)]
        found = [file for file in found if file.is_file() and not is_companion(file)]
        if not found:
            raise FileError(f"{name}: expected a pattern of files, found none that matches.")
    else:
        raise FileError(f"{name}: expected a cloud, a folder of clouds or a pattern in quotes, found nothing there.")
    return sorted(found, key=lambda file: by_numbers(str(file)))


def by_numbers(name: str) -> list[tuple[int, str]]:
    """A key by which cloud_2 comes before cloud_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def read_truth(path: Path, frames: int, body: Body, coordinates: Coordinates) -> Floats:
    """True node positions, (frames or more, n, 3), metres, on the inner axes.

    Args:
        path: .npy of shape (frames or more, n, 3), or (n, 3) for one frame, metres, on the axes of the twin's files.
        frames: how many are wanted.
        body: the body.
        coordinates: of the twin's files.

    Raises:
        ConfigError: no such array, another shape, or numbers that are not finite.
    """
    nodes = len(body.points)
    try:
        positions = np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except (ValueError, EOFError, OSError) as error:
        raise ConfigError(f"--truth: expected an array of node positions in {path} ({error}).") from None
    if positions.shape == (nodes, 3) and frames == 1:
        positions = positions[None]
    if positions.ndim != 3 or positions.shape[1:] != (nodes, 3) or len(positions) < frames:
        one = f" or ({nodes}, 3)" if frames == 1 else ""
        raise ConfigError(
            f"--truth: expected shape ({frames} or more, {nodes}, 3){one}, got {positions.shape} in {path}."
        )
    if not np.isfinite(positions).all():
        raise ConfigError(f"--truth: expected finite positions, got NaN or infinity in {path}.")
    turned = coordinates.directions(positions)
    off = np.linalg.norm(turned[0, body.fixed] - body.points[body.fixed], axis=1)
    away = float(off.mean()) if len(off) else 0.0
    is_spot = len(off) > 1 and float(np.ptp(turned[0, body.fixed], axis=0).max()) == 0.0  # displacements: all zero
    if away > _FAR_OFF * body.size or is_spot:
        raise ConfigError(
            f"--truth: expected positions in metres in which the fixed nodes are where the body has them, got them "
            f"{away:.3g} m away on average in {path}; are these displacements, or in another unit or on other axes?"
        )
    return turned


def check_output(output: Path, home: twins.Home, names: Sequence[Path | str]) -> None:
    """Refuse to write among what is read: the next run would take results for clouds, or for a twin.

    Args:
        output: folder to write to.
        home: of the twin.
        names: files, folders or patterns of clouds.

    Raises:
        ConfigError: it is a folder whose clouds are all read, or the twin's.
    """
    wanted, read = output.resolve(), [Path(name) for name in names if not Path(name).is_file()]
    if wanted in {(path if path.is_dir() else path.parent).resolve() for path in read}:
        raise ConfigError(f"--output: expected a folder of its own, got {output}, in which the clouds are.")
    if wanted == home.folder.resolve():
        raise ConfigError(f"--output: expected a folder of its own, got {output}, in which the twin is.")


def camera_from_matrix(path: Path, coordinates: Coordinates) -> Pose:
    """The pose in a file, between the inner axes of body and clouds.

    Args:
        path: as for `read_matrix`: it takes the body at rest to the camera.
        coordinates: of the clouds; their unit is that of the translation. A `.tfm` says its own.

    Raises:
        FileError: see `read_matrix`.
    """
    pose = read_matrix(path, coordinates.unit)
    return pose if path.suffix.lower() == ".tfm" else Pose.from_matrix(coordinates.motion(pose.matrix))


@dataclass(frozen=True)
class Start:
    """Where a person says that the camera stands, at most one of the first three, and what pulls beside the clouds.

    Args:
        matrix: file of the pose.
        landmarks: files of landmarks, on the body and in the camera's coordinates.
        align: look for the pose in the clouds.
        frame_landmarks: file of points on the body at rest, and the folder of where each cloud's frame shows
            them (or the file, for one cloud); see `LandmarkFiles`.
    """

    matrix: Path | None = None
    landmarks: tuple[Path, Path] | None = None
    align: bool = False
    frame_landmarks: tuple[Path, Path] | None = None


def register_files(
    place: Path,
    names: Sequence[Path | str],
    output: Path,
    options: Mapping[str, Any],
    *,
    unit: Unit | None = None,
    axes: Axes | None = None,
    start: Start | None = None,
    truth: Path | None = None,
    formats: tuple[str, ...] = (),
    budget: float | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, int]:
    """Register the clouds in files to the twin in a folder; returns how many frames bear each verdict.

    Args:
        place: the twin; see `find_twin`.
        names: files, folders or patterns of clouds.
        output: folder to write to.
        options: entries of [registration] that replace the twin's.
        unit: of the clouds; that of the twin's files if not given.
        axes: of the clouds; those of the twin's files if not given.
        start: where the camera stands; in the body's coordinates if not given.
        truth: file of true node positions.
        formats: of the files of each frame; VTU and VTP if none.
        budget: seconds for a frame, after which no step is begun; what the configuration says if not given.
        say: prints a line.

    Raises:
        ConfigError, FileError, CloudError, PoseError, TwinError: what cannot be used, and why.
    """
    scene = Scene.of(place, options, unit, axes)
    clouds = find_clouds(names, scene.outside, scene.normals)
    budget = scene.budget(budget)
    check_output(output, scene.home, names)
    positions = None if truth is None else read_truth(truth, len(clouds), scene.home.body, scene.inside)
    if positions is not None and len(positions) > len(clouds):
        say(f"warning: --truth has {len(positions)} frames, for {len(clouds)} clouds: the first of them are taken.")
    start = start or Start()
    frame_landmarks = scene.frame_landmarks(start, [cloud.path for cloud in clouds])
    with scene.opened(start, say) as (twin, camera):
        say_coordinates(twin, say)
        chosen = formats or WRITTEN
        rows = register_clouds(
            twin,
            clouds,
            output,
            camera=camera,
            truth=positions,
            formats=chosen,
            budget=budget,
            frame_landmarks=frame_landmarks,
            say=say,
        )
    return counts(rows)


@dataclass(frozen=True)
class Scene:
    """A twin in a folder and the coordinates of its files and of the clouds'.

    Args:
        home: of the twin.
        options: entries of [registration] that replace the twin's.
        inside: coordinates of the body's files.
        outside: of the clouds' files.
    """

    home: twins.Home
    options: Mapping[str, Any]
    inside: Coordinates
    outside: Coordinates

    @classmethod
    def of(cls, place: Path, options: Mapping[str, Any], unit: Unit | None, axes: Axes | None = None) -> Scene:
        """The scene of a place; see `find_twin`.

        Args:
            place: the twin.
            options: as above.
            unit: of the clouds; that of the twin's files if not given.
            axes: of the clouds; those of the twin's files if not given.

        Raises:
            ConfigError: there is no twin, or an option cannot be.
        """
        home = twins.find_twin(place)
        inside = coordinates_of(twins.with_options(home.config, dict(options)))
        return cls(home, options, inside, Coordinates(unit or inside.unit, axes or inside.axes))

    @property
    def normals(self) -> bool:
        """Whether the normals in the clouds' files are wanted."""
        return twins.with_options(self.home.config, dict(self.options)).registration.normals

    def budget(self, given: float | None) -> float | None:
        """Seconds for a frame: those given, or the configuration's; None for no limit."""
        if given is not None:
            return given
        return twins.with_options(self.home.config, dict(self.options)).registration.budget or None

    def frame_landmarks(self, start: Start, clouds: Sequence[Path] | None = None) -> LandmarkFiles | None:
        """What pulls beside the clouds; None where nothing was given.

        Args:
            start: what a person has given.
            clouds: files of all clouds; None where they are yet to come.

        Raises:
            ConfigError, FileError: see `LandmarkFiles.read`.
        """
        return (
            None
            if start.frame_landmarks is None
            else LandmarkFiles.read(*start.frame_landmarks, self.inside, self.outside, clouds)
        )

    @contextmanager
    def opened(self, start: Start, say: Callable[[str], None]) -> Iterator[tuple[Twin, Camera]]:
        """The twin, and where the camera stands.

        Args:
            start: what a person has given.
            say: prints a line.

        Raises:
            ConfigError, FileError, PoseError, TwinError: what cannot be used, and why.
        """
        section = twins.with_options(self.home.config, dict(self.options)).registration
        for line in priors_taken(section.parameters) if section.forces != "known" else ():
            say(line)
        pose = None
        if start.matrix is not None:
            pose = camera_from_matrix(start.matrix, self.outside)
        if start.landmarks is not None:
            fit = camera_from_landmarks(*start.landmarks, self.inside, self.outside)
            say(describe_landmarks(fit))
            pose = fit.pose
        once = "compiling for this machine, once: the first frame waits for it"
        with said_when_compiling(lambda: say(once)), self.home.twin(**self.options) as twin:
            is_fitted = start.landmarks is not None
            yield twin, "align" if start.align else camera_of(twin, pose, is_fitted=is_fitted)


def say_coordinates(twin: Twin, say: Callable[[str], None]) -> None:
    """Say in which unit and on which axes results are written."""
    say(f"results in {twin.written_in.unit}, {twin.written_in.axes.upper()}")
    for note in notes_on(twin):
        say(note)


def camera_of(twin: Twin, pose: Pose | None, *, is_fitted: bool = False) -> Pose | PosePrior | None:
    """A start as the configuration wants it: known, or an unknown near it.

    Args:
        twin: the twin; `config.registration.pose` says which.
        pose: the start; None where none was given: the camera's coordinates are the body's.
        is_fitted: the start comes from landmarks on the organ as the camera has seen it; see `Twin.fitted_prior`.
    """
    wanted = twin.config.registration.pose
    if wanted == "unknown" or (wanted == "auto" and pose is not None):
        return twin.fitted_prior(pose) if is_fitted and pose is not None else twin.near(pose or Pose.identity())
    return pose


def register_clouds(
    twin: Twin,
    clouds: Sequence[CloudFile | ArrayLike],
    output: Path,
    *,
    zone: str | None = None,
    camera: Camera = None,
    truth: Floats | None = None,
    formats: tuple[str, ...] = WRITTEN,
    budget: float | None = None,
    frame_landmarks: LandmarkFiles | None = None,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Register a sequence and write each frame as it is found; returns the figures of all frames.

    Args:
        twin: the twin.
        clouds: one a frame: files, or points (p, 3) in metres.
        output: folder to write to.
        zone: as for `Twin.register`.
        camera: where the camera stands.
        truth: true node positions of each frame, (frames, n, 3), metres, to state errors.
        formats: of the files of each frame.
        budget: as for `register_files`.
        frame_landmarks: landmarks that pull beside clouds in files.
        say: prints one line a frame.

    Raises:
        CloudError: none of the clouds could be registered at all; their frames are written all the same.
        ConfigError: a budget that is no positive number; landmarks that this twin cannot take.
    """
    check_budget(budget)
    sequence = twins.Sequence(twin, zone, camera)
    if frame_landmarks is not None:
        frame_landmarks.check(twin)
    with (
        Recorder(Exporter(twin, output, formats), zone, truth) as recorder,
        tqdm(total=len(clouds), desc="registering", unit="frame", disable=None) as bar,
    ):
        for cloud in clouds:
            until = math.inf if budget is None else time.monotonic() + budget
            row = recorder.add(registered(sequence, cloud, until, frame_landmarks), name_of(cloud))
            with tqdm.external_write_mode():
                say(describe(row))
            bar.update()
    check_any(recorder.rows)
    return recorder.rows


def check_budget(budget: float | None) -> None:
    """Refuse seconds for a frame that are no positive number.

    Raises:
        ConfigError: they are not.
    """
    option_of(RegisterArguments, "budget").check(budget, "--budget")


def check_any(rows: Sequence[Mapping[str, Any]]) -> None:
    """Refuse a sequence of which nothing could be registered.

    Args:
        rows: figures of its frames.

    Raises:
        CloudError: with the first frame's reason.
    """
    if rows and all("outcome" not in row for row in rows):
        name = f"{rows[0]['cloud']}: " if rows[0]["cloud"] else ""
        raise CloudError(f"no cloud could be registered; the first: {name}{rows[0]['reasons'][0]}")


def name_of(cloud: CloudFile | ArrayLike) -> str:
    """Of a cloud's file; empty for points."""
    return cloud.path.name if isinstance(cloud, CloudFile) else ""


def registered(
    sequence: twins.Sequence,
    cloud: CloudFile | ArrayLike,
    until: float = math.inf,
    frame_landmarks: LandmarkFiles | None = None,
) -> Frame:
    """The next frame of a sequence; refused, with the reason, where its file or its landmarks' cannot be read.

    Args:
        sequence: the sequence.
        cloud: a file, or points (p, 3) in metres.
        until: as for `Sequence.register`.
        frame_landmarks: landmarks that pull beside clouds in files.
    """
    if not isinstance(cloud, CloudFile):
        return sequence.register(cloud, until)
    try:
        points, missing = cloud.measured()
        landmarks = None if frame_landmarks is None else frame_landmarks.of(cloud.path)
    except FileError as error:  # it could be read a moment ago, or holds nothing to register
        return sequence.refuse(str(error).removeprefix(f"{cloud.path}: "))  # the frame says which file it is
    frame = sequence.register(points, until, landmarks)
    return replace(frame, missing=frame.missing + missing)
