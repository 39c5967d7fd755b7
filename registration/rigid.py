"""A rigid start where nobody gives one: the pose of an organ that explains a partial cloud, or why there is none.

Thousands of poses are looked at, hundreds are brought closer by a robust point-to-plane iteration (Chen and Medioni
1992) in one batch, the distinct best of them are refined, and the best one is believed only if no other pose, and no
mirror image of the cloud, comes near it. Lengths inside are in sizes of the organ (diagonal of its bounding box).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Surface
from softtwin.meshes.clouds import CloudError, sample

from .policy import RIGID
from .pose import Pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_MIRROR = np.array([-1.0, 1.0, 1.0])


class AlignmentOutcome(Enum):
    """How a search for a pose ended, and what to do about it."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    MIRRORED = "mirrored"
    NO_MATCH = "no match"

    @property
    def advice(self) -> str:
        """What to do, one sentence."""
        return _ADVICE[self]


_ADVICE = {
    AlignmentOutcome.FOUND: "The pose is good to one or two centimetres: refine it with the organ's deformation.",
    AlignmentOutcome.AMBIGUOUS: "Other poses, or the mirror image of the cloud, fit as well: show more of the organ, "
    "its edges above all, or give landmarks or a start matrix.",
    AlignmentOutcome.MIRRORED: "The mirror image of the cloud fits the organ better than the cloud: "
    "check the signs and the order of its axes.",
    AlignmentOutcome.NO_MATCH: "No pose explains the cloud: check its unit, that it shows this organ and little else, "
    "or give landmarks or a start matrix.",
}


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose that was found for a cloud, and why it is believed or not.

    Args:
        outcome: `FOUND`, or the reason not to use the pose.
        pose: best pose, from the body at rest to the cloud's coordinates.
        rms: root mean squared distance of the points that the pose explains, metres.
        inliers: share of the points that the pose explains: those within s = 3 % of the organ's size of its surface.
        misfit: what is left unexplained, from 0 to 1: the mean of d^2 / (d^2 + s^2).
        runner_up: the strongest other pose, one that places the organ elsewhere; None where no other was found.
        runner_up_ratio: its misfit in parts of the best pose's, over the points that one of the two explains.
        mirror_ratio: the same for the mirror image of the cloud at its own best pose; below 1 it fits better.
    """

    outcome: AlignmentOutcome
    pose: Pose
    rms: float
    inliers: float
    misfit: float
    runner_up: Pose | None
    runner_up_ratio: float
    mirror_ratio: float

    @property
    def is_found(self) -> bool:
        """True where the pose may be used."""
        return self.outcome is AlignmentOutcome.FOUND


def align(surface: Surface, cloud: ArrayLike) -> Alignment:
    """The pose of an organ, at rest or bent by a few centimetres, whose surface explains a partial, noisy cloud.

    One-sided: each point of the cloud wants a place on the surface, the surface need not be seen. Twice the same input
    gives twice the same answer.

    Args:
        surface: the closed organ at rest wound outward, or its observed side, metres.
        cloud: observed points in the camera's coordinates, (p, 3), metres.

    Raises:
        CloudError: fewer than 20 points, another shape, or numbers that are not finite.
    """
    points = _checked_cloud(cloud)
    shape = _shape(surface)
    centre = np.median(points, axis=0)
    observed = _thinned((points - centre) / shape.size)
    found = _search(shape, observed)
    mirrored = _search(shape, observed * _MIRROR)
    return _judged(shape, found, mirrored, centre)


def _checked_cloud(cloud: ArrayLike) -> Floats:
    points = np.asarray(cloud, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CloudError(f"cloud: expected shape (p, 3), got {points.shape}.")
    if len(points) < RIGID.minimum_points:
        raise CloudError(f"cloud: expected at least {RIGID.minimum_points} points to find a pose, got {len(points)}.")
    if not np.isfinite(points).all():
        raise CloudError("cloud: expected finite coordinates, got NaN or infinity.")
    return points


def _thinned(points: Floats) -> Floats:
    # A random choice keeps the share of outliers; voxels would keep each of them and thin the rest.
    if len(points) <= RIGID.cloud_points:
        return points
    return points[np.random.default_rng(0).choice(len(points), RIGID.cloud_points, replace=False)]


# --- The surface, ready to be asked what is near.


@dataclass(frozen=True, eq=False)
class _Shape:
    """A surface in its own size: samples with normals, a tree of them, and a grid that knows the nearest."""

    size: float
    centre: Floats
    points: Floats
    normals: Floats
    tree: cKDTree
    low: Floats
    counts: Ints
    nearest: Ints
    distance: Floats

    def voxels(self, points: Floats) -> Ints:
        """Number of the voxel that holds each point, or of the one at the border next to it."""
        index = np.clip(np.rint((points - self.low) * RIGID.voxels), 0, self.counts - 1).astype(np.int32)
        return (index[..., 0] * self.counts[1] + index[..., 1]) * self.counts[2] + index[..., 2]


def _shape(surface: Surface) -> _Shape:
    corners = surface.points[np.unique(surface.triangles)]
    size, centre = float(np.linalg.norm(np.ptp(corners, axis=0))), corners.mean(axis=0)
    points = (sample(surface, RIGID.samples, np.random.default_rng(0)) - centre) / size
    tree = cKDTree(points)
    low = points.min(axis=0) - RIGID.margin
    counts = np.ceil((points.max(axis=0) + RIGID.margin - low) * RIGID.voxels).astype(np.int32) + 1
    nearest, distance = _lookup(points, low, counts)
    return _Shape(size, centre, points, _normals(points, tree), tree, low, counts, nearest, distance)


def _lookup(points: Floats, low: Floats, counts: Ints) -> tuple[Ints, Floats]:
    holder = np.full(counts, -1, dtype=np.int32)
    i, j, k = np.rint((points - low) * RIGID.voxels).astype(np.int32).T
    holder[i, j, k] = np.arange(len(points))
    distance, index = distance_transform_edt(holder < 0, return_indices=True)
    return holder[tuple(index)].ravel(), (distance / RIGID.voxels).astype(np.float32).ravel()


def _normals(points: Floats, tree: cKDTree) -> Floats:
    # Planes through neighbours rather than triangles: they round off what the mesh's size has made of the organ.
    _, near = tree.query(points, RIGID.neighbours)
    groups = points[near] - points[near].mean(axis=1, keepdims=True)
    return np.linalg.eigh(groups.transpose(0, 2, 1) @ groups)[1][:, :, 0]


# --- The search. Motions lead from the cloud to the surface: rotations (k, 3, 3), shifts (k, 3).


@dataclass(frozen=True, eq=False)
class _Motions:
    rotations: Floats
    shifts: Floats

    def apply(self, points: Floats) -> Floats:
        """Points (p, 3) under every motion, (k, p, 3)."""
        return points @ self.rotations.transpose(0, 2, 1) + self.shifts[:, None]

    def back(self, points: Floats) -> Floats:
        """Where the camera sees points of the surface under every motion, (k, p, 3)."""
        return (points - self.shifts[:, None]) @ self.rotations

    def chosen(self, order: Ints) -> _Motions:
        return _Motions(self.rotations[order], self.shifts[order])


@dataclass(frozen=True, eq=False)
class _Found:
    """Distinct motions, the best first, with their misfit (k,) and the distances of the cloud's points, (k, p)."""

    motions: _Motions
    misfits: Floats
    distances: Floats


