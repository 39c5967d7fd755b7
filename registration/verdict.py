"""Whether a registration can be used: accepted, doubtful or refused, each with its reasons."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtwin.meshes.metrics import displacement_gradients

from .forward import ForwardModel, State
from .gauss_newton import SolverResult
from .hyperparameters import LogNormalPrior
from .identifiability import uninformed
from .loss import REJECTED
from .outcome import Outcome
from .problem import Problem

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


class Verdict(Enum):
    """What a result may be used for."""

    ACCEPTED = "accepted"
    DOUBTFUL = "doubtful"
    REFUSED = "refused"


@dataclass(frozen=True)
class Judgement:
    """A verdict with its reasons.

    Args:
        verdict: the worst of what was found.
        reasons: one sentence each; none where it is accepted.
    """

    verdict: Verdict
    reasons: tuple[str, ...] = ()

    @property
    def is_usable(self) -> bool:
        """True unless it is refused."""
        return self.verdict is not Verdict.REFUSED


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
    discrepancy_scale: float = 2.0
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


_Finding = tuple[Verdict, str]


def judge(
    problem: Problem, found: SolverResult, state: State, expected: Expectations, discrepancy_scale: float = 1.0
) -> Judgement:
    """The verdict on a solver's result.

    Args:
        problem: what was registered.
        found: where the solver ended.
        state: the body's state there.
        expected: what a usable result looks like.
        discrepancy_scale: how large the model's error was found, in units of its samples'.
    """
    findings = [
        *_of_the_search(found),
        *_of_the_cloud(problem, found, expected),
        *_of_the_fit(problem, found, expected),
        *_of_the_state(problem, state, expected),
        *_of_the_error(problem, found, expected, discrepancy_scale),
        *_of_the_pose(problem, found, expected),
        *_of_the_conditions(problem, found, expected),
        *_of_the_marks(problem, found),
        *_of_the_normals(problem, found),
    ]
    if not findings:
        return Judgement(Verdict.ACCEPTED)
    findings.sort(key=lambda finding: finding[0] is not Verdict.REFUSED)  # the gravest reasons first
    worst = findings[0][0]
    if found.outcome is Outcome.OUT_OF_TIME:  # whatever else is wrong may come of it
        findings.sort(key=lambda finding: finding[1] != _of_the_search(found)[0][1])
    return Judgement(worst, tuple(reason for _, reason in findings))


def _of_the_search(found: SolverResult) -> list[_Finding]:
    if found.outcome is Outcome.CONVERGED:
        return []
    return [(Verdict.DOUBTFUL, f"not converged: {found.outcome.value}; {found.outcome.advice}")]


def _of_the_cloud(problem: Problem, found: SolverResult, expected: Expectations) -> list[_Finding]:
    cloud, findings = problem.cloud, []
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False) / np.sqrt(len(cloud))
    if len(cloud) < _FEWEST_POINTS:
        findings.append(
            (Verdict.DOUBTFUL, f"the cloud has {len(cloud)} points; fewer than {_FEWEST_POINTS} tell little")
        )
    if len(cloud) < 3 or spread[1] < 0.02 * spread[0]:
        findings.append((Verdict.REFUSED, "the cloud is a line or a spot: it shows no surface"))
    if problem.forces.size and found.posterior.informed < expected.informed:
        findings.append(
            (Verdict.DOUBTFUL, f"the cloud tells {found.posterior.informed:.1f} directions of force: hardly anything")
        )
    return findings


def _of_the_fit(problem: Problem, found: SolverResult, expected: Expectations) -> list[_Finding]:
    match, findings = found.evaluation.match, list[_Finding]()
    by_patches = problem.shared_noise(found.evaluation)
    noise = float(np.hypot(found.posterior.scales.noise, np.sqrt(np.mean(by_patches**2))))
    if noise > expected.noise:
        verdict = Verdict.REFUSED if noise > 1.5 * expected.noise else Verdict.DOUBTFUL
        findings.append(
            (verdict, f"organ and cloud do not match: points lie {1e3 * noise:.1f} mm from the surface "
                      f"(up to {1e3 * expected.noise:.1f} mm could be noise)")
        )  # fmt: skip
    systematic = noise  # of which neighbours share a part
    if systematic > expected.systematic:
        systematic *= np.sqrt(shared(problem.observed.closest_points(match), match.distances, found.weights))
    if systematic > expected.systematic:
        verdict = Verdict.REFUSED if systematic > 2.0 * expected.systematic else Verdict.DOUBTFUL
        findings.append(
            (verdict, f"organ and cloud do not match: whole patches of the surface are {1e3 * systematic:.1f} mm off, "
                      f"which no noise of points explains (up to {1e3 * expected.systematic:.1f} mm is let pass)")
        )  # fmt: skip
    outliers = float(np.mean(~found.is_kept))
    if outliers > expected.outliers:
        findings.append((Verdict.DOUBTFUL, f"{100 * outliers:.0f} % of the points fit nowhere"))
    elif outliers > _MUCH and thickness(found.evaluation.cloud[~found.is_kept]) < _THIN:
        findings.append(
            (Verdict.DOUBTFUL, f"{100 * outliers:.0f} % of the points are a surface that is none of this organ's: "
                               "something else is in the cloud")
        )  # fmt: skip
    return findings


def _of_the_marks(problem: Problem, found: SolverResult) -> list[_Finding]:
    """Landmarks that lie far from where they were found: one was taken for another, or the state is another."""
    if problem.landmarks is None:
        return []
    off = np.linalg.norm(problem.landmark_residuals(found.evaluation).reshape(-1, 3), axis=1)
    if off.max() <= _MARK_OFF:
        return []
    away = 1e3 * problem.landmarks.deviation * off.max()
    return [(Verdict.DOUBTFUL, f"landmark {int(off.argmax())} lies {away:.1f} mm from where it was found")]


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


def _of_the_normals(problem: Problem, found: SolverResult) -> list[_Finding]:
    """Normals that are none of this surface's: of another frame, say, or columns of something else."""
    if problem.tangent_basis is None:
        return []
    known = np.abs(problem.tangent_basis).max(axis=(1, 2)) > 0.0
    leaning = (
        np.linalg.norm(problem.normal_residuals(found.evaluation).reshape(-1, 2)[known], axis=1)
        * problem.normal_deviation
    )
    median = float(np.rad2deg(np.arcsin(np.minimum(np.median(leaning), 1.0))))
    expected = float(np.rad2deg(np.sqrt(2.0 * np.log(2.0)) * problem.normal_deviation))  # Rayleigh's law
    if median <= _LEANING * expected:
        return []
    return [
        (Verdict.DOUBTFUL, f"the cloud's normals do not match: half of them lean by more than {median:.0f} degrees "
                           f"from the surface found, where {expected:.0f} were expected")
    ]  # fmt: skip


