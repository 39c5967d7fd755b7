"""Checks of a registration against what its model and its body lead one to expect; `judge` makes them.

Three that need a second registration, or another frame, are made elsewhere: forces elsewhere
(`strategies/elsewhere.py`), the contact (`contact.py`), what was lost (`tracker.py`).

Each is a statistic with a level. Where the law that it has under a right model is known in closed form, its chance is
given, too. Blocks of parameters and residual terms have checks of their own. A new check is one function here
and one code in `verdict.Code`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtri, ndtr

from .expectations import Expectations
from .forward import State
from .gauss_newton import SolverResult
from .hyperparameters import LogNormalPrior
from .linear_law import displacement_gradient_norm
from .loss import REJECTED
from .outcome import Outcome
from .parameters.block import BlockPosterior
from .policy import ACCURACY, POLICY
from .problem import Problem
from .score import Score, by_rigid_motion, by_scale, scores
from .verdict import Check, Code, Judgement, Verdict, checked

Floats = NDArray[np.float64]
_ABOUT = 8  # neighbours of a point, whose plane tells a surface


def judge(problem: Problem, found: SolverResult, state: State, expected: Expectations) -> Judgement:
    """The verdict on a solver's result.

    Args:
        problem: what was registered.
        found: where the solver ended.
        state: the body's state there.
        expected: what a usable result looks like.
    """
    checks = (
        _convergence(found),
        *_cloud(problem, found, expected),
        *_fit(problem, found, expected),
        *_state(problem, state, expected),
        *_blocks(problem, found, expected),
        *(check for term in problem.terms for check in term.checks(found.evaluation)),
        *_left_out(problem, found),
    )
    return Judgement.of(checks, Code.CONVERGENCE if found.outcome is Outcome.OUT_OF_TIME else None)


def _convergence(found: SolverResult) -> Check:
    """How long the next step would be; how the search ended decides."""
    is_converged = found.outcome is Outcome.CONVERGED
    return Check(
        Code.CONVERGENCE,
        Verdict.ACCEPTED if is_converged else Verdict.DOUBTFUL,
        found.local.length,
        None,
        "posterior deviations",
        reason="" if is_converged else f"not converged: {found.outcome.value}; {found.outcome.advice}",
    )


def _cloud(problem: Problem, found: SolverResult, expected: Expectations) -> Iterator[Check]:
    cloud = problem.cloud
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False) / np.sqrt(len(cloud))
    few = f"the cloud has {len(cloud)} points; fewer than {POLICY.minimum_points} tell little"
    yield checked(Code.POINT_COUNT, len(cloud), POLICY.minimum_points, few, is_minimum=True)
    width = float(spread[1] / spread[0]) if len(cloud) >= 3 and spread[0] > 0.0 else 0.0
    narrow = "the cloud is a line or a spot: it shows no surface"
    yield checked(Code.CLOUD_SHAPE, width, POLICY.line, narrow, is_minimum=True, refused=POLICY.line)
    if problem.forces.size:
        informed = found.posterior.informed
        nothing = f"the cloud tells {informed:.1f} directions of what is unknown: hardly anything"
        yield checked(Code.INFORMATION, informed, expected.informed, nothing, unit="directions", is_minimum=True)


def _fit(problem: Problem, found: SolverResult, expected: Expectations) -> Iterator[Check]:
    match = found.evaluation.match
    by_patches = problem.shared_noise(found.evaluation)
    noise = float(np.hypot(found.local.noise, np.sqrt(np.mean(by_patches**2))))
    yield checked(
        Code.MISFIT,
        noise,
        expected.noise,
        f"organ and cloud do not match: points lie {1e3 * noise:.1f} mm from the surface "
        f"(up to {1e3 * expected.noise:.1f} mm could be noise)",
        refused=POLICY.excess * expected.noise,
        unit="m",
        law=_log_normal(noise, problem.noise),
    )
    part = shared(problem.observed.closest_points(match), match.distances, found.weights)
    systematic = noise * float(np.sqrt(part))
    yield checked(
        Code.SPATIAL_CORRELATION,
        systematic,
        expected.systematic,
        f"organ and cloud do not match: whole patches of the surface are {1e3 * systematic:.1f} mm off, which no noise "
        f"of points explains (up to {1e3 * expected.systematic:.1f} mm is let pass)",
        refused=POLICY.excess * expected.systematic,
        unit="m",
    )
    outliers = float(np.mean(~found.is_kept))
    many = f"{100 * outliers:.0f} % of the points fit nowhere"
    yield checked(Code.OUTLIERS, outliers, expected.outliers, many)
    if POLICY.foreign < outliers <= expected.outliers:
        thin = thickness(found.evaluation.cloud[~found.is_kept])
        other = (
            f"{100 * outliers:.0f} % of the points are a surface that is none of this organ's: something else is in "
            "the cloud"
        )
        yield checked(Code.FOREIGN_SURFACE, thin, POLICY.thin, other, is_minimum=True)


def _log_normal(value: float, prior: LogNormalPrior) -> tuple[str, float] | None:
    """The chance of so large a scale by what was believed of it."""
    if prior.spread == 0.0:
        return None
    chance = float(ndtr(-np.log(value / max(prior.median, prior.minimum)) / prior.spread)) if value > 0.0 else 1.0
    return "log-normal prior of the noise", chance


def shared(closest_points: Floats, distances: Floats, weights: Floats) -> float:
    """Part of the variance of the distances that a point shares with its neighbours, between 0 and 1.

    Args:
        closest_points: on the undeformed surface, (p, 3), metres; in space, noise sorts points by sign.
        distances: signed, (p,), metres.
        weights: of the points, (p,); those without weight are left out.
    """
    kept = weights > REJECTED
    points, values = closest_points[kept], distances[kept]
    count = min(ACCURACY.neighbours, len(points) - 1)
    if count < 1 or not values.any():
        return 0.0
    asked = slice(None, None, max(1, len(points) // ACCURACY.asked))
    tree = cKDTree(points, compact_nodes=False, balanced_tree=False)  # so few are asked that it pays to make it quickly
    _, near = tree.query(points[asked], k=count + 1)
    beside = values[near[:, 1:]].mean(axis=1)
    return float(np.clip((values[asked] * beside).mean() / (values**2).mean(), 0.0, 1.0))


def thickness(points: Floats) -> float:
    """Part of the spread about a point that is across its neighbours' plane, median: 0 of a surface, 0.1 of a space.

    Surface variation (Pauly, Gross and Kobbelt 2002).

    Args:
        points: (p, 3), metres.
    """
    if len(points) <= _ABOUT:
        return 1.0
    _, near = cKDTree(points).query(points, k=_ABOUT + 1)
    arms = points[near] - points[near].mean(axis=1, keepdims=True)
    squares = np.linalg.svd(arms, compute_uv=False) ** 2
    return float(np.median(squares[:, 2] / np.maximum(squares.sum(axis=1), 1e-300)))


def _state(problem: Problem, state: State, expected: Expectations) -> Iterator[Check]:
    if problem.forces.size:  # known loads may move it as far as they do
        movement = float(np.linalg.norm(state.displacement, axis=1).max())
        far = (
            f"a node moved {1e3 * movement:.0f} mm; an organ of this size does not move more than "
            f"{1e3 * expected.movement:.0f} mm"
        )
        yield checked(Code.MOVEMENT, movement, expected.movement, far, refused=expected.movement, unit="m")
    if expected.gradient < np.inf:
        largest = displacement_gradient_norm(problem.observed.body, state.displacement)
        bent = (
            f"parts of the organ turn or stretch by {100 * largest:.0f} %; its law is linear, which holds up to "
            f"{100 * expected.gradient:.0f} %"
        )
        # Below a norm of 1 no cell is turned inside out; beyond, nothing says that this is a body.
        yield checked(Code.LINEAR_LAW, largest, expected.gradient, bent, refused=1.0)
    ratio, limit = state.extrapolation_ratio, expected.extrapolation_ratio
    if ratio is not None:
        beyond = f"the load is {ratio:.1f} times the largest that the surrogate has learned"
        yield checked(Code.LOAD, ratio, limit, beyond, refused=POLICY.excess * limit)
    pivots = state.negative_pivots
    if pivots is not None:
        unstable = f"the state is unstable: {pivots} negative pivots of its tangent"
        yield checked(Code.STABILITY, pivots, 0.0, unstable, unit="negative pivots")


def _blocks(problem: Problem, found: SolverResult, expected: Expectations) -> Iterator[Check]:
    """What each block of parameters says of what was found of it."""
    at, covariance, scales = found.evaluation, found.posterior.covariance, found.posterior.scales
    for block, part in problem.parts:
        known = BlockPosterior(at, at.coefficients[part], covariance[part, part], scales, problem.forces.size > 0)
        yield from block.checks(known, expected)


def _left_out(problem: Problem, found: SolverResult) -> Iterator[Check]:
    """What is no unknown here, and would explain the cloud better: its scale, and a pose that was given as exact."""
    local = found.local
    motion = by_rigid_motion(local) if problem.pose is None else np.zeros((len(problem.cloud), 0))
    of_scale, of_pose = scores(local, by_scale(local), motion)
    if of_scale is not None:
        larger = float(of_scale.estimate[0])
        matters = abs(larger) * problem.observed.body.size / 2.0 > problem.noise.median
        another = (
            f"the cloud fits better {100 * abs(larger):.1f} % {'larger' if larger > 0.0 else 'smaller'}: it has not "
            "the scale of the organ; look at its unit, the calibration of the camera, or the segmentation"
        )
        yield _scored(Code.SCALE, of_scale, matters, another, POLICY.unlikely)
    if of_pose is not None:
        turn, shift = (float(np.linalg.norm(part)) for part in np.split(of_pose.estimate, 2))
        matters = max(turn * problem.observed.body.size / 2.0, shift) > problem.noise.median
        odd = (
            f"the cloud fits better turned by {np.rad2deg(turn):.1f} degrees and shifted by {1e3 * shift:.1f} mm: the "
            "pose is not exact; say --pose unknown"
        )
        yield _scored(Code.EXACT_POSE, of_pose, matters, odd, POLICY.unlikely_score)


def _scored(code: Code, told: Score, matters: bool, reason: str, unlikely: float) -> Check:
    """A check by a score test, doubtful below a chance; what is sure and too small to matter is passed."""
    level = float(chdtri(len(told.estimate), unlikely))
    law = f"chi-square, {len(told.estimate)} degrees of freedom", told.p_value
    made = checked(code, told.statistic, level, reason, law=law)
    return made if matters else replace(made, verdict=Verdict.ACCEPTED, level=None, reason="")
