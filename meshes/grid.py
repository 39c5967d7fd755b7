"""The sparse grid: regular hexahedra around a closed surface, which rides in them (an immersed boundary)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label
from scipy.sparse import csr_array
from vtkmodules.vtkCommonDataModel import vtkPolyData

from .body import Body, BodyError, Surface
from .signed import polydata, signed_distances

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Corners of a cell in VTK order, as steps along x, y and z.
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
_ROUND_OFF = 1e-9  # in cells: lengths and fractions closer than this count as equal
_TINY = 1e-30  # stands for zero in a denominator
_FLATTEST = 1e-7  # of a triangle's height over its longest edge: below 1e-8 VTK mistakes inside and outside
_DEEPEST = 6
_MOST_CELLS = 2_000_000  # of the enclosing grid: more is a spacing in other units than metres
_AT_ONCE = 200_000  # points whose distances are asked for together, which bounds the memory


@dataclass(frozen=True, eq=False)
class SparseGrid:
    """A body of regular hexahedra around a closed surface, and the ties between the two.

    Cells cut by the surface count with the share of their volume that lies inside: weight what is integrated over
    a cell with its fraction.

    Args:
        body: the hexahedra, with their fractions; the surface is its skin. Its `fixed` nodes are all nodes of the
            cells that hold a fixed vertex, so that such a vertex cannot move at all; other sets likewise.
        surface: the embedded surface at rest.
        weights: the row of a surface vertex holds the trilinear weights of its cell's 8 nodes, (v, n); they sum to 1.
        index: position of each cell in the enclosing grid, (m, 3).
        shape: cells of the enclosing grid along x, y and z.
        origin: low corner of the enclosing grid, (3,), metres.
        spacing: edge lengths of a cell, (3,), metres.
    """

    body: Body
    surface: Surface
    weights: csr_array
    index: Ints
    shape: tuple[int, int, int]
    origin: Floats
    spacing: Floats

    @cached_property
    def node_index(self) -> Ints:
        """Position of each node in the enclosing grid, (n, 3): 0 to `shape` (included) along each axis."""
        positions = np.empty((len(self.body.points), 3), dtype=np.int64)
        positions[self.body.cells] = self.index[:, None] + _CORNERS
        return positions

    @property
    def fractions(self) -> Floats:
        """Share of each cell's volume inside the surface, (m,), in (0, 1]; 1 for cells that are not cut."""
        assert self.body.fractions is not None
        return self.body.fractions

    @property
    def volume(self) -> float:
        """Volume inside the surface as the fractions have it, cubic metres."""
        return self.body.volume

    def carry(self, displacement: ArrayLike) -> Floats:
        """Displacements of the surface's vertices, (v, 3), metres.

        Args:
            displacement: nodal displacements, (n, 3), metres.

        Raises:
            ValueError: another shape.
        """
        return self.weights @ _checked_field("displacement", displacement, len(self.body.points))

    def spread(self, forces: ArrayLike) -> Floats:
        """Nodal forces that do the same work as forces on the surface's vertices, (n, 3), newtons.

        Their sum is the same, and so is, at rest, their moment about any point.

        Args:
            forces: forces on the surface's vertices, (v, 3), newtons.

        Raises:
            ValueError: another shape.
        """
        return self.weights.T @ _checked_field("forces", forces, len(self.surface.points))


