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
from softtwin.meshes.export import SURFACE_FORMATS, write_points, write_series, write_surface
from softtwin.meshes.files import write_deformed
from softtwin.registration.registrar import Registration

from .twin import Twin

Floats = NDArray[np.float64]
FORMATS = ("vtu", *SURFACE_FORMATS)
WRITTEN = ("vtu", "vtp")  # where nothing else is asked for
SERIES = "frames.pvd"
VOLUME, CLOUD = "frame", "cloud"


@dataclass(frozen=True)
class Exporter:
    """Writes frames of a twin in the unit and on the axes of the files that it was made from.

    Args:
        twin: the twin.
        folder: to write to; it is there.
        formats: `vtu` for the whole organ with displacement and force, `stl`, `ply`, `vtp` for the surfaces.

    Raises:
        ValueError: an unknown format.
    """

    twin: Twin
    folder: Path
    formats: tuple[str, ...] = WRITTEN

    def __post_init__(self) -> None:
        unknown = [name for name in self.formats if name not in FORMATS]
        if unknown:
            raise ValueError(f"Exporter.formats: expected some of {', '.join(FORMATS)}, got {', '.join(unknown)}.")

    @cached_property
    def _body(self) -> Body:
        body = self.twin.body
        return replace(body, points=self.twin.coordinates.lengths(body.points), surfaces={}, inner={}, skin=None)

    @cached_property
    def _names(self) -> Mapping[str, str]:
        return file_names(self.twin.body.inner)

    def write(self, number: int, result: Registration, cloud: Floats | None = None) -> list[str]:
        """Names of the files written for a frame, each whole or not at all.

        Args:
            number: of the frame.
            result: what was found.
            cloud: the cloud, thinned, (p, 3), metres; written beside the surfaces, in the body's coordinates.
        """
        names, place = [], self.twin.coordinates
        moved = place.lengths(result.displacement)
        if "vtu" in self.formats:
            names.append(f"{VOLUME}_{number:04d}.vtu")
            fields = {
                "force_N": place.directions(result.forces),
                "deviation": place.distances(result.uncertainty.deviation),
            }
            write_deformed(self.folder / names[-1], self._body, moved, fields)
        kinds = [kind for kind in SURFACE_FORMATS if kind in self.formats]
        for name, surface in self.twin.surfaces(result).items() if kinds else ():
            rest = self.twin.body.inner[name] if name in self.twin.body.inner else outer(self.twin.body).rest
            outward = Surface(place.lengths(surface.points), surface.triangles)
            shift = {"displacement": place.lengths(surface.points - rest.points)}
            for kind in kinds:
                names.append(f"{self._names.get(name, 'organ')}_{number:04d}.{kind}")
                write_surface(self.folder / names[-1], outward, shift)
        if cloud is not None and "vtp" in kinds:
            names.append(f"{CLOUD}_{number:04d}.vtp")
            write_points(self.folder / names[-1], place.lengths(result.pose.inverse().apply(cloud)))
        return names

    def write_series(self, frames: Iterable[tuple[int, Sequence[str]]]) -> str:
        """Name of the time series of the frames, numbers and files of each; empty where no format goes into one."""
        pieces = [
            (float(number), re.sub(r"_\d+\.\w+$", "", file), file)
            for number, files in frames
            for file in files
            if file.endswith((".vtu", ".vtp"))
        ]
        if not pieces:
            return ""
        write_series(self.folder / SERIES, pieces)
        return SERIES


def file_names(structures: Iterable[str]) -> dict[str, str]:
    """For each inner structure a name that a file may bear: no two alike, and none of those that frames use."""
    taken, named = {"organ", VOLUME, CLOUD}, {}
    for structure in structures:
        plain = re.sub(r"[^\w.-]+", "_", structure).strip("._") or "inner"
        name, count = plain, 2
        while name in taken:
            name, count = f"{plain}-{count}", count + 1
        taken.add(name)
        named[structure] = name
    return named
