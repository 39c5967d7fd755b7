"""The organ of a configuration whose source is a segmentation: its surface, what lies inside, what touches it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softtwin.meshes.attachment import File, Region, RegionError, Touching, parse_file, parts_of
from softtwin.meshes.body import Floats, Surface
from softtwin.meshes.components import Cavities
from softtwin.meshes.io import METRES, Axes, Unit
from softtwin.meshes.segmentation import (
    Segmentation,
    distances_to,
    find,
    frame_of,
    inner_surface,
    organ_surface,
    read_segmentation,
    the_organ,
    voxel_diagonal,
)

from .config import BodySection, ConfigError, files_axes

_FEW = 3  # points: fewer hold no body


@dataclass(frozen=True, eq=False)
class Scan:
    """A segmentation, and which of its labels a body is made of.

    Args:
        segmentation: the labels.
        organ: the label of the body.
        labels: label of each inner structure that is no file, by the structure's name.
        touching: what has to touch the organ.
        join: labels that are part of the organ.
        component: which component of the organ is meant.
        cavities: which of its holes stay; empty for the rule.
    """

    segmentation: Segmentation
    organ: str
    labels: Mapping[str, str]
    touching: tuple[Touching, ...] = ()
    join: tuple[str, ...] = ()
    component: str = "largest"
    cavities: Cavities = ""

    def surface(self) -> tuple[Surface, list[str]]:
        """The organ's surface, and what to say of it.

        Raises:
            FileError: it is one voxel thick.
        """
        inner = [label for label in self.labels.values() if label not in self.join]
        return organ_surface(self.segmentation, self.organ, inner, self.join, self.component, self.cavities)

    def inner(self, name: str) -> tuple[Surface, list[str]]:
        """The surface of an inner structure, and what to say of it.

        Raises:
            FileError: it is one voxel thick.
        """
        return inner_surface(self.segmentation, self.labels[name])

    def near(self, region: Touching, points: Floats, edge: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which points of the organ's boundary another label touches, (p,).

        Where the region says no distance it is one voxel's diagonal, or, where too few points for an attachment lie
        that near, as in a coarse mesh, one cell.

        Args:
            region: the label, and how near.
            points: (p, 3), metres.
            edge: of a cell, metres.

        Raises:
            RegionError: none, with how far away it is.
        """
        away = distances_to(self.segmentation, region.label, points)
        reach = region.distance or voxel_diagonal(self.segmentation, region.label)
        if region.distance is None and (away <= reach).sum() < _FEW:
            reach = max(edge, reach)
        if not (away <= reach).any():
            raise self._out_of_reach(region, reach, float(away.min()))
        return away <= reach

    def check_touching(self, surface: Surface, edge: float) -> None:
        """Refuse before a mesh is made what no mesh of this surface comes near.

        Args:
            surface: the organ's.
            edge: that no cell exceeds, metres.

        Raises:
            RegionError: with how far away it is.
        """
        for region in self.touching:
            away = float(distances_to(self.segmentation, region.label, surface.points).min())
            voxel = voxel_diagonal(self.segmentation, region.label)  # a mesh's boundary is as near to the surface
            reach = region.distance or max(edge, voxel)
            if away > reach + voxel:
                raise self._out_of_reach(region, reach, away)

    def _out_of_reach(self, region: Touching, reach: float, away: float) -> RegionError:
        return RegionError(
            f"touching {region.label}: expected it within {1e3 * reach:.3g} mm of {self.organ}, it is "
            f"{1e3 * away:.3g} mm away; touching:{region.label}:{np.ceil(1e3 * away) + 1:g}mm reaches it, if it holds "
            "the organ at all."
        )


def open_scan(section: BodySection, root: Path, regions: Iterable[Region]) -> Scan:
    """The segmentation of a configuration, whose labels are all there.

    Args:
        section: the configuration's [body].
        root: folder that relative paths start from.
        regions: of attachment, zones and observed side.

    Raises:
        ConfigError: another unit or other axes than the file's.
        FileError: it cannot be read, or lacks a label.
    """
    path = root / parse_file(section.source).path
    _check_frame(section, path)
    segmentation = read_segmentation(path, files_axes(section), parse_file(section.source).unit)
    inner = {name: text for name, text in section.inner.items() if not (root / parse_file(text).path).is_file()}
    touching = tuple(region for region in regions if isinstance(region, Touching))
    join = tuple(inner.get(name, name) for name in parts_of(section.join))
    component = section.component.strip()
    if component.startswith("near:"):
        near = component.removeprefix("near:")
        component = f"near:{inner.get(near, near)}"
    organ = section.organ or the_organ(segmentation)
    scan = Scan(segmentation, organ, inner, touching, join, component, section.cavities)
    for label in (scan.organ, *inner.values(), *join, *(region.label for region in touching)):
        find(segmentation, label)
    return scan


def framed(source: str, unit: Unit | None, frame: Axes | None) -> tuple[str, Unit, Axes]:
    """Source with its whole path and axes, unit and axes, as a segmentation says them itself.

    A unit that the user says wins over the file's: it stands behind the source then.

    Args:
        source: file or folder, with unit and axes behind it or not.
        unit: that the user says.
        frame: axes that the user says.

    Raises:
        ConfigError: the user says other axes than the file, or nobody says the axes.
        FileError: it cannot be read.
    """
    file = parse_file(source)
    stated, axes, scale = frame_of(file.path)
    told, turned = file.unit or unit, file.axes or frame
    if turned and axes and turned != axes:
        raise ConfigError(
            f"--frame: expected {axes}, which {file.path} says of itself, got {turned}. Coordinates are on the file's "
            "own axes; other files have theirs behind the name (veins.ply:cm:lps)."
        )
    found = axes or turned
    if found is None:
        raise ConfigError(f"--frame: expected lps or ras, since {file.path} says no space of its own.")
    forced = told if told and METRES[told] != scale else None
    return str(File(file.path.resolve(), forced, found)), forced or stated, found


def _check_frame(section: BodySection, path: Path) -> None:
    """Refuse a configuration that says something else than its source: clouds would be read otherwise later."""
    stated, axes, _ = frame_of(path)
    forced = parse_file(section.source).unit
    if section.unit != (unit := forced or stated):
        told = File(parse_file(section.source).path, section.unit, files_axes(section))
        raise ConfigError(
            f'body.unit: {path} is in {unit}, got {section.unit!r}; write unit = "{unit}", or, where the file is wrong '
            f'about itself, source = "{told}".'
        )
    if axes and files_axes(section) != axes:
        written = File(parse_file(section.source).path, None, axes)
        raise ConfigError(f'body.source: {path} is in {axes.upper()}, expected source = "{written}".')