def sparse_grid(
    surface: Surface,
    fixed: ArrayLike,
    *,
    spacing: float | None = None,
    cells_per_axis: Sequence[int] | None = None,
    node_sets: Mapping[str, ArrayLike] | None = None,
    depth: int = 3,
    smallest: float = 1e-3,
) -> SparseGrid:
    """The sparse grid around a closed surface (Odot 2023, section 4.2): only cells inside it or cut by it are kept.

    A cut cell's fraction comes from recursive subdivision; a finest part that is still cut counts with its share
    below the plane through the surface point nearest to its centre. That is exact for flat surfaces. With finest
    parts of edge h = spacing / 2^depth the error of the whole volume falls as h^2, to about (h / 2R)^2 of the volume
    on a sphere of radius R; parts across a sharp edge are each wrong by up to their own volume.

    Args:
        surface: closed surface without self-intersections (not checked here),
            wound outward, every vertex in use, metres.
        fixed: numbers of the attached surface vertices; all nodes of the cells that hold them become fixed.
        spacing: edge length of cubic cells, metres; the grid is centred on the surface. Give this or `cells_per_axis`.
        cells_per_axis: cells along x, y and z, which share out the surface's bounding box.
        node_sets: numbers of further surface vertices by name, mapped to nodes as `fixed` is.
        depth: how often a cut cell is halved along each axis, 0 to 6. One more takes about four times as long.
        smallest: cells with a smaller fraction are dropped, in (0, 1); those that hold a surface vertex are kept
            and count with this fraction.

    Raises:
        BodyError: the surface is not closed, wound inward, or has flat triangles or unused vertices; the cells do not
            hang together by their faces; or `Body` refuses them, for instance since all nodes are fixed.
        ValueError: neither or both of `spacing` and `cells_per_axis`, an argument outside the range given above,
            or more than 2 million cells in the enclosing grid.
    """
    _check_surface(surface)
    _check_limits(depth, smallest)
    sets = _vertex_sets(fixed, node_sets or {}, len(surface.points))
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    shape, edges = _layout(high - low, spacing, cells_per_axis)
    middle = (low + high) / 2
    # About the middle, since VTK compares lengths with absolute tolerances.
    centred = Surface(surface.points - middle, surface.triangles)
    share = _volume_fractions(centred, shape, edges, depth)
    places: Floats = centred.points / edges + shape / 2  # in cells from the low corner
    holders = _vertex_cells(places, share)
    kept = share >= smallest
    kept[tuple(holders.T)] = True
    _check_pieces(kept)
    points, cells, numbers = _kept_cells(kept)
    around = cells[_at(numbers, holders)]
    origin = middle - shape * edges / 2
    body = Body(
        origin + points * edges,
        cells,
        {name: around[members].ravel() for name, members in sets.items()},
        fractions=np.maximum(share, smallest)[kept],
        skin=surface,
    )
    return SparseGrid(
        body=body,
        surface=surface,
        weights=_weights(places - holders, around, len(points)),
        index=np.argwhere(kept),
        shape=(int(shape[0]), int(shape[1]), int(shape[2])),
        origin=origin,
        spacing=edges,
    )


def gridded(
    body: Body, spacing: float | None = None, cells_per_axis: Sequence[int] | None = None, smallest: float = 0.1
) -> Body:
    """A body on a regular grid instead of its own cells: its boundary becomes the skin, its sets and surfaces stay.

    Args:
        body: a body of tetrahedra or hexahedra with fixed nodes.
        spacing: edge length of cubic cells, metres; see `sparse_grid`. Give this or `cells_per_axis`.
        cells_per_axis: cells along x, y and z.
        smallest: fraction below which cells are dropped; larger than there, since a force on the skin moves the loose
            corners of a nearly empty cell by much more than the organ (with 1e-3 thirteen times as far on a liver of
            3,700 cells).

    Raises:
        BodyError, ValueError: see `sparse_grid`.
    """
    vertices, corners = np.unique(body.boundary, return_inverse=True)
    numbers = np.full(len(body.points), -1)
    numbers[vertices] = np.arange(len(vertices))
    sets = {name: numbers[np.intersect1d(nodes, vertices)] for name, nodes in body.node_sets.items()}
    fixed = sets.pop("fixed", np.empty(0, dtype=np.int64))
    surface = Surface(body.points[vertices], corners.reshape(-1, 3))
    grid = sparse_grid(
        surface, fixed, spacing=spacing, cells_per_axis=cells_per_axis, node_sets=sets, smallest=smallest
    )
    surfaces = {name: numbers[triangles] for name, triangles in body.surfaces.items()}
    return replace(grid.body, surfaces=surfaces, inner=body.inner)


def _layout(extent: Floats, spacing: float | None, cells_per_axis: Sequence[int] | None) -> tuple[Ints, Floats]:
    """Cells along each axis, (3,), and their edge lengths, (3,), metres."""
    if cells_per_axis is not None and spacing is None:
        counts = np.asarray(cells_per_axis)
        if counts.shape != (3,) or not np.issubdtype(counts.dtype, np.integer) or counts.min() < 1:
            raise ValueError(f"cells_per_axis: expected three whole numbers of at least 1, got {cells_per_axis!r}.")
        edges = extent / counts
    elif spacing is not None and cells_per_axis is None:
        if not 0 < spacing < np.inf:
            raise ValueError(f"spacing: expected a positive length in metres, got {spacing}.")
        counts = np.maximum(np.ceil(extent / spacing - _ROUND_OFF), 1)
        edges = np.full(3, float(spacing))
    else:
        raise ValueError("sparse_grid: expected one of spacing and cells_per_axis, got neither or both.")
    if np.prod(counts.astype(float)) > _MOST_CELLS:
        raise ValueError(
            f"spacing, cells_per_axis: expected at most {_MOST_CELLS} cells in the enclosing grid, got "
            f"{' x '.join(f'{count:.0f}' for count in counts)} of {edges.min():.3g} m; the surface and the spacing "
            "are in metres."
        )
    return counts.astype(np.int64), edges


