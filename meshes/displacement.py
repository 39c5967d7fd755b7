"""Displacement fields on regular grids, in both directions, and their NRRD files, which ITK and 3D Slicer read."""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal

import nrrd
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, map_coordinates
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkFiltersCore import vtkProbeFilter

from .body import Body, Floats, Surface
from .closest import closest_points
from .export import Coordinates
from .io import FileError, discard, unstructured_grid

Direction = Literal["forward", "inverse"]
VOXELS = 64  # along the organ's longest side, where no spacing is told
MAXIMUM_VOXELS = 512  # along any side: more would be gigabytes
_RIM = 2  # voxels about the organ that carry its surface's movement on
_SPACES: Mapping[str, str] = {"lps": "left-posterior-superior", "ras": "right-anterior-superior"}
_MEANINGS: Mapping[str, str] = {
    "forward": "rest to deformed: a point at rest x lies at x + v(x) in the deformed organ",
    "inverse": "deformed to rest: a point x of the deformed organ lay at x + v(x) at rest; resamples images, as ITK "
    "and 3D Slicer take a displacement field",
}
_NOTICE = "Research software: not a medical device."


class Region(IntEnum):
    """What is said of a voxel: nothing (its vector is zero), the organ, or its rim.

    In the rim, outside but within two voxels, the movement of the nearest point of the surface is carried on, so that
    interpolation between voxels holds up to the surface.
    """

    OUTSIDE = 0
    ORGAN = 1
    RIM = 2


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """Displacement vectors at the centres of cubic voxels; all on LPS axes.

    Args:
        direction: `forward`, of points at rest, or `inverse`, of points of the deformed organ back to rest.
        origin: centre of the first voxel, (3,), metres.
        spacing: edge of a voxel, metres.
        vectors: (i, j, k, 3), metres; zero outside.
        region: what is said of each voxel, (i, j, k): see `Region`.
    """

    direction: Direction
    origin: Floats
    spacing: float
    vectors: Floats
    region: NDArray[np.uint8]

    def at(self, points: ArrayLike) -> Floats:
        """Displacements of points, (p, 3), metres, linear between the voxels about them; zero beyond the grid.

        Args:
            points: (p, 3), metres.
        """
        places = ((np.asarray(points, dtype=np.float64) - self.origin) / self.spacing).T
        parts = [map_coordinates(self.vectors[..., axis], places, order=1, mode="constant") for axis in range(3)]
        return np.stack(parts, axis=1)


def forward_field(body: Body, displacement: ArrayLike, spacing: float = 0.0) -> DisplacementField:
    """How the points at rest move, on a grid about the body at rest.

    Args:
        body: the body at rest.
        displacement: of its nodes, (n, 3), metres.
        spacing: edge of a voxel, metres; 0: 64 voxels along the longest side.

    Raises:
        ValueError: another shape, or a spacing that no grid can have.
    """
    moved = _checked(body, displacement)
    return _field("forward", body, body.points, moved, spacing)


def inverse_field(body: Body, displacement: ArrayLike, spacing: float = 0.0) -> DisplacementField:
    """Where the points of the deformed body come from, on a grid about it; where it overlaps, one of their origins.

    Inside a cell it is the inverse of the forward field by the same shape functions, not of its voxels.

    Args:
        body: the body at rest.
        displacement: of its nodes, (n, 3), metres.
        spacing: edge of a voxel, metres; 0: 64 voxels along the longest side of the body at rest.

    Raises:
        ValueError: another shape, or a spacing that no grid can have.
    """
    moved = _checked(body, displacement)
    return _field("inverse", body, body.points + moved, -moved, spacing)


