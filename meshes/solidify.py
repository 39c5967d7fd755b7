"""Any triangle surface made solid: put in order, thinned, filled by fTetWild, its worst cells mended, and all said."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

from .body import Floats, Ints, Surface
from .checks import Defects, SurfaceError, compacted, merged, piece_numbers, put_in_order
from .closest import distances, polydata
from .components import Cavities, ComponentError, Structures, chosen_component
from .metrics import cell_volumes, tetrahedron_quality
from .nesting import encloses, nesting
from .smoothing import Flags, improved, outer_faces, used_points
from .tetwild import tetrahedra

_log = logging.getLogger(__name__)
MAXIMUM_NODES = 200_000  # fTetWild would take hours for more, and a wrong unit asks for billions
_LOWEST_QUALITY = 1e-3  # radius ratio below which a tetrahedron is a sliver that no solver should meet
_GOOD_JACOBIAN = 0.25  # scaled: cells below are mended where that goes
# How far the boundary may lie from the surface: this part of its size, or for coarse cells this part of their edge.
_TOLERANCE, _TOLERANCE_OF_EDGE = 3e-3, 0.08
# Of the cells' edge: finer triangles take up to ten times as long in fTetWild; coarser ones lose volume.
_TRIANGLE_EDGE = 0.75
_EDGE_RATIO = 1.4  # fTetWild's wanted edge over the mean edge that it makes
# Nodes are about this times volume / size^3 and this times area / size^2 (measured on organ surfaces).
_NODES_IN_CUBE, _NODES_ON_SQUARE = 0.72, 1.44
_LEFT_OUT = 0.01  # of the surface's size: a component whose median point lies farther from the solid is not in it
_LARGE_PART = 0.05  # of the volume
_SEARCHES = 5
_COUNT_TOLERANCE = 0.15
_SLOPE = 2.2  # nodes fall with this power of the cell size: 3 inside, 2 on the surface, less where details bind
_UNPINCHES = 20
_PROBES = 7  # vertices of a structure that are asked whether they lie inside a component


@dataclass(frozen=True)
class Mending:
    """What was done to a surface on its way to a solid; print it for a readable list.

    Args:
        defects: what was wrong with the surface.
        dropped: volumes of the components left out, largest first, cubic metres.
        volume_before: of the surface, holes closed flat, cubic metres, with components left out.
        volume_after: of the solid, cubic metres.
        distance: largest distance between the surface (holes closed) and the solid's boundary, either way, metres.
        mean_distance: mean of both ways, metres.
        others: volumes of the components beside the one that was asked for, largest first, cubic metres.
    """

    defects: Defects
    dropped: tuple[float, ...]
    volume_before: float
    volume_after: float
    distance: float
    mean_distance: float
    others: tuple[float, ...] = ()

    def __str__(self) -> str:
        d = self.defects
        said = [
            (d.merged_vertices, f"{d.merged_vertices} vertices merged with others at the same place or across a gap"),
            (d.degenerate_triangles, f"{d.degenerate_triangles} triangles without area or there twice left out"),
            (d.open_edges, f"{d.holes} holes ({d.open_edges} open edges) closed"),
            (d.crowded_edges, f"{d.crowded_edges} edges of more than two triangles resolved"),
            (d.clashing_edges, f"{d.clashing_edges} edges between triangles of opposite winding: turned alike"),
            (d.winds_inward, "triangles wound inward: turned outward"),
            (
                len(d.cavities),
                f"{len(d.cavities)} cavities (closed surfaces inside others) of "
                f"{1e6 * sum(d.cavities):.4g} ml {'filled' if d.filled else 'stay open; --cavities fill fills them'}",
            ),
            (len(self.dropped), f"{len(self.dropped)} components left out, the largest {_millilitres(self.dropped)}"),
        ]
        lines = [line for holds, line in said if holds]
        if self.others:
            lines.append(f"{1e6 * sum(self.others):.4g} ml in {len(self.others)} other components left out, as you say")
        lines = lines or ["nothing was wrong with the surface"]
        share = (self.volume_after + sum(self.dropped)) / self.volume_before
        lines += [
            f"volume before {1e6 * self.volume_before:.5g} ml, after {1e6 * self.volume_after:.5g} ml"
            + (f", with what was left out {share:.4f} of it" if self.dropped else f" ({share:.4f} of it)"),
            f"moved at most {1e3 * self.distance:.2f} mm, {1e3 * self.mean_distance:.3f} mm on average",
        ]
        lines = [f"surface: {line}" for line in lines]
        if d.misleading and not d.filled:
            lines.append(
                "warning: an inner surface winds outward like the outer one; that it lies inside makes it a cavity. If "
                "what it encloses is solid (a tumour), say --cavities fill, and give it as --inner from a file of its "
                "own"
            )
        lost = sum(map(abs, self.dropped)) / self.volume_before
        if lost > _LARGE_PART:
            lines.append(
                f"warning: {100 * lost:.0f} % of the surface's volume is in components that were left out; "
                "--component left, right, 2 or near:STRUCTURE takes another one"
            )
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class Solid:
    """Tetrahedra that fill a surface, and what was done to it.

    Args:
        points: node positions, (n, 3), metres.
        cells: node numbers, (m, 4).
        mending: what was done.
    """

    points: Floats
    cells: Ints
    mending: Mending


def solidify(
    surface: Surface,
    cell_size: float | None = None,
    node_count: int | None = None,
    cavities: Cavities = "",
    component: str = "largest",
    structures: Structures | None = None,
) -> Solid:
    """Tetrahedra that fill what a surface encloses, whatever its defects: holes, crumbs, overlaps, any winding.

    Of several components one is kept. The mesh is another one at each call (see `tetwild.tetrahedra`).

    Args:
        surface: triangle surface, metres.
        cell_size: wanted mean edge length, metres. Give this or `node_count`.
        node_count: wanted number of nodes; the edge length is searched until the number is met within 15 %, with
            at most 5 meshes (the number reached is the length of the points returned, and is logged).
        cavities: fill closed components inside others, or keep them as cavities, as is done where nothing is said.
        component: `largest`, or which of several that lie apart is meant (see `components.check_component`).
        structures: vertices of the structures that `near:` may name.

    Raises:
        SurfaceError: no solid came, or only one with slivers.
        ValueError: neither or both of `cell_size` and `node_count`, one out of its range, or more nodes than
            `MAXIMUM_NODES`.
    """
    _check_wish(cell_size, node_count)
    chosen, others = _component(surface, component, structures or _no_structure)
    ordered, defects = put_in_order(chosen, cavities)
    if not ordered.volume > 0:
        raise SurfaceError(
            "surface: expected triangles that enclose a volume, got none; is it a sheet, or open on one side?"
        )
    if cell_size is None:
        assert node_count is not None
        points, cells = _search_size(ordered, node_count)
    else:
        check_node_count(ordered, cell_size)
        points, cells = _filled(ordered, cell_size)
    worst = float(tetrahedron_quality(points, cells).min())
    if worst < _LOWEST_QUALITY:
        raise SurfaceError(
            f"surface: expected tetrahedra with a radius ratio of at least {_LOWEST_QUALITY:g}, the worst has "
            f"{worst:.2g}; try another number of nodes or cell size."
        )
    return Solid(points, cells, replace(_mending(ordered, defects, points, cells), others=others))


def _component(surface: Surface, component: str, structures: Structures) -> tuple[Surface, tuple[float, ...]]:
    """The component that words mean, with what lies inside it, and the volumes of the others, cubic metres."""
    if component.strip() == "largest":
        return surface, ()
    whole = compacted(merged(surface))
    vertices = piece_numbers(whole)
    pieces = vertices[whole.triangles[:, 0]]
    count = int(pieces.max()) + 1
    found = nesting(whole, pieces, np.ones(count, dtype=np.bool_))
    tops = np.flatnonzero(found.depths == 0)
    middles = np.array([whole.points[vertices == top].mean(axis=0) for top in tops])

    def away(name: str) -> Floats:
        vertices = structures(name)
        return np.array([_away(whole, whole.triangles[pieces == top], vertices) for top in tops])

    chosen = tops[chosen_component(component, found.volumes[tops], middles, away, "the surface")]
    inside = [k for k in range(count) if k == chosen or (found.depths[k] > 0 and found.holders[k] == chosen)]
    others = np.sort(found.volumes[tops[tops != chosen]])[::-1]
    return compacted(Surface(whole.points, whole.triangles[np.isin(pieces, inside)])), tuple(others.tolist())


def _away(surface: Surface, triangles: Ints, vertices: Floats) -> float:
    """How far a structure is from what some triangles enclose, metres: 0 where a part of it is inside."""
    probes = vertices[np.linspace(0, len(vertices) - 1, min(_PROBES, len(vertices))).astype(int)]
    if encloses(surface, triangles, probes).any():
        return 0.0
    return float(distances(Surface(surface.points, triangles), vertices).min())


def _no_structure(name: str) -> Floats:
    raise ComponentError(f"--component near:{name}: expected the name of an inner structure; none is known.")


def check_node_count(surface: Surface, cell_size: float) -> None:
    """Refuse a cell size that would make more nodes than `MAXIMUM_NODES`.

    Args:
        surface: closed surface, metres.
        cell_size: edge length, metres.

    Raises:
        ValueError: with the number of nodes that would come.
    """
    count = _node_estimate(surface, cell_size)
    if count > MAXIMUM_NODES:
        raise ValueError(
            f"cell_size: {cell_size:g} m in a surface {np.ptp(surface.points, axis=0).max():.3g} m across makes about "
            f"{count:.2g} nodes, expected at most {MAXIMUM_NODES}; is the surface in another unit (--unit mm)? "
            "cell_size is in metres."
        )


def _check_wish(cell_size: float | None, node_count: int | None) -> None:
    if (cell_size is None) == (node_count is None):
        raise ValueError("solidify: expected one of cell_size and node_count, got neither or both.")
    if cell_size is not None and not 0 < cell_size < np.inf:
        raise ValueError(f"cell_size: expected a positive length in metres, got {cell_size}.")
    if node_count is not None and not 20 <= node_count <= MAXIMUM_NODES:
        raise ValueError(f"node_count: expected 20 to {MAXIMUM_NODES}, got {node_count}.")


def _node_estimate(surface: Surface, cell_size: float) -> float:
    return abs(surface.volume) * _NODES_IN_CUBE / cell_size**3 + surface.area * _NODES_ON_SQUARE / cell_size**2


def size_estimate(surface: Surface, node_count: float) -> float:
    """The edge length, metres, of cells that fill a surface with about so many nodes."""
    roots = np.roots([node_count, 0.0, -surface.area * _NODES_ON_SQUARE, -abs(surface.volume) * _NODES_IN_CUBE])
    return float(roots[np.isreal(roots)].real.max())


def _search_size(surface: Surface, node_count: int) -> tuple[Floats, Ints]:
    size, found = size_estimate(surface, node_count), dict[float, tuple[Floats, Ints]]()
    for _ in range(_SEARCHES):
        found[size] = _filled(surface, size)
        count = len(found[size][0])
        _log.info("cells of %.3g mm give %d nodes, wanted %d", 1e3 * size, count, node_count)
        if abs(count / node_count - 1) <= _COUNT_TOLERANCE:
            break
        surface = _without(surface, _left_out(surface, *found[size])[0])  # what is left out need not be meshed again
        size = _next_size({tried: len(mesh[0]) for tried, mesh in found.items()}, node_count)
    return min(found.values(), key=lambda mesh: abs(np.log(len(mesh[0]) / node_count)))


def _next_size(counts: dict[float, int], wanted: int) -> float:
    """The cell size to try next, from the numbers of nodes that others gave: a straight line through logarithms."""
    small = max((size for size, count in counts.items() if count >= wanted), default=None)
    large = min((size for size, count in counts.items() if count < wanted), default=None)
    if small is not None and large is not None and small < large:
        part = np.log(wanted / counts[large]) / np.log(counts[small] / counts[large])
        return float(large * (small / large) ** part)
    last = list(counts)[-1]
    return float(last * (counts[last] / wanted) ** (1 / _SLOPE))


def _filled(surface: Surface, cell_size: float) -> tuple[Floats, Ints]:
    thinned = _thinned(surface, _TRIANGLE_EDGE * cell_size)
    tolerance = max(_TOLERANCE * _size(surface), _TOLERANCE_OF_EDGE * cell_size)
    points, cells = tetrahedra(thinned, _EDGE_RATIO * cell_size, tolerance)
    if len(cells) == 0:
        raise SurfaceError("surface: fTetWild found nothing inside it; is it a sheet, or open on one side?")
    cells = _unpinched(points, _largest(points, cells))
    return improved(*used_points(points, cells), _GOOD_JACOBIAN)


def _size(surface: Surface) -> float:
    return float(np.linalg.norm(np.ptp(surface.points, axis=0)))


def _thinned(surface: Surface, edge: float) -> Surface:
    """The surface with about as many triangles as have this edge length, each where it changes the shape least."""
    count = surface.area / (np.sqrt(3) / 4 * edge**2)
    if count >= len(surface.triangles):
        return surface
    decimation = vtkQuadricDecimation()
    decimation.SetInputData(polydata(surface))
    decimation.SetTargetReduction(1 - count / len(surface.triangles))
    decimation.VolumePreservationOn()
    decimation.Update()
    mesh = decimation.GetOutput()
    if mesh.GetNumberOfPolys() == 0:
        return surface
    triangles = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    return compacted(Surface(vtk_to_numpy(mesh.GetPoints().GetData()).astype(np.float64), triangles))


def _largest(points: Floats, cells: Ints) -> Ints:
    """The cells of the component of the largest volume (by faces)."""
    labels = _by_faces(cells)
    return cells[labels == np.bincount(labels, cell_volumes(points, cells)).argmax()]


def _by_faces(cells: Ints) -> Ints:
    """Number of each cell's component: cells that hang together by their faces, (m,)."""
    faces, outer = outer_faces(cells)
    shared = np.flatnonzero(~outer.ravel())
    order = np.lexsort(np.sort(faces.reshape(-1, 3)[shared], axis=1).T)
    pairs = shared[order].reshape(-1, 2) // 4
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _unpinched(points: Floats, cells: Ints) -> Ints:
    """Cells without the smaller parts that touch the rest in an edge or a node only: such a part would turn freely."""
    for _ in range(_UNPINCHES):
        gone = _pinched(points, cells)
        if len(gone) == 0:
            break
        cells = _largest(points, np.delete(cells, gone, axis=0))
    return cells


