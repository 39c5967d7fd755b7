"""Supports that give way: springs spread over a part of the surface, as ligaments and neighbours hold an organ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.elements import KINDS
from softtwin.meshes.quadrature import quadrature, quadrature_degree, shape_functions

Floats = NDArray[np.float64]


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


def springs_of(plan: Mapping[str, Any]) -> dict[str, Springs]:
    """The springs in the plan of a data set or of a twin's card, by the surface that they hold."""
    return {name: Springs(**each) for name, each in plan.get("springs", {}).items()}


def checked_springs(springs: Mapping[str, Springs], body: Body) -> dict[str, Springs]:
    """Springs by the surface that they hold.

    Raises:
        ValueError: a surface that the body does not have.
    """
    known = sorted({*body.surfaces, "boundary"})
    for name in springs:
        if name not in known:
            raise ValueError(f"Problem.springs: expected a surface among {known}, got {name!r}.")
    return dict(springs)


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
    for number, (name, each) in enumerate(checked_springs(springs, body).items()):
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
