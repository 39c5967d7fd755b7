"""Label maps made in the test: shapes in voxels of any size, turned any way, written as NIfTI or NRRD."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_XML = "<?xml version='1.0' encoding='UTF-8'?> <CaretExtension><VolumeInformation Index='0'><LabelTable>{}</LabelTable>"
_LABEL = "<Label Key='{}' Red='1' Green='0' Blue='0' Alpha='1'><![CDATA[{}]]></Label>\n"


@dataclass(frozen=True)
class Grid:
    """Voxels about a box, LPS, millimetres: edges, turn in degrees about z and then y, axes that run backwards."""

    spacing: tuple[float, float, float] = (2.0, 2.0, 2.0)
    turn: float = 0.0
    flips: tuple[int, ...] = ()
    half: tuple[float, float, float] = (50.0, 40.0, 45.0)
    middle: tuple[float, float, float] = (12.0, -30.0, 220.0)

    @property
    def axes(self) -> np.ndarray:
        c, s = np.cos(np.radians(self.turn)), np.sin(np.radians(self.turn))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        return turn * self.spacing * [-1 if axis in self.flips else 1 for axis in range(3)]

    @property
    def shape(self) -> tuple[int, int, int]:
        return tuple(np.ceil(2 * np.array(self.half) / self.spacing).astype(int).tolist())

    @property
    def origin(self) -> np.ndarray:
        # Off the middle by a part of a voxel: nothing is to hang on how a shape lies between them.
        return self.middle - self.axes @ ((np.array(self.shape) - 1) / 2 + [0.21, 0.37, 0.43])

    def label(self, *inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Labels 1, 2, ...: where a function of places (LPS, millimetres) is below 0; the last one counts."""
        numbers = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1)
        places, labels = numbers @ self.axes.T + self.origin, np.zeros(self.shape, np.uint8)
        for value, function in enumerate(inside, start=1):
            labels[function(places) < 0] = value
        return labels


def ellipsoid(middle: Sequence[float], radii: Sequence[float]) -> Callable[[np.ndarray], np.ndarray]:
    """About the distance to an ellipsoid near it, millimetres, negative inside."""

    def distance(x: np.ndarray) -> np.ndarray:
        scaled = (x - np.asarray(middle)) / np.asarray(radii)
        level, slope = np.linalg.norm(scaled, axis=-1), np.linalg.norm(scaled / np.asarray(radii), axis=-1)
        return level * (level - 1) / np.maximum(slope, 1e-12)

    return distance


def write_nifti(path: Path, grid: Grid, labels: np.ndarray, names: Mapping[int, str] | None = None) -> Path:
    """As TotalSegmentator writes it: RAS, millimetres, names in an extension of the header."""
    import nibabel

    place = np.eye(4)
    place[:3, :3], place[:3, 3] = grid.axes, grid.origin
    image: Any = nibabel.Nifti1Image(labels, np.diag([-1.0, -1.0, 1.0, 1.0]) @ place)
    image.header.set_xyzt_units("mm")
    if names:
        xml = _XML.format("".join(_LABEL.format(*item) for item in names.items()))
        content = f"{xml}</VolumeInformation></CaretExtension>\n     ".encode()
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, content))
    nibabel.save(image, path)
    return path


def write_nrrd(
    path: Path, grid: Grid, labels: np.ndarray, names: Mapping[str, tuple[int, int]] | None = None, axes: str = "lps"
) -> Path:
    """As 3D Slicer writes it, layers first; `axes` may be empty, then the file says no space."""
    import nrrd

    turn = np.diag([-1.0, -1.0, 1.0]) if axes == "ras" else np.eye(3)
    directions = (turn @ grid.axes).T
    space = {"lps": "left-posterior-superior", "ras": "right-anterior-superior"}.get(axes)
    header: dict[str, Any] = {"space": space} if space else {"space dimension": 3}
    header |= {"space origin": turn @ grid.origin, "kinds": ["domain"] * 3, "space directions": directions}
    if labels.ndim == 4:
        header["kinds"] = ["list", *header["kinds"]]
        header["space directions"] = np.vstack([np.full(3, np.nan), directions])
    for number, (name, (layer, value)) in enumerate((names or {}).items()):
        header |= {f"Segment{number}_{key}": str(word)
                   for key, word in (("Name", name), ("Layer", layer), ("LabelValue", value))}  # fmt: skip
    nrrd.write(str(path), labels, header)
    return path
