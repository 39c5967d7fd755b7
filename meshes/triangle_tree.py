"""Closest points of a triangle surface that moves: a tree of boxes that is made once, and refitted where it has moved.

Exact wherever the surface is: the boxes hold the triangles as they lie, and only how fast the search is depends on how
much it resembles the surface that the tree was made for. Without numba libigl makes a tree anew at each search.
"""

from __future__ import annotations

import numpy as np

from .body import Floats, Ints, Surface
from .closest import NEEDLE, closest_in_triangles, closest_points
from .compiled import IS_COMPILED, compiled

_LEAF = 2  # triangles in a box that is not parted any further
_DEEPEST = 64  # boxes inside each other: each holds half of the triangles of the one around it
_TINY = 1e-300  # an edge without length divides by it
_NOWHERE = np.zeros(0, dtype=np.int64)


class TriangleTree:
    """Closest points on the triangles of a surface, wherever its vertices are.

    Args:
        points: vertices about where they will be, (v, 3), metres.
        triangles: vertex numbers, (t, 3).

    Raises:
        ValueError: no triangles.
    """

    def __init__(self, points: Floats, triangles: Ints) -> None:
        if not len(triangles):
            raise ValueError("TriangleTree.triangles: expected at least one, got none.")
        self.triangles = np.ascontiguousarray(triangles, dtype=np.int64)
        if IS_COMPILED:
            self._order, self._parts, self._children = _tree(points[self.triangles].mean(axis=1))
            self._places, self._ordered = np.argsort(self._order), self.triangles[self._order]

    def closest(self, positions: Floats, cloud: Floats, near: Ints | None = None) -> tuple[Ints, Floats]:
        """Triangle, (p,), and barycentric weights, (p, 3), of the closest point on the surface for each of a cloud.

        Args:
            positions: where the vertices are now, (v, 3), metres.
            cloud: points, (p, 3), metres.
            near: a triangle for each point, (p,): where it is near, the search ends sooner.
        """
        if not IS_COMPILED:
            found = closest_points(Surface(positions, self.triangles), cloud)[1]
            return found, closest_in_triangles(positions[self.triangles[found]], cloud)[0]
        corners = positions[self._ordered]
        boxes = _boxes(corners, self._parts, self._children)
        begun = _NOWHERE if near is None else self._places[near]
        found, weights = _closest(corners, self._parts, self._children, boxes, np.ascontiguousarray(cloud), begun)
        return self._order[found], weights


def signed_distances(
    positions: Floats, triangles: Ints, weights: Floats, cloud: Floats, touching: float
) -> tuple[Floats, Floats]:
    """How far points are behind their closest ones, (p,), metres, and the unit vectors in which that grows, (p, 3).

    Positive where the surface is beyond the point. On the surface itself the offset has no direction: the normal is its
    limit.

    Args:
        positions: of the vertices, (v, 3), metres.
        triangles: corners of those that hold the closest points, (p, 3).
        weights: barycentric, of the closest points, (p, 3).
        cloud: points, (p, 3), metres.
        touching: as near as that, a point is on the surface, metres.
    """
    if IS_COMPILED:
        return _signed(positions, triangles, weights, np.ascontiguousarray(cloud), touching)
    corners = positions[triangles]
    offsets = np.einsum("pk,pki->pi", weights, corners) - cloud
    lengths = np.sqrt(np.einsum("pi,pi->p", offsets, offsets))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.sqrt(np.einsum("pi,pi->p", normals, normals))[:, None]
    on_it = lengths < touching
    directions = np.where(on_it[:, None], normals, offsets / np.where(on_it, 1.0, lengths)[:, None])
    side = np.where(np.einsum("pi,pi->p", directions, normals) < 0.0, -1.0, 1.0)
    return side * lengths, side[:, None] * directions


@compiled
def _signed(
    positions: Floats, triangles: Ints, weights: Floats, cloud: Floats, touching: float
) -> tuple[Floats, Floats]:
    distances, directions = np.empty(len(cloud)), np.empty((len(cloud), 3))
    e, f, off, normal = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for point in range(len(cloud)):
        a, b, c = triangles[point, 0], triangles[point, 1], triangles[point, 2]
        for i in range(3):
            e[i], f[i] = positions[b, i] - positions[a, i], positions[c, i] - positions[a, i]
            off[i] = positions[a, i] + weights[point, 1] * e[i] + weights[point, 2] * f[i] - cloud[point, i]
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            normal[i] = e[j] * f[k] - e[k] * f[j]
        length = np.sqrt(off[0] ** 2 + off[1] ** 2 + off[2] ** 2)
        if length < touching:
            size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            distances[point] = length
            for i in range(3):
                directions[point, i] = normal[i] / size
            continue
        side = -1.0 if off[0] * normal[0] + off[1] * normal[1] + off[2] * normal[2] < 0.0 else 1.0
        distances[point] = side * length
        for i in range(3):
            directions[point, i] = side * off[i] / length
    return distances, directions


@compiled
def _tree(centres: Floats) -> tuple[Ints, Ints, Ints]:
    """Triangles in the order of the boxes, (t,), and of each box the first and the last of them and the first child.

    Children are two that follow each other, behind the box that they part; -1 of a box that is not parted.
    """
    count = len(centres)
    order, parts, children = np.arange(count), np.empty((2 * count, 2), np.int64), np.full(2 * count, -1)
    parts[0, 0], parts[0, 1] = 0, count
    made, asked = 1, 0
    while asked < made:
        begin, end = parts[asked]
        if end - begin > _LEAF:
            inside = order[begin:end].copy()
            axis, widest = 0, -1.0
            for i in range(3):
                along = centres[inside, i]
                if along.max() - along.min() > widest:
                    axis, widest = i, along.max() - along.min()
            order[begin:end] = inside[np.argsort(centres[inside, axis])]
            middle = (begin + end) // 2
            children[asked] = made
            parts[made, 0], parts[made, 1] = begin, middle
            parts[made + 1, 0], parts[made + 1, 1] = middle, end
            made += 2
        asked += 1
    return order, parts[:made].copy(), children[:made].copy()


