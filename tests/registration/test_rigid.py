from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from alignment import OUTLIERS, View, view, with_outliers

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.clouds import CloudError
from softtwin.meshes.shapes import liver_phantom
from softtwin.registration.pose import Pose
from softtwin.registration.rigid import Alignment, AlignmentOutcome, align

Half = Callable[[int], tuple[View, Alignment]]
NEAR, FAR = 0.015, 0.030  # metres: a good start; another pose
MIRROR = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def phantom() -> Body:
    return liver_phantom()


def _bent(points: np.ndarray) -> np.ndarray:
    """The phantom with its left end bent down by 20 mm."""
    x = np.maximum(points[:, 0], 0.0)
    return points + np.outer(0.02 * (x / x.max()) ** 2, [0.0, 0.3, -1.0])


def _view(body: Body, share: float, seed: int) -> View:
    return view(body.points, _bent(body.points), body.boundary, share, np.random.default_rng([11, seed]))


def _error(alignment: Alignment, seen: View) -> float:
    return alignment.pose.distance_to(seen.pose, seen.positions)


@pytest.fixture(scope="module")
def half(phantom: Body) -> Half:
    """A view of half of the surface by its seed, and what is found of it: looked for once."""

    @cache
    def seen_and_found(seed: int) -> tuple[View, Alignment]:
        seen = _view(phantom, 0.5, seed)
        return seen, align(phantom.boundary_surface, seen.cloud)

    return seen_and_found


@pytest.mark.parametrize("seed", range(4))
def test_a_bent_organ_is_found_from_one_view(phantom: Body, half: Half, seed: int) -> None:
    seen, found = half(seed)
    assert found.outcome is AlignmentOutcome.FOUND and found.is_found
    assert _error(found, seen) < NEAR
    assert found.inliers > 0.9 and found.rms < 0.008
    assert found.runner_up is not None and found.runner_up_ratio > 1.3 and found.mirror_ratio > 1.3
    # Another pose is one that places the organ elsewhere: by a fifteenth of its size.
    assert found.pose.distance_to(found.runner_up, phantom.points) > phantom.size / 20


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_outliers_do_not_pull(phantom: Body, half: Half, seed: int) -> None:
    seen, clean = half(seed)
    found = align(phantom.boundary_surface, with_outliers(seen.cloud, np.random.default_rng(5)))
    assert found.is_found
    assert clean.pose.distance_to(found.pose, phantom.points) < 1e-3  # the noise of the cloud
    assert found.inliers < clean.inliers - OUTLIERS / 4


def test_the_same_cloud_gives_the_same_pose(phantom: Body) -> None:
    cloud = _view(phantom, 0.25, 1).cloud
    first, second = (align(phantom.boundary_surface, cloud) for _ in range(2))
    assert np.array_equal(first.pose.matrix, second.pose.matrix) and first.misfit == second.misfit


def test_a_cloud_that_is_moved_moves_the_pose(phantom: Body, half: Half) -> None:
    seen, here = half(2)
    motion = Pose.identity().moved([0.4, -1.0, 2.0, 0.3, 0.1, -0.2], np.zeros(3))
    there = align(phantom.boundary_surface, motion.apply(seen.cloud))
    # Two searches from other starts end within the tolerance of eight last steps, not in the same bits.
    assert here.pose.then(motion).distance_to(there.pose, phantom.points) < 1e-3


def test_a_small_smooth_patch_is_ambiguous(phantom: Body) -> None:
    centre = phantom.points[phantom.boundary].mean(axis=1)
    # The dome of the right lobe: nearly a sphere, which fits in any turn about its middle.
    dome = np.linalg.norm(centre - centre[np.argmin(centre[:, 0] - centre[:, 2])], axis=1) < 0.03
    cloud = centre[dome]
    found = align(phantom.boundary_surface, cloud)
    assert len(cloud) > 20 and found.outcome is AlignmentOutcome.AMBIGUOUS
    assert "landmarks" in found.outcome.advice


def _line(rng: np.random.Generator) -> np.ndarray:
    return np.outer(rng.uniform(-0.1, 0.1, 300), [1.0, 2.0, 3.0])


def _plane(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-0.05, 0.05, (300, 3)) * [1, 1, 0]


def _box(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-0.1, 0.1, (300, 3))


def _one_place(rng: np.random.Generator) -> np.ndarray:
    return np.ones((300, 3))


@pytest.mark.parametrize(
    ("draw", "outcomes"),
    [
        (_line, (AlignmentOutcome.AMBIGUOUS, AlignmentOutcome.NO_MATCH)),
        (_plane, (AlignmentOutcome.AMBIGUOUS, AlignmentOutcome.NO_MATCH)),
        (_one_place, (AlignmentOutcome.AMBIGUOUS,)),
        (_box, (AlignmentOutcome.NO_MATCH,)),
    ],
)
def test_what_holds_no_pose_is_refused(phantom: Body, draw, outcomes: tuple[AlignmentOutcome, ...]) -> None:
    found = align(phantom.boundary_surface, draw(np.random.default_rng(1)))
    assert found.outcome in outcomes and not found.is_found


