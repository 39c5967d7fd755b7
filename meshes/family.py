"""A family of organs: smooth bodies of many forms, each with a support and a tissue, each a function of its number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .body import Body, Floats, Ints
from .metrics import cell_volumes, tetrahedron_quality
from .shapes import beam

_NODES = (300, 2500)  # drawn evenly on a logarithmic scale
# Least and largest extents along the three axes of each form, metres; how round it is (0: a box, 1: an ellipsoid).
_FORMS: dict[str, tuple[tuple[tuple[float, float], ...], tuple[float, float]]] = {
    "round": (((0.10, 0.20), (0.08, 0.15), (0.07, 0.12)), (0.8, 1.0)),
    "slender": (((0.16, 0.26), (0.05, 0.09), (0.05, 0.08)), (0.5, 1.0)),
    "flat": (((0.13, 0.22), (0.10, 0.18), (0.035, 0.06)), (0.5, 1.0)),
    "box": (((0.10, 0.20), (0.07, 0.14), (0.06, 0.11)), (0.0, 0.4)),
}
_TURN = 1.2  # radians, at most, by which the long axis is bent
_TAPER = 0.35  # at most, of the cross-section at either end
_WAVE = (0.003, 0.009)  # standard deviation of the smooth random displacement, metres
_LENGTH = (0.3, 0.7)  # its correlation length, of the longest extent
_FEATURES = 64  # random Fourier features of it (Rahimi and Recht 2007)
_HELD = (0.05, 0.25)  # of the surface's nodes
_POISSON, _YOUNG = (0.40, 0.47), (2e3, 1e4)  # the latter evenly on a logarithmic scale, pascals
_QUALITY = 0.05  # least radius ratio of a cell
_ATTEMPTS = 12  # with ever smaller deformations


@dataclass(frozen=True, eq=False)
class Member:
    """An organ of the family.

    Args:
        number: of it.
        form: `round`, `slender`, `flat` or `box`.
        body: tetrahedra with the node set `fixed` and the surface `observed`, the half that looks away from it.
        young_modulus: pascals.
        poisson_ratio: of its tissue.
    """

    number: int
    form: str
    body: Body
    young_modulus: float
    poisson_ratio: float


def member(number: int, seed: int = 0, nodes: int | None = None) -> Member:
    """The organ of a number, on any machine the same up to rounding.

    A box of tetrahedra is rounded, tapered, bent and displaced by a smooth Gaussian process; a part of its surface is
    held. Where its cells bear none of that, it is the box. No file is read.

    Args:
        number: 0 or more.
        seed: of the whole family.
        nodes: so many cells' corners in a box of its extents: up to twice as many nodes come where they are few; drawn
            from 300 to 2,500 if not given.

    Raises:
        ValueError: a negative number, or fewer than 100 nodes.
    """
    if number < 0:
        raise ValueError(f"member.number: expected 0 or more, got {number}.")
    if nodes is not None and nodes < 100:
        raise ValueError(f"member.nodes: expected at least 100, got {nodes}.")
    rng = np.random.default_rng([seed, number])
    form = list(_FORMS)[rng.integers(len(_FORMS))]
    extents, roundness = _FORMS[form]
    size = np.array([rng.uniform(*each) for each in extents])
    drawn = float(np.exp(rng.uniform(*np.log(_NODES))))
    points, cells = _grid(size, nodes or drawn)
    points = _deformed(points, cells, size, rng.uniform(*roundness), rng)
    bare = Body(points, cells, {"fixed": np.arange(len(points) - 1)})
    fixed = _held(bare, rng)
    body = Body(points, cells, {"fixed": fixed}, {"observed": _away_from(bare, fixed)})
    modulus = float(np.exp(rng.uniform(*np.log(_YOUNG))))
    return Member(number, form, body, modulus, float(rng.uniform(*_POISSON)))


def _grid(size: Floats, count: float) -> tuple[Floats, Ints]:
    """A box of tetrahedra in [-1, 1]^3 with about so many nodes, its cells about as long as wide in the organ."""
    edge = (np.prod(size) / count) ** (1.0 / 3.0)
    divisions = np.maximum(np.round(size / edge), 3).astype(int)
    base = beam((int(divisions[0]), int(divisions[1]), int(divisions[2])), (2.0, 2.0, 2.0), "tetrahedron")
    return base.points - 1.0, base.cells


def _deformed(points: Floats, cells: Ints, size: Floats, roundness: float, rng: np.random.Generator) -> Floats:
    """The organ's nodes, (n, 3), metres: as far from the box as its cells bear."""
    square = points**2
    others = square[:, [1, 2, 0]], square[:, [2, 0, 1]]
    ball = points * np.sqrt(1.0 - others[0] / 2.0 - others[1] / 2.0 + others[0] * others[1] / 3.0)
    turn, ends = rng.uniform(0.0, _TURN), rng.uniform(-_TAPER, _TAPER, 2)
    wave, length = rng.uniform(*_WAVE), rng.uniform(*_LENGTH) * float(size.max())
    ways = rng.standard_normal((_FEATURES, 3)) / length
    phases, factors = rng.uniform(0.0, 2.0 * np.pi, _FEATURES), rng.standard_normal((_FEATURES, 3))
    strength = 1.0
    for _ in range(_ATTEMPTS):
        share = strength * roundness
        found = ((1.0 - share) * points + share * ball) * (0.5 * size)
        along = found[:, 0] / (0.5 * size[0])
        wide = 1.0 + strength * np.where(along > 0.0, ends[0] * along, -ends[1] * along)
        found = _bent(found * np.column_stack([np.ones_like(wide), wide, wide]), strength * turn / size[0])
        features = np.sqrt(2.0 / _FEATURES) * np.cos(found @ ways.T + phases)
        found = found + strength * wave * (features @ factors)
        if cell_volumes(found, cells).min() > 0.0 and tetrahedron_quality(found, cells).min() >= _QUALITY:
            return np.asarray(found)
        strength *= 0.85
    return np.asarray(points * (0.5 * size))


def _bent(points: Floats, curvature: float) -> Floats:
    """The first axis laid along an arc in the plane of the first two."""
    if curvature < 1e-9:
        return points
    angle, radius = curvature * points[:, 0], 1.0 / curvature - points[:, 1]
    return np.column_stack([radius * np.sin(angle), 1.0 / curvature - radius * np.cos(angle), points[:, 2]])


def _held(body: Body, rng: np.random.Generator) -> Ints:
    """Nodes of the surface in a ball around one of them, sorted."""
    surface = body.boundary_nodes
    centre = body.points[surface[rng.integers(len(surface))]]
    count = max(4, round(rng.uniform(*_HELD) * len(surface)))
    near: NDArray[np.int64] = np.argsort(np.linalg.norm(body.points[surface] - centre, axis=1), kind="stable")[:count]
    return np.sort(surface[near])


def _away_from(body: Body, fixed: Ints) -> Ints:
    """Triangles of the surface that look away from what is held, (t, 3)."""
    triangles = body.boundary
    a, b, c = (body.points[triangles[:, i]] for i in range(3))
    way = body.points.mean(axis=0) - body.points[fixed].mean(axis=0)
    return triangles[np.cross(b - a, c - a) @ way > 0.0]
