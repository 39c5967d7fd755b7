"""Checks of a registration against what its model and its body lead one to expect; `judge` makes all of them.

Each is a statistic with a level. Where the law that it has under a right model is known in closed form, its chance is
given, too. A new check is one function here and one code in `verdict.Code`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtrc, chdtri, ndtr

from softtwin.meshes.metrics import displacement_gradients

from .forward import ForwardModel, State
from .gauss_newton import SolverResult
from .hyperparameters import LogNormalPrior
from .identifiability import uninformed
from .loss import REJECTED
from .outcome import Outcome
from .problem import Problem
from .score import Score, by_rigid_motion, by_scale, score
from .verdict import Check, Code, Judgement, Verdict

Floats = NDArray[np.float64]
_NEIGHBOURS = 6
_ASKED = 250  # points at least, whose neighbours are looked at
_MARK_OFF = 4.0  # deviations of a landmark's place; three axes together are beyond it once in a thousand
_LEANING = 3.0  # times what normals of the deviation that was told would be off by in the median
_FEWEST_POINTS = 30
_MUCH, _THIN, _ABOUT = 0.2, 0.05, 8  # share of the points that fit nowhere, thickness of a surface, neighbours for that
# Turn (radians) or stretch that a linear law holds for, half of which it is off by, relative: a centimetre of movement
# is then good to a camera's noise. Per cent of the cells.
_SMALL, _NEARLY_ALL = 0.03, 95.0
# Chance of a score, a choice: forces that are localised by the cloud that they explain leave larger scores than
# chi-square has. It is far below that of the other checks.
_UNLIKELY = 1e-5
_LINE = 0.02  # of a cloud's width to its length: a narrower one shows no surface
_REFUSED_NOISE, _REFUSED_PATCHES, _REFUSED_LOAD = 1.5, 2.0, 2.0  # times the level: no use at all


@dataclass(frozen=True)
class Expectations:
    """What a usable result looks like.

    Args:
        noise: largest standard deviation of a point's distance, metres: beyond it organ and cloud do not match.
        systematic: largest part of it that neighbouring points share, metres: noise is shared by none.
        movement: largest displacement of a node, metres; nothing is known of larger ones.
        outliers: largest share of points that may be wrong.
        extrapolation_ratio: largest load relative to what the model has learned.
        informed: fewest directions that a cloud must tell, where so many are unknown.
        pose: largest move of the pose in deviations of its prior.
        parameter: the same of stiffness and other unknowns beside the forces.
        gradient: largest turn or stretch that nearly all cells stay below; a law that is linear holds for small ones.
        discrepancy_scale: how often as large as it was seen to be what the model gets wrong may be taken.
        correction: however large beside what was seen, so little of it harms nobody: of an observed node, metres.
        minimum_variance_reduction: part of the variance of such a parameter, and of every combination of them, that a
            cloud must take
            away where all forces are known.
    """

    noise: float
    systematic: float
    movement: float
    outliers: float = 0.4
    extrapolation_ratio: float = 1.2
    informed: float = 2.0
    pose: float = 3.0
    parameter: float = 3.0
    discrepancy_scale: float = 1.5
    correction: float = 0.0
    minimum_variance_reduction: float = 0.5
    gradient: float = np.inf

    @classmethod
    def of(cls, model: ForwardModel, noise: LogNormalPrior) -> Expectations:
        """By the size of the model's body and the noise that is expected.

        Args:
            model: the forward model.
            noise: what is believed of the noise beforehand.
        """
        size = model.body.size
        return cls(
            noise=max(0.025 * size, 3.0 * noise.median),
            systematic=max(0.005 * size, noise.median),
            movement=0.35 * size,
            correction=0.0005 * size,
            gradient=_SMALL if getattr(model, "is_linear", False) else np.inf,
        )


def judge(
    problem: Problem,
    found: SolverResult,
    state: State,
    expected: Expectations,
    discrepancy_scale: float = 1.0,
) -> Judgement:
    """The verdict on a solver's result.

    Args:
        problem: what was registered.
        found: where the solver ended.
        state: the body's state there.
        expected: what a usable result looks like.
        discrepancy_scale: how large the model's error was found, in units of its samples'.
    """
    checks = (
        _convergence(found),
        *_cloud(problem, found, expected),
        *_fit(problem, found, expected),
        *_state(problem, state, expected),
        *_discrepancy(problem, found, expected, discrepancy_scale),
        *_pose(problem, found, expected),
        *_left_out(problem, found),
        *_parameters(problem, found, expected),
        *_landmarks(problem, found),
        *_normals(problem, found),
    )
    return Judgement.of(checks, Code.CONVERGENCE if found.outcome is Outcome.OUT_OF_TIME else None)


def _check(
    code: Code,
    statistic: float,
    level: float,
    reason: str,
    *,
    refused: float | None = None,
    unit: str = "",
    is_minimum: bool = False,
    law: tuple[str, float] | None = None,
    subject: str = "",
) -> Check:
    """A check that is passed up to the level (or from it on, where that is the least), and refused beyond another."""
    sign = -1.0 if is_minimum else 1.0
    verdict = Verdict.ACCEPTED
    if not sign * statistic <= sign * level:
        verdict = Verdict.REFUSED if refused is not None and sign * statistic > sign * refused else Verdict.DOUBTFUL
    reason = "" if verdict is Verdict.ACCEPTED else reason
    name, chance = law or ("", None)
    return Check(code, verdict, float(statistic), float(level), unit, is_minimum, name, chance, subject, reason)


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
    few = f"the cloud has {len(cloud)} points; fewer than {_FEWEST_POINTS} tell little"
    yield _check(Code.POINT_COUNT, len(cloud), _FEWEST_POINTS, few, is_minimum=True)
    width = float(spread[1] / spread[0]) if len(cloud) >= 3 and spread[0] > 0.0 else 0.0
    narrow = "the cloud is a line or a spot: it shows no surface"
    yield _check(Code.CLOUD_SHAPE, width, _LINE, narrow, is_minimum=True, refused=_LINE)
    if problem.forces.size:
        informed = found.posterior.informed
        nothing = f"the cloud tells {informed:.1f} directions of force: hardly anything"
        yield _check(Code.INFORMATION, informed, expected.informed, nothing, unit="directions", is_minimum=True)


def _fit(problem: Problem, found: SolverResult, expected: Expectations) -> Iterator[Check]:
    match = found.evaluation.match
    by_patches = problem.shared_noise(found.evaluation)
    noise = float(np.hypot(found.local.noise, np.sqrt(np.mean(by_patches**2))))
    yield _check(
        Code.MISFIT,
        noise,
        expected.noise,
        f"organ and cloud do not match: points lie {1e3 * noise:.1f} mm from the surface "
        f"(up to {1e3 * expected.noise:.1f} mm could be noise)",
        refused=_REFUSED_NOISE * expected.noise,
        unit="m",
        law=_log_normal(noise, problem.noise),
    )
    systematic = noise  # of which neighbours share a part
    if systematic > expected.systematic:
        systematic *= np.sqrt(shared(problem.observed.closest_points(match), match.distances, found.weights))
    yield _check(
        Code.SPATIAL_CORRELATION,
        systematic,
        expected.systematic,
        f"organ and cloud do not match: whole patches of the surface are {1e3 * systematic:.1f} mm off, which no noise "
        f"of points explains (up to {1e3 * expected.systematic:.1f} mm is let pass)",
        refused=_REFUSED_PATCHES * expected.systematic,
        unit="m",
    )
    outliers = float(np.mean(~found.is_kept))
    many = f"{100 * outliers:.0f} % of the points fit nowhere"
    yield _check(Code.OUTLIERS, outliers, expected.outliers, many)
    if _MUCH < outliers <= expected.outliers:
        thin = thickness(found.evaluation.cloud[~found.is_kept])
        other = (
            f"{100 * outliers:.0f} % of the points are a surface that is none of this organ's: something else is in "
            "the cloud"
        )
        yield _check(Code.FOREIGN_SURFACE, thin, _THIN, other, is_minimum=True)


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
    count = min(_NEIGHBOURS, len(points) - 1)
    if count < 1 or not values.any():
        return 0.0
    asked = slice(None, None, max(1, len(points) // _ASKED))
    _, near = cKDTree(points).query(points[asked], k=count + 1)
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
        yield _check(Code.MOVEMENT, movement, expected.movement, far, refused=expected.movement, unit="m")
    if expected.gradient < np.inf:
        gradients = displacement_gradients(problem.observed.body, state.displacement)
        largest = float(np.percentile(np.linalg.norm(gradients, ord=2, axis=(1, 2)), _NEARLY_ALL))
        bent = (
            f"parts of the organ turn or stretch by {100 * largest:.0f} %; its law is linear, which holds up to "
            f"{100 * expected.gradient:.0f} %"
        )
        yield _check(Code.LINEAR_LAW, largest, expected.gradient, bent)
    ratio, limit = state.extrapolation_ratio, expected.extrapolation_ratio
    if ratio is not None:
        beyond = f"the load is {ratio:.1f} times the largest that the surrogate has learned"
        yield _check(Code.LOAD, ratio, limit, beyond, refused=_REFUSED_LOAD * limit)
    pivots = state.negative_pivots
    if pivots is not None:
        unstable = f"the state is unstable: {pivots} negative pivots of its tangent"
        yield _check(Code.STABILITY, pivots, 0.0, unstable, unit="negative pivots")


def _discrepancy(
    problem: Problem, found: SolverResult, expected: Expectations, discrepancy_scale: float
) -> Iterator[Check]:
    """What no state explains goes into what the model gets wrong: more of that than was seen is none of it."""
    if problem.error is None:
        return
    correction = problem.correction(found.evaluation)[problem.observed.nodes]
    size = float(np.sqrt((correction**2).sum(axis=1).mean()))
    level = expected.discrepancy_scale if size > expected.correction else np.inf  # so little of it harms nobody
    much = (
        f"the cloud asks for {discrepancy_scale:.1f} times what the model was seen to get wrong, {1e3 * size:.1f} mm: "
        "some of it shows no state of this organ, or the organ is not as it was taken for"
    )
    made = _check(Code.DISCREPANCY_SCALE, discrepancy_scale, level, much, unit="times what was seen")
    yield made if np.isfinite(level) else replace(made, level=None)


def _pose(problem: Problem, found: SolverResult, expected: Expectations) -> Iterator[Check]:
    if problem.pose is None:
        return
    values = np.abs(found.evaluation.coefficients[problem.pose_part])
    largest = float(values.max())
    advice = "say --pose unknown" if problem.pose.is_said else "give a better start"
    far = f"the pose lies {largest:.1f} deviations from where it was expected; {advice}"
    yield _check(Code.POSE, largest, expected.pose, far, unit="deviations", law=_largest_normal(largest, len(values)))


def _largest_normal(value: float, count: int) -> tuple[str, float]:
    """The chance of so large a deviation, the largest of several by its prior."""
    chance = _of_several(2.0 * float(ndtr(-value)), count)
    return f"largest of {count} standard normal deviations" if count > 1 else "standard normal", chance


def _left_out(problem: Problem, found: SolverResult) -> Iterator[Check]:
    """What is no unknown here, and would explain the cloud better: its scale, and a pose that was given as exact."""
    told = score(found.local, by_scale(found.local))
    if told is not None:
        yield _scored(Code.SCALE, told, False, "")  # see `score.by_scale`: shown, and decides nothing
    if problem.pose is not None:
        return
    told = score(found.local, by_rigid_motion(found.local))
    if told is not None:
        turn, shift = (float(np.linalg.norm(part)) for part in np.split(told.estimate, 2))
        matters = max(turn * problem.observed.body.size / 2.0, shift) > problem.noise.median
        odd = (
            f"the cloud fits better turned by {np.rad2deg(turn):.1f} degrees and shifted by {1e3 * shift:.1f} mm: the "
            "pose is not exact; say --pose unknown"
        )
        yield _scored(Code.EXACT_POSE, told, matters, odd)


def _scored(code: Code, told: Score, matters: bool, reason: str) -> Check:
    """A check by a score test; what is sure and too small to matter is passed."""
    level = float(chdtri(len(told.estimate), _UNLIKELY))
    law = f"chi-square, {len(told.estimate)} degrees of freedom", told.p_value
    made = _check(code, told.statistic, level, reason, law=law)
    return made if matters else replace(made, verdict=Verdict.ACCEPTED, level=None, reason="")


def _of_several(chance: float, count: int) -> float:
    """The chance that the largest of so many is as far out, where one is with a chance."""
    return 1.0 if chance >= 1.0 else float(-np.expm1(count * np.log1p(-chance)))


def _parameters(problem: Problem, found: SolverResult, expected: Expectations) -> Iterator[Check]:
    """Unknowns far from where they were expected, and those that the cloud says nothing of.

    With unknown forces the latter is no fault: the prior of the stiffness is what the newtons are worth. Nor is it one
    of a contact, which only its place along the surface tells.
    """
    if problem.parameter_blocks is None:
        return
    part = problem.parameter_part
    for known in problem.parameter_blocks.estimates(
        found.evaluation.coefficients[part], found.posterior.covariance[part, part]
    ):
        far = f"{known.name} lies {known.deviations:.1f} deviations from where it was expected"
        yield _check(
            Code.PARAMETER,
            known.deviations,
            expected.parameter,
            far,
            unit="deviations",
            law=_largest_normal(known.deviations, 1),
            subject=known.name,
        )
    if not problem.forces.size and not problem.parameter_blocks.has_forces_alone:
        yield from _identifiability(problem, found, expected)


def _identifiability(problem: Problem, found: SolverResult, expected: Expectations) -> Iterator[Check]:
    """Unknowns, and combinations of them, of which the cloud has left most of what was believed beforehand."""
    parameter_blocks, part = problem.parameter_blocks, problem.parameter_part
    assert parameter_blocks is not None
    covariance = found.posterior.covariance[part, part]
    names = [known.name for known in parameter_blocks.estimates(found.evaluation.coefficients[part], covariance)]
    if parameter_blocks.has_regions:
        names = [f"{name} of the rest" if name == "Young's modulus" else name for name in names]
    alone, combined = uninformed(parameter_blocks, names, covariance, expected.minimum_variance_reduction)
    kept = float(np.linalg.eigvalsh(covariance)[-1]) if np.isfinite(covariance).all() else np.inf
    level = 1.0 - expected.minimum_variance_reduction
    given = "what is given is what was expected beforehand"
    same = "other values that differ so would explain it as well"
    reasons = [(name, given) for name in alone] + [(name, same) for name in combined]
    if not reasons:
        yield Check(Code.IDENTIFIABILITY, Verdict.ACCEPTED, kept, level, "of the variance beforehand")
    for name, why in reasons:
        reason = f"the cloud does not tell {name} under this load: {why}"
        unit = "of the variance beforehand"
        yield Check(Code.IDENTIFIABILITY, Verdict.DOUBTFUL, kept, level, unit, subject=name, reason=reason)


def _landmarks(problem: Problem, found: SolverResult) -> Iterator[Check]:
    """Landmarks that lie far from where they were found: one was taken for another, or the state is another."""
    if problem.landmarks is None:
        return
    off = np.linalg.norm(problem.landmark_residuals(found.evaluation).reshape(-1, 3), axis=1)
    number, largest = int(off.argmax()), float(off.max())
    away = f"landmark {number} lies {1e3 * problem.landmarks.deviation * largest:.1f} mm from where it was found"
    chance = _of_several(float(chdtrc(3, largest**2)), len(off))
    yield _check(
        Code.LANDMARKS,
        largest,
        _MARK_OFF,
        away,
        unit="deviations",
        law=(f"largest of {len(off)} lengths of three normal deviations", chance),
        subject=f"landmark {number}",
    )


def _normals(problem: Problem, found: SolverResult) -> Iterator[Check]:
    """Normals that are none of this surface's: of another frame, say, or columns of something else."""
    if problem.tangent_basis is None:
        return
    known = np.abs(problem.tangent_basis).max(axis=(1, 2)) > 0.0
    leaning = (
        np.linalg.norm(problem.normal_residuals(found.evaluation).reshape(-1, 2)[known], axis=1)
        * problem.normal_deviation
    )
    median = float(np.rad2deg(np.arcsin(np.minimum(np.median(leaning), 1.0))))
    expected = float(np.rad2deg(np.sqrt(2.0 * np.log(2.0)) * problem.normal_deviation))  # Rayleigh's law
    lean = (
        f"the cloud's normals do not match: half of them lean by more than {median:.0f} degrees from the surface "
        f"found, where {expected:.0f} were expected"
    )
    yield _check(Code.NORMALS, median, _LEANING * expected, lean, unit="degrees")
