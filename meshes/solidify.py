"""A closed triangle surface made solid: checks, repair, tetrahedra of a wanted size or number of nodes."""

from __future__ import annotations

import logging
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .body import Floats, Ints, Surface
from .metrics import tetrahedron_quality

_log = logging.getLogger(__name__)
_GMSH_LOCK = threading.RLock()  # gmsh has one global state
_TETRAHEDRON, _TRIANGLE = 4, 2  # gmsh's element types
_LOWEST_QUALITY = 1e-3  # radius ratio below which a tetrahedron is a sliver that no solver should meet
_SEARCHES = 6
_COUNT_TOLERANCE = 0.03
_FEWEST_VERTICES = 30
_VERTICES_PER_CLUSTER = 10  # of the surface before remeshing, for clusters of even size


class SurfaceError(ValueError):
    """A surface that cannot be made solid: the message says what is wrong with it and what to do."""


@contextmanager
def gmsh_model(name: str) -> Iterator[Any]:
    """A fresh gmsh model: silent, one thread (so the same input gives the same mesh), gone afterwards.

    Args:
        name: the model's name.

    Raises:
        ImportError: gmsh is not installed.
    """
    try:
        import gmsh  # here only: beams and surfaces must work where gmsh is not installed
    except (ImportError, OSError) as error:
        raise ImportError(f"gmsh is needed to make tetrahedra and could not be loaded ({error}); "
                          "install softtwin[mesh].") from error  # fmt: skip
    with _GMSH_LOCK:
        # Without interruptible=False gmsh takes over Ctrl-C, which fails outside the main thread.
        gmsh.initialize(["-nopopup"], readConfigFiles=False, interruptible=False)
        try:
            gmsh.option.setNumber("General.Terminal", 0)
            gmsh.option.setNumber("General.NumThreads", 1)
            gmsh.option.setNumber("Mesh.RandomSeed", 1)
            gmsh.model.add(name)
            yield gmsh
        finally:
            gmsh.finalize()


def solidify(
    surface: Surface, cell_size: float | None = None, node_count: int | None = None, *, remesh: bool = True
) -> tuple[Floats, Ints]:
    """Tetrahedra that fill a closed surface.

    Args:
        surface: closed triangle surface, metres; an inside-out one is turned.
        cell_size: wanted edge length, metres. Give this or `node_count`.
        node_count: wanted number of nodes; the edge length is searched, the number met within a few per cent
            where the surface allows it (the number reached is the length of the points returned, and is logged).
        remesh: True to remesh the surface with the same edge length, False to keep its triangles and nodes.

    Returns:
        points (n, 3) in metres and cells (m, 4).

    Raises:
        SurfaceError: the surface is open, not manifold, intersects itself, has several components, or gives slivers.
        ValueError: neither or both of `cell_size` and `node_count`, or one not positive.
    """
    _check_wish(cell_size, node_count)
    surface = checked_surface(surface)
    if cell_size is None:
        assert node_count is not None
        points, cells = _search_size(surface, node_count, remesh)
    else:
        points, cells = _tetrahedra(surface, cell_size, remesh)
    _check_slivers(points, cells, remesh)
    return points, cells


def checked_surface(surface: Surface) -> Surface:
    """The surface, compacted and wound outward, if it can be made solid.

    Args:
        surface: triangle surface, metres.

    Raises:
        SurfaceError: see `solidify`.
    """
    surface = compacted(surface)
    _check_edges(surface)
    _check_components(surface)
    if surface.volume < 0:
        _log.info("the surface was inside out; its triangles were turned outward")
        surface = Surface(surface.points, surface.triangles[:, ::-1])
    _check_intersections(surface)
    return surface


def repair(surface: Surface) -> Surface:
    """A closed surface made from a damaged one by MeshFix: holes filled, overlaps cut, the largest component kept.

    Args:
        surface: triangle surface, metres.

    Raises:
        SurfaceError: nothing was left, or what was left is still not fit.
        ImportError: pymeshfix is not installed.
    """
    from pymeshfix import MeshFix  # of the extra `mesh`, wanted only here and for the intersections

    surface = compacted(surface)
    fix = MeshFix(surface.points, surface.triangles.astype(np.int32))
    fix.repair()
    if len(fix.faces) == 0:
        raise SurfaceError("surface: repair left no triangles; expected a surface that encloses a volume.")
    return checked_surface(Surface(np.asarray(fix.points), np.asarray(fix.faces)))


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


def _check_wish(cell_size: float | None, node_count: int | None) -> None:
    if (cell_size is None) == (node_count is None):
        raise ValueError("solidify: expected one of cell_size and node_count, got neither or both.")
    if cell_size is not None and not 0 < cell_size < np.inf:
        raise ValueError(f"cell_size: expected a positive length in metres, got {cell_size}.")
    if node_count is not None and node_count < 20:
        raise ValueError(f"node_count: expected at least 20, got {node_count}.")


def _edges(triangles: Ints) -> Ints:
    return triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _check_edges(surface: Surface) -> None:
    edges = _edges(surface.triangles)
    _, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    open_edges, crowded = int((counts == 1).sum()), int((counts > 2).sum())
    if open_edges:
        raise SurfaceError(
            f"surface: expected a closed surface, got {open_edges} open edges (edges of one triangle only) of "
            f"{len(counts)}; close the holes in the segmentation tool, or repair it (--repair)."
        )
    if crowded:
        raise SurfaceError(
            f"surface: expected a manifold surface, got {crowded} edges shared by more than two triangles; "
            "repair it (--repair)."
        )
    if len(np.unique(edges, axis=0)) < len(edges):
        raise SurfaceError("surface: expected one winding, got neighbouring triangles that wind against each other; "
                           "repair it (--repair).")  # fmt: skip


