"""Tetrahedra by gmsh, for the shapes that the project makes: smooth, closed, without defects."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from .body import Floats, Ints, Surface
from .checks import SurfaceError, checked_surface
from .signals import restore_sigpipe

_GMSH_LOCK = threading.RLock()  # gmsh has one global state
_TETRAHEDRON, _TRIANGLE = 4, 2  # gmsh's element types
_FEWEST_VERTICES = 30
_ATTEMPTS, _MORE = 10, 1.04  # numbers of vertices that are tried, and the factor from one to the next
_VERTICES_PER_CLUSTER = 10  # of the surface before remeshing, for clusters of even size
_AROUND = 1000  # triangles around a vertex that it may be moved to: as many as pyacvd looks at


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
        restore_sigpipe()
        try:
            gmsh.option.setNumber("General.Terminal", 0)
            gmsh.option.setNumber("General.NumThreads", 1)
            gmsh.option.setNumber("Mesh.RandomSeed", 1)
            gmsh.model.add(name)
            yield gmsh
        finally:
            gmsh.finalize()
            restore_sigpipe()


def filled(surface: Surface, size: float) -> tuple[Floats, Ints]:
    """Points (n, 3) in metres and tetrahedra (m, 4) of even size inside a good surface; always the same mesh.

    Args:
        surface: closed manifold surface, fine enough for cells of this size, metres.
        size: edge length, metres.

    Raises:
        SurfaceError: the surface is no such surface, or gmsh could not fill it.
        ImportError: gmsh or pyacvd is not installed.
    """
    surface = _remeshed(checked_surface(surface), size)
    with gmsh_model("solid") as gmsh:
        _load(gmsh, surface)
        faces = [tag for _, tag in gmsh.model.getEntities(2)]
        gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop(faces)])
        gmsh.model.geo.synchronize()
        try:
            return fill(gmsh, size)
        except Exception as error:  # gmsh raises bare Exceptions
            raise SurfaceError(
                f"surface: gmsh could not fill it with cells of {size * 1e3:.3g} mm ({error}); try another cell size."
            ) from error


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


def _remeshed(surface: Surface, size: float) -> Surface:
    """The surface in triangles of about one size; in a few more where so many close no surface."""
    count = max(int(surface.area / (size**2 * np.sqrt(3) / 2)), _FEWEST_VERTICES)
    for attempt in range(_ATTEMPTS):
        try:
            return checked_surface(_clustered(surface, round(count * _MORE**attempt)))
        except SurfaceError as error:
            reason = error
    raise SurfaceError(
        f"surface: remeshed with triangles of {size * 1e3:.3g} mm it lost its shape ({reason}); choose smaller cells."
    ) from reason


def _clustered(surface: Surface, count: int) -> Surface:
    """About so many vertices, evenly over the surface: thin parts may come out with open edges, or folded."""
    # Clustering (ACVD) never hangs; gmsh's own remeshing does, when it cannot flatten a patch with tiny triangles.
    import pyacvd
    import pyvista

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyacvd uses a name that pyvista deprecates
        make: Any = pyvista.PolyData.from_regular_faces  # its stubs refuse float64
        clusters = pyacvd.Clustering(make(surface.points, surface.triangles))
        rounds = np.ceil(np.log(_VERTICES_PER_CLUSTER * count / len(surface.points)) / np.log(4))
        if rounds > 0:
            clusters.subdivide(int(rounds))
        clusters.cluster(count)
        mesh = clusters.create_mesh(moveclus=False, clean=False)
        fine = clusters.mesh.points.astype(float), np.asarray(clusters.mesh.regular_faces)
        mesh.points = _on_surface(np.asarray(mesh.points, float), clusters.cluster_norm, *fine)
        mesh = mesh.clean()
    return Surface(np.asarray(mesh.points, float), np.asarray(mesh.regular_faces))


def _on_surface(points: Floats, normals: Floats, vertices: Floats, triangles: Ints) -> Floats:
    """Points moved along their normals to the nearest of the triangles around them.

    As pyacvd's `moveclus` does, which looks for these triangles for most of the time that remeshing takes.

    Args:
        points: (p, 3).
        normals: at the points, (p, 3).
        vertices: of the triangles, (v, 3).
        triangles: (t, 3).
    """
    from pyacvd.clustering import ray_trace

    middles = vertices[triangles].mean(axis=1)
    near = cKDTree(middles).query(points, min(len(triangles) - 1, _AROUND))[1]
    way = ray_trace(points, normals, vertices, triangles, near.astype(np.uint32), num_threads=1)[0]
    moved: Floats = points + normals * way[:, None]
    return moved


def _load(gmsh: Any, surface: Surface) -> None:
    entity = gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(2, entity, np.arange(1, len(surface.points) + 1), surface.points.ravel())
    gmsh.model.mesh.addElementsByType(entity, _TRIANGLE, [], (surface.triangles + 1).ravel())
