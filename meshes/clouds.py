"""Point clouds: sampled from a deformed body, seen from one side, noisy; and checked when they come in."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from vtkmodules.vtkCommonCore import vtkPoints

from .body import Body, Floats, Surface
from .closest import cell_locator
from .embedding import outer

_LIMIT_OF_SIZE = 0.5  # a cloud farther from the body than this part of its size needs a rigid start
_GLANCE = 200  # points that a cloud's distance is judged by
_UNIT_RATIO = 50.0  # a cloud this many times larger than the body is in another unit


class CloudError(ValueError):
    """A cloud that cannot be registered: the message says what is wrong with it and what to do."""


def sample(surface: Surface, count: int, rng: np.random.Generator) -> Floats:
    """Points drawn uniformly over the area of a surface, (count, 3), metres.

    Args:
        surface: triangle surface, metres.
        count: number of points.
        rng: source of random numbers.

    Raises:
        ValueError: `count` is below 1, or the surface has no area.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1 point, got {count}.")
    corners = surface.points[surface.triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not areas.sum() > 0:
        raise ValueError("surface: expected a surface with an area, got 0.")
    chosen = corners[rng.choice(len(areas), size=count, p=areas / areas.sum())]
    # The square root makes the density even over the triangle.
    r, s = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    return (1 - r) * chosen[:, 0] + r * (1 - s) * chosen[:, 1] + r * s * chosen[:, 2]


def partial_view(
    body: Body,
    displacement: ArrayLike,
    direction: ArrayLike,
    count: int,
    noise: float,
    rng: np.random.Generator,
    surface: str | None = None,
) -> Floats:
    """A cloud of the part of a deformed body that a distant camera sees, (count, 3), metres.

    Args:
        body: the body at rest.
        displacement: nodal displacements, (n, 3), metres.
        direction: direction from the body towards the camera, (3,), any length.
        count: number of points.
        noise: standard deviation of the isotropic Gaussian noise, metres.
        rng: source of random numbers.
        surface: name of one of the body's surfaces, to see only its triangles; None for the whole boundary.

    Raises:
        ValueError: shapes, a zero direction, negative noise, an unknown surface, or nothing is visible.
    """
    moved = np.asarray(displacement, dtype=np.float64)
    if moved.shape != body.points.shape:
        raise ValueError(f"displacement: expected shape {body.points.shape}, got {moved.shape}.")
    if not noise >= 0:
        raise ValueError(f"noise: expected a standard deviation of at least 0 m, got {noise}.")
    if surface is not None and surface not in body.surfaces:
        raise ValueError(f"surface: expected one of {sorted(body.surfaces)}, got {surface!r}.")
    deformed = outer(body).moved(moved)
    seen = visible_triangles(deformed, direction)
    if surface is not None:
        wanted = {tuple(sorted(corners)) for corners in body.surfaces[surface].tolist()}
        seen &= np.array([tuple(sorted(corners)) in wanted for corners in deformed.triangles.tolist()])
    if not seen.any():
        raise ValueError("direction: no triangle of the surface is visible from there.")
    cloud = sample(Surface(deformed.points, deformed.triangles[seen]), count, rng)
    return cloud + noise * rng.standard_normal(cloud.shape)


def visible_triangles(surface: Surface, direction: ArrayLike) -> NDArray[np.bool_]:
    """True for each triangle that faces a distant camera and is not hidden behind others, (t,).

    A triangle counts as hidden when something stands between its centroid and the camera.

    Args:
        surface: closed triangle surface wound outward, metres.
        direction: direction from the surface towards the camera, (3,), any length.

    Raises:
        ValueError: the direction is not three finite numbers, or zero.
    """
    towards = np.asarray(direction, dtype=np.float64)
    if towards.shape != (3,) or not np.isfinite(towards).all() or not np.linalg.norm(towards) > 0:
        raise ValueError(f"direction: expected three finite numbers that are not all zero, got {direction!r}.")
    far = 2 * float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    return _facing(surface, np.tile(far * towards / np.linalg.norm(towards), (len(surface.triangles), 1)))


def triangles_seen_from(surface: Surface, position: ArrayLike) -> NDArray[np.bool_]:
    """True for each triangle that faces a camera at a place and is not hidden behind others, (t,).

    Args:
        surface: closed triangle surface wound outward, metres.
        position: of the camera, (3,), metres.

    Raises:
        ValueError: the position is not three finite numbers.
    """
    camera = np.asarray(position, dtype=np.float64)
    if camera.shape != (3,) or not np.isfinite(camera).all():
        raise ValueError(f"position: expected three finite numbers, got {position!r}.")
    return _facing(surface, camera - surface.points[surface.triangles].mean(axis=1))


def _facing(surface: Surface, towards: Floats) -> NDArray[np.bool_]:
    """Triangles that face their camera and have nothing between; `towards` leads from centroids to it, (t, 3)."""
    a, b, c = (surface.points[surface.triangles[:, i]] for i in range(3))
    seen = np.einsum("ti,ti->t", np.cross(b - a, c - a), towards) > 0
    seen[seen] = ~_hidden(surface, ((a + b + c) / 3)[seen], towards[seen])
    return seen


def _hidden(surface: Surface, points: Floats, towards: Floats) -> NDArray[np.bool_]:
    size = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    locator = cell_locator(surface)
    starts = points + 1e-6 * size * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    hits, hit = vtkPoints(), np.zeros(len(points), dtype=bool)
    for i, (start, end) in enumerate(zip(starts, points + towards, strict=True)):
        hit[i] = locator.IntersectWithLine(start, end, 0.0, hits, None)  # with a tolerance: VTK before 9.6 has no other
    return hit


def check_cloud(cloud: ArrayLike, body: Body, limit: float | None = None) -> Floats:
    """The cloud as (p, 3) float64, if it can be registered to the body.

    Args:
        cloud: observed points, (p, 3), metres.
        body: the body at rest.
        limit: largest median distance of the cloud's points to the body's nodes, metres; None for half the body's size.

    Raises:
        CloudError: empty, another shape, NaN or infinity, or too far from the body.
    """
    points = np.asarray(cloud, dtype=np.float64)
    if points.size == 0:
        raise CloudError("cloud: expected at least one point, got an empty cloud.")
    if points.ndim != 2 or points.shape[1] != 3:
        raise CloudError(f"cloud: expected shape (p, 3), got {points.shape}.")
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise CloudError(f"cloud: expected finite coordinates, got NaN or infinity in {bad} of {len(points)} points; "
                         "remove them.")  # fmt: skip
    _check_distance(points, body, _LIMIT_OF_SIZE * body.size if limit is None else limit)
    return points


def _check_distance(points: Floats, body: Body, limit: float) -> None:
    few = points[:: max(1, len(points) // _GLANCE)]
    if np.median(body.boundary_tree.query(few)[0]) <= limit:
        return
    distances, _ = body.boundary_tree.query(points)
    centroids = float(np.linalg.norm(points.mean(axis=0) - body.points[body.boundary_nodes].mean(axis=0)))
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    advice = (
        f"the cloud is {extent:.3g} m across and the body {body.size:.3g} m: check the cloud's unit (--unit mm)"
        if extent > _UNIT_RATIO * body.size
        else "give a rigid start that brings the cloud to the body, or check the unit and the axes"
    )
    raise CloudError(
        f"cloud: expected points near the body (median distance up to {limit:.3g} m), got a median distance of "
        f"{np.median(distances):.3g} m, {distances.min():.3g} m between the nearest points and {centroids:.3g} m "
        f"between the centroids; {advice}."
    )


def thin(cloud: ArrayLike, spacing: float) -> Floats:
    """The cloud with one point, the mean, for each occupied voxel, (q, 3), metres.

    Args:
        cloud: points, (p, 3), metres.
        spacing: edge of a voxel, metres.

    Raises:
        ValueError: `spacing` is not positive.
        CloudError: another shape.
    """
    points = np.asarray(cloud, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CloudError(f"cloud: expected shape (p, 3), got {points.shape}.")
    if not spacing > 0:
        raise ValueError(f"spacing: expected a positive length in metres, got {spacing}.")
    _, voxels, counts = np.unique(np.floor(points / spacing), axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(voxels.ravel(), weights=points[:, i], minlength=len(counts)) for i in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]