def _volume_fractions(surface: Surface, shape: Ints, edges: Floats, depth: int) -> Floats:
    """Share of each cell inside the surface, (nx, ny, nz), in a grid of this shape centred on the origin."""
    positions = np.moveaxis(np.indices(tuple(shape)), 0, -1).reshape(-1, 3)
    share = _fractions(polydata(surface), (positions + 0.5 - shape / 2) * edges, edges, depth)
    share[share > 1 - _ROUND_OFF] = 1.0  # so that whole cells can be told from cut ones
    return share.reshape(tuple(shape))


def _fractions(surface: vtkPolyData, centres: Floats, edges: Floats, depth: int) -> Floats:
    """Share of each box inside the surface, (k,)."""
    if len(centres) > _AT_ONCE:
        blocks = np.array_split(centres, len(centres) // _AT_ONCE + 1)
        return np.concatenate([_fractions(surface, block, edges, depth) for block in blocks])
    distances, directions = signed_distances(surface, centres)
    share = (distances < 0).astype(np.float64)
    cut = np.flatnonzero(np.abs(distances) < np.linalg.norm(edges) / 2)
    if len(cut) and depth == 0:
        share[cut] = _below_plane(distances[cut], np.abs(directions[cut]) * edges)
    elif len(cut):
        parts = centres[cut][:, None] + (_CORNERS - 0.5) * edges / 2
        share[cut] = _fractions(surface, parts.reshape(-1, 3), edges / 2, depth - 1).reshape(-1, 8).mean(axis=1)
    return share


def _below_plane(distances: Floats, widths: Floats) -> Floats:
    """Share of each box below a plane, (k,) (Scardovelli and Zaleski 2000, J. Comput. Phys. 164, section 2.2).

    Args:
        distances: of the box's centre above the plane, (k,), metres.
        widths: extent of the box's three edges along the plane's normal, (k, 3), metres.
    """
    total = widths.sum(axis=1)
    below = np.clip(0.5 - distances / total, 0.0, 1.0)
    a = np.minimum(below, 1 - below)  # on the side with the smaller share
    m = np.sort(widths / total[:, None], axis=1).T
    m1, m2, m3 = np.where(m < _ROUND_OFF, _TINY, m)
    m12 = m1 + m2
    bounds = [a < m1, a < m2, a < np.minimum(m12, m3), m12 <= m3]
    corner = a**3 - (a - m1) ** 3 - (a - m2) ** 3
    values = [
        a**3 / (6 * m1 * m2 * m3),
        (a * (a - m1) + m1**2 / 3) / (2 * m2 * m3),
        corner / (6 * m1 * m2 * m3),
        (2 * a - m12) / (2 * m3),
    ]
    share = np.select(bounds, values, (corner - (a - m3) ** 3) / (6 * m1 * m2 * m3))
    return np.where(below < 0.5, share, 1 - share)


def _at(values: NDArray[Any], positions: Ints) -> NDArray[Any]:
    """Values of a grid's array at positions, (..., 3)."""
    return values[tuple(np.moveaxis(positions, -1, 0))]


def _vertex_cells(places: Floats, share: Floats) -> Ints:
    """Position of the cell that holds each vertex, (v, 3): of those that it touches the one with the largest share.

    Args:
        places: the vertices in cells from the grid's low corner, (v, 3).
        share: of each cell inside the surface, (nx, ny, nz).
    """
    touched = np.floor(places[:, None] + (2 * _CORNERS - 1) * _ROUND_OFF).astype(np.int64)
    touched = np.clip(touched, 0, np.subtract(share.shape, 1))
    return touched[np.arange(len(places)), _at(share, touched).argmax(axis=1)]


def _kept_cells(kept: Flags) -> tuple[Ints, Ints, Ints]:
    """Positions of the nodes, (n, 3), node numbers of the cells, (m, 8), and the grid's cell numbers (-1: dropped)."""
    corners = np.argwhere(kept)[:, None] + _CORNERS  # (m, 8, 3)
    used = np.zeros(np.add(kept.shape, 1), dtype=bool)
    used[tuple(np.moveaxis(corners, -1, 0))] = True
    return np.argwhere(used), _at(_numbers(used), corners), _numbers(kept)


def _numbers(chosen: Flags) -> Ints:
    numbers = np.cumsum(chosen, dtype=np.int64).reshape(chosen.shape) - 1
    return np.where(chosen, numbers, -1)


def _weights(xi: Floats, nodes: Ints, count: int) -> csr_array:
    """Trilinear weights at local coordinates, (v, 3) in 0 to 1, of nodes, (v, 8), as a matrix, (v, count)."""
    factors = np.where(_CORNERS > 0, xi[:, None], 1 - xi[:, None])  # (v, 8, 3)
    rows = np.arange(0, nodes.size + 1, 8)
    return csr_array((factors.prod(axis=2).ravel(), nodes.ravel(), rows), shape=(len(nodes), count))


def _vertex_sets(fixed: ArrayLike, others: Mapping[str, ArrayLike], count: int) -> dict[str, Ints]:
    if "fixed" in others:
        raise ValueError("node_sets: expected names other than 'fixed', which is an argument of its own.")
    sets = {name: _checked_vertices(f"node_sets[{name!r}]", vertices, count) for name, vertices in others.items()}
    sets["fixed"] = _checked_vertices("fixed", fixed, count)
    if len(sets["fixed"]) == 0:
        raise ValueError("fixed: expected at least one surface vertex, got none.")
    return sets


def _checked_vertices(name: str, vertices: ArrayLike, count: int) -> Ints:
    numbers = np.asarray(vertices)
    if numbers.ndim != 1 or (numbers.size and not np.issubdtype(numbers.dtype, np.integer)):
        raise ValueError(f"{name}: expected a list of vertex numbers, got {numbers.dtype} of shape {numbers.shape}.")
    if numbers.size and (numbers.min() < 0 or numbers.max() >= count):
        raise ValueError(f"{name}: expected vertex numbers in 0..{count - 1}, got {numbers.min()}..{numbers.max()}.")
    return numbers.astype(np.int64)


def _checked_field(name: str, values: ArrayLike, count: int) -> Floats:
    field = np.asarray(values, dtype=np.float64)
    if field.shape != (count, 3):
        raise ValueError(f"{name}: expected shape ({count}, 3), got {field.shape}.")
    return field


def _check_limits(depth: int, smallest: float) -> None:
    if not isinstance(depth, int | np.integer) or not 0 <= depth <= _DEEPEST:
        raise ValueError(f"depth: expected a whole number from 0 to {_DEEPEST}, got {depth!r}.")
    if not 0 < smallest < 1:
        raise ValueError(f"smallest: expected a fraction between 0 and 1, got {smallest}.")


def _check_surface(surface: Surface) -> None:
    count = len(surface.points)
    unused = count - len(np.unique(surface.triangles))
    if unused:
        raise BodyError(
            f"surface: expected every vertex to belong to a triangle, got {unused} of {count} that do not; "
            "drop them (checks.compacted)."
        )
    _check_closed(surface)
    flat = int((_relative_heights(surface) < _FLATTEST).sum())
    if flat:
        raise BodyError(
            f"surface: expected triangles higher than {_FLATTEST} of their longest edge, got {flat} flat ones, which "
            "have no side; make it solid (solidify) and take its boundary."
        )
    volume = Surface(surface.points - surface.points.mean(axis=0), surface.triangles).volume
    if not volume > 0:
        raise BodyError(
            f"surface: expected triangles that wind outward, got an enclosed volume of {volume:.3g} m^3; "
            "turn them (triangles[:, ::-1])."
        )


def _relative_heights(surface: Surface) -> Floats:
    """Height of each triangle above its longest edge, over that edge, (t,)."""
    corners = surface.points[surface.triangles]
    sides = np.roll(corners, -1, axis=1) - corners
    longest = (sides**2).sum(axis=2).max(axis=1)
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / np.maximum(longest, _TINY)


def _check_closed(surface: Surface) -> None:
    count = len(surface.points)
    edges = surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    forth, back = edges @ [count, 1], edges @ [1, count]
    # In a closed surface of one winding each edge is met twice, once in each direction.
    lone = int((~np.isin(forth, back)).sum())
    again = len(forth) - len(np.unique(forth))
    if lone or again:
        raise BodyError(
            f"surface: expected a closed surface of one winding, got {lone} edges of {len(edges)} that no neighbour "
            f"meets in the other direction and {again} met twice in one; make it solid (solidify), take its boundary."
        )


def _check_pieces(kept: Flags) -> None:
    # By faces, since pieces that share an edge or a corner only would turn about it freely.
    labels, count = label(kept)
    if count > 1:
        sizes = np.sort(np.bincount(labels[kept]))[::-1]
        raise BodyError(
            f"sparse_grid: expected cells that hang together by their faces, got {count} pieces of "
            f"{sizes[:5][:count].tolist()} cells; try another spacing or a smaller `smallest`, or build one body for "
            "each component of the surface."
        )