def write_displacement(path: str | Path, field: DisplacementField, place: Coordinates) -> tuple[Path, Path]:
    """Write a field as a vector image, and beside it what is said of each voxel; each is there whole or not at all.

    Both state space, unit, direction and sign. The grid lies on the axes asked for. The vectors' components are those
    of LPS in any case, since ITK turns the grid of a file in RAS and leaves its vectors as they are (ITK,
    NrrdImageIO::ReadImageInformation; Slicer's vtkMRMLTransformStorageNode::ReadFromImageFile takes what ITK has read
    as LPS). The file's measurement frame says so: it takes the components to the file's space.

    Args:
        path: file to write, `.nrrd`; of `NAME_0000.nrrd` the voxels' meaning is `NAME-region_0000.nrrd`.
        field: the field.
        place: axes and unit that are written.

    Returns:
        The two files.

    Raises:
        FileError: another suffix, or a file could not be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".nrrd":
        raise FileError(f"{path}: expected the suffix .nrrd, got {path.suffix!r}.")
    beside = region_path(path)
    turn = place.directions(np.ones(3))
    grid = {
        "space": _SPACES[place.axes],
        "space units": [place.unit] * 3,
        "space origin": place.lengths(field.origin),
        "encoding": "gzip",
    }
    steps = np.diag(turn * float(place.distances(field.spacing)))
    said = {"direction": field.direction, "meaning": _MEANINGS[field.direction], "notice": _NOTICE}
    vectors = {
        **grid,
        "content": f"displacement field, {field.direction}",
        "kinds": ["vector", "domain", "domain", "domain"],
        "labels": ["displacement (L, P, S)", *_labels(place)],
        "space directions": np.vstack([np.full(3, np.nan), steps]),
        "measurement frame": np.diag(turn),
        **said,
        "vectors": f"components along L, P and S, in {place.unit}, whatever the space of the grid",
        "outside": f"zero where nothing is said; {beside.name} holds 1 in the organ, 2 in its rim, 0 outside",
    }
    region = {
        **grid,
        "content": "0 outside, 1 organ, 2 rim that carries the surface's movement on",
        "kinds": ["domain"] * 3,
        "labels": _labels(place),
        "space directions": steps,
        **said,
    }
    components = float(place.distances(1.0)) * np.moveaxis(field.vectors, 3, 0)
    _write(path, components.astype(np.float32), vectors)
    _write(beside, field.region, region)
    return path, beside


def region_path(path: Path) -> Path:
    """The file that says what a field's voxels are.

    Args:
        path: of the field.
    """
    name, line, number = path.stem.rpartition("_")
    return path.with_name(f"{name}-region_{number}.nrrd" if line and number.isdigit() else f"{path.stem}-region.nrrd")


def read_displacement(path: str | Path) -> DisplacementField:
    """The field that `write_displacement` wrote, in metres and LPS, to single precision.

    Args:
        path: file of the vectors; the file of its voxels' meaning lies beside it.

    Raises:
        FileError: missing or damaged file, or one that `write_displacement` did not write.
    """
    path = Path(path)
    vectors, header = _read(path)
    region, _ = _read(region_path(path))
    axes = {space: axes for axes, space in _SPACES.items()}.get(header.get("space", ""))
    direction, units = header.get("direction"), header.get("space units", [""])
    if (
        axes is None
        or direction not in ("forward", "inverse")
        or vectors.ndim != 4
        or units[0] not in ("m", "cm", "mm")
    ):
        raise FileError(f"{path}: not a displacement field written by softtwin.")
    place = Coordinates(units[0], axes)  # type: ignore[arg-type]
    in_space = np.einsum("cd,dijk->ijkc", header["measurement frame"], vectors.astype(np.float64))
    spacing = float(np.linalg.norm(place.metres(header["space directions"][1])))
    return DisplacementField(
        direction, place.metres(header["space origin"]), spacing, place.metres(in_space), region.astype(np.uint8)
    )


def _checked(body: Body, displacement: ArrayLike) -> Floats:
    moved = np.asarray(displacement, dtype=np.float64)
    if body.dimension != 3 or moved.shape != body.points.shape:
        raise ValueError(f"displacement: expected shape ({len(body.points)}, 3), got {moved.shape}.")
    return moved


def _field(direction: Direction, body: Body, nodes: Floats, vectors: Floats, spacing: float) -> DisplacementField:
    """Vectors of the nodes, which lie where they are asked for, at the voxels about them."""
    edge = spacing or float(np.ptp(body.points, axis=0).max()) / VOXELS
    low, high = nodes.min(axis=0) - (_RIM + 1) * edge, nodes.max(axis=0) + (_RIM + 1) * edge
    if not 0.0 < edge < np.inf or (high - low).max() / edge > MAXIMUM_VOXELS:
        raise ValueError(
            f"spacing: expected an edge of at least {(high - low).max() / MAXIMUM_VOXELS:.2g} m, got {spacing:g}: "
            f"more than {MAXIMUM_VOXELS} voxels along a side."
        )
    counts = np.ceil((high - low) / edge).astype(int) + 1
    found, inside = _probed(body, nodes, vectors, low, edge, counts)
    rim = binary_dilation(inside, np.ones((3, 3, 3)), iterations=_RIM) & ~inside
    found[~inside] = 0.0
    found[rim] = _carried_on(body, nodes, vectors, low + edge * np.argwhere(rim))
    region = np.where(inside, Region.ORGAN, np.where(rim, Region.RIM, Region.OUTSIDE)).astype(np.uint8)
    return DisplacementField(direction, low, edge, found, region)


def _probed(
    body: Body, nodes: Floats, vectors: Floats, low: Floats, edge: float, counts: NDArray[np.int64]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Nodal vectors at the voxels by the cells' shape functions, (i, j, k, 3), and which voxels lie in a cell."""
    grid = unstructured_grid(nodes, body.cells)
    array = numpy_to_vtk(np.ascontiguousarray(vectors), deep=True)
    array.SetName("vectors")
    grid.GetPointData().AddArray(array)
    image = vtkImageData()
    image.SetOrigin(*low)
    image.SetSpacing(edge, edge, edge)
    image.SetDimensions(*map(int, counts))
    probe = vtkProbeFilter()
    probe.SetInputData(image)
    probe.SetSourceData(grid)
    probe.Update()
    data = probe.GetOutput().GetPointData()
    found = vtk_to_numpy(data.GetArray("vectors")).reshape(*counts[::-1], 3).transpose(2, 1, 0, 3)
    valid = vtk_to_numpy(data.GetArray(probe.GetValidPointMaskArrayName())).reshape(*counts[::-1]).transpose(2, 1, 0)
    return np.array(found), np.array(valid, dtype=bool)