def _pinched(points: Floats, cells: Ints) -> Ints:
    """Cells around edges of four boundary triangles, and around nodes, that hang together with most of them nowhere."""
    faces, outer = outer_faces(cells)
    triangles = faces[outer]
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs, counts = np.unique(edges, axis=0, return_counts=True)
    groups = [np.flatnonzero(np.isin(cells, pair).sum(axis=1) == 2) for pair in pairs[counts > 2]]
    groups += [np.flatnonzero((cells == node).any(axis=1)) for node in _nodes_of_two_fans(triangles)]
    volumes = cell_volumes(points, cells)
    return np.unique(np.concatenate([np.empty(0, np.int64), *(_lesser(cells, group, volumes) for group in groups)]))


def _nodes_of_two_fans(triangles: Ints) -> Ints:
    """Nodes whose boundary triangles do not all hang together by edges at the node."""
    count = len(triangles)
    corners = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    places = np.tile([0, 1, 1, 2, 2, 0], (count, 1)) + 3 * np.arange(count)[:, None]  # corner k of triangle t: 3 t + k
    turned = corners[:, 0] > corners[:, 1]
    corners, places = (np.where(turned[:, None], x[:, ::-1], x) for x in (corners, places.reshape(-1, 2)))
    order = np.lexsort(corners.T)
    alike = (corners[order][1:] == corners[order][:-1]).all(axis=1)
    pairs = np.concatenate(
        [np.column_stack([places[order][:-1][alike, end], places[order][1:][alike, end]]) for end in (0, 1)]
    )
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(3 * count, 3 * count))
    _, fans = connected_components(graph, directed=False)
    owners = np.unique(np.column_stack([triangles.ravel(), fans]), axis=0)[:, 0]
    nodes, counts = np.unique(owners, return_counts=True)
    return nodes[counts > 1]