def _of_the_state(problem: Problem, state: State, expected: Expectations) -> list[_Finding]:
    findings = []
    movement = float(np.linalg.norm(state.displacement, axis=1).max())
    if movement > expected.movement and problem.forces.size:  # known loads may move it as far as they do
        findings.append(
            (Verdict.REFUSED, f"a node moved {1e3 * movement:.0f} mm; an organ of this size does not move more than "
                              f"{1e3 * expected.movement:.0f} mm")
        )  # fmt: skip
    if expected.gradient < np.inf:
        gradients = displacement_gradients(problem.observed.body, state.displacement)
        maximum = float(np.percentile(np.linalg.norm(gradients, ord=2, axis=(1, 2)), _NEARLY_ALL))
        if maximum > expected.gradient:
            findings.append(
                (Verdict.DOUBTFUL, f"parts of the organ turn or stretch by {100 * maximum:.0f} %; its law is linear, "
                                   f"which holds up to {100 * expected.gradient:.0f} %")
            )  # fmt: skip
    extrapolation_ratio = state.extrapolation_ratio
    if extrapolation_ratio is not None and extrapolation_ratio > expected.extrapolation_ratio:
        verdict = Verdict.REFUSED if extrapolation_ratio > 2.0 * expected.extrapolation_ratio else Verdict.DOUBTFUL
        findings.append(
            (verdict, f"the load is {extrapolation_ratio:.1f} times the largest that the surrogate has learned")
        )
    pivots = state.negative_pivots
    if pivots:
        findings.append((Verdict.DOUBTFUL, f"the state is unstable: {pivots} negative pivots of its tangent"))
    return findings


