import numpy as np
import pytest

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.embedding import carried, embed, is_carried_along
from softtwin.meshes.shapes import beam

EPS = np.finfo(float).eps


def _affine(points: np.ndarray) -> np.ndarray:
    return points @ np.array([[0.3, -1.2, 0.4], [0.9, 0.1, -0.5], [-0.2, 0.7, 1.1]]) + [0.1, -0.2, 0.3]


def _inside(body: Body, count: int) -> np.ndarray:
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    return np.random.default_rng(1).uniform(low, high, (count, 3))


def test_an_affine_field_is_carried_exactly(skewed: Body) -> None:
    points = np.concatenate([_inside(skewed, 500), skewed.points, skewed.points[skewed.cells].mean(axis=1)])
    embedding = embed(skewed, points)
    assert (embedding.outside == 0).all()
    # A weight carries the error of one 3 x 3 solve; weights of skewed cells amplify it by some tens.
    assert np.abs(embedding.displace(_affine(skewed.points)) - _affine(points)).max() < 1e3 * EPS


def test_weights_are_those_of_a_point_in_its_cell(skewed: Body) -> None:
    embedding = embed(skewed, _inside(skewed, 300))
    assert embedding.weights.min() > -1e-8
    assert np.allclose(embedding.weights.sum(axis=1), 1, rtol=0, atol=100 * EPS)
    assert np.array_equal(embedding.nodes, skewed.cells[embedding.cells])
    assert len(np.unique(embedding.cells)) > len(skewed.cells) / 2


def test_a_node_is_carried_by_itself(skewed: Body) -> None:
    field = np.random.default_rng(0).normal(size=skewed.points.shape)
    assert np.allclose(embed(skewed, skewed.points).displace(field), field, rtol=0, atol=1e4 * EPS)


def test_a_hexahedron_carries_trilinear_fields_exactly() -> None:
    cube = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
    body = Body(0.1 * cube, np.arange(8)[None], {"fixed": [0, 1, 2, 3]})
    points = 0.1 * np.random.default_rng(2).random((50, 3))
    field = np.prod(body.points, axis=1)[:, None] * [1, 2, 3]
    expected = np.prod(points, axis=1)[:, None] * [1, 2, 3]
    assert np.allclose(embed(body, points).displace(field), expected, rtol=0, atol=1e3 * EPS * 1e-3)


def test_the_matrix_is_the_same_map(skewed: Body) -> None:
    embedding = embed(skewed, _inside(skewed, 100))
    field = np.random.default_rng(0).normal(size=skewed.points.shape)
    assert embedding.matrix.shape == (100, len(skewed.points))
    assert np.allclose(embedding.matrix @ field, embedding.displace(field), rtol=0, atol=100 * EPS)


def test_a_point_outside_is_tied_to_the_nearest_point_of_the_boundary(bar: Body) -> None:
    embedding = embed(bar, [[0.2, 0.05, 0.25], [-0.03, -0.04, 0.1], [0.2, 0.05, 0.1]])
    assert np.allclose(embedding.outside, [0.05, 0.05, 0.0], rtol=0, atol=1e-15)
    expected = _affine(np.array([[0.2, 0.05, 0.2], [0.0, 0.0, 0.1], [0.2, 0.05, 0.1]]))
    assert np.abs(embedding.displace(_affine(bar.points)) - expected).max() < 1e3 * EPS
    assert embedding.weights.min() > -1e-12


def test_points_far_away_report_their_distance(bar: Body) -> None:
    embedding = embed(bar, [[10.4, 0.05, 0.1]])
    assert embedding.outside == pytest.approx([10.0], rel=1e-12)


def test_no_points_make_an_empty_embedding(bar: Body) -> None:
    embedding = embed(bar, np.empty((0, 3)))
    assert embedding.displace(np.zeros_like(bar.points)).shape == (0, 3)


def test_inner_surfaces_are_carried_along(liver: Body) -> None:
    moved = carried(liver, _affine(liver.points) - liver.points)
    assert set(moved) == set(liver.inner)
    for name, surface in liver.inner.items():
        assert np.abs(moved[name].points - _affine(surface.points)).max() < 1e3 * EPS
        assert np.array_equal(moved[name].triangles, surface.triangles)


def test_a_surface_inside_needs_no_clamping(bar: Body, ball: Surface) -> None:
    tumour = Surface(0.5 * ball.points + [0.2, 0.05, 0.1], ball.triangles)
    assert (embed(bar, tumour.points).outside == 0).all()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((3, 2)), r"points: expected shape \(p, 3\), got \(3, 2\)"),
        ([[0, 0, np.nan]], "points: expected finite coordinates"),
    ],
)
def test_what_is_no_point_is_refused(bar: Body, points: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        embed(bar, points)  # type: ignore[arg-type]


def test_a_field_of_another_body_is_refused(bar: Body) -> None:
    with pytest.raises(ValueError, match=r"displacement: expected shape \(60, 3\), got \(7, 3\)"):
        embed(bar, bar.points).displace(np.zeros((7, 3)))


@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
def test_quadratic_cells_carry_quadratic_fields_exactly(kind: str) -> None:
    body = beam((3, 2, 2), (0.6, 0.2, 0.2), kind).quadratic()

    def field(x: np.ndarray) -> np.ndarray:
        return np.stack([x[:, 0] * x[:, 1], x[:, 2] ** 2 - x[:, 0], x[:, 1] * x[:, 2]], axis=1)

    points = _inside(body, 200)
    assert np.abs(embed(body, points).displace(field(body.points)) - field(points)).max() < 1e3 * EPS


def test_curved_cells_are_refused() -> None:
    straight = beam((3, 2, 2), (0.6, 0.2, 0.2), "tetrahedron").quadratic()
    points = straight.points.copy()
    points[-1] += 1e-3
    with pytest.raises(ValueError, match="expected straight cells"):
        embed(Body(points, straight.cells, dict(straight.node_sets)), points[:3])


def test_what_lies_farther_outside_than_the_mesh_is_rough_is_carried_along(tetrahedral_beam: Body) -> None:
    middle, end = np.array([0.3, 0.1, 0.1]), np.array([0.6, 0.1, 0.1])
    points = np.array([middle, end, end])
    points[1:, 0] += [0.005, 0.03]  # of edges of 0.1 m
    assert is_carried_along(tetrahedral_beam, embed(tetrahedral_beam, points)).tolist() == [False, False, True]
