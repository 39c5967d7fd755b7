"""Bodies and surfaces that the tests of meshes share."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.shapes import beam, liver_phantom

_OCTAHEDRON = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])


def _ball(rounds: int, radius: float) -> Surface:
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    triangles = _OCTAHEDRON
    for _ in range(rounds):
        corners = points[triangles]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        a, b, c, ab, bc, ca = (*np.swapaxes(corners, 0, 1), *np.swapaxes(middles, 0, 1))
        quads = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]], axis=0)
        flat = np.moveaxis(quads, 2, 0).reshape(-1, 3)
        points, numbers = np.unique(flat.round(12) + 0.0, axis=0, return_inverse=True)
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        triangles = numbers.reshape(-1, 3)
    return Surface(radius * points, triangles)


@pytest.fixture(scope="session")
def ball() -> Surface:
    """A sphere of radius 50 mm with 512 triangles."""
    return _ball(rounds=3, radius=0.05)


@pytest.fixture(scope="session")
def liver() -> Body:
    return liver_phantom()


@pytest.fixture(scope="session", params=["hexahedron", "tetrahedron"])
def bar(request: pytest.FixtureRequest) -> Body:
    return beam((4, 2, 3), (0.4, 0.1, 0.2), request.param)


@pytest.fixture
def skewed(bar: Body) -> Body:
    """The bar with its inner nodes moved, so that no two cells are alike."""
    rng = np.random.default_rng(3)
    inner = np.setdiff1d(np.arange(len(bar.points)), bar.boundary_nodes)
    points = bar.points.copy()
    points[inner] += 0.008 * rng.uniform(-1, 1, (len(inner), 3))
    return Body(points, bar.cells, bar.node_sets)
