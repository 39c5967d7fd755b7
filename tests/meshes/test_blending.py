"""Between two balls lies a ball; between organs something of both, wherever they lay and however they were turned."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes.blending import blended
from softtwin.meshes.body import Floats, Surface
from softtwin.meshes.checks import SurfaceError, checked_surface
from softtwin.meshes.shapes import isosurface, liver_phantom


def ellipsoid(radii: tuple[float, float, float], spacing: float = 0.004) -> Surface:
    size = np.array(radii)

    def level(x: Floats) -> Floats:
        return np.asarray(np.linalg.norm(x / size, axis=-1) - 1.0)

    return isosurface(level, -1.2 * size, 1.2 * size, spacing)


def turned(surface: Surface, rng: np.random.Generator) -> Surface:
    """Somewhere else, turned at random."""
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    return Surface(surface.points @ rotation.T + rng.standard_normal(3), surface.triangles)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_between_balls_lies_the_ball_of_the_radius_between(share: float) -> None:
    found = blended(ellipsoid((0.05,) * 3), ellipsoid((0.08,) * 3), share)
    radii = np.linalg.norm(found.points - found.points.mean(axis=0), axis=1)
    np.testing.assert_allclose(radii, 0.05 + 0.03 * share, atol=1.5e-3)
    checked_surface(found)


def test_the_other_is_laid_upon_the_first(rng) -> None:
    """An organ and itself somewhere else, turned: whatever the share, it is the organ where it was."""
    vertices, local = np.unique(liver_phantom(0.02).boundary, return_inverse=True)
    organ = Surface(liver_phantom(0.02).points[vertices], local.reshape(-1, 3))
    found = blended(organ, turned(organ, rng), 0.5)
    assert found.volume == pytest.approx(organ.volume, rel=0.02)
    np.testing.assert_allclose(found.points.min(axis=0), organ.points.min(axis=0), atol=4e-3)
    np.testing.assert_allclose(found.points.max(axis=0), organ.points.max(axis=0), atol=4e-3)


def test_between_long_and_flat_lies_something_of_both(rng) -> None:
    long, flat = ellipsoid((0.10, 0.03, 0.03)), turned(ellipsoid((0.07, 0.06, 0.02)), rng)
    extents = [np.ptp(blended(long, flat, share).points, axis=0) for share in (0.0, 0.5, 1.0)]
    assert (np.diff([each[0] for each in extents]) < 0.0).all()
    assert (np.diff([each[1] for each in extents]) > 0.0).all() or (np.diff([each[2] for each in extents]) > 0.0).all()


def test_what_cannot_be_blended_is_refused() -> None:
    ball = ellipsoid((0.05,) * 3)
    with pytest.raises(ValueError, match=r"blended\.share: expected a number in \[0, 1\], got 1\.5"):
        blended(ball, ball, 1.5)
    with pytest.raises(ValueError, match=r"blended\.divisions: expected at least 8, got 2"):
        blended(ball, ball, 0.5, divisions=2)
    thin = ellipsoid((0.08, 0.08, 0.003), 0.0015)
    with pytest.raises(ValueError, match=r"blended: expected something between the surfaces at 0.5, got nothing on"):
        blended(thin, thin, 0.5, divisions=8)
    with pytest.raises(SurfaceError, match="expected a closed surface, got 3 open edges"):
        blended(ball, Surface(ball.points, ball.triangles[:-1]), 0.5)