@compiled
def _boxes(corners: Floats, parts: Ints, children: Ints) -> Floats:
    """Least and largest coordinates of the triangles of each part, (b, 6)."""
    boxes = np.empty((len(parts), 6))
    for box in range(len(parts) - 1, -1, -1):
        child = children[box]
        if child >= 0:
            for i in range(3):
                boxes[box, i] = min(boxes[child, i], boxes[child + 1, i])
                boxes[box, 3 + i] = max(boxes[child, 3 + i], boxes[child + 1, 3 + i])
            continue
        for i in range(3):
            boxes[box, i], boxes[box, 3 + i] = np.inf, -np.inf
        for triangle in range(parts[box, 0], parts[box, 1]):
            for corner in range(3):
                for i in range(3):
                    boxes[box, i] = min(boxes[box, i], corners[triangle, corner, i])
                    boxes[box, 3 + i] = max(boxes[box, 3 + i], corners[triangle, corner, i])
    return boxes


@compiled
def _closest(
    corners: Floats, parts: Ints, children: Ints, boxes: Floats, cloud: Floats, begun: Ints
) -> tuple[Ints, Floats]:
    """Place, (p,), and barycentric weights, (p, 3): the nearer of two boxes first, none that is too far.

    It begins with a triangle for each point, (p,), or with none, (0,).
    """
    found, weights = np.zeros(len(cloud), np.int64), np.empty((len(cloud), 3))
    waiting, far = np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST)
    for point in range(len(cloud)):
        x, y, z = cloud[point, 0], cloud[point, 1], cloud[point, 2]
        least, first, second = np.inf, 0.0, 0.0
        if len(begun):
            found[point] = begun[point]
            least, first, second = _in_triangle(corners, begun[point], x, y, z)
        waiting[0], far[0], left = 0, 0.0, 1
        while left > 0:
            left -= 1
            if far[left] >= least:
                continue
            box = waiting[left]
            child = children[box]
            if child < 0:
                for triangle in range(parts[box, 0], parts[box, 1]):
                    square, v, w = _in_triangle(corners, triangle, x, y, z)
                    if square < least:
                        least, first, second, found[point] = square, v, w, triangle
                continue
            near, other = _away(boxes, child, x, y, z), _away(boxes, child + 1, x, y, z)
            if near > other:
                near, other, child, beside = other, near, child + 1, child
            else:
                beside = child + 1
            if other < least:
                waiting[left], far[left] = beside, other
                left += 1
            if near < least:
                waiting[left], far[left] = child, near
                left += 1
        weights[point, 0], weights[point, 1], weights[point, 2] = 1.0 - first - second, first, second
    return found, weights


@compiled
def _away(boxes: Floats, box: int, x: float, y: float, z: float) -> float:
    """Squared distance of a point from a box."""
    i = max(boxes[box, 0] - x, 0.0, x - boxes[box, 3])
    j = max(boxes[box, 1] - y, 0.0, y - boxes[box, 4])
    k = max(boxes[box, 2] - z, 0.0, z - boxes[box, 5])
    return i * i + j * j + k * k


@compiled
def _in_triangle(corners: Floats, triangle: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Squared distance of the closest point of a triangle, and its weights at the second and third corner.

    The unconstrained minimum where it is inside, else the best of the three edges.
    """
    ax, ay, az = corners[triangle, 0, 0], corners[triangle, 0, 1], corners[triangle, 0, 2]
    ex, ey, ez = corners[triangle, 1, 0] - ax, corners[triangle, 1, 1] - ay, corners[triangle, 1, 2] - az
    fx, fy, fz = corners[triangle, 2, 0] - ax, corners[triangle, 2, 1] - ay, corners[triangle, 2, 2] - az
    gx, gy, gz = x - ax, y - ay, z - az
    ee, ef, ff = ex * ex + ey * ey + ez * ez, ex * fx + ey * fy + ez * fz, fx * fx + fy * fy + fz * fz
    ge, gf, gg = gx * ex + gy * ey + gz * ez, gx * fx + gy * fy + gz * fz, gx * gx + gy * gy + gz * gz
    size = ee * ff - ef * ef
    is_needle = not size > NEEDLE * ee * ff
    v, w = (ff * ge - ef * gf) / max(size, _TINY), (ee * gf - ef * ge) / max(size, _TINY)
    if is_needle or v < 0.0 or w < 0.0 or v + w > 1.0:
        on_e = min(max(ge / max(ee, _TINY), 0.0), 1.0)
        on_f = min(max(gf / max(ff, _TINY), 0.0), 1.0)
        # Along the edge from b to c: b + t (c - b).
        on_g = min(max((gf - ge - ef + ee) / max(ee - 2.0 * ef + ff, _TINY), 0.0), 1.0)
        v, w = on_e, 0.0
        least = v * (v * ee - 2.0 * ge)
        square = on_f * (on_f * ff - 2.0 * gf)
        if square < least:
            v, w, least = 0.0, on_f, square
        a, b = 1.0 - on_g, on_g
        if a * (a * ee - 2.0 * ge) + b * (b * ff - 2.0 * gf) + 2.0 * a * b * ef < least:
            v, w = a, b
    square = gg + v * (v * ee - 2.0 * ge) + w * (w * ff - 2.0 * gf) + 2.0 * v * w * ef
    return max(square, 0.0), v, w
