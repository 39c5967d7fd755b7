"""A rigid start found from a partial cloud alone: how often, how near, and how often it is wrong without saying so.

    python benchmarks/alignment.py [--draws 500] [--wild 40]

Views of the real liver as the tool has bent it (any frame of s1-s3, any direction, 500 points, 1 mm of noise, any
pose), cut to a share of the organ's area: 50 % is all that one view shows (about 40 to 50 %). Errors are mean
distances of the true node positions. Where the organ is bent under the cloud no rigid pose is near; `matched` says
what one would find that knew which point of the cloud is which of the organ. Then clouds for which every pose is wrong.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from liver import SEQUENCES, liver, sequence
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Surface
from softtwin.meshes.clouds import visible_triangles
from softtwin.meshes.shapes import liver_phantom
from softtwin.registration.pose import Pose, from_landmarks
from softtwin.registration.rigid import Alignment, AlignmentOutcome, align

Floats = NDArray[np.float64]
SHARES = (0.50, 0.25, 0.08)
NEAR, FAR, WRONG = 0.015, 0.030, 0.050  # metres: a good start; another pose; one that no search comes back from
POINTS, NOISE, OUTLIERS, OUTLIER_REACH = 500, 1e-3, 0.1, 0.03


@dataclass(frozen=True, eq=False)
class View:
    """A cloud in the camera's coordinates with what is true of it."""

    cloud: Floats
    pose: Pose
    positions: Floats
    matched: Pose


