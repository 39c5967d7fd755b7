"""Fields over a surface in the eigenmodes of its Laplacian: eigenvalues, covariance, derivatives, open edges."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.registration.surface_modes import SurfaceModes, surface_modes

WIDTH, HEIGHT = 0.3, 0.2


def rectangle(across: int = 45, along: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a flat rectangle, metres."""
    x, y = np.meshgrid(np.linspace(0.0, WIDTH, across), np.linspace(0.0, HEIGHT, along))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    first = (np.arange(along - 1)[:, None] * across + np.arange(across - 1)).ravel()
    lower = np.column_stack([first, first + 1, first + across + 1])
    upper = np.column_stack([first, first + across + 1, first + across])
    return points, np.concatenate([lower, upper])


@pytest.fixture(scope="module")
def modes() -> SurfaceModes:
    return surface_modes(*rectangle(), 120)


def test_eigenvalues_of_a_rectangle_are_those_of_cosines(modes: SurfaceModes) -> None:
    """(pi i / a)^2 + (pi j / b)^2: nothing flows across the edges."""
    steps = np.arange(12)
    exact = np.sort(((np.pi * steps / WIDTH)[:, None] ** 2 + (np.pi * steps / HEIGHT) ** 2).ravel())
    assert modes.area == pytest.approx(WIDTH * HEIGHT)
    np.testing.assert_allclose(modes.values[:14], exact[:14], rtol=0.01, atol=1e-6)


def test_modes_have_mean_square_one_and_share_nothing(modes: SurfaceModes) -> None:
    points, triangles = rectangle()
    share = np.zeros(len(points))
    np.add.at(share, triangles, 1.0 / (3.0 * len(triangles)))
    products = modes.modes.T @ (share[:, None] * modes.modes)
    np.testing.assert_allclose(products, np.eye(120), atol=1e-8)


@pytest.mark.parametrize("length", [0.03, 0.05])
def test_a_field_has_materns_covariance_within_the_surface(modes: SurfaceModes, length: float) -> None:
    """(1 + sqrt(3) d / l) exp(-sqrt(3) d / l) between points that lie far from the edges."""
    points, _ = rectangle()
    variances = np.exp(modes.log_variances(length)[0])
    middle = int(np.argmin(np.linalg.norm(points - [WIDTH / 2.0, HEIGHT / 2.0, 0.0], axis=1)))
    found = modes.modes @ (variances * modes.modes[middle])
    found /= found[middle]  # near the edges, that reflect it, the field varies more, so that it does less here
    apart = np.linalg.norm(points - points[middle], axis=1)
    scaled = np.sqrt(3.0) * apart / length
    wanted = (1.0 + scaled) * np.exp(-scaled)
    near = apart < 0.06
    np.testing.assert_allclose(found[near], wanted[near], atol=0.06)


def test_variances_add_up_to_one_with_what_is_left_out(modes: SurfaceModes) -> None:
    whole = surface_modes(*rectangle(), 500)
    for length in (0.01, 0.03):
        few, many = (np.exp(each.log_variances(length)[0]).sum() for each in (modes, whole))
        assert few < many < 1.0
        np.testing.assert_allclose(
            np.exp(whole.log_variances(length)[0][:120]).sum(), few, rtol=0.15
        )  # Weyl's law, without its term for the edges
    assert np.exp(modes.log_variances(0.1)[0]).sum() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("smoothness", [0.5, 1.5])
def test_the_derivative_by_the_length_is_exact(modes: SurfaceModes, smoothness: float) -> None:
    step = 1e-6
    up, down = (modes.log_variances(0.03 * np.exp(sign * step), smoothness)[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(modes.log_variances(0.03, smoothness)[1], (up - down) / (2.0 * step), atol=1e-7)


def test_values_at_points_are_linear_between_vertices(modes: SurfaceModes, rng: np.random.Generator) -> None:
    _, triangles = rectangle()
    weights = rng.dirichlet(np.ones(3), len(triangles))
    found = modes.at(triangles, weights)
    np.testing.assert_allclose(found[7], weights[7] @ modes.modes[triangles[7]], rtol=1e-12)
    assert modes.leading(5).at(triangles, weights).shape == (len(triangles), 5)


def test_surfaces_in_pieces_and_with_flat_triangles_have_modes() -> None:
    """Each piece has its own constant; a triangle without area is no division by zero; few vertices give few modes."""
    points, triangles = rectangle(12, 8)
    apart = np.concatenate([triangles, triangles + len(points)])
    both = surface_modes(np.concatenate([points, points + np.array([1.0, 0.0, 0.0])]), apart, 20)
    np.testing.assert_allclose(both.values[:2], 0.0, atol=1e-6)
    assert both.values[2] > 1.0
    flat = np.concatenate([triangles, [[0, 1, 2]]])
    assert np.isfinite(surface_modes(points, flat, 20).modes).all()
    assert len(surface_modes(points[[0, 1, 12]], np.array([[0, 1, 2]]), 20).values) == 1


def test_what_is_no_surface_and_no_length_is_refused() -> None:
    points, triangles = rectangle(12, 8)
    with pytest.raises(ValueError, match="3 vertices and 1 mode at least, got 2"):
        surface_modes(points[:2], triangles[:0], 4)
    with pytest.raises(ValueError, match="got NaN"):
        surface_modes(np.where(points == 0.0, np.nan, points), triangles, 4)
    with pytest.raises(ValueError, match="one place alone"):
        surface_modes(np.zeros_like(points), triangles, 4)
    with pytest.raises(ValueError, match=r"expected positive numbers, got 0\.0"):
        surface_modes(points, triangles, 4).log_variances(0.0)
