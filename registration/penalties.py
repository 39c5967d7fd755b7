"""What a large or a crooked force costs in place of the Gaussian prior: the penalties of the thesis (section 6.2.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from softtwin.meshes.body import Body

from .parameters.nodal_forces import NodalForces

Floats = NDArray[np.float64]
Cost = Callable[[Floats], tuple[float, Floats]]
_ROUND = 0.02  # of the expected force: where the root of a square is rounded off, so that it has a derivative


class Penalty(Protocol):
    """Says what forces cost on a body."""

    def of(self, body: Body, forces: NodalForces) -> Cost:
        """The cost of coefficients of the forces, (k,), and its gradient, (k,), in units of the distances' cost.

        Args:
            body: the body.
            forces: whose coefficients are asked for; their expected size makes the penalty dimensionless.

        Raises:
            ValueError: a body that the penalty is not known for.
        """


@dataclass(frozen=True)
class Amplitude:
    """alpha / 2 times the integral of |b| over the boundary (Odot 2023, eq. 6.5), in expected nodal forces.

    Unsquared, it leaves most nodes without force. Of forces lumped at the nodes the integral is the sum of their sizes.

    Args:
        alpha: weight beside the distances, in [0, 1].
    """

    alpha: float

    def __post_init__(self) -> None:
        _check(self, self.alpha)

    def of(self, body: Body, forces: NodalForces) -> Cost:
        """See `Penalty.of`."""
        patterns, expected = forces.patterns, forces.scale.median
        minimum = _ROUND * expected

        def cost(coefficients: Floats) -> tuple[float, Floats]:
            nodal = (patterns @ coefficients).reshape(-1, 3)
            sizes = np.sqrt((nodal**2).sum(axis=1) + minimum**2)
            slope = (nodal / sizes[:, None]).ravel() @ patterns
            part = 0.5 * self.alpha / expected
            return part * float((sizes - minimum).sum()), part * slope

        return cost


@dataclass(frozen=True)
class Divergence:
    """alpha / 2 times the integral of the squared surface divergence of b (Odot 2023, eq. 6.6), in expected tractions.

    Squared, since as printed a negative divergence would be a gain. The traction of a node is its force over a third
    of the triangles about it, linear between nodes.

    Args:
        alpha: weight beside the distances, in [0, 1].
    """

    alpha: float

    def __post_init__(self) -> None:
        _check(self, self.alpha)

    def of(self, body: Body, forces: NodalForces) -> Cost:
        """See `Penalty.of`; a body whose surface has vertices of its own (a sparse grid with a skin) has none."""
        if body.skin is not None:
            raise ValueError("Divergence.body: expected a body whose nodes are its surface's, got one with a skin.")
        rows, areas, nodal = _divergence(body)
        expected = forces.scale.median / nodal[nodal > 0.0].mean()
        own = np.repeat(1.0 / np.maximum(nodal, 1e-300), 3)[:, None] * forces.basis
        moved = rows @ own * np.sqrt(areas)[:, None] / expected
        squares = moved.T @ moved

        def cost(coefficients: Floats) -> tuple[float, Floats]:
            slope = self.alpha * squares @ coefficients
            return 0.5 * float(slope @ coefficients), slope

        return cost


PENALTIES: dict[str, Callable[[float], Penalty]] = {"amplitude": Amplitude, "divergence": Divergence}


def _check(penalty: object, alpha: float) -> None:
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(f"{type(penalty).__name__}.alpha: expected a number in [0, 1], got {alpha}.")


def _divergence(body: Body) -> tuple[csr_array, Floats, Floats]:
    """Surface divergence on each triangle of nodal vectors, (t, 3n), the triangles' areas, (t,), the nodes', (n,)."""
    corners = body.points[body.boundary]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)  # the edge that faces each corner
    gradients = np.cross(normals[:, None], opposite) / (doubled**2)[:, None, None]  # of each corner's hat function
    count, places = len(body.boundary), 3 * body.boundary[:, :, None] + np.arange(3)
    triangles = np.repeat(np.arange(count), 9)
    shape = (count, 3 * len(body.points))
    rows = csr_array((gradients.ravel(), (triangles, places.ravel())), shape=shape)
    nodal = np.zeros(len(body.points))
    np.add.at(nodal, body.boundary.ravel(), np.repeat(doubled / 6.0, 3))
    return rows, doubled / 2.0, nodal