def _search(shape: _Shape, cloud: Floats) -> _Found:
    few = cloud[:: max(1, len(cloud) // RIGID.early_points)]
    motions = _starts(shape, few[:: RIGID.every])
    for scale in RIGID.scales:
        motions = _step(shape, few, motions, scale, lambda z: shape.nearest[shape.voxels(z)])
    rough = _misfit(shape.distance[shape.voxels(motions.apply(cloud))], RIGID.scale)
    motions = motions.chosen(_distinct(shape, motions, rough, RIGID.distinct, RIGID.refined))
    for _ in range(RIGID.last_steps):
        motions = _step(shape, cloud, motions, RIGID.scale, lambda z: shape.tree.query(z)[1])
    distances = _distances(shape, motions.apply(cloud))
    misfits = _misfit(distances, RIGID.scale)
    order = _distinct(shape, motions, misfits, RIGID.distinct, RIGID.refined)
    return _Found(motions.chosen(order), misfits[order], distances[order])


def _misfit(distances: Floats, scale: float) -> Floats:
    # Geman and McClure: a point far away counts 1, however far.
    return np.mean(distances**2 / (distances**2 + scale**2), axis=-1)


def _distances(shape: _Shape, places: Floats) -> Floats:
    straight, near = shape.tree.query(places)
    planes = np.abs(np.sum((places - shape.points[near]) * shape.normals[near], axis=-1))
    return np.where(straight < RIGID.scale, planes, straight)


def _starts(shape: _Shape, cloud: Floats) -> _Motions:
    """The best of rotations spread evenly, each with the cloud's middle on patches spread over the surface."""
    middle = cloud[np.argmin(np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1))]
    rotations = _spread_rotations(RIGID.rotations)
    patches = shape.points[_spread_points(shape.points, RIGID.patches)]
    turned = (cloud - middle) @ rotations.transpose(0, 2, 1)
    misfits = np.array([_misfit(shape.distance[shape.voxels(turned + patch)], RIGID.scales[-1]) for patch in patches])
    patch, rotation = np.divmod(np.argsort(misfits, axis=None, kind="stable")[: RIGID.starts], RIGID.rotations)
    return _Motions(rotations[rotation], patches[patch] - rotations[rotation] @ middle)


def _spread_rotations(count: int) -> Floats:
    """Super-Fibonacci spirals on the quaternions (Alexa 2022), (count, 3, 3)."""
    s = (np.arange(count) + 0.5) / count
    a, b = (2 * np.pi * count * s / ratio for ratio in (np.sqrt(2.0), 1.533751168755204288118041))
    r, big = np.sqrt(s), np.sqrt(1 - s)
    return Rotation.from_quat(
        np.stack([r * np.sin(a), r * np.cos(a), big * np.sin(b), big * np.cos(b)], axis=1)
    ).as_matrix()


def _spread_points(points: Floats, count: int) -> Ints:
    """Numbers of points far from one another, each the farthest from those before it, (count,)."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def _distinct(shape: _Shape, motions: _Motions, misfits: Floats, apart: float, maximum: int) -> Ints:
    """Numbers of the best motions that place the organ at different places, the best first."""
    order = np.argsort(misfits, kind="stable")
    seen = motions.back(shape.points[_spread_points(shape.points, RIGID.places)])
    kept: list[int] = []
    for i in order.tolist():
        if not kept or np.linalg.norm(seen[kept] - seen[i], axis=2).mean(axis=1).min() > apart:
            kept.append(i)
        if len(kept) == maximum:
            break
    return np.array(kept)


def _step(shape: _Shape, cloud: Floats, motions: _Motions, scale: float, nearest: Callable[[Floats], Ints]) -> _Motions:
    """One robust Gauss-Newton step of all motions towards the planes of the nearest samples."""
    places = motions.apply(cloud)
    near = nearest(places)
    normals, offsets = shape.normals[near], places - shape.points[near]
    weights = (1 + np.sum(offsets**2, axis=-1) / scale**2) ** -2
    centres = places.mean(axis=1)
    arms = places - centres[:, None]
    rows = np.concatenate([np.cross(arms, normals), normals], axis=-1)
    matrix = (rows * weights[..., None]).transpose(0, 2, 1) @ rows
    pull = np.sum(rows * (weights * np.sum(offsets * normals, axis=-1))[..., None], axis=1)
    _add_sliding(matrix, pull, arms, offsets, RIGID.sliding * weights)
    matrix += RIGID.damping * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(6)
    twists = -np.linalg.solve(matrix, pull[..., None])[..., 0]
    turns = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    moved = np.einsum("kij,kj->ki", turns, motions.shifts - centres) + centres + twists[:, 3:]
    return _Motions(turns @ motions.rotations, moved)


def _add_sliding(matrix: Floats, pull: Floats, arms: Floats, offsets: Floats, weights: Floats) -> None:
    """Add the distances to the nearest samples themselves, lightly, to the normal equations of the planes."""
    weighted = weights[..., None] * arms
    moment, inertia = weighted.sum(axis=1), weighted.transpose(0, 2, 1) @ arms
    coupling = np.cross(np.eye(3), moment[:, None])
    matrix[:, :3, :3] += np.trace(inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3) - inertia
    matrix[:, :3, 3:] -= coupling
    matrix[:, 3:, :3] -= coupling.transpose(0, 2, 1)
    matrix[:, 3:, 3:] += weights.sum(axis=1)[:, None, None] * np.eye(3)
    pull[:, :3] += np.cross(weighted, offsets).sum(axis=1)
    pull[:, 3:] += (weights[..., None] * offsets).sum(axis=1)


# --- The verdict.


def _judged(shape: _Shape, found: _Found, mirrored: _Found, centre: Floats) -> Alignment:
    best, misfit = found.distances[0], float(found.misfits[0])
    others = np.array([_evidence(best, other) for other in found.distances[1:]])
    rival = None if len(others) == 0 else 1 + int(others.argmin())
    against = float(others.min()) if len(others) else np.inf
    mirror = min(_evidence(best, other) for other in mirrored.distances)
    inside, inside_mirrored = best < RIGID.scale, mirrored.distances[0] < RIGID.scale
    return Alignment(
        outcome=_outcome(shape, misfit, inside.mean(), inside_mirrored.mean(), against, mirror),
        pose=_pose(shape, found.motions, 0, centre),
        rms=shape.size * float(np.sqrt(np.mean(best[inside] ** 2))) if inside.any() else np.inf,
        inliers=float(inside.mean()),
        misfit=misfit,
        runner_up=None if rival is None else _pose(shape, found.motions, rival, centre),
        runner_up_ratio=against,
        mirror_ratio=mirror,
    )


def _evidence(best: Floats, other: Floats) -> float:
    """How many times worse another pose explains the points that at least one of the two explains."""
    # A point that neither explains is an outlier to both and says nothing of which one is right.
    told = (best < RIGID.scale) | (other < RIGID.scale)
    if not told.any():
        return 1.0
    worse, better = (max(float(_misfit(distances[told], RIGID.scale)), RIGID.floor) for distances in (other, best))
    return worse / better


def _outcome(
    shape: _Shape, misfit: float, inliers: float, mirrored_inliers: float, against: float, mirror: float
) -> AlignmentOutcome:
    if mirrored_inliers >= RIGID.inliers and mirror * RIGID.mirrored < 1:
        return AlignmentOutcome.MIRRORED
    if inliers < RIGID.inliers:
        return AlignmentOutcome.NO_MATCH
    if against < RIGID.unique or (mirror < RIGID.unique and not _is_its_own_mirror(shape, misfit)):
        return AlignmentOutcome.AMBIGUOUS
    return AlignmentOutcome.FOUND


def _is_its_own_mirror(shape: _Shape, misfit: float) -> bool:
    """True for an organ (many kidneys) so near to its mirror image that a cloud of this misfit fits both."""
    image = _search(shape, _thinned(shape.points) * _MIRROR)
    return bool(image.misfits[0] <= misfit)


def _pose(shape: _Shape, motions: _Motions, number: int, centre: Floats) -> Pose:
    # Inside: x / size - middle = R (y - centre) / size + t.
    rotation = motions.rotations[number].T
    return Pose(rotation, centre - rotation @ (shape.centre + shape.size * motions.shifts[number]))