@pytest.mark.parametrize(("factor", "outcome"), [(1e3, AlignmentOutcome.NO_MATCH), (1e-3, AlignmentOutcome.AMBIGUOUS)])
def test_another_unit_is_refused(phantom: Body, factor: float, outcome: AlignmentOutcome) -> None:
    found = align(phantom.boundary_surface, factor * _view(phantom, 0.5, 0).cloud)
    assert found.outcome is outcome and "unit" in AlignmentOutcome.NO_MATCH.advice


def test_a_mirrored_cloud_is_refused(phantom: Body) -> None:
    for seed in range(3):
        assert not align(phantom.boundary_surface, MIRROR * _view(phantom, 0.5, seed).cloud).is_found


def _bean(rounds: int = 40) -> Surface:
    """A bean: tapered and bent, its own mirror image in the plane z = 0, and in nothing else."""
    angles, heights = np.linspace(0, 2 * np.pi, rounds, endpoint=False), np.linspace(-1, 1, rounds + 2)[1:-1]
    radii = np.sqrt(1 - heights**2)
    rings = np.stack([np.outer(np.ones(rounds), heights), *(np.outer(f(angles), radii) for f in (np.cos, np.sin))], -1)
    points = np.concatenate([rings.transpose(1, 0, 2).reshape(-1, 3), [[-1.0, 0, 0], [1.0, 0, 0]]])
    x, y, z = points.T
    shaped = np.stack([0.06 * x, 0.03 * (1 + 0.4 * x) * y + 0.03 * x**2, 0.022 * (1 + 0.4 * x) * z], axis=1)
    i, j = np.meshgrid(np.arange(rounds - 1), np.arange(rounds), indexing="ij")
    a, b = i * rounds + j, i * rounds + (j + 1) % rounds
    sides = np.concatenate([np.stack([a, b, a + rounds], -1), np.stack([b, b + rounds, a + rounds], -1)]).reshape(-1, 3)
    ring, last = np.arange(rounds), (rounds - 1) * rounds
    first = np.stack([np.roll(ring, -1), ring, np.full(rounds, len(points) - 2)], axis=1)
    end = np.stack([last + ring, last + np.roll(ring, -1), np.full(rounds, len(points) - 1)], axis=1)
    surface = Surface(shaped, np.concatenate([sides, first, end]))
    return surface if surface.volume > 0 else Surface(shaped, surface.triangles[:, ::-1])


def test_an_organ_that_is_its_own_mirror_image_is_not_refused_for_it() -> None:
    bean = _bean()
    seen = view(bean.points, bean.points, bean.triangles, 0.5, np.random.default_rng([12, 0]))
    found = align(bean, seen.cloud)
    assert found.mirror_ratio == pytest.approx(1.0, abs=0.2)
    assert found.is_found and _error(found, seen) < 0.005


@pytest.mark.parametrize(
    ("cloud", "said"),
    [
        (np.zeros((30, 2)), r"expected shape \(p, 3\), got \(30, 2\)"),
        (np.zeros((19, 3)), "expected at least 20 points to find a pose, got 19"),
        (np.full((30, 3), np.nan), "NaN"),
    ],
)
def test_a_cloud_that_cannot_be_searched_is_refused(phantom: Body, cloud: np.ndarray, said: str) -> None:
    with pytest.raises(CloudError, match=said):
        align(phantom.boundary_surface, cloud)


# --- The real liver.


@pytest.fixture(scope="module")
def real(liver_folder: Path) -> tuple[Body, np.ndarray]:
    from liver import SEQUENCES, liver

    folder = liver_folder / "sequences" / "neohookean"
    return liver(), np.concatenate([np.load(folder / s / "positions-default.npy") for s in SEQUENCES])


def _real_view(real: tuple[Body, np.ndarray], share: float, seed: int) -> View:
    body, frames = real
    rng = np.random.default_rng([13, seed])
    return view(body.points, frames[rng.integers(len(frames))], body.boundary, share, rng)


@pytest.mark.liver
@pytest.mark.parametrize(("share", "least"), [(0.5, 6), (0.25, 5), (0.08, 3)])
def test_the_liver_is_found_and_never_elsewhere(real: tuple[Body, np.ndarray], share: float, least: int) -> None:
    views = [_real_view(real, share, seed) for seed in range(8)]
    found = [align(real[0].boundary_surface, seen.cloud) for seen in views]
    errors = [_error(alignment, seen) for alignment, seen in zip(found, views, strict=True)]
    assert max(error for error, a in zip(errors, found, strict=True) if a.is_found) < FAR
    assert sum(a.is_found and error < NEAR for error, a in zip(errors, found, strict=True)) >= least


@pytest.mark.liver
@pytest.mark.parametrize("share", [0.5, 0.25])
def test_a_mirrored_liver_is_called_mirrored(real: tuple[Body, np.ndarray], share: float) -> None:
    found = [align(real[0].boundary_surface, MIRROR * _real_view(real, share, seed).cloud) for seed in range(4)]
    assert not any(a.is_found for a in found)
    assert sum(a.outcome is AlignmentOutcome.MIRRORED for a in found) >= 3
    assert "axes" in AlignmentOutcome.MIRRORED.advice
