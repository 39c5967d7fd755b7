"""Triangle surfaces looked at and put in order: shared vertices, open edges, components, winding, holes."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkPolyDataNormals

from .body import Floats, Ints, Surface
from .closest import polydata
from .components import Cavities
from .nesting import nesting

_log = logging.getLogger(__name__)
_COINCIDENT = 1e-6  # of the surface's size: vertices nearer to each other are one; coordinates in single precision hold
_GAP = 1e-3  # of the surface's size: open edges nearer to each other are one edge that was torn
_LARGEST_LID = 0.6  # of a patch's area: a larger lid would be a second side of a sheet that has no inside


class SurfaceError(ValueError):
    """A surface that cannot be made solid: the message says what is wrong with it and what to do."""


@dataclass(frozen=True)
class Defects:
    """What keeps a surface from being the closed boundary of one solid, counted.

    Args:
        merged_vertices: vertices that lie on another one, or across a narrow gap from it.
        degenerate_triangles: triangles that use a vertex twice, or that are there twice.
        open_edges: edges of one triangle only.
        holes: groups of open edges that hang together.
        crowded_edges: edges of more than two triangles.
        clashing_edges: edges whose two triangles wind against each other.
        pieces: components that share no vertex.
        winds_inward: True where the surface as a whole is inside out.
        cavities: volumes of closed components that lie inside others, largest first, cubic metres.
        misleading: True where one of these winds like a solid.
        filled: whether they were filled.
    """

    merged_vertices: int
    degenerate_triangles: int
    open_edges: int
    holes: int
    crowded_edges: int
    clashing_edges: int
    pieces: int
    winds_inward: bool
    cavities: tuple[float, ...] = ()
    misleading: bool = False
    filled: bool = False


def put_in_order(surface: Surface, cavities: Cavities = "") -> tuple[Surface, Defects]:
    """The surface with shared vertices, one winding (outward) and flat lids over its holes, and what was wrong with it.

    A closed component inside another bounds a cavity, whichever way it winds (see `nesting`). Nothing is guessed that
    only a mesher can settle: sheets without an inside, crowded edges and self-intersections stay.

    Args:
        surface: triangle surface, metres.
        cavities: fill them, or keep them, which is also what happens where nothing is said.

    Raises:
        SurfaceError: no triangle is left.
    """
    shared = _stitched(merged(surface))
    whole = compacted(shared)
    distinct = Surface(whole.points, _distinct(whole.triangles))
    open_, crowded, clashing = _edge_counts(distinct.triangles)
    wound = _wound(distinct) if clashing else distinct
    rims = _open_edges(wound.triangles)
    lidded = _lidded(wound, rims)
    inward = lidded.volume < 0
    ordered = Surface(lidded.points, lidded.triangles[:, ::-1]) if inward else lidded
    ordered, hollow, misled = _nested(ordered, cavities)
    defects = Defects(
        merged_vertices=len(surface.points) - len(shared.points),
        degenerate_triangles=len(surface.triangles) - len(distinct.triangles),
        open_edges=open_,
        holes=_groups(rims, len(wound.points))[0],
        crowded_edges=crowded,
        clashing_edges=clashing,
        pieces=int(piece_numbers(distinct).max()) + 1,
        winds_inward=inward,
        cavities=hollow,
        misleading=misled and not clashing,
        filled=cavities == "fill",
    )
    return ordered, defects


def _nested(surface: Surface, cavities: Cavities) -> tuple[Surface, tuple[float, ...], bool]:
    """Components wound as they lie in each other, volumes of the cavities, and whether one wound like a solid."""
    vertices = piece_numbers(surface)
    pieces = vertices[surface.triangles[:, 0]]
    count = int(pieces.max()) + 1
    if count == 1:
        return surface, (), False
    is_closed = np.ones(count, dtype=np.bool_)
    is_closed[vertices[_open_edges(surface.triangles)[:, 0]]] = False
    found = nesting(surface, pieces, is_closed)
    turned = found.is_known & (found.is_inward != found.is_cavity)
    if not (turned.any() or found.is_cavity.any()):
        return surface, (), False
    volumes = tuple(np.sort(found.volumes[found.is_cavity])[::-1].tolist())
    misled = bool((found.is_cavity & ~found.is_inward).any())  # the outermost component winds outward by now
    if cavities == "fill":
        return compacted(Surface(surface.points, surface.triangles[(found.depths == 0)[pieces]])), volumes, misled
    flipped = np.where(turned[pieces][:, None], surface.triangles[:, ::-1], surface.triangles)
    return Surface(surface.points, flipped), volumes, misled


def merged(surface: Surface) -> Surface:
    """The surface with vertices that coincide (to 1e-6 of its size) made one; the first of them gives the place.

    Args:
        surface: triangle surface, metres.
    """
    return _merged(surface, np.arange(len(surface.points)), _COINCIDENT)


def _stitched(surface: Surface) -> Surface:
    """The surface with vertices along open edges merged across narrow gaps, where that closes open edges."""
    rims = _open_edges(surface.triangles)
    if len(rims) == 0:
        return surface
    stitched = _merged(surface, np.unique(rims), _GAP)
    edges = np.sort(stitched.triangles, axis=1)
    kept = stitched.triangles[(np.diff(edges, axis=1) != 0).all(axis=1)]
    return stitched if len(kept) and len(_open_edges(kept)) < len(rims) else surface


def _merged(surface: Surface, chosen: Ints, share: float) -> Surface:
    """The surface with chosen vertices made one where they are nearer to each other than this share of its size."""
    size = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    pairs = chosen[cKDTree(surface.points[chosen]).query_pairs(share * size, output_type="ndarray")]
    if len(pairs) == 0:
        return surface
    count, labels = _groups(pairs, len(surface.points), lone=True)
    first = np.full(count, len(labels))
    np.minimum.at(first, labels, np.arange(len(labels)))
    order = np.argsort(first)  # vertices keep their order
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    return Surface(surface.points[first[order]], rank[labels][surface.triangles])


def compacted(surface: Surface) -> Surface:
    """The surface without vertices that no triangle uses and without triangles that use a vertex twice.

    Args:
        surface: triangle surface, metres.

    Raises:
        SurfaceError: no triangle is left.
    """
    corners = np.sort(surface.triangles, axis=1)
    triangles = surface.triangles[(np.diff(corners, axis=1) != 0).all(axis=1)]
    if len(triangles) == 0:
        raise SurfaceError("surface: expected triangles with three different corners, got none.")
    used, numbers = np.unique(triangles, return_inverse=True)
    return Surface(surface.points[used], numbers.reshape(-1, 3))


def checked_surface(surface: Surface) -> Surface:
    """The surface, compacted and wound outward, if it is closed, manifold, of one winding and of one component.

    Args:
        surface: triangle surface, metres.

    Raises:
        SurfaceError: what it is not.
    """
    surface = compacted(surface)
    open_, crowded, clashing = _edge_counts(surface.triangles)
    if open_:
        raise SurfaceError(f"surface: expected a closed surface, got {open_} open edges (edges of one triangle only).")
    if crowded:
        raise SurfaceError(f"surface: expected a manifold surface, got {crowded} edges shared by more than two "
                           "triangles.")  # fmt: skip
    if clashing:
        raise SurfaceError("surface: expected one winding, got neighbouring triangles that wind against each other.")
    labels = piece_numbers(surface)
    if labels.max() > 0:
        sizes = np.sort(np.bincount(labels[surface.triangles[:, 0]]))[::-1]
        raise SurfaceError(f"surface: expected one component, got {len(sizes)} with {sizes[:5].tolist()} triangles.")
    if surface.volume < 0:
        _log.info("the surface was inside out; its triangles were turned outward")
        surface = Surface(surface.points, surface.triangles[:, ::-1])
    return surface


def _distinct(triangles: Ints) -> Ints:
    """Each triangle once, whichever way its copies wind."""
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    return triangles[np.sort(first)]


def _edges(triangles: Ints) -> Ints:
    return triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _edge_counts(triangles: Ints) -> tuple[int, int, int]:
    """Edges of one triangle, of more than two, and of two that wind against each other."""
    edges = _edges(triangles)
    _, numbers, counts = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    ascending = np.bincount(numbers.ravel(), weights=edges[:, 0] < edges[:, 1], minlength=len(counts))
    return int((counts == 1).sum()), int((counts > 2).sum()), int(((counts == 2) & (ascending != 1)).sum())


def _open_edges(triangles: Ints) -> Ints:
    """Edges of one triangle only, in the direction in which it runs through them, (e, 2)."""
    edges = _edges(triangles)
    _, first, counts = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return edges[first[counts == 1]]


def _groups(pairs: Ints, count: int, lone: bool = False) -> tuple[int, Ints]:
    """Number of groups that the pairs make of `count` vertices, and each vertex's group; lone ones count if asked."""
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    groups, labels = connected_components(graph, directed=False)
    return (groups if lone else groups - (count - len(np.unique(pairs)))), labels.astype(np.int64)