def _of_the_error(
    problem: Problem, found: SolverResult, expected: Expectations, discrepancy_scale: float
) -> list[_Finding]:
    """What no state explains goes into what the model gets wrong: more of that than was seen is none of it."""
    if discrepancy_scale <= expected.discrepancy_scale:
        return []
    correction = problem.correction(found.evaluation)[problem.observed.nodes]
    size = float(np.sqrt((correction**2).sum(axis=1).mean()))
    if size <= expected.correction:
        return []
    return [
        (Verdict.DOUBTFUL, f"the cloud asks for {discrepancy_scale:.1f} times what the model was seen to get wrong, "
                           f"{1e3 * size:.1f} mm: some of it shows no state of this organ, or the organ is not as it "
                           "was taken for")
    ]  # fmt: skip


def _of_the_pose(problem: Problem, found: SolverResult, expected: Expectations) -> list[_Finding]:
    if problem.pose is None:
        return []
    largest = float(np.abs(found.evaluation.coefficients[problem.pose_part]).max())
    if largest <= expected.pose:
        return []
    advice = "say --pose unknown" if problem.pose.is_said else "give a better start"
    return [(Verdict.DOUBTFUL, f"the pose lies {largest:.1f} deviations from where it was expected; {advice}")]


def _of_the_conditions(problem: Problem, found: SolverResult, expected: Expectations) -> list[_Finding]:
    """Unknowns far from where they were expected, and those that the cloud says nothing of.

    With unknown forces the latter is no fault: the prior of the stiffness is what the newtons are worth. Nor is it one
    of a contact, which only its place along the surface tells.
    """
    if problem.parameter_blocks is None:
        return []
    is_asked_for = not problem.forces.size and not problem.parameter_blocks.has_forces_alone
    part, findings = problem.parameter_part, list[_Finding]()
    for known in problem.parameter_blocks.estimates(
        found.evaluation.coefficients[part], found.posterior.covariance[part, part]
    ):
        if known.deviations > expected.parameter:
            findings.append(
                (Verdict.DOUBTFUL, f"{known.name} lies {known.deviations:.1f} deviations from where it was expected")
            )
    return findings + (_of_what_is_untold(problem, found, expected) if is_asked_for else [])


def _of_what_is_untold(problem: Problem, found: SolverResult, expected: Expectations) -> list[_Finding]:
    """Unknowns, and combinations of them, of which the cloud has left most of what was believed beforehand."""
    parameter_blocks, part = problem.parameter_blocks, problem.parameter_part
    assert parameter_blocks is not None
    covariance = found.posterior.covariance[part, part]
    names = [known.name for known in parameter_blocks.estimates(found.evaluation.coefficients[part], covariance)]
    if parameter_blocks.has_regions:
        names = [f"{name} of the rest" if name == "Young's modulus" else name for name in names]
    alone, combined = uninformed(parameter_blocks, names, covariance, expected.minimum_variance_reduction)
    given = "what is given is what was expected beforehand"
    same = "other values that differ so would explain it as well"
    return [
        *((Verdict.DOUBTFUL, f"the cloud does not tell {name} under this load: {given}") for name in alone),
        *((Verdict.DOUBTFUL, f"the cloud does not tell {names} under this load: {same}") for names in combined),
    ]
