"""The body that a configuration describes: surface made solid, attachment, zones, observed side, inner surfaces."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtwin.meshes.body import Body, BodyError
from softtwin.meshes.files import FileError, read_cloud, read_mesh, read_surface
from softtwin.meshes.metrics import edge_lengths
from softtwin.meshes.shapes import beam, liver_phantom, propeller
from softtwin.meshes.solidify import repair, solidify

from .config import BodySection, ConfigError

Ints = NDArray[np.int64]
SHAPES: dict[str, Callable[..., Body]] = {"liver-phantom": liver_phantom, "propeller": propeller, "beam": beam}


def make_body(section: BodySection, root: Path) -> Body:
    """The body that a configuration describes.

    Args:
        section: the configuration's [body].
        root: folder that relative paths start from.
    """
    if section.source in SHAPES:
        body = SHAPES[section.source](**({"cell_size": section.cell_size} if _takes_size(section) else {}))
        return _with_zones(body, section, root)
    points, cells = _solid(section, root)
    if not section.fixed:
        raise BodyError(
            "body.fixed: expected what holds the organ, got nothing; without it the organ has no equilibrium. Give "
            "--fixed FILE (points or triangles near the attachment, or .npy/.txt with node numbers)."
        )
    bare = Body(points, cells, {"fixed": np.arange(len(points) - 1)})
    fixed = _nodes_from(bare, "body.fixed", root / section.fixed, section)
    body = Body(points, cells, {"fixed": _attached(bare, fixed)})
    return _with_zones(body, section, root)


def _takes_size(section: BodySection) -> bool:
    return section.cell_size > 0.0 and section.source != "beam"


def _solid(section: BodySection, root: Path) -> tuple[NDArray[np.float64], Ints]:
    found = read_mesh(root / section.source, section.unit)
    if isinstance(found, tuple):
        return found
    surface = repair(found) if section.repair else found
    if section.cell_size > 0.0:
        return solidify(surface, cell_size=section.cell_size)
    return solidify(surface, node_count=section.nodes)


def _attached(bare: Body, nodes: Ints) -> Ints:
    """The given nodes that belong to a boundary triangle given whole: an attachment is a surface, not a lone node."""
    whole = bare.boundary[np.isin(bare.boundary, nodes).all(axis=1)]
    if len(whole) == 0:
        raise BodyError(
            f"body.fixed: expected fixed nodes that cover part of the surface, got {len(nodes)} nodes that span no "
            "whole boundary triangle; enlarge fixed_distance or give more of the attachment."
        )
    return np.unique(whole)


def _nodes_from(body: Body, name: str, path: Path, section: BodySection) -> Ints:
    """Node numbers from a file of numbers, or the boundary nodes near the points of a file."""
    numbers = _read_numbers(path)
    if numbers is not None:
        if numbers.size and (numbers.min() < 0 or numbers.max() >= len(body.points)):
            raise BodyError(
                f"{name}: expected node numbers in 0..{len(body.points) - 1}, "
                f"got {numbers.min()}..{numbers.max()} in {path}."
            )
        return np.unique(numbers)
    near = section.fixed_distance or float(np.median(edge_lengths(body.points, body.cells)))
    distances, _ = cKDTree(read_cloud(path, section.unit)).query(body.points[body.boundary_nodes])
    nodes = body.boundary_nodes[distances <= near]
    if len(nodes) == 0:
        raise BodyError(
            f"{name}: no boundary node lies within {1e3 * near:.1f} mm of the points in {path} "
            f"(the nearest is {1e3 * distances.min():.1f} mm away). Same unit and axes? Else raise fixed_distance."
        )
    return nodes


def _read_numbers(path: Path) -> Ints | None:
    """Node numbers if the file holds whole numbers in one column, else None."""
    if not path.is_file():
        raise FileError(f"{path}: expected a file, found none.")
    try:
        values = (
            np.load(path) if path.suffix == ".npy" else np.loadtxt(path, ndmin=1) if path.suffix == ".txt" else None
        )
    except ValueError:
        return None
    if values is None or values.ndim != 1 or not np.array_equal(values, np.round(values)):
        return None
    return values.astype(np.int64)


def _with_zones(body: Body, section: BodySection, root: Path) -> Body:
    zones = {
        name: _nodes_from(body, f"body.zones.{name}", root / file, section) for name, file in section.zones.items()
    }
    body = body.with_sets(**zones)
    inner = {name: read_surface(root / file, section.unit) for name, file in section.inner.items()}
    body = body.with_inner(**inner)
    if not section.observed:
        return body
    return Body(
        body.points,
        body.cells,
        body.node_sets,
        {**body.surfaces, "observed": _observed(body, root / section.observed, section)},
        body.inner,
    )


def _observed(body: Body, path: Path, section: BodySection) -> Ints:
    if path.suffix == ".npy":
        return np.load(path)
    near = section.fixed_distance or float(np.median(edge_lengths(body.points, body.cells)))
    distances, _ = cKDTree(read_surface(path, section.unit).points).query(body.points[body.boundary].mean(axis=1))
    if not (distances <= near).any():
        raise ConfigError(f"body.observed: no boundary triangle lies within {1e3 * near:.1f} mm of {path}.")
    return body.boundary[distances <= near]