def _carried_on(body: Body, nodes: Floats, vectors: Floats, points: Floats) -> Floats:
    """Vectors at the nearest points of the boundary, (p, 3)."""
    triangles = body.boundary
    nearest, numbers = closest_points(Surface(nodes, triangles), points)
    corners = nodes[triangles[numbers]]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    rest = np.einsum("pij,pj->pi", np.linalg.pinv(edges), nearest - corners[:, 0])
    weights = np.column_stack([1.0 - rest.sum(axis=1), rest])
    return np.einsum("pk,pki->pi", weights, vectors[triangles[numbers]])


def _labels(place: Coordinates) -> list[str]:
    return list(place.axes.upper())


def _write(path: Path, data: NDArray[Any], header: Mapping[str, Any]) -> None:
    partial = path.with_name(f".partial.{path.name}")
    try:
        nrrd.write(str(partial), data, dict(header), index_order="F")
        os.replace(partial, path)
    except OSError as error:
        discard(partial)
        raise FileError(
            f"{path}: could not be written; is the folder there, and is the disk full? ({error})."
        ) from None


def _read(path: Path) -> tuple[NDArray[Any], dict[str, Any]]:
    try:
        data, header = nrrd.read(str(path), index_order="F")
    except (OSError, ValueError, EOFError, StopIteration, zlib.error, nrrd.NRRDError) as error:
        raise FileError(f"{path}: could not be read as nrrd; the file may be missing, truncated or damaged "
                        f"({error}).") from None  # fmt: skip
    return data, dict(header)