def _check_components(surface: Surface) -> None:
    edges = _edges(surface.triangles)
    n = len(surface.points)
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, labels = connected_components(graph, directed=False)
    if count > 1:
        sizes = np.sort(np.bincount(labels[surface.triangles[:, 0]]))[::-1]
        raise SurfaceError(
            f"surface: expected one component, got {count} with {sizes[:5].tolist()} triangles; "
            "repair it (--repair keeps the largest) or build one body each."
        )


def intersecting_triangles(surface: Surface) -> Ints:
    """Numbers of the triangles that cut through another triangle of the surface, sorted.

    Args:
        surface: triangle surface, metres.

    Raises:
        ImportError: pymeshfix is not installed.
    """
    from pymeshfix import PyTMesh

    mesh = PyTMesh()
    mesh.set_quiet(True)
    mesh.load_array(surface.points, surface.triangles.astype(np.int32))
    return np.unique(np.asarray(mesh.select_intersecting_triangles(), dtype=np.int64))


def _check_intersections(surface: Surface) -> None:
    count = len(intersecting_triangles(surface))
    if count:
        raise SurfaceError(
            f"surface: expected a surface that does not intersect itself, got {count} of {len(surface.triangles)} "
            "triangles that cut others; repair it (--repair)."
        )


def _search_size(surface: Surface, node_count: int, remesh: bool) -> tuple[Floats, Ints]:
    # A tetrahedron of a good mesh has about 0.11 h^3, a node has about 5 tetrahedra.
    size = (surface.volume / (0.11 * 5 * node_count)) ** (1 / 3)
    best: tuple[Floats, Ints] | None = None
    for _ in range(_SEARCHES):
        found = _tetrahedra(surface, size, remesh)
        if best is None or abs(len(found[0]) - node_count) < abs(len(best[0]) - node_count):
            best = found
        ratio = len(found[0]) / node_count
        if abs(ratio - 1) <= _COUNT_TOLERANCE:
            break
        size *= ratio ** (1 / 2.7)  # between 3 (all nodes inside) and 2 (all nodes on the surface)
    assert best is not None
    _log.info("asked for %d nodes, made %d", node_count, len(best[0]))
    return best


def _tetrahedra(surface: Surface, size: float, remesh: bool) -> tuple[Floats, Ints]:
    if remesh:
        surface = _remeshed(surface, size)
    with gmsh_model("solid") as gmsh:
        _load(gmsh, surface)
        faces = [tag for _, tag in gmsh.model.getEntities(2)]
        gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop(faces)])
        gmsh.model.geo.synchronize()
        try:
            return fill(gmsh, size)
        except Exception as error:  # gmsh raises bare Exceptions
            raise SurfaceError(
                f"surface: gmsh could not fill it with cells of {size * 1e3:.3g} mm ({error}); "
                "try another cell size, remesh on or off, or repair it (--repair)."
            ) from error


def _remeshed(surface: Surface, size: float) -> Surface:
    # Clustering (ACVD) never hangs; gmsh's own remeshing does, when it cannot flatten a patch with tiny triangles.
    import pyacvd
    import pyvista

    count = max(int(surface.area / (size**2 * np.sqrt(3) / 2)), _FEWEST_VERTICES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyacvd uses a name that pyvista deprecates
        make: Any = pyvista.PolyData.from_regular_faces  # its stubs refuse float64
        clusters = pyacvd.Clustering(make(surface.points, surface.triangles))
        rounds = np.ceil(np.log(_VERTICES_PER_CLUSTER * count / len(surface.points)) / np.log(4))
        if rounds > 0:
            clusters.subdivide(int(rounds))
        clusters.cluster(count)
        mesh = clusters.create_mesh()
    try:
        return checked_surface(Surface(np.asarray(mesh.points, float), np.asarray(mesh.regular_faces)))
    except SurfaceError as error:
        raise SurfaceError(
            f"surface: remeshed with triangles of {size * 1e3:.3g} mm it lost its shape ({error}); "
            "choose smaller cells, or no remeshing."
        ) from error


def _load(gmsh: Any, surface: Surface) -> None:
    entity = gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(2, entity, np.arange(1, len(surface.points) + 1), surface.points.ravel())
    gmsh.model.mesh.addElementsByType(entity, _TRIANGLE, [], (surface.triangles + 1).ravel())


def fill(gmsh: Any, size: float) -> tuple[Floats, Ints]:
    """Points (n, 3) and tetrahedra (m, 4) of a model's volumes, optimised against slivers by gmsh and Netgen.

    Args:
        gmsh: the gmsh module with a current model.
        size: edge length, in the model's unit.

    Raises:
        ValueError: gmsh made no tetrahedra.
    """
    gmsh.option.setNumber("Mesh.MeshSizeMin", size)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.option.setNumber("Mesh.Optimize", 1)
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.optimize("Netgen")
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    _, corners = gmsh.model.mesh.getElementsByType(_TETRAHEDRON)
    if len(corners) == 0:
        raise ValueError("gmsh made no tetrahedra")
    order = np.argsort(tags)
    cells = order[np.searchsorted(tags, corners, sorter=order)].reshape(-1, 4)
    used, numbers = np.unique(cells, return_inverse=True)
    return coordinates.reshape(-1, 3)[used], numbers.reshape(-1, 4).astype(np.int64)


def _check_slivers(points: Floats, cells: Ints, remesh: bool) -> None:
    worst = float(tetrahedron_quality(points, cells).min())
    if worst < _LOWEST_QUALITY:
        advice = "repair it (--repair) or choose another cell size" if remesh else "let it be remeshed"
        raise SurfaceError(
            f"surface: expected tetrahedra with a radius ratio of at least {_LOWEST_QUALITY:g}, "
            f"the worst has {worst:.2g}; {advice}."
        )
