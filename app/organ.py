"""The body that a configuration describes: surface made solid, attachment, zones, observed side, inner surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtwin.meshes.attachment import (
    File,
    Region,
    Touching,
    boundary_nodes,
    boundary_triangles,
    check_structure,
    median_edge,
    parse_file,
    parse_regions,
    turned,
)
from softtwin.meshes.body import Body, BodyError, Surface
from softtwin.meshes.components import ComponentError, Structures, check_component, component_of_cells
from softtwin.meshes.embedding import embed, is_carried_along
from softtwin.meshes.grid import gridded
from softtwin.meshes.io import (
    LARGEST,
    SMALLEST,
    Axes,
    FileError,
    Unit,
    Volume,
    is_segmentation,
    read_cloud,
    read_mesh,
    read_surface,
    stated_axes,
    stated_unit,
    unit_advice,
)
from softtwin.meshes.shapes import beam, liver_phantom, propeller
from softtwin.meshes.solidify import solidify

from .config import BodySection, ConfigError, files_axes

if TYPE_CHECKING:
    from .scan import Scan

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
SHAPES: dict[str, Callable[..., Body]] = {"liver-phantom": liver_phantom, "propeller": propeller, "beam": beam}
_COARSEST = 0.2  # of the body's size: the edge of a grid's cells
_LONG = 2.0  # edges of a mesh of n nodes in a volume V are shorter than this times (V / n)^(1/3)


@dataclass(frozen=True, eq=False)
class Organ:
    """A body, and what was done and found on the way to it.

    Args:
        body: the body.
        notes: one line each; those that start with `warning:` may be a mistake of the input.
    """

    body: Body
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Reader:
    """How the files of one body are read: where they lie, their unit and axes (None: nobody says the source's)."""

    root: Path
    unit: Unit
    axes: Axes | None
    scan: Scan | None = None
    numbers: Ints | None = None  # of the body's nodes in its file; None where they are the body's

    def options(self, file: File) -> tuple[Path, Unit, Axes]:
        """Path, unit and axes to read a file with; one that says none has those of the source."""
        path = self.root / file.path
        axes = file.axes or stated_axes(path) or self.axes
        return path, file.unit or stated_unit(path) or self.unit, axes if axes and self.axes else "lps"


def make_body(section: BodySection, root: Path) -> Body:
    """The body that a configuration describes; see `make_organ`."""
    return make_organ(section, root).body


def make_organ(section: BodySection, root: Path, springs: Mapping[str, str] = MappingProxyType({})) -> Organ:
    """The body that a configuration describes, and what was done to its surface.

    Args:
        section: the configuration's [body].
        root: folder that relative paths start from.
        springs: where springs hold it, by name: a surface of the body each.

    Raises:
        RegionError, FileError, SurfaceError, BodyError, ConfigError: what is wrong with the input. What can be seen
            before a surface is made solid is said before.
    """
    check_component(section.component)
    regions = _checked_regions(section, root, springs)
    notes: list[str] = []
    scan = _scan(section, root, regions)
    if section.source in SHAPES:
        reader = _Reader(root, section.unit, section.frame or "lps")
        body = SHAPES[section.source](**_shape_options(section))
    else:
        source = parse_file(section.source)
        if scan is None:
            _check_stated(section, root)
        reader = _Reader(root, section.unit, files_axes(section), scan)
        solid, notes = _solid(section, reader, source)
        body, reader = Body(solid.points, solid.cells, {}), replace(reader, numbers=solid.numbers)
        notes += [*_overruled(section, root), *_axes_said(reader)]
    for name, text in section.inner.items():
        surface, said = _inner(name, text, reader)
        notes += [*said, *_outside(body, name, surface)]
        body = body.with_inner(**{name: surface})
    if regions["fixed"]:
        body = body.with_sets(fixed=_attached(body, _nodes(body, "body.fixed", regions["fixed"], section, reader)))
    zones = {
        zone: _nodes(body, f"body.zones.{zone}", regions[f"zones.{zone}"], section, reader) for zone in section.zones
    }
    body = body.with_sets(**zones)
    for name in springs:
        nodes = _nodes(body, f"springs.where.{name}", regions[f"springs.{name}"], section, reader)
        body = body.with_surfaces(**{name: _covered(body, f"springs.where.{name}", nodes)})
    if regions["observed"]:
        observed, said = _observed(body, regions["observed"], reader)
        body, notes = body.with_surfaces(observed=observed), [*notes, *said]
    if section.grid > 0.0:
        if springs:
            raise ConfigError(
                f"springs.where: expected none on a grid, whose cells do not end there, got {[*springs]}."
            )
        body, line = _on_grid(body, section.grid)
        notes.append(line)
    return Organ(body, tuple(notes))


def _axes_said(reader: _Reader) -> list[str]:
    return [f"axes: {reader.axes.upper()}, inside LPS" if reader.axes else "axes: none said, nothing turned"]


def _overruled(section: BodySection, root: Path) -> list[str]:
    """A warning where a mesh file states another unit than the one that stands behind its name."""
    source = parse_file(section.source)
    path = root / source.path
    if source.unit is None or is_segmentation(path) or (stated := stated_unit(path)) in (None, source.unit):
        return []
    return [f"warning: {path} states that it is in {stated}; {source.unit} was taken, as you say"]


def _on_grid(body: Body, edge: float) -> tuple[Body, str]:
    """The body on a regular grid, and what to say of it.

    Raises:
        BodyError: cells as large as the organ; see also `gridded`.
    """
    if edge > _COARSEST * body.size:
        raise BodyError(
            f"body.grid: expected an edge length in metres of at most {_COARSEST:g} of the organ's size "
            f"({body.size:.3g} m), got {edge:g} m."
        )
    grid = gridded(body, edge)
    share = grid.volume / body.volume
    return grid, f"grid: {len(grid.cells)} hexahedra of {1e3 * edge:g} mm, {share:.4f} of the volume"


def _check_stated(section: BodySection, root: Path) -> None:
    """Refuse a source in RAS, or in another unit, where the configuration does not say so: clouds are read like it.

    Raises:
        ConfigError: with what to write.
    """
    source = parse_file(section.source)
    path = root / source.path
    if not path.is_file():
        return
    if source.unit is None and (unit := stated_unit(path)) not in (None, section.unit):
        raise ConfigError(
            f'body.unit: {path} states that it is in {unit}, got {section.unit!r}; write unit = "{unit}".'
        )
    if stated_axes(path) == "ras" and files_axes(section) is None:
        raise ConfigError(
            f"body.source: {path} states that it is in RAS, which the configuration must say for what comes later: "
            f'write source = "{section.source}:ras".'
        )


def _checked_regions(section: BodySection, root: Path, springs: Mapping[str, str]) -> dict[str, tuple[Region, ...]]:
    """The regions of attachment, springs, zones, observed side, refused where they cannot be before a mesh is made."""
    if section.source not in SHAPES and not section.fixed and not springs:
        raise BodyError(
            "body.fixed: expected what holds the organ, got nothing; without it the organ has no equilibrium. Give "
            "--fixed FILE (points or triangles near the attachment, or .npy/.txt with node numbers), or say where it "
            "is: near:STRUCTURE:5mm, touching:LABEL, ball:X,Y,Z:RADIUS, box:X,Y,Z:X,Y,Z, halfspace:X,Y,Z:NX,NY,NZ."
        )
    texts = {"fixed": section.fixed, "observed": section.observed}
    texts |= {f"zones.{name}": text for name, text in section.zones.items()}
    texts |= {f"springs.{name}": text for name, text in springs.items()}
    regions = {name: parse_regions(text, section.unit, root) if text else () for name, text in texts.items()}
    if files_axes(section) == "ras":
        regions = {name: tuple(map(turned, group)) for name, group in regions.items()}
    structures = (*section.inner, *_OWN_STRUCTURES.get(section.source, ()))
    for region in (region for group in regions.values() for region in group):
        check_structure(region, structures)
    files = [region for group in regions.values() for region in group if isinstance(region, File)]
    named = {} if is_segmentation(root / parse_file(section.source).path) else section.inner  # else they may be labels
    for file in [*files, *map(parse_file, named.values())]:
        if not (root / file.path).is_file():
            raise FileError(f"{root / file.path}: no such file.")
    return regions


_OWN_STRUCTURES = {"liver-phantom": ("vessel_portal", "vessel_hepatic", "tumour")}


def _scan(section: BodySection, root: Path, regions: Mapping[str, tuple[Region, ...]]) -> Scan | None:
    """The segmentation that is the source, or None where that is a mesh.

    Raises:
        ConfigError, FileError: see `open_scan`; words that only a segmentation knows.
    """
    every = [region for group in regions.values() for region in group]
    if section.source not in SHAPES and is_segmentation(root / parse_file(section.source).path):
        from .scan import open_scan  # a twin from a volume mesh is built where nibabel is not installed

        return open_scan(section, root, every)
    for name in ("organ", "join"):
        if getattr(section, name):
            raise ConfigError(
                f"body.{name}: expected a segmentation as source, got {section.source}; it has no labels."
            )
    if any(isinstance(region, Touching) for region in every):
        raise ConfigError(
            f"touching: expected a segmentation as source, got {section.source}; near: and ball: are known of it."
        )
    return None


def _inner(name: str, text: str, reader: _Reader) -> tuple[Surface, list[str]]:
    if reader.scan is not None and name in reader.scan.labels:
        return reader.scan.inner(name)
    return read_surface(*reader.options(parse_file(text))), []


def _shape_options(section: BodySection) -> dict[str, float]:
    return {"cell_size": section.cell_size} if section.cell_size > 0.0 and section.source != "beam" else {}


def _solid(section: BodySection, reader: _Reader, source: File) -> tuple[Volume, list[str]]:
    found: Surface | Volume
    if reader.scan is not None:
        found, said = reader.scan.surface()
    else:
        found, said = read_mesh(*reader.options(source)), []
    size = float(np.ptp(found.points, axis=0).max())
    _check_size(reader.root / source.path, size, source.unit or section.unit)

    def structures(name: str) -> Floats:
        if name not in section.inner:
            named = ", ".join(sorted(section.inner)) or "none"
            raise ComponentError(f"--component near:{name}: expected an inner structure, one of {named}.")
        return _inner(name, section.inner[name], reader)[0].points

    if not isinstance(found, Surface):
        return _one_component(found, section.component, structures)
    if reader.scan is not None:
        reader.scan.check_touching(found, section.cell_size or _LONG * float(np.cbrt(found.volume / section.nodes)))
    # What a segmentation has of components and holes was chosen among its voxels.
    options: dict[str, Any] = {}
    if reader.scan is None:
        options = {"cavities": section.cavities, "component": section.component, "structures": structures}
    if section.cell_size > 0.0:
        solid = solidify(found, cell_size=section.cell_size, **options)
    else:
        solid = solidify(found, node_count=section.nodes, **options)
    made = Volume(solid.points, solid.cells, np.arange(len(solid.points)))
    return made, said + str(solid.mending).splitlines()


def _one_component(volume: Volume, component: str, structures: Structures) -> tuple[Volume, list[str]]:
    """The component of a volume mesh that is asked for; nothing is left out that nobody has asked to leave out."""
    if component.strip() == "largest":  # said or not: cells of a file are never lost for a default
        return volume, list(volume.said)
    nodes, cells, said = component_of_cells(volume.points, volume.cells, component, structures)
    found = Volume(volume.points[nodes], cells, volume.numbers[nodes])
    return found, [*volume.said, *([said] if said else [])]


def _check_size(path: Path, size: float, unit: Unit) -> None:
    if not SMALLEST <= size <= LARGEST:
        raise FileError(
            f"{path}: expected an organ of {1e3 * SMALLEST:g} mm to {LARGEST:g} m, got {size:.3g} m across when read "
            f"in {unit}; {unit_advice(size, unit)}."
        )


def _outside(body: Body, name: str, surface: Surface) -> list[str]:
    """What to say of an inner surface that does not lie inside: its part outside is carried along, not tracked.

    Raises:
        BodyError: no part of it lies inside.
    """
    carried = embed(body, surface.points)
    outside, share = carried.outside, float(is_carried_along(body, carried).mean())
    if share == 1.0:
        raise BodyError(
            f"body.inner.{name}: expected a surface inside the organ, got all of its vertices outside, "
            f"up to {1e3 * outside.max():.1f} mm; has its file another unit (FILE:mm) or other axes (FILE:ras)?"
        )
    if share > 0:
        return [
            f"warning: {name}: {100 * share:.1f} % of its vertices lie outside the organ, up to "
            f"{1e3 * outside.max():.1f} mm; they move with the nearest point of the boundary, where they really are is "
            f"not known; a label of a segmentation becomes part of the organ with --join {name}"
        ]
    return []


def _attached(body: Body, nodes: Ints) -> Ints:
    """The given nodes that belong to a boundary triangle given whole: an attachment is a surface, not a lone node."""
    return np.unique(_covered(body, "body.fixed", nodes))


def _covered(body: Body, name: str, nodes: Ints) -> Ints:
    """The boundary triangles whose nodes are all given, (t, 3)."""
    whole = body.boundary[np.isin(body.boundary, nodes).all(axis=1)]
    if len(whole) == 0:
        raise BodyError(
            f"{name}: expected nodes that cover part of the surface, got {len(nodes)} nodes that span no "
            "whole boundary triangle; enlarge the distance (--fixed-distance) or give more of the attachment."
        )
    return whole


def _nodes(body: Body, name: str, regions: Iterable[Region], section: BodySection, reader: _Reader) -> Ints:
    """Nodes of a union of regions, sorted."""
    near = section.fixed_distance if name == "body.fixed" or name.startswith("springs.") else 0.0
    parts = [
        _nodes_of_file(body, name, region, near or median_edge(body), reader)
        if isinstance(region, File)
        else _nodes_touched(body, region, reader)
        if isinstance(region, Touching)
        else boundary_nodes(region, body)
        for region in regions
    ]
    return np.unique(np.concatenate(parts))


def _nodes_touched(body: Body, region: Touching, reader: _Reader) -> Ints:
    assert reader.scan is not None  # refused before
    nodes = body.boundary_nodes
    return nodes[reader.scan.near(region, body.points[nodes], median_edge(body))]


def _nodes_of_file(body: Body, name: str, file: File, near: float, reader: _Reader) -> Ints:
    """Node numbers from a file of numbers, or the boundary nodes near the points of a file."""
    path, unit, axes = reader.options(file)
    numbers = _read_numbers(path)
    if numbers is not None:
        known = np.arange(len(body.points)) if reader.numbers is None else reader.numbers
        if (unknown := np.setdiff1d(numbers, known)).size:
            raise BodyError(
                f"{name}: expected node numbers in 0..{known[-1]} that belong to cells, "
                f"got {numbers.min()}..{numbers.max()} in {path}, of which {len(unknown)} do not, first {unknown[0]}."
            )
        return np.searchsorted(known, np.unique(numbers))
    distances, _ = cKDTree(read_cloud(path, unit, axes)).query(body.points[body.boundary_nodes])
    nodes = body.boundary_nodes[distances <= near]
    if len(nodes) == 0:
        raise BodyError(
            f"{name}: no boundary node lies within {1e3 * near:.1f} mm of the points in {path} "
            f"(the nearest is {1e3 * distances.min():.1f} mm away). Same unit and axes? Else "
            f"{'raise --fixed-distance' if name == 'body.fixed' else 'give points nearer to the surface'}."
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


def _observed(body: Body, regions: Iterable[Region], reader: _Reader) -> tuple[Ints, list[str]]:
    """Boundary triangles of a union of regions, each once and wound outward, and what to say of it."""
    parts = [
        _triangles_of_file(body, region, reader)
        if isinstance(region, File)
        else _triangles_touched(body, region, reader)
        if isinstance(region, Touching)
        else boundary_triangles(region, body)
        for region in regions
    ]
    given = np.concatenate(parts)
    known = {tuple(sorted(triangle)): i for i, triangle in enumerate(body.boundary.tolist())}
    numbers = [known.get(tuple(sorted(triangle))) for triangle in given.tolist()]
    strange = sum(number is None for number in numbers)
    if strange:
        raise BodyError(
            f"body.observed: expected triangles of the body's boundary, got {strange} of {len(given)} that are not."
        )
    chosen = body.boundary[np.unique(np.array(numbers))]
    shifted = np.stack([np.roll(given, turn, axis=1) for turn in range(3)])
    outward = (shifted == body.boundary[np.array(numbers)]).all(axis=2).any(axis=0)
    turned = int((~outward).sum())
    return chosen, [f"observed: {turned} of {len(given)} triangles wound inward and were turned"] if turned else []


def _triangles_touched(body: Body, region: Touching, reader: _Reader) -> Ints:
    assert reader.scan is not None  # refused before
    return body.boundary[reader.scan.near(region, body.points[body.boundary].mean(axis=1), median_edge(body))]


def _triangles_of_file(body: Body, file: File, reader: _Reader) -> Ints:
    path, unit, axes = reader.options(file)
    if path.suffix == ".npy":
        triangles = np.load(path)
        if triangles.ndim == 2 and triangles.shape[1] == 3 and np.issubdtype(triangles.dtype, np.integer):
            if triangles.size and (triangles.min() < 0 or triangles.max() >= len(body.points)):
                raise BodyError(
                    f"body.observed: expected node numbers in 0..{len(body.points) - 1}, "
                    f"got {triangles.min()}..{triangles.max()} in {path}."
                )
            return triangles.astype(np.int64)
        raise BodyError(f"body.observed: expected node numbers of shape (t, 3), got {triangles.dtype} of shape "
                        f"{triangles.shape} in {path}.")  # fmt: skip
    near = median_edge(body)
    distances, _ = cKDTree(read_surface(path, unit, axes).points).query(body.points[body.boundary].mean(axis=1))
    if not (distances <= near).any():
        raise ConfigError(
            f"body.observed: no boundary triangle lies within {1e3 * near:.1f} mm of {path} "
            f"(the nearest is {1e3 * distances.min():.1f} mm away). Same unit and axes?"
        )
    return body.boundary[distances <= near]
