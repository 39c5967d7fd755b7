import numpy as np
import pytest
from scipy.spatial import cKDTree

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.clouds import CloudError, check_cloud, partial_view, sample, thin, visible_triangles
from softtwin.meshes.embedding import embed
from softtwin.meshes.shapes import beam


def _rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_samples_lie_on_the_surface_evenly(bar: Body) -> None:
    cloud = sample(bar.boundary_surface, 4000, _rng())
    # Inside points have distance 0 and the box's faces are flat, so the gap to the faces tells.
    low, high = bar.points.min(axis=0), bar.points.max(axis=0)
    gaps = np.minimum(np.abs(cloud - low), np.abs(cloud - high)).min(axis=1)
    assert gaps.max() < 1e-15
    on_end = np.isclose(cloud[:, 0], 0, atol=1e-12).mean()
    share = 0.1 * 0.2 / (2 * (0.4 * 0.1 + 0.4 * 0.2 + 0.1 * 0.2))
    assert on_end == pytest.approx(share, abs=4 * np.sqrt(share / 4000))  # four standard deviations


def test_the_same_seed_gives_the_same_cloud(bar: Body) -> None:
    first, second = (partial_view(bar, np.zeros_like(bar.points), [0, 0, 1], 50, 1e-3, _rng()) for _ in range(2))
    assert np.array_equal(first, second)


def test_a_view_from_above_sees_the_deformed_top_only(bar: Body) -> None:
    cloud = partial_view(bar, np.full_like(bar.points, 0.05), [0, 0, 3.0], 300, 0.0, _rng())
    assert cloud.shape == (300, 3) and np.allclose(cloud[:, 2], 0.25, rtol=0, atol=1e-15)


def test_half_a_sphere_is_visible(ball: Surface) -> None:
    seen = visible_triangles(ball, [1, 1, 1])
    assert seen.sum() == pytest.approx(len(seen) / 2, rel=0.1)
    centroids = ball.points[ball.triangles].mean(axis=1)
    assert (centroids[seen] @ [1, 1, 1] > 0).all()


def test_what_stands_behind_is_hidden(ball: Surface) -> None:
    shadow = Surface(0.5 * ball.points - [0.2, 0, 0], ball.triangles)
    both = Surface(
        np.concatenate([ball.points, shadow.points]),
        np.concatenate([ball.triangles, shadow.triangles + len(ball.points)]),
    )
    front, behind = np.split(visible_triangles(both, [1, 0, 0]), 2)
    assert np.array_equal(front, visible_triangles(ball, [1, 0, 0])) and front.any()
    assert not behind.any() and np.split(visible_triangles(both, [0, 0, 1]), 2)[1].any()


def test_a_view_of_a_named_surface_stays_on_it(liver: Body) -> None:
    cloud = partial_view(liver, np.zeros_like(liver.points), [0.2, -1, 0.3], 400, 0.0, _rng(), surface="observed")
    assert embed(liver, cloud).outside.max() < 1e-12
    observed = Surface(liver.points, liver.surfaces["observed"])
    nearest, _ = cKDTree(sample(observed, 20000, _rng())).query(cloud)
    assert nearest.max() < 0.004  # 20000 samples of the observed side stand about 1.5 mm apart


def test_noise_has_the_wanted_spread(bar: Body) -> None:
    still = np.zeros_like(bar.points)
    clean, noisy = (partial_view(bar, still, [0, 0, 1], 3000, noise, _rng()) for noise in (0.0, 0.002))
    # The standard deviation of 9000 numbers is known to 1 / sqrt(18000); four of these.
    assert np.std(noisy - clean) == pytest.approx(0.002, rel=4 / np.sqrt(18000))
    assert np.abs((noisy - clean).mean(axis=0)).max() < 4 * 0.002 / np.sqrt(3000)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"direction": [0, 0, 0]}, "direction: expected three finite numbers that are not all zero"),
        ({"direction": [0, 1]}, "direction: expected three finite numbers"),
        ({"count": 0}, "count: expected at least 1 point, got 0"),
        ({"noise": -1.0}, "noise: expected a standard deviation of at least 0 m, got -1"),
        ({"surface": "liver"}, r"surface: expected one of \[\], got 'liver'"),
        ({"displacement": np.zeros((2, 3))}, r"displacement: expected shape \(60, 3\), got \(2, 3\)"),
    ],
)
def test_a_view_that_cannot_be_is_refused(bar: Body, change: dict[str, object], message: str) -> None:
    options = {"displacement": np.zeros_like(bar.points), "direction": [0, 0, 1], "count": 9, "noise": 0.0, **change}
    with pytest.raises(ValueError, match=message):
        partial_view(bar, rng=_rng(), **options)  # type: ignore[arg-type]


def test_a_good_cloud_passes_unchanged(liver: Body) -> None:
    cloud = partial_view(liver, np.full_like(liver.points, 0.02), [0, -1, 0], 100, 0.001, _rng())
    assert np.array_equal(check_cloud(cloud, liver), cloud)


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.empty((0, 3)), "at least one point, got an empty cloud"),
        ([], "at least one point, got an empty cloud"),
        (np.zeros((4, 2)), r"expected shape \(p, 3\), got \(4, 2\)"),
        ([[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0]], "got NaN or infinity in 2 of 3 points"),
    ],
)
def test_a_bad_cloud_is_refused(liver: Body, cloud: object, message: str) -> None:
    with pytest.raises(CloudError, match=message):
        check_cloud(cloud, liver)  # type: ignore[arg-type]


@pytest.mark.parametrize("body", ["liver", "beam"])
def test_a_cloud_a_metre_away_is_refused_with_its_distance(body: str, request: pytest.FixtureRequest) -> None:
    organ: Body = beam() if body == "beam" else request.getfixturevalue("liver")
    far = partial_view(organ, np.zeros_like(organ.points), [0, -1, 0], 100, 0.0, _rng()) + np.array([0, 0, 1.0])
    with pytest.raises(CloudError) as caught:
        check_cloud(far, organ)
    assert "rigid start" in str(caught.value)
    gap = float(str(caught.value).split(" m between the nearest points")[0].rsplit(" ", 1)[1])
    distances = np.linalg.norm(far[:, None] - organ.points[organ.boundary_nodes], axis=2)
    assert gap == pytest.approx(distances.min(), rel=1e-2)


def test_a_cloud_in_millimetres_is_refused_with_the_flag(liver: Body) -> None:
    with pytest.raises(CloudError, match=r"check the cloud's unit \(--unit mm\)"):
        check_cloud(1000 * liver.points[liver.boundary_nodes], liver)


def test_a_given_limit_is_obeyed(liver: Body) -> None:
    cloud = liver.points[liver.boundary_nodes] - [0, 0.3, 0]
    assert len(check_cloud(cloud, liver, limit=0.35))
    with pytest.raises(CloudError, match=r"up to 0\.1 m"):
        check_cloud(cloud, liver, limit=0.1)


def test_thinning_leaves_one_point_a_voxel() -> None:
    cloud = _rng().random((5000, 3))
    thinned = thin(cloud, 0.25)
    voxels = np.floor(thinned / 0.25)
    assert len(thinned) == 64 and len(np.unique(voxels, axis=0)) == 64
    assert np.array_equal(np.unique(voxels, axis=0), np.unique(np.floor(cloud / 0.25), axis=0))
    assert np.allclose(thin(cloud, 10.0), cloud.mean(axis=0), rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="spacing: expected a positive length in metres, got 0"):
        thin(cloud, 0)
    with pytest.raises(CloudError, match=r"expected shape \(p, 3\)"):
        thin(np.zeros(3), 1)
