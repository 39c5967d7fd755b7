"""Bad tetrahedra made better: flat ones peeled off the boundary, nodes of the others moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .body import TETRAHEDRON_FACES, Floats, Ints
from .metrics import scaled_jacobians

_TRIES = 48  # places tried for one node
_STEPS = np.array([0.4, 0.2, 0.1, 0.03])[np.arange(_TRIES) % 4]  # of its shortest edge
_PASSES, _ROUNDS = 4, 6
_LEAST_GAIN = 1e-4

# The face opposite to each corner.
_OPPOSITE = np.array([next(face for face in TETRAHEDRON_FACES.tolist() if corner not in face) for corner in range(4)])

Flags = NDArray[np.bool_]


def improved(points: Floats, cells: Ints, target: float) -> tuple[Floats, Ints]:
    """The mesh with its worst tetrahedra improved, as far as it goes; the same input gives the same mesh.

    Flat cells on the boundary are taken off. Then the nodes of bad cells move to the best of places around them,
    nodes of the boundary only within their tangent plane.

    Args:
        points: node positions, (n, 3), metres.
        cells: node numbers, (m, 4), positively oriented.
        target: scaled Jacobian from which on a cell is good.
    """
    rng = np.random.default_rng(0)
    for _ in range(_PASSES):
        points, cells = used_points(points, _peeled(points, cells, target))
        points = _smoothed(points, cells, target, rng)
        if scaled_jacobians(points, cells).min() >= target:
            break
    return points, cells


def used_points(points: Floats, cells: Ints) -> tuple[Floats, Ints]:
    """Points that a cell uses, and the cells with their new numbers.

    Args:
        points: node positions, (n, 3).
        cells: node numbers, (m, 4).
    """
    used, numbers = np.unique(cells, return_inverse=True)
    return points[used], numbers.reshape(cells.shape)


def outer_faces(cells: Ints) -> tuple[Ints, Flags]:
    """The faces of each tetrahedron, (m, 4, 3), outward, face i opposite to corner i; and which are outer, (m, 4).

    Args:
        cells: node numbers, (m, 4).
    """
    faces = cells[:, _OPPOSITE]
    _, numbers, counts = np.unique(
        np.sort(faces.reshape(-1, 3), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return faces, (counts[numbers.ravel()] == 1).reshape(-1, 4)


def _peeled(points: Floats, cells: Ints, target: float) -> Ints:
    """Cells without those bad ones whose loss leaves the boundary a manifold."""
    quality = scaled_jacobians(points, cells)
    faces, outer = outer_faces(cells)
    rim = np.sort(faces[outer][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = set(map(tuple, rim.tolist()))
    gone, touched = [], set[int]()
    for cell in np.argsort(quality)[: int((quality < target).sum())]:
        corners = cells[cell].tolist()
        count = int(outer[cell].sum())
        if count not in (2, 3) or touched & set(corners):
            continue
        # Off with two outer faces, the edge between the corners opposite to them comes to the light.
        bared = tuple(sorted(cells[cell][outer[cell]].tolist()))
        if count == 2 and bared in edges:
            continue
        gone.append(cell)
        touched |= set(corners)
    return np.delete(cells, gone, axis=0)


def _smoothed(points: Floats, cells: Ints, target: float, rng: np.random.Generator) -> Floats:
    points = points.copy()
    normals = _normals(points, cells)
    order = np.argsort(cells.ravel(), kind="stable")
    start = np.searchsorted(cells.ravel()[order], np.arange(len(points) + 1))
    for _ in range(_ROUNDS):
        quality = scaled_jacobians(points, cells)
        bad = np.flatnonzero(quality < target)
        moved = False
        for node in dict.fromkeys(cells[bad[np.argsort(quality[bad])]].ravel().tolist()):
            star = cells[order[start[node] : start[node + 1]] // 4]
            better = _better_place(points, star, node, normals[node], rng)
            if better is not None:
                points[node], moved = better, True
        if not moved:
            break
    return points


def _better_place(points: Floats, star: Ints, node: int, normal: Floats, rng: np.random.Generator) -> Floats | None:
    """A place where the worst cell of a node's star is better, or None."""
    corners, own = points[star], star == node
    steps = rng.standard_normal((_TRIES, 3))
    steps -= np.outer(steps @ normal, normal)
    shortest = np.linalg.norm(corners - points[node], axis=2)[~own].min()
    steps *= (_STEPS * shortest / np.linalg.norm(steps, axis=1))[:, None]
    tried = np.repeat(corners[None], _TRIES, axis=0)
    tried[:, own] = (points[node] + steps)[:, None]
    quality = scaled_jacobians(tried.reshape(-1, 3), np.arange(tried.size // 3).reshape(-1, 4))
    worst = quality.reshape(_TRIES, -1).min(axis=1)
    best = worst.argmax()
    return points[node] + steps[best] if worst[best] > scaled_jacobians(points, star).min() + _LEAST_GAIN else None


def _normals(points: Floats, cells: Ints) -> Floats:
    """Unit normals at the nodes of the boundary, (n, 3); zero inside."""
    faces, outer = outer_faces(cells)
    triangles = faces[outer]
    a, b, c = (points[triangles[:, i]] for i in range(3))
    normals = np.zeros_like(points)
    for i in range(3):
        np.add.at(normals, triangles[:, i], np.cross(b - a, c - a))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1.0)