def _lesser(cells: Ints, chosen: Ints, volumes: Floats) -> Ints:
    """Of the chosen cells those that do not hang, by faces, together with the largest part."""
    labels = _by_faces(cells[chosen])
    return chosen[labels != np.bincount(labels, volumes[chosen]).argmax()]


def _mending(surface: Surface, defects: Defects, points: Floats, cells: Ints) -> Mending:
    pieces = piece_numbers(surface)
    far, back = _left_out(surface, points, cells)
    there = distances(surface, _samples(_boundary(points, cells)))
    kept = back[~far[_sample_pieces(surface, pieces)]]
    return Mending(
        defects=defects,
        dropped=tuple(np.sort(_volumes(surface, pieces)[far])[::-1].tolist()),
        volume_before=surface.volume,
        volume_after=float(cell_volumes(points, cells).sum()),
        distance=float(max(there.max(), kept.max())),
        mean_distance=float((there.mean() + kept.mean()) / 2),
    )


def _left_out(surface: Surface, points: Floats, cells: Ints) -> tuple[Flags, Floats]:
    """Which components of a surface the solid does not follow, and the distances of the surface's samples to it."""
    away = distances(_boundary(points, cells), _samples(surface))
    pieces = piece_numbers(surface)
    order = np.argsort(_sample_pieces(surface, pieces), kind="stable")
    groups = np.split(away[order], np.cumsum(np.bincount(_sample_pieces(surface, pieces)))[:-1])
    return np.array([np.median(group) for group in groups]) > _LEFT_OUT * _size(surface), away


def _without(surface: Surface, far: Flags) -> Surface:
    pieces = piece_numbers(surface)
    return compacted(Surface(surface.points, surface.triangles[~far[pieces[surface.triangles[:, 0]]]]))


def _boundary(points: Floats, cells: Ints) -> Surface:
    faces, outer = outer_faces(cells)
    return compacted(Surface(points, faces[outer]))


def _sample_pieces(surface: Surface, pieces: Ints) -> Ints:
    return np.concatenate([pieces, pieces[surface.triangles[:, 0]]])


def _volumes(surface: Surface, pieces: Ints) -> Floats:
    """Volume that each piece encloses, cubic metres."""
    corners = (surface.points - surface.points.mean(axis=0))[surface.triangles]
    six = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return np.bincount(pieces[surface.triangles[:, 0]], six) / 6


def _samples(surface: Surface) -> Floats:
    return np.concatenate([surface.points, surface.points[surface.triangles].mean(axis=1)])


def _millilitres(volumes: tuple[float, ...]) -> str:
    return f"{1e6 * volumes[0]:.4g} ml" if volumes else ""
