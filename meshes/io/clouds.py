"""Point clouds: tables of any program, arrays of a depth camera, PCD, or the points of a mesh file."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..body import Floats
from .common import HEAD, LARGEST, RAS_TO_LPS, Axes, ContentError, FileError, Unit, existing, placed
from .formats.apart import read_apart
from .formats.ply import read_ply_normals
from .formats.table import Table, read_table
from .formats.vtk import READERS
from .raw import FARTHEST, SUFFIXES, read_anyhow

_log = logging.getLogger(__name__)
TABLES = (".txt", ".csv", ".xyz", ".pts", ".asc", ".tsv", ".xyzn", ".xyzrgb")
_PCD = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
_POINTS = (
    ("x", "y", "z"), ("points:0", "points:1", "points:2"), ("points_0", "points_1", "points_2"),
    ("coordinates:0", "coordinates:1", "coordinates:2"), ("px", "py", "pz"), ("pos_x", "pos_y", "pos_z"),
    ("position_x", "position_y", "position_z"), ("x_coord", "y_coord", "z_coord"),
)  # fmt: skip
_NORMALS = (
    ("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normals:0", "normals:1", "normals:2"),
    ("normals_0", "normals_1", "normals_2"), ("normal:0", "normal:1", "normal:2"),
)  # fmt: skip
_MOST_COLUMNS = 32  # more are the rows of an image, not what is known of a point
_UNIT = 0.05  # how far the length of a normal may be from 1: three decimals, or bytes
_SCENE = 2 * LARGEST  # metres: what a camera sees around an organ; a part of it may be as small as it likes
_MOST_PACKED = 300  # bytes in a byte: what LZF makes of zeros
_MOST = 0.9  # share of the rows whose columns must be normals to be taken for such


@dataclass(frozen=True, eq=False)
class Cloud:
    """Measured points.

    Args:
        points: (p, 3), metres, LPS.
        normals: (p, 3), as measured, in LPS; NaN or zeros where there is none; None where they were not asked for.
        rows: of the file, with those that were left out.
        said: what was done, one line each.
    """

    points: Floats
    normals: Floats | None
    rows: int
    said: tuple[str, ...] = ()


def read_cloud(path: str | Path, unit: Unit = "m", axes: Axes = "lps", normals: bool = False) -> Floats:
    """The points of a file, (p, 3), metres; with the normals measured there (p, 6). See `read_points`."""
    cloud = read_points(path, unit, axes, normals)
    for line in cloud.said:
        _log.info("%s: %s", path, line)
    return cloud.points if cloud.normals is None else np.hstack([cloud.points, cloud.normals])


def read_points(path: str | Path, unit: Unit = "m", axes: Axes = "lps", normals: bool = False) -> Cloud:
    """The points of a file, and what was left out.

    A row without a measurement is no point: coordinates that are NaN or infinite, or all zero in more than one row,
    as a depth camera writes pixels in which it saw nothing (one point may lie in the origin).

    Args:
        path: a table as text (TXT, CSV, TSV, XYZ, PTS, ASC: columns by their names, or the first three; a line of
            comment, of names or with the count before them), NPY of shape (p, 3 or more), (h, w, 3 or more) or with
            fields x, y, z, a PCD, or any mesh file, whose points are taken.
        unit: the file's unit of length.
        axes: the file's axes: `lps` is kept, `ras` is turned to LPS (x and y change sign).
        normals: read them, too: columns named so, or columns 4 to 6 or 7 to 9 of a table that are unit vectors, `nx`,
            `ny`, `nz` of a PLY, `normal_x` and so on of a PCD, the normals of a VTK file.

    Raises:
        FileError: missing, empty, damaged or unknown file, or no three columns of numbers; no normals where they are
            asked for.
    """
    path = existing(path)
    points, facing, said = _content(path, normals)
    if normals and (facing is None or facing.shape != points.shape):
        got = "none" if facing is None else f"shape {facing.shape}"
        raise FileError(f"{path}: expected a normal for each point, got {got}; without --normals it can be used.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise FileError(f"{path}: expected a cloud of shape (p, 3), got {points.shape}.")
    if len(points) == 0:
        raise ContentError(f"{path}: expected a cloud with points, got none.")
    keep = np.isfinite(points).all(axis=1)
    if (far := float(np.abs(points[keep]).max(initial=0.0))) > FARTHEST:
        raise ContentError(f"{path}: expected coordinates of an organ, got {far:.3g}; the file may be damaged.")
    if lost := int((~keep).sum()):
        said.append(f"points: {lost} of {len(points)} rows have no measurement (NaN or infinity) and were left out")
    zeros = (points == 0.0).all(axis=1)
    if zeros.sum() > 1:
        said.append(f"points: {zeros.sum()} of {len(points)} rows are zeros, without a measurement, and were left out")
        keep &= ~zeros
    if not keep.any():
        raise ContentError(f"{path}: expected a cloud with measured points, got {len(points)} rows without one.")
    found = placed(path, points[keep], unit, axes, smallest=0.0, largest=_SCENE)
    turned = None if facing is None else facing[keep] * (RAS_TO_LPS if axes == "ras" else 1.0)
    return Cloud(found, turned, len(points), tuple(said))


def _content(path: Path, normals: bool) -> tuple[Floats, Floats | None, list[str]]:
    """Points, normals if asked for and there, what to say."""
    suffix = path.suffix.lower()
    if suffix in TABLES:
        try:
            return _of_table(path, read_table(path), normals)
        except (ValueError, OSError) as error:
            if isinstance(error, FileError):
                raise
            raise FileError(
                f"{path}: expected rows of three numbers; the file may be truncated or damaged ({error})."
            ) from error
    if suffix == ".npy":
        return _of_array(path, _load(path), normals)
    if suffix == ".pcd":
        points = _read_pcd(path, _PCD[: 6 if normals else 3])
        return points[:, :3], points[:, 3:] if normals else None, []
    if suffix not in SUFFIXES:
        known = ", ".join((*TABLES, ".npy", ".pcd", *SUFFIXES))
        raise FileError(f"{path}: expected a file of a cloud ({known}), got suffix {suffix!r}.")
    return read_anyhow(path).points, _vertex_normals(path) if normals else None, []


def _of_table(path: Path, table: Table, normals: bool) -> tuple[Floats, Floats | None, list[str]]:
    said = []
    if table.values.shape[1] < 3:
        raise FileError(f"{path}: expected a cloud of shape (p, 3), got {table.values.shape}.")
    places, facing = _named(table.names, _POINTS), _named(table.names, _NORMALS) if normals else None
    if places is None and len(table.names) > 3:
        raise FileError(f"{path}: expected columns named x, y and z among {', '.join(table.names[:12])}; name them so.")
    if places is None:
        places = [0, 1, 2]
        if table.values.shape[1] == 4 and _is_count(table.values[:, 0]):
            places = [1, 2, 3]
            said.append("columns: the first counts the rows and was left out")
    if normals and facing is None:
        width = table.values.shape[1]
        columns = [[at, at + 1, at + 2] for at in (places[-1] + 1, places[-1] + 4) if at + 3 <= width]
        facing = next((three for three in columns if _are_normals(table.values[:, three])), None)
    if more := table.values.shape[1] - len(places) - len(facing or ()):
        said.append(f"columns: {more} beside the coordinates were left out")
    return table.values[:, places], None if facing is None else table.values[:, facing], said


def _of_array(path: Path, array: NDArray[Any], normals: bool) -> tuple[Floats, Floats | None, list[str]]:
    if array.dtype.names:
        fields = {name.lower(): name for name in array.dtype.names}
        wanted = _PCD[: 6 if normals else 3]
        if missing := [name for name in wanted if name not in fields]:
            raise FileError(f"{path}: expected fields {', '.join(wanted)}, got {', '.join(fields)} ({missing[0]}).")
        flat = array.ravel()
        array = np.stack([flat[fields[name]].astype(np.float64) for name in wanted], axis=1)
    if array.dtype.kind not in "fiu":
        raise FileError(f"{path}: expected numbers, got {array.dtype}.")
    if array.ndim not in (2, 3) or not 3 <= array.shape[-1] <= _MOST_COLUMNS:
        advice = "; is it a depth image? softtwin wants the points that it shows" if array.ndim == 2 else ""
        raise FileError(f"{path}: expected a cloud of shape (p, 3) or (h, w, 3), got {array.shape}{advice}.")
    flat = array.reshape(-1, array.shape[-1]).astype(np.float64)
    return _of_table(path, Table(flat, ()), normals)


def _load(path: Path) -> NDArray[Any]:
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except Exception as error:  # of the tokenizer that reads its header, too
        raise FileError(
            f"{path}: expected rows of three numbers; the file may be truncated or damaged ({error})."
        ) from error


def _named(names: tuple[str, ...], wanted: tuple[tuple[str, str, str], ...]) -> list[int] | None:
    for three in wanted:
        if all(names.count(name) == 1 for name in three):
            return [names.index(name) for name in three]
    return None


def _is_count(column: Floats) -> bool:
    return len(column) > 3 and any(np.array_equal(column, np.arange(start, start + len(column))) for start in (0, 1))


def _are_normals(columns: Floats) -> bool:
    lengths = np.linalg.norm(columns, axis=1)
    there = lengths[np.isfinite(lengths) & (lengths > 0)]
    return columns.shape[1] == 3 and (len(there) == 0 or bool((np.abs(there - 1) < _UNIT).mean() > _MOST))


def _vertex_normals(path: Path) -> Floats | None:
    """Normals of the points of a mesh file, (p, 3), as they stand in it; None where it has none."""
    suffix, found = path.suffix.lower(), None
    if suffix == ".ply":
        found = read_ply_normals(path)
    elif suffix in READERS:
        found = read_apart(path).normals
    return None if found is None else np.asarray(found, dtype=np.float64)


def _check_pcd(path: Path) -> None:
    """Refuse a header that names more points than its file can hold: all of them would be made room for."""
    with path.open("rb") as file:
        head = file.read(HEAD).split(b"DATA")[0].decode("latin-1")
    fields = {line.split()[0]: line.split()[1:] for line in head.splitlines() if line.split()}
    sizes, counts = ([int(word) for word in fields.get(name, ["1"])] for name in ("SIZE", "COUNT"))
    row = sum(size * count for size, count in zip(sizes, counts, strict=False)) or 1
    wanted = max(
        int(fields.get("POINTS", ["0"])[0]), int(np.prod([int(fields.get(n, ["1"])[0]) for n in ("WIDTH", "HEIGHT")]))
    )
    if not 0 <= wanted * row <= _MOST_PACKED * path.stat().st_size:
        raise ValueError(f"{wanted} points of {row} bytes in a file of {path.stat().st_size}")


def _read_pcd(path: Path, fields: tuple[str, ...]) -> Floats:
    from pypcd4.pypcd4 import PointCloud  # drags pydantic's models in: only where a PCD comes

    try:
        _check_pcd(path)
        cloud = PointCloud.from_path(path)
        if missing := [name for name in fields if name not in cloud.fields]:
            raise ValueError(f"expected the fields {', '.join(fields)}, and {missing[0]} is missing")
        points = np.asarray(cloud.numpy(fields), dtype=np.float64)
        if len(points) != cloud.points:
            raise ValueError(f"expected {cloud.points} points, got {len(points)}")
    except Exception as error:  # of pydantic, struct and lzf, each with its own
        raise FileError(f"{path}: could not be read as pcd; the file may be truncated or damaged "
                        f"({' '.join(str(error).split())[:200]}).") from error  # fmt: skip
    return points
