"""Closest points of a surface that moves are the closest, wherever it has moved to, and whatever its triangles are."""

from __future__ import annotations

import igl
import numpy as np
import pytest
from numpy.typing import NDArray

from softtwin.meshes import compiled as compilation
from softtwin.meshes import triangle_tree
from softtwin.meshes.shapes import liver_phantom
from softtwin.meshes.triangle_tree import TriangleTree, signed_distances

Floats = NDArray[np.float64]


@pytest.fixture(params=["numba", "libigl"])
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """With what closest points are found."""
    if request.param == "numba":
        needs_numba()
    monkeypatch.setattr(triangle_tree, "IS_COMPILED", request.param == "numba")


def needs_numba() -> None:
    if compilation.numba is None:
        pytest.skip("numba is absent: the extra `app`")


@pytest.fixture(scope="module")
def surface() -> tuple[Floats, NDArray[np.int64]]:
    phantom = liver_phantom(0.02)
    vertices, local = np.unique(phantom.boundary, return_inverse=True)
    return phantom.points[vertices], local.reshape(-1, 3)


def lengths(
    positions: Floats,
    triangles: NDArray[np.int64],
    cloud: Floats,
    tree: TriangleTree,
    near: NDArray[np.int64] | None = None,
) -> Floats:
    """Distances of the closest points found, which lie in their triangles."""
    found, weights = tree.closest(positions, cloud, near)
    assert weights.min() > -1e-12
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    places = np.einsum("pk,pki->pi", weights, positions[triangles[found]])
    return np.linalg.norm(places - cloud, axis=1)


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("far", [0.0, 5e-4, 2e-2, 1.0])
@pytest.mark.parametrize("how", ["at rest", "shifted", "twisted", "torn", "flat", "a point"])
def test_the_closest_is_found_wherever_the_surface_is(surface, rng, how: str, far: float) -> None:
    """The tree is that of the surface at rest; libigl makes a new one each time."""
    rest, triangles = surface
    turn = 20.0 * rest[:, 2]
    positions = {
        "at rest": rest,
        "shifted": rest + np.array([0.3, -0.2, 0.1]),
        "twisted": np.stack(
            [
                np.cos(turn) * rest[:, 0] - np.sin(turn) * rest[:, 1],
                np.sin(turn) * rest[:, 0] + np.cos(turn) * rest[:, 1],
                rest[:, 2],
            ],
            axis=1,
        ),
        "torn": rest + 0.02 * rng.standard_normal(rest.shape),
        "flat": rest * [1.0, 1.0, 0.0],
        "a point": 0.0 * rest + 0.1,
    }[how]
    cloud = positions[triangles[rng.integers(len(triangles), size=400)]].mean(axis=1)
    cloud += far * rng.standard_normal(cloud.shape)
    wanted = np.sqrt(igl.point_mesh_squared_distance(cloud, np.ascontiguousarray(positions), triangles)[0])
    tree = TriangleTree(rest, triangles)
    np.testing.assert_allclose(lengths(positions, triangles, cloud, tree), wanted, rtol=1e-9, atol=1e-9)
    guessed = rng.integers(len(triangles), size=len(cloud))  # wherever the search begins
    np.testing.assert_allclose(lengths(positions, triangles, cloud, tree, guessed), wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_triangles(rng, count: int) -> None:
    """Against samples of each triangle, of which none is nearer."""
    corners = rng.standard_normal((3 * count, 3))
    triangles = np.arange(3 * count).reshape(-1, 3)
    points = 3.0 * rng.standard_normal((200, 3))
    samples = np.einsum("qk,tki->tqi", rng.dirichlet(np.full(3, 0.5), size=2000), corners[triangles]).reshape(-1, 3)
    brute = np.sqrt(((samples - points[:, None]) ** 2).sum(axis=2).min(axis=1))
    found = lengths(corners, triangles, points, TriangleTree(corners, triangles))
    assert (found <= brute + 1e-9).all() and (brute - found).max() < 0.3


@pytest.mark.usefixtures("engine")
def test_triangles_without_area() -> None:
    """Needles and points have closest points, too: those of their edges."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    triangles = np.array([[0, 1, 2], [3, 3, 3], [0, 0, 2]])
    points = np.array([[2.0, 1.0, 0.0], [-1.0, 0.0, 1.0], [0.0, 5.0, 0.25], [4.0, 0.0, 0.0]])
    found = lengths(corners, triangles, points, TriangleTree(corners, triangles))
    np.testing.assert_allclose(found, [1.0, np.sqrt(2.0), 0.25, 1.0], rtol=1e-12)


def test_no_triangles_are_refused() -> None:
    with pytest.raises(ValueError, match=r"TriangleTree\.triangles: expected at least one, got none"):
        TriangleTree(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int64))


def test_positions_that_are_no_numbers_give_distances_that_are_none(surface) -> None:
    needs_numba()
    rest, triangles = surface
    found, weights = TriangleTree(rest, triangles).closest(np.full_like(rest, np.nan), rest[:5])
    places = np.einsum("pk,pki->pi", weights, np.full_like(rest, np.nan)[triangles[found]])
    assert np.isnan(places).all()


def test_without_a_place_for_its_cache_a_loop_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    needs_numba()
    njit = compilation.numba.njit

    def nowhere(*, cache: bool = False, **named):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**named)

    monkeypatch.setattr(compilation.numba, "njit", nowhere)
    assert compilation.compiled(lambda x: 2.0 * x)(3.0) == 6.0


def test_without_numba_a_function_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "numba", None)
    assert compilation.compiled(abs) is abs


@pytest.mark.usefixtures("engine")
def test_distances_have_the_sign_of_the_side(surface, rng) -> None:
    """Of points beyond and behind a surface by known lengths, and of points on it, whose direction is the normal."""
    rest, triangles = surface
    middles, corners = rest[triangles].mean(axis=1), rest[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    off = rng.choice([-1e-4, 0.0, 1e-4, 1e-3], size=len(triangles))
    third = np.full((len(triangles), 3), 1.0 / 3.0)
    found, directions = signed_distances(rest, triangles, third, middles + off[:, None] * normals, 1e-13)
    np.testing.assert_allclose(found, -off, atol=1e-15)
    np.testing.assert_allclose(directions, normals, atol=1e-9)
