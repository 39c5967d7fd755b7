"""Ways that carry a surface to a cloud and know nothing of tissue: peers of registration, each as a map of places.

Rigid and affine iterative closest points (Besl and McKay 1992), coherent point drift (Myronenko and Song 2010, pycpd),
non-rigid closest points (Amberg et al. 2007, trimesh) and a thin-plate spline through closest points. Each is given
what registration is given, the observed surface at rest and the cloud; places inside are carried by the map itself
where it is one of space, by a thin-plate spline through the moved vertices where it is one of the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from pycpd import DeformableRegistration
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Surface

Floats = NDArray[np.float64]
Map = Callable[[Floats], Floats]  # of places at rest, (p, 3), metres, to where they are
SAMPLES, POINTS, ROUNDS = 20_000, 1000, 100  # of the surface; of a cloud for methods whose cost grows with both
STIFFEST, SOFTEST, STEPS = 100.0, 0.5, 8  # of Amberg's surface, relative to its size; the softer the nearer
NEAR = 0.03  # of the size: vertices of Amberg's surface that are farther from the cloud are not drawn to it
SMOOTHING = 1e-3  # of the spline, relative to what scatters it


@dataclass(frozen=True, eq=False)
class Scene:
    """What is registered.

    Args:
        surface: the observed surface at rest.
        cloud: of it moved, (p, 3), metres.
        shares_frame: whether both are in one frame: then what bends begins where the organ was, else at affine ICP.
        shows_all: whether the cloud shows the whole surface: then closest points are sought both ways, from the place
            where both middles are one.
    """

    surface: Surface
    cloud: Floats
    shares_frame: bool = True
    shows_all: bool = False


Method = Callable[[Scene], Map]


def _sampled(surface: Surface) -> Floats:
    mesh = trimesh.Trimesh(surface.points, surface.triangles, process=False)
    return np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])


def _thinned(cloud: Floats) -> Floats:
    chosen = np.random.default_rng(0).permutation(len(cloud))[:POINTS]
    return np.asarray(cloud[chosen])


def _closest(scene: Scene, fitted: Callable[[Floats, Floats], Map], moved: Map) -> Map:
    """Closest points of cloud and surface, and the map of these onto each other, by turns."""
    rest, cloud, before = _sampled(scene.surface), scene.cloud, np.inf
    for _ in range(ROUNDS):
        there = moved(rest)
        distances, places = cKDTree(there).query(cloud)
        if before - distances.mean() < 1e-7:
            break
        before = float(distances.mean())
        pairs = rest[places], cloud
        if scene.shows_all:
            others = cloud[cKDTree(cloud).query(there)[1]]
            share = np.linspace(0, len(rest) - 1, len(cloud)).astype(int) if len(cloud) < len(rest) else slice(None)
            pairs = np.vstack([pairs[0], rest[share]]), np.vstack([pairs[1], others[share]])
        moved = fitted(*pairs)
    return moved


def _middles(scene: Scene) -> Map:
    """Where a search begins."""
    apart = scene.cloud.mean(axis=0) - _sampled(scene.surface).mean(axis=0) if scene.shows_all else np.zeros(3)
    return lambda places: places + apart


def _rigid_fit(rest: Floats, cloud: Floats) -> Map:
    middle, aim = rest.mean(axis=0), cloud.mean(axis=0)
    turned = Rotation.align_vectors(cloud - aim, rest - middle)[0]
    return lambda places: turned.apply(places - middle) + aim


def _affine_fit(rest: Floats, cloud: Floats) -> Map:
    matrix = np.linalg.lstsq(np.column_stack([rest, np.ones(len(rest))]), cloud, rcond=None)[0]
    return lambda places: places @ matrix[:3] + matrix[3]


def nothing(scene: Scene) -> Map:
    """Where it was."""
    return lambda places: places


def rigid(scene: Scene) -> Map:
    """Rigid iterative closest points."""
    return _closest(scene, _rigid_fit, _middles(scene))


def affine(scene: Scene) -> Map:
    """Affine iterative closest points, from the rigid ones."""
    return _closest(scene, _affine_fit, rigid(scene))


def _used(surface: Surface) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices in use and the triangles in their numbers."""
    numbers, corners = np.unique(surface.triangles, return_inverse=True)
    return surface.points[numbers], corners.reshape(-1, 3)


def _begun(scene: Scene) -> Map:
    """Where methods that bend begin."""
    return nothing(scene) if scene.shares_frame else affine(scene)


def drift(scene: Scene) -> Map:
    """Coherent point drift with a tenth of outliers; a map of space."""
    before = _begun(scene)
    vertices = before(_used(scene.surface)[0])
    middle, size = vertices.mean(axis=0), vertices.std()
    source = (vertices - middle) / size
    search = DeformableRegistration(X=(_thinned(scene.cloud) - middle) / size, Y=source, w=0.1, max_iterations=ROUNDS)
    search.register()

    def moved(places: Floats) -> Floats:
        at = (before(places) - middle) / size
        kernel = np.exp(-cdist(at, source, "sqeuclidean") / (2.0 * search.beta**2))
        return np.asarray((at + kernel @ search.W) * size + middle)

    return moved


def amberg(scene: Scene) -> Map:
    """Non-rigid closest points with a surface made softer step by step."""
    before = _begun(scene)
    vertices, triangles = _used(scene.surface)
    mesh = trimesh.Trimesh(before(vertices), triangles, process=False)
    stiffness = np.geomspace(STIFFEST, SOFTEST, STEPS)
    steps = [(value, 0.0, 0.0, 10) for value in stiffness]
    found = trimesh.registration.nricp_amberg(
        mesh, _thinned(scene.cloud), steps=steps, distance_threshold=NEAR, use_faces=False, use_vertex_normals=False
    )
    return _spline(vertices, np.asarray(found), 0.0)


def spline(scene: Scene) -> Map:
    """A smoothing thin-plate spline through closest points, ten times anew."""
    moved, rest, points = _begun(scene), _sampled(scene.surface), _thinned(scene.cloud)
    for _ in range(10):
        places = cKDTree(moved(rest)).query(points)[1]
        chosen = np.unique(places, return_index=True)[1]
        moved = _spline(rest[places[chosen]], points[chosen], SMOOTHING)
    return moved


def _spline(rest: Floats, moved: Floats, smoothing: float) -> Map:
    size = float(rest.std())
    fitted = RBFInterpolator(rest / size, (moved - rest) / size, kernel="thin_plate_spline", smoothing=smoothing)
    return lambda places: places + size * np.asarray(fitted(places / size))


METHODS: dict[str, Method] = {
    "nothing": nothing,
    "rigid ICP": rigid,
    "affine ICP": affine,
    "coherent point drift": drift,
    "Amberg's non-rigid ICP": amberg,
    "thin-plate spline": spline,
}
