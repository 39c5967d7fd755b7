"""Mean curvature of triangle surfaces against its closed form."""

from __future__ import annotations

import numpy as np

from softtwin.meshes.body import Surface
from softtwin.meshes.curvature import mean_curvature


def test_a_sphere_bends_by_the_inverse_of_its_radius(ball: Surface) -> None:
    curvature = mean_curvature(ball)
    np.testing.assert_allclose(np.percentile(curvature, [5, 50, 95]), 1.0 / 0.05, rtol=0.05)
    inside_out = Surface(ball.points, np.ascontiguousarray(ball.triangles[:, ::-1]))
    np.testing.assert_allclose(mean_curvature(inside_out), -curvature, atol=1e-9)


def test_a_plane_does_not_bend() -> None:
    x, y = np.meshgrid(np.linspace(0.0, 0.1, 5), np.linspace(0.0, 0.2, 6), indexing="ij")
    number = np.arange(30).reshape(5, 6)
    a, b, c, d = (number[i : i + 4, j : j + 5].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    plane = Surface(np.column_stack([x.ravel(), y.ravel(), np.zeros(30)]), triangles)
    np.testing.assert_allclose(mean_curvature(plane), 0.0, atol=1e-9)
