"""Supports that give way: springs spread over a part of the surface, and ligaments from a place to a fixed point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.elements import KINDS
from softtwin.meshes.embedding import Embedding, embed, is_carried_along
from softtwin.meshes.quadrature import quadrature, quadrature_degree, shape_functions

Floats = NDArray[np.float64]
_TAUT = 1e-12  # of a length: rounding


@dataclass(frozen=True)
class Springs:
    """An elastic foundation: traction -(k_n n n^T + k_t (1 - n n^T)) u on the surface at rest, with its normal n.

    A Robin condition (Winkler's foundation). Springs do not turn with the surface. With no tangential part the surface
    slides; with a normal part far above Young's modulus over the body's size, on a track.

    Args:
        normal: stiffness per area across the surface, k_n, N/m^3.
        tangential: along it, k_t, N/m^3.

    Raises:
        ValueError: a stiffness that is negative or not finite, or none at all.
    """

    normal: float = 0.0
    tangential: float = 0.0

    def __post_init__(self) -> None:
        for name in ("normal", "tangential"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise ValueError(f"Springs.{name}: expected a stiffness of 0 N/m^3 or more, got {value}.")
        if self.normal == 0.0 and self.tangential == 0.0:
            raise ValueError("Springs: expected a stiffness above 0 N/m^3 across or along the surface, got none.")


@dataclass(frozen=True)
class Ligament:
    """A cord from a place of the organ to a point that stays: it pulls where it is longer than its slack length.

    Energy k/2 (l - l0)^2 of a length l above l0. Not smooth where it becomes slack; at l0 itself it counts as taut.

    Args:
        place: on or in the organ at rest, (3,), metres; moved by the nodes of its cell.
        end: the other end, which stays, (3,), metres.
        stiffness: k, N/m.
        slack: l0, metres; the distance of both ends at rest if not given, and less for one that pulls at rest.

    Raises:
        ValueError: numbers that are not finite, a stiffness that is not positive, a negative length, both ends in one
            place.
    """

    place: tuple[float, float, float]
    end: tuple[float, float, float]
    stiffness: float
    slack: float | None = None

    def __post_init__(self) -> None:
        for name in ("place", "end"):
            values = tuple(map(float, getattr(self, name)))
            if len(values) != 3 or not np.isfinite(values).all():
                raise ValueError(f"Ligament.{name}: expected three finite coordinates, metres, got {values}.")
            object.__setattr__(self, name, values)
        if not 0.0 < self.stiffness < np.inf:
            raise ValueError(f"Ligament.stiffness: expected more than 0 N/m, got {self.stiffness}.")
        if self.slack is not None and not 0.0 <= self.slack < np.inf:
            raise ValueError(f"Ligament.slack: expected a length of 0 m or more, got {self.slack}.")
        if self.place == self.end:
            raise ValueError(f"Ligament.end: expected another point than the place, got {self.end} for both.")

    @property
    def length(self) -> float:
        """Beyond which it pulls, metres."""
        return float(np.linalg.norm(np.subtract(self.place, self.end))) if self.slack is None else self.slack

    def response(self, moved: Floats) -> tuple[float, Floats, Floats]:
        """Energy, J, its gradient, (3,), N, and its second derivative, (3, 3), N/m, where the place has moved.

        Args:
            moved: displacement of the place, (3,), metres.
        """
        apart = np.add(self.place, moved) - self.end
        length = float(np.linalg.norm(apart))
        stretch = length - self.length
        if stretch < -_TAUT * length:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        along = apart / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
        stretch = max(stretch, 0.0)
        across = stretch / length if length > 0.0 else 1.0
        pulled = np.outer(along, along)
        stiffness = self.stiffness * (pulled + across * (np.eye(3) - pulled))
        return 0.5 * self.stiffness * stretch**2, self.stiffness * stretch * along, stiffness

    def carried(self, name: str, body: Body) -> Embedding:
        """The place as its cell carries it.

        Raises:
            ValueError: it is not on the organ.
        """
        found = embed(body, np.array([self.place]))
        if is_carried_along(body, found)[0]:
            raise ValueError(
                f"Problem.springs[{name!r}].place: expected a place on the organ, got one {1e3 * found.outside[0]:.1f} "
                "mm away from it."
            )
        return found


Support = Springs | Ligament


def springs_of(plan: Mapping[str, Any]) -> dict[str, Support]:
    """The springs in the plan of a data set or of a twin's card, by name."""
    given = plan.get("springs", {}).items()
    return {name: Ligament(**each) if "end" in each else Springs(**each) for name, each in given}


def checked_springs(springs: Mapping[str, Support], body: Body) -> dict[str, Support]:
    """Springs by the surface that they hold, ligaments by a name of their own.

    Raises:
        ValueError: a surface that the body does not have, or a ligament that is not on it.
    """
    known = sorted({*body.surfaces, "boundary"})
    for name, each in springs.items():
        if isinstance(each, Ligament):
            each.carried(name, body)
        elif name not in known:
            raise ValueError(f"Problem.springs: expected a surface among {known}, got {name!r}.")
    return dict(springs)


def on_surfaces(springs: Mapping[str, Support]) -> dict[str, Springs]:
    """Those that are spread over surfaces."""
    return {name: each for name, each in springs.items() if isinstance(each, Springs)}


def ligaments_of(springs: Mapping[str, Support]) -> dict[str, Ligament]:
    """Those that are cords."""
    return {name: each for name, each in springs.items() if isinstance(each, Ligament)}


@dataclass(frozen=True, eq=False)
class CellSprings:
    """Springs as matrices of the cells that they hold: what a solver without facets adds to its cells.

    Args:
        cells: numbers of these cells, (c,).
        stiffness: of each, node by node, of the springs on each surface, (surfaces, c, 3k, 3k), N/m.
        areas: integral of products of shape functions over the part that is held, (c, k, k), m^2.
    """

    cells: NDArray[np.int64]
    stiffness: Floats
    areas: Floats


def cell_springs(body: Body, springs: Mapping[str, Springs]) -> CellSprings:
    """The matrices of springs, with the quadrature of the reference.

    Args:
        body: the body, in space.
        springs: by the surface that they hold, which ends on its cells.

    Raises:
        ValueError: a surface that the body does not have.
    """
    checked_springs(springs, body)
    kind = body.kind
    local = np.array(kind.facets)
    owners = {
        tuple(sorted(corners)): (cell, place)
        for cell, facets in enumerate(body.cells[:, local].tolist())
        for place, corners in enumerate(facets)
    }
    facet_kind = KINDS[2, local.shape[1]]
    degree = max(quadrature_degree(body), 2 * kind.degree)
    points, weights = quadrature(facet_kind, degree)
    values, slopes = shape_functions(facet_kind, points)
    count = len(springs)
    found: dict[int, tuple[Floats, Floats]] = {}
    for number, (name, each) in enumerate(springs.items()):
        for facet in (body.facets if name == "boundary" else body.facets_of(name)).tolist():
            cell, place = owners[tuple(sorted(facet))]
            nodes = local[place]
            areas = np.einsum("qkd,ki->qid", slopes, body.points[body.cells[cell, nodes]])
            normals = np.cross(areas[:, :, 0], areas[:, :, 1])
            sizes = np.linalg.norm(normals, axis=1)
            normals /= sizes[:, None]
            across = np.einsum("qi,qj->qij", normals, normals)
            per_area = each.normal * across + each.tangential * (np.eye(3) - across)
            products = np.einsum("q,qa,qb->qab", weights * sizes, values, values)
            empty = np.zeros((count, *(kind.nodes, 3) * 2)), np.zeros((kind.nodes,) * 2)
            stiffness, area = found.setdefault(cell, empty)
            stiffness[number][np.ix_(nodes, range(3), nodes, range(3))] += np.einsum(
                "qab,qij->aibj", products, per_area
            )
            area[np.ix_(nodes, nodes)] += products.sum(axis=0)
    cells = np.array(sorted(found), dtype=np.int64)
    shape = (count, len(cells), 3 * kind.nodes, 3 * kind.nodes)
    return CellSprings(
        cells,
        np.array([found[cell][0] for cell in cells]).reshape(len(cells), count, *shape[2:]).swapaxes(0, 1).copy(),
        np.array([found[cell][1] for cell in cells]).reshape(len(cells), kind.nodes, kind.nodes),
    )