def piece_numbers(surface: Surface) -> Ints:
    """Number of the component that each vertex belongs to, (v,); components share no vertex.

    Args:
        surface: triangle surface whose vertices are all used, metres.
    """
    return _groups(_edges(surface.triangles), len(surface.points), lone=True)[1]


def _wound(surface: Surface) -> Surface:
    """The surface with neighbours that wind alike; each piece outward as far as it encloses anything."""
    normals = vtkPolyDataNormals()
    normals.SetInputData(polydata(surface))
    normals.SplittingOff()
    normals.ConsistencyOn()
    normals.AutoOrientNormalsOff()
    normals.Update()
    triangles = vtk_to_numpy(normals.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    # Neighbours through an edge of two triangles wind alike now; what hangs together only otherwise has its own sign.
    labels = _patches(triangles)
    corners = surface.points[triangles] - surface.points.mean(axis=0)
    volumes = np.bincount(labels, np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    inward = (volumes < 0)[labels]
    return Surface(surface.points, np.where(inward[:, None], triangles[:, ::-1], triangles))


def _patches(triangles: Ints) -> Ints:
    """Number of each triangle's patch: triangles that hang together by edges of two triangles, (t,)."""
    edges = np.sort(_edges(triangles), axis=1)
    _, numbers, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    plain = np.flatnonzero(counts[numbers.ravel()] == 2)
    pairs = plain[np.argsort(numbers.ravel()[plain], kind="stable")].reshape(-1, 2) // 3
    return _groups(pairs, len(triangles), lone=True)[1]


def _lidded(surface: Surface, rims: Ints) -> Surface:
    """The surface with a fan of triangles from the middle of each hole to its rim, where it is a hole in something."""
    if len(rims) == 0:
        return surface
    _, labels = _groups(rims, len(surface.points))
    holes, numbers = np.unique(labels[rims[:, 0]], return_inverse=True)
    counts = np.bincount(numbers)
    middles = np.stack([np.bincount(numbers, surface.points[rims[:, 0], i]) / counts for i in range(3)], axis=1)
    fans = np.column_stack([rims[:, 1], rims[:, 0], len(surface.points) + numbers])
    whole = Surface(np.concatenate([surface.points, middles]), np.concatenate([surface.triangles, fans]))
    lids = np.bincount(numbers, _areas(whole)[len(surface.triangles) :], minlength=len(holes))
    # A lid belongs to the piece that its rim belongs to; a sheet's lid is as large as the sheet.
    pieces = piece_numbers(surface)
    areas = np.bincount(pieces[surface.triangles[:, 0]], _areas(surface), minlength=pieces.max() + 1)
    rim_pieces = np.zeros(len(holes), dtype=np.int64)
    rim_pieces[numbers] = pieces[rims[:, 0]]
    fits = (lids <= _LARGEST_LID * areas[rim_pieces])[numbers]
    return compacted(Surface(whole.points, np.concatenate([surface.triangles, fans[fits]])))


def _areas(surface: Surface) -> Floats:
    a, b, c = (surface.points[surface.triangles[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
