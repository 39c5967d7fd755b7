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

    def closest(self, positions: Floats, cloud: Floats) -> tuple[Ints, Floats]:
        """Triangle, (p,), and barycentric weights, (p, 3), of the closest point on the surface for each of a cloud.

        Args:
            positions: where the vertices are now, (v, 3), metres.
            cloud: points, (p, 3), metres.
        """
        if not IS_COMPILED:
            found = closest_points(Surface(positions, self.triangles), cloud)[1]
            return found, closest_in_triangles(positions[self.triangles[found]], cloud)[0]
        corners = positions[self.triangles[self._order]]
        boxes = _boxes(corners, self._parts, self._children)
        found, weights = _closest(corners, self._parts, self._children, boxes, np.ascontiguousarray(cloud))
        return self._order[found], weights


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
def _closest(corners: Floats, parts: Ints, children: Ints, boxes: Floats, cloud: Floats) -> tuple[Ints, Floats]:
    """Place, (p,), and barycentric weights, (p, 3): the nearer of two boxes first, none that is too far."""
    found, weights = np.zeros(len(cloud), np.int64), np.zeros((len(cloud), 3))
    waiting, far = np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST)
    for point in range(len(cloud)):
        least, first, second = np.inf, 0.0, 0.0
        waiting[0], far[0], left = 0, 0.0, 1
        while left > 0:
            left -= 1
            if far[left] >= least:
                continue
            box = waiting[left]
            child = children[box]
            if child < 0:
                for triangle in range(parts[box, 0], parts[box, 1]):
                    square, v, w = _in_triangle(corners[triangle], cloud[point])
                    if square < least:
                        least, first, second, found[point] = square, v, w, triangle
                continue
            near, other = _away(boxes[child], cloud[point]), _away(boxes[child + 1], cloud[point])
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
def _away(box: Floats, point: Floats) -> float:
    """Squared distance of a point from a box."""
    square = 0.0
    for i in range(3):
        off = max(box[i] - point[i], 0.0, point[i] - box[3 + i])
        square += off * off
    return square


@compiled
def _in_triangle(corners: Floats, point: Floats) -> tuple[float, float, float]:
    """Squared distance of the closest point of a triangle, and its weights at the second and third corner.

    The unconstrained minimum where it is inside, else the best of the three edges.
    """
    ee = ef = ff = ge = gf = gg = 0.0
    for i in range(3):
        e, f, g = corners[1, i] - corners[0, i], corners[2, i] - corners[0, i], point[i] - corners[0, i]
        ee += e * e
        ef += e * f
        ff += f * f
        ge += g * e
        gf += g * f
        gg += g * g
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