def view(rest: Floats, moved: Floats, triangles: NDArray[np.int64], share: float, rng: np.random.Generator) -> View:
    """What a camera sees of a moved organ, the part around a random place that makes up a share of the area."""
    surface = Surface(moved, triangles)
    corners = moved[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    seen = np.flatnonzero(visible_triangles(surface, rng.normal(size=3)))
    centroids = corners[seen].mean(axis=1)
    seen = seen[np.argsort(np.linalg.norm(centroids - centroids[rng.integers(len(seen))], axis=1))]
    seen = seen[: 1 + np.searchsorted(np.cumsum(areas[seen]), share * areas.sum())]
    chosen = triangles[rng.choice(seen, POINTS, p=areas[seen] / areas[seen].sum())]
    root, s = np.sqrt(rng.random(POINTS)), rng.random(POINTS)
    weights = np.stack([1 - root, root * (1 - s), root * s], axis=1)
    pose = Pose(Rotation.random(random_state=int(rng.integers(2**31))).as_matrix(), 0.3 * rng.normal(size=3))
    material, places = (np.einsum("pk,pki->pi", weights, points[chosen]) for points in (rest, pose.apply(moved)))
    names = [str(i) for i in range(POINTS)]
    matched = from_landmarks(dict(zip(names, material, strict=True)), dict(zip(names, places, strict=True))).pose
    return View(places + NOISE * rng.standard_normal(places.shape), pose, moved, matched)


def with_outliers(cloud: Floats, rng: np.random.Generator) -> Floats:
    """The cloud with a tenth of its points moved by up to 30 mm along each axis."""
    wild = rng.random(len(cloud)) < OUTLIERS
    return cloud + wild[:, None] * rng.uniform(-OUTLIER_REACH, OUTLIER_REACH, cloud.shape)


def timed(surface: Surface, cloud: Floats) -> tuple[Alignment, float, float]:
    """An alignment, its seconds, and its processor's seconds, which a busy machine does not stretch."""
    start, spent = time.perf_counter(), time.process_time()
    return align(surface, cloud), time.perf_counter() - start, time.process_time() - spent


def of_liver(surface: Surface, views: list[View], clouds: list[Floats]) -> dict[str, Any]:
    """Shares over views whose true pose is known."""
    runs = [timed(surface, cloud) for cloud in clouds]
    errors = np.array([off(a, v) for (a, *_), v in zip(runs, views, strict=True)])
    matched = np.array([v.matched.distance_to(v.pose, v.positions) for v in views])
    found = np.array([alignment.is_found for alignment, *_ in runs])
    return {
        "draws": len(runs),
        "within_15_mm": float(np.mean(errors < NEAR)),
        "matched_within_15_mm": float(np.mean(matched < NEAR)),
        "within_30_mm": float(np.mean(errors < FAR)),
        "found": float(np.mean(found)),
        "found_within_15_mm": float(np.mean(found & (errors < NEAR))),
        "found_beyond_15_mm": float(np.mean(found & (errors >= NEAR))),
        "found_beyond_30_mm": float(np.mean(found & (errors >= FAR))),
        "found_beyond_50_mm": float(np.mean(found & (errors >= WRONG))),
        "median_error_of_found_m": float(np.median(errors[found])) if found.any() else None,
        "seconds_median": float(np.median([seconds for _, seconds, _ in runs])),
        "processor_seconds_median": float(np.median([seconds for *_, seconds in runs])),
        "outcomes": outcomes([alignment for alignment, *_ in runs]),
    }


def off(found: Alignment, of: View) -> float:
    """Mean distance of the true node positions between the pose found and the true one, metres."""
    return found.pose.distance_to(of.pose, of.positions)


def outcomes(alignments: list[Alignment]) -> dict[str, int]:
    """How often each outcome came."""
    return {outcome.value: sum(a.outcome is outcome for a in alignments) for outcome in AlignmentOutcome}


def impossible(draw: Callable[[np.random.Generator], Floats], surface: Surface, draws: int) -> dict[str, Any]:
    """Outcomes for clouds that no pose explains or that say nothing of it."""
    alignments = [align(surface, draw(np.random.default_rng([3, i]))) for i in range(draws)]
    return {"draws": draws, "found": float(np.mean([a.is_found for a in alignments])), "outcomes": outcomes(alignments)}


def of_share(kind: str, share: float, draws: int, wild: int) -> dict[str, Any]:
    """What is found of views of the organ that show a share of it, as they are or with outliers."""
    return of_liver(organ().boundary_surface, *views_of(kind, share, draws if kind == "liver" else min(draws, wild)))


def views_of(kind: str, share: float, draws: int) -> tuple[list[View], list[Floats]]:
    """Views of the organ that show a share of it, and their clouds, as they are or with outliers."""
    views = [seen(share, np.random.default_rng([1, i])) for i in range(draws)]
    clouds = [v.cloud for v in views]
    if kind == "outliers":
        clouds = [with_outliers(cloud, np.random.default_rng([2, i])) for i, cloud in enumerate(clouds)]
    return views, clouds


organ, phantom = cache(liver), cache(liver_phantom)


@cache
def frames() -> Floats:
    """True positions of all sequences."""
    return np.concatenate([sequence(name).positions for name in SEQUENCES])


def seen(share: float, rng: np.random.Generator) -> View:
    """A view of the organ in one of its frames."""
    return view(organ().points, frames()[rng.integers(len(frames()))], organ().boundary, share, rng)


def other(share: float, rng: np.random.Generator) -> Floats:
    """A cloud of another organ."""
    return view(phantom().points, phantom().points, phantom().boundary, share, rng).cloud


IMPOSSIBLE: dict[str, Callable[[np.random.Generator], Floats]] = {
    **{f"mirrored {s:.0%}": lambda rng, s=s: seen(s, rng).cloud * np.array([-1.0, 1.0, 1.0]) for s in SHARES},
    **{f"another organ {s:.0%}": partial(other, s) for s in SHARES},
    "line": lambda rng: (
        np.outer(rng.uniform(-0.1, 0.1, POINTS), rng.normal(size=3)) + NOISE * rng.normal(size=(POINTS, 3))
    ),
    "plane": lambda rng: rng.uniform(-0.05, 0.05, (POINTS, 3)) * [1, 1, 0] + NOISE * rng.normal(size=(POINTS, 3)),
    "box": lambda rng: rng.uniform(-0.1, 0.1, (POINTS, 3)),
}
KINDS = {f"{kind} {share:.0%}": (kind, share) for share in SHARES for kind in ("liver", "outliers")}


def work(row: str, given: Given) -> dict[str, Any]:
    if row in IMPOSSIBLE:
        return impossible(IMPOSSIBLE[row], organ().boundary_surface, max(1, given.wild // 2))
    return of_share(*KINDS[row], given.draws, given.wild)


BENCHMARK = Benchmark(
    name="alignment",
    title="A rigid start found from a partial cloud alone: how often, how near, how often wrong unsaid",
    about=("registration/rigid.py", "registration/pose.py", "meshes"),
    work=work,
    rows=(*KINDS, *IMPOSSIBLE),
    columns=(
        Column("draws", "", "{draws}"),
        Column("found", "%", "{found*100:.1f}"),
        Column("found within 15 mm", "%", "{found_within_15_mm*100:.1f}"),
        Column("at best within 15 mm", "%", "{matched_within_15_mm*100:.1f}"),
        Column("found, beyond 30; 50 mm", "%", "{found_beyond_30_mm*100:.1f}; {found_beyond_50_mm*100:.1f}"),
        Column("median error of those found", "mm", "{median_error_of_found_m*1000:.1f}"),
        Column("median", "s", "{seconds_median:.2f}"),
    ),
    settings={
        "draws": Setting(40, "of each row"),
        "wild": Setting(40, "draws with outliers; half as many of each wrong cloud"),
    },
    seeds=(1, 2, 3),
    small={"draws": 2, "wild": 2},
    under="rows",
    finish=lambda figures, given: {"points": POINTS, "noise_m": NOISE},
)


if __name__ == "__main__":
    run(BENCHMARK)
