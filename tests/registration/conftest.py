"""A forward model with a closed form, so that registration is tested where FEniCSx is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.outcome import NotConverged


@dataclass(frozen=True, eq=False)
class CantileverState:
    """u = w(x) g(m) with m = w . f a weighted sum of the forces and g odd and saturating."""

    shape: np.ndarray
    mean: np.ndarray
    reach: float
    negative_pivots: int | None = None
    extrapolation_ratio: float | None = None

    @property
    def displacement(self) -> np.ndarray:
        return self.reach * self.shape[:, None] * np.tanh(self.mean)

    @property
    def _slope(self) -> np.ndarray:
        return self.reach * (1.0 - np.tanh(self.mean) ** 2)

    def jvp(self, changes: ArrayLike) -> np.ndarray:
        moved = np.asarray(changes).reshape(len(self.shape), 3, -1)
        mean = np.einsum("n,nik->ik", self.shape, moved)
        return np.einsum("n,i,ik->nik", self.shape, self._slope, mean).reshape(-1, moved.shape[2])

    def vjp(self, cotangent: ArrayLike) -> np.ndarray:
        return self.shape[:, None] * self._slope * (self.shape @ np.asarray(cotangent))


class Cantilever:
    """A smooth nonlinear forward model without any solver."""

    def __init__(self, body: Body, refuse_above: float = np.inf, learned: float | None = None) -> None:
        self.body = body
        self.refuse_above, self.learned = refuse_above, learned
        span = body.points[:, 0] / body.points[:, 0].max()
        self._shape = span**2
        self._shape[body.fixed] = 0.0

    error = 0.0
    discrepancy = None

    def solve(self, forces: ArrayLike, near: Any = None) -> CantileverState:
        mean = self._shape @ np.asarray(forces)
        size = float(np.abs(mean).max())
        if size > self.refuse_above:
            raise NotConverged("too large a step for the test model")
        extrapolation_ratio = None if self.learned is None else size / self.learned
        return CantileverState(self._shape, mean, 0.2, extrapolation_ratio=extrapolation_ratio)


def seen_from_above(cells: tuple[int, int, int] = (8, 3, 3)) -> Body:
    """A beam with its top and its front side observed: a patch with an edge, on which a cloud cannot slide freely."""
    made = beam(cells, (0.8, 0.2, 0.2), "tetrahedron")
    corners = made.points[made.boundary]
    seen = (corners[:, :, 2] > 0.199).all(axis=1) | (corners[:, :, 1] > 0.199).all(axis=1)
    return Body(made.points, made.cells, made.node_sets, {"observed": made.boundary[seen]})


@pytest.fixture(scope="session")
def body() -> Body:
    return seen_from_above()


def cloud_on(
    body: Body, displacement: np.ndarray, count: int, rng: np.random.Generator, noise: float = 0.0
) -> np.ndarray:
    """Points drawn evenly over the observed side of a deformed body, with isotropic noise, (count, 3)."""
    triangles = body.surfaces["observed"][rng.integers(len(body.surfaces["observed"]), size=count)]
    weights = rng.dirichlet(np.ones(3), size=count)
    points = np.einsum("pk,pki->pi", weights, (body.points + displacement)[triangles])
    return points + noise * rng.standard_normal(points.shape)


def tip_forces(body: Body, net: tuple[float, float, float]) -> np.ndarray:
    """A net force spread evenly over the tip, (n, 3), newtons."""
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"]] = np.array(net) / len(body.node_sets["tip"])
    return forces
