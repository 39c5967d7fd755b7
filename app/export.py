"""A registered frame as files: the organ with its fields, the moved surface of each structure, all as a time series."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.embedding import outer
from softtwin.meshes.export import SURFACE_FORMATS, Coordinates, write_points, write_series, write_surface
from softtwin.meshes.io import write_deformed
from softtwin.registration.result import Registration

from .bundles import Track, write_scene, write_sequence
from .config import ConfigError
from .markups import targets_of, write_targets
from .twin import Twin

Floats = NDArray[np.float64]
FIELD, TARGETS, SEQUENCE = "nrrd", "mrk.json", "seq.mrb"
FORMATS = ("vtu", *SURFACE_FORMATS, FIELD, TARGETS, SEQUENCE)
WRITTEN = ("vtu", "vtp")  # where nothing else is asked for
SERIES, SCENE = "frames.pvd", "frames.mrb"
VOLUME, CLOUD, DISPLACEMENT, POINTS = "frame", "cloud", "displacement", "targets"
_TAKEN = ("organ", "frames", VOLUME, CLOUD, POINTS, f"{DISPLACEMENT}-forward", f"{DISPLACEMENT}-inverse")


@dataclass(frozen=True)
class Exporter:
    """Writes frames of a twin in the coordinates that its configuration says: millimetres and LPS, if nothing else.

    What 3D Slicer and ITK alone read (`nrrd`, `mrk.json`, `seq.mrb`) is in millimetres in any case: they take no other.

    Args:
        twin: the twin.
        folder: to write to; it is there.
        formats: `vtu` for the whole organ with displacement and force; `stl`, `ply`, `obj`, `vtp` for the surfaces;
            `nrrd` for the displacement field in both directions, unless a frame is refused; `mrk.json` for the inner
            structures as points with their margins; `seq.mrb` for the surfaces of all frames as sequences (which
            brings `vtp` along).

    Raises:
        ConfigError: an unknown format, points of inner structures of a twin that has none, or too small a voxel.
    """

    twin: Twin
    folder: Path
    formats: tuple[str, ...] = WRITTEN

    def __post_init__(self) -> None:
        unknown = [name for name in self.formats if name not in FORMATS]
        if unknown:
            raise ConfigError(f"Exporter.formats: expected some of {', '.join(FORMATS)}, got {', '.join(unknown)}.")
        if TARGETS in self.formats and not self.twin.body.inner:
            raise ConfigError(
                f"Exporter.formats: expected a twin with inner structures for {TARGETS} (softtwin build --inner "
                "NAME=FILE), got one without."
            )

        if FIELD in self.formats:
            _check_voxel(self.twin)

    @property
    def place(self) -> Coordinates:
        """Unit and axes of the files."""
        return self.twin.written_in

    @cached_property
    def _body(self) -> Body:
        body = self.twin.body
        return replace(body, points=self.place.lengths(body.points), surfaces={}, inner={}, skin=None)

    @cached_property
    def _names(self) -> Mapping[str, str]:
        return file_names(self.twin.body.inner)

    @property
    def _kinds(self) -> list[str]:
        wanted = {*self.formats, *(("vtp",) if SEQUENCE in self.formats else ())}  # sequences are made of these
        return [kind for kind in SURFACE_FORMATS if kind in wanted]

    def write(self, number: int, result: Registration, cloud: Floats | None = None) -> list[str]:
        """Names of the files written for a frame, each whole or not at all.

        Args:
            number: of the frame.
            result: what was found.
            cloud: the cloud, thinned, (p, 3), metres; written beside the surfaces, in the body's coordinates.

        Raises:
            FileError: a file could not be written.
        """
        names = []
        if "vtu" in self.formats:
            names.append(self._write_volume(number, result))
        names += self._write_surfaces(number, result) if self._kinds else []
        if cloud is not None and "vtp" in self._kinds:
            names.append(f"{CLOUD}_{number:04d}.vtp")
            seen = self.place.lengths(result.pose.inverse().apply(cloud))
            write_points(self.folder / names[-1], seen, place=self.place)
        if FIELD in self.formats and result.judgement.is_usable:  # nobody is to move images by another
            names += self._write_fields(number, result)
        if TARGETS in self.formats:
            names.append(f"{POINTS}_{number:04d}.{TARGETS}")
            points = targets_of(self.twin, result, self.twin.config.registration.target_points)
            write_targets(self.folder / names[-1], points, self.place.axes)
        return names

    def _write_volume(self, number: int, result: Registration) -> str:
        name, place = f"{VOLUME}_{number:04d}.vtu", self.place
        fields = {
            "force_N": place.directions(result.forces),
            "deviation": place.distances(result.uncertainty.deviation),
        }
        moved = place.lengths(result.displacement)
        words = {**place.words, "MARGINS_IN": result.frame}
        write_deformed(self.folder / name, self._body, moved, fields, words)
        return name

    def _write_surfaces(self, number: int, result: Registration) -> list[str]:
        names, place = [], self.place
        for name, surface in self.twin.surfaces(result).items():
            rest = self.twin.body.inner[name] if name in self.twin.body.inner else outer(self.twin.body).rest
            outward = Surface(place.lengths(surface.points), surface.triangles)
            shift = {"displacement": place.lengths(surface.points - rest.points)}
            if name in self.twin.outside and (outside := self.twin.outside[name]).any():
                shift["is_known"] = (~outside).astype(np.uint8)
            for kind in self._kinds:
                names.append(f"{self._names.get(name, 'organ')}_{number:04d}.{kind}")
                write_surface(self.folder / names[-1], outward, shift, place)
        return names

    def _write_fields(self, number: int, result: Registration) -> list[str]:
        from softtwin.meshes.displacement import forward_field, inverse_field, write_displacement  # pynrrd, here alone

        body, moved, edge = self.twin.body, result.displacement, self.twin.config.registration.voxel
        names, place = list[str](), Coordinates("mm", self.place.axes)
        for direction, make in (("forward", forward_field), ("inverse", inverse_field)):
            path = self.folder / f"{DISPLACEMENT}-{direction}_{number:04d}.{FIELD}"
            names += [file.name for file in write_displacement(path, make(body, moved, edge), place)]
        return names

    def write_series(self, frames: Iterable[tuple[int, Sequence[str]]]) -> str:
        """Name of the time series of the frames, numbers and files of each; empty where no format goes into one."""
        pieces = [
            (float(number), _part(file), file)
            for number, files in frames
            for file in files
            if file.endswith((".vtu", ".vtp"))
        ]
        if not pieces:
            return ""
        write_series(self.folder / SERIES, pieces, self.place)
        return SERIES

    def write_bundles(self, frames: Iterable[tuple[int, Sequence[str]]]) -> list[str]:
        """Names of the sequences for 3D Slicer, and of the scene that plays all; none where they were not asked for.

        Args:
            frames: numbers and files of each.

        Raises:
            FileError: a file could not be written.
        """
        written = [(number, {_part(file): file for file in files if file.endswith(".vtp")}) for number, files in frames]
        parts = [("organ" if "organ" not in self._names else "organ surface", "organ"), *self._names.items()]
        tracks = []
        for name, part in parts if SEQUENCE in self.formats else ():
            found = [(number, self.folder / files[part]) for number, files in written if part in files]
            if found:
                tracks.append(Track(name, f"{part}.{SEQUENCE}", found))
        for track in tracks:
            write_sequence(self.folder / track.file, track, self.place)
        if not tracks:
            return []
        write_scene(self.folder / SCENE, self.folder, tracks, self.place)
        return [*(track.file for track in tracks), SCENE]


def _check_voxel(twin: Twin) -> None:
    """Refuse voxels of which there would be too many; a deformed organ may be twice as long as at rest."""
    from softtwin.meshes.displacement import MAXIMUM_VOXELS  # pynrrd, which is missed before the first frame

    least = 2.0 * float(np.ptp(twin.body.points, axis=0).max()) / MAXIMUM_VOXELS
    edge = twin.config.registration.voxel
    if 0.0 < edge < least:
        raise ConfigError(f"registration.voxel: expected 0 or at least {least:.2g} m for this organ, got {edge:g} m.")


def _part(file: str) -> str:
    """The structure that a frame's file is of, as files name it."""
    return re.sub(r"_\d+\.\w+$", "", file)


def file_names(structures: Iterable[str]) -> dict[str, str]:
    """For each inner structure a name that a file may bear: no two alike, and none of those that frames use."""
    taken, named = set(_TAKEN), {}
    for structure in structures:
        plain = re.sub(r"[^\w.-]+", "_", structure).strip("._") or "inner"
        name, count = plain, 2
        while name in taken:
            name, count = f"{plain}-{count}", count + 1
        taken.add(name)
        named[structure] = name
    return named
