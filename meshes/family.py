"""A family of organs: smooth bodies of many forms, each with a support and a tissue, each a function of its number.

Two ways lead to one: `member` deforms a box and reads no file, `blend` lies between two of given surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .blending import blended
from .body import Body, Floats, Ints, Surface
from .filling import filled
from .metrics import cell_volumes, tetrahedron_quality
from .shapes import beam
from .solidify import size_estimate

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
_TUMOURS = 2  # at most
_RADIUS, _STIFFER = (0.006, 0.02), (2.0, 10.0)  # metres; times as stiff, evenly on a logarithmic scale
_SHARE = (0.2, 0.8)  # of the other surface in a blend
_QUALITY = 0.05  # least radius ratio of a cell
_ATTEMPTS = 12  # with ever smaller deformations


@dataclass(frozen=True, eq=False)
class Tumour:
    """A ball of stiffer tissue.

    Args:
        centre: (3,), metres.
        radius: metres.
        stiffness: Young's modulus over that of the tissue around it.
        cells: numbers of the cells whose middle lies in it, at least one, sorted.
    """

    centre: Floats
    radius: float
    stiffness: float
    cells: Ints


@dataclass(frozen=True, eq=False)
class Member:
    """An organ of the family.

    Args:
        number: of it.
        form: `round`, `slender`, `flat`, `box` or `blend`.
        body: tetrahedra with the node set `fixed` and the surface `observed`, the half that looks away from it.
        young_modulus: of its tissue, pascals.
        poisson_ratio: of all of it.
        tumours: none, one or two.
    """

    number: int
    form: str
    body: Body
    young_modulus: float
    poisson_ratio: float
    tumours: tuple[Tumour, ...] = ()

    @property
    def young_moduli(self) -> Floats:
        """Of each cell, (c,), pascals, with the tumours; the stiffer one counts where two meet."""
        times = np.ones(len(self.body.cells))
        for tumour in self.tumours:
            times[tumour.cells] = np.maximum(times[tumour.cells], tumour.stiffness)
        return self.young_modulus * times


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
    _check("member", number, nodes)
    rng = np.random.default_rng([seed, number])
    form = list(_FORMS)[rng.integers(len(_FORMS))]
    extents, roundness = _FORMS[form]
    size = np.array([rng.uniform(*each) for each in extents])
    drawn = float(np.exp(rng.uniform(*np.log(_NODES))))
    points, cells = _grid(size, nodes or drawn)
    points = _deformed(points, cells, size, rng.uniform(*roundness), rng)
    return _member(number, form, points, cells, rng, seed)


def blend(number: int, surfaces: Sequence[Surface], seed: int = 0, nodes: int | None = None) -> Member:
    """The organ of a number between two of given ones, displaced by a smooth Gaussian process as others are.

    The same number gives the same organ, with the same surfaces in the same order and the same version of gmsh.

    Args:
        number: 0 or more.
        surfaces: closed ones, at least two, metres.
        seed: of the whole family.
        nodes: about so many; drawn from 300 to 2,500 if not given.

    Raises:
        ValueError: a negative number, fewer than two surfaces or than 100 nodes, or two that nothing lies between.
        SurfaceError: what lies between them could not be filled.
        ImportError: gmsh or pyacvd is not installed: the extra `mesh`.
    """
    _check("blend", number, nodes)
    if len(surfaces) < 2:
        raise ValueError(f"blend.surfaces: expected at least two, got {len(surfaces)}.")
    rng = np.random.default_rng([seed, number, 2])
    one, other = (surfaces[place] for place in rng.choice(len(surfaces), 2, replace=False))
    between = blended(one, other, rng.uniform(*_SHARE))
    drawn = float(np.exp(rng.uniform(*np.log(_NODES))))
    points, cells = filled(between, size_estimate(between, nodes or drawn))
    strength, wave = 1.0, _Wave.drawn(float(np.ptp(points, axis=0).max()), rng)
    for _ in range(_ATTEMPTS):
        found = points + strength * wave.at(points)
        if _is_sound(found, cells):
            points = found
            break
        strength *= 0.85
    return _member(number, "blend", points, cells, rng, seed)


def _check(name: str, number: int, nodes: int | None) -> None:
    if number < 0:
        raise ValueError(f"{name}.number: expected 0 or more, got {number}.")
    if nodes is not None and nodes < 100:
        raise ValueError(f"{name}.nodes: expected at least 100, got {nodes}.")


def _member(number: int, form: str, points: Floats, cells: Ints, rng: np.random.Generator, seed: int) -> Member:
    """The organ of a mesh, with its support, its tissue and its tumours."""
    bare = Body(points, cells, {"fixed": np.arange(len(points) - 1)})
    fixed = _held(bare, rng)
    body = Body(points, cells, {"fixed": fixed}, {"observed": _away_from(bare, fixed)})
    modulus, ratio = float(np.exp(rng.uniform(*np.log(_YOUNG)))), float(rng.uniform(*_POISSON))
    return Member(number, form, body, modulus, ratio, _tumours(body, np.random.default_rng([seed, number, 1])))


def _tumours(body: Body, rng: np.random.Generator) -> tuple[Tumour, ...]:
    """Up to two balls about places inside, no larger than a quarter of the shortest extent."""
    middles, most = body.points[body.cells].mean(axis=1), 0.25 * float(np.ptp(body.points, axis=0).min())
    found = []
    for _ in range(int(rng.integers(_TUMOURS + 1))):
        centre = middles[rng.integers(len(middles))]
        radius = min(rng.uniform(*_RADIUS), most)
        cells = np.flatnonzero(np.linalg.norm(middles - centre, axis=1) <= radius)
        found.append(Tumour(centre, radius, float(np.exp(rng.uniform(*np.log(_STIFFER)))), cells))
    return tuple(found)


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
    strength, wave = 1.0, _Wave.drawn(float(size.max()), rng)
    for _ in range(_ATTEMPTS):
        share = strength * roundness
        found = ((1.0 - share) * points + share * ball) * (0.5 * size)
        along = found[:, 0] / (0.5 * size[0])
        wide = 1.0 + strength * np.where(along > 0.0, ends[0] * along, -ends[1] * along)
        found = _bent(found * np.column_stack([np.ones_like(wide), wide, wide]), strength * turn / size[0])
        found = found + strength * wave.at(found)
        if _is_sound(found, cells):
            return np.asarray(found)
        strength *= 0.85
    return np.asarray(points * (0.5 * size))


@dataclass(frozen=True, eq=False)
class _Wave:
    """A smooth random displacement: a Gaussian process by random Fourier features.

    Args:
        size: standard deviation, metres.
        ways: wave vectors, (f, 3), 1/m.
        phases: (f,).
        factors: (f, 3).
    """

    size: float
    ways: Floats
    phases: Floats
    factors: Floats

    @classmethod
    def drawn(cls, extent: float, rng: np.random.Generator) -> _Wave:
        """One of a body whose longest extent is given, metres."""
        size, length = float(rng.uniform(*_WAVE)), float(rng.uniform(*_LENGTH)) * extent
        ways = rng.standard_normal((_FEATURES, 3)) / length
        return cls(size, ways, rng.uniform(0.0, 2.0 * np.pi, _FEATURES), rng.standard_normal((_FEATURES, 3)))

    def at(self, points: Floats) -> Floats:
        """Of points, (n, 3), metres."""
        features = np.sqrt(2.0 / _FEATURES) * np.cos(points @ self.ways.T + self.phases)
        return self.size * (features @ self.factors)


def _is_sound(points: Floats, cells: Ints) -> bool:
    return bool(cell_volumes(points, cells).min() > 0.0 and tetrahedron_quality(points, cells).min() >= _QUALITY)


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
