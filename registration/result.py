"""What a registered cloud says: the state with its forces, their doubt, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from .evaluation import Evaluation
from .forward import State
from .gauss_newton import IterationRecord, SolverResult
from .linear_law import linear_law_error
from .local_model import LocalModel
from .outcome import Outcome
from .parameters.block import Estimate
from .policy import POLICY
from .pose import Pose
from .posterior import Posterior
from .prepared import Prepared
from .problem import Problem
from .uncertainty import CoordinateFrame, Uncertainty, uncertainty
from .verdict import Check, Judgement, Verdict

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Moved:
    """How the organ has moved, and by which forces.

    Args:
        state: the body's state as the model has it, with its derivatives.
        correction: what the cloud asks for beside it within what the model is known to get wrong, (n, 3), metres; with
            it what a pose that was said to be known is off by.
        pose: from the body's coordinates to the cloud's.
        pose_correction: what a pose that was said to be known is off by: a motion in the body's coordinates.
        forces: nodal forces, (n, 3), newtons.
        net_force: (3,), newtons.
        net_force_covariance: given the noise found and the prior, (3, 3), newtons^2.
    """

    state: State
    correction: Floats
    pose: Pose
    pose_correction: Pose
    forces: Floats
    net_force: Floats
    net_force_covariance: Floats


@dataclass(frozen=True, eq=False)
class Registration:
    """One registered cloud: the state, its posterior, the verdict, and how it came about.

    Args:
        moved: how the organ has moved.
        solved: where the solver ended, with the posterior; the next frame starts there.
        judgement: whether the result can be used, and why not.
        prepared: the forces' basis that its coefficients belong to.
        seconds: wall time.
        draft: what a faster model had found, where this one went on from there.
    """

    moved: Moved
    solved: SolverResult
    judgement: Judgement
    prepared: Prepared
    seconds: float
    draft: Registration | None = None

    def with_check(self, check: Check) -> Registration:
        """The same with a check more; what is refused stays so."""
        return replace(self, judgement=self.judgement.with_check(check))

    def seen_from(self, pose: Pose) -> Registration:
        """The same of a cloud that was brought to the body by a pose which is exact."""
        return replace(self, moved=replace(self.moved, pose=pose))

    @property
    def state(self) -> State:
        """The body's state as the model has it; see `Moved`."""
        return self.moved.state

    @property
    def correction(self) -> Floats:
        """What the cloud asks for beside it, (n, 3), metres; see `Moved`."""
        return self.moved.correction

    @property
    def displacement(self) -> Floats:
        """Of all nodes, (n, 3), metres, in the body's coordinates: the state's with the correction."""
        return self.state.displacement + self.correction

    @property
    def pose(self) -> Pose:
        """From the body's coordinates to the cloud's."""
        return self.moved.pose

    @property
    def pose_correction(self) -> Pose:
        """What a pose that was said to be known is off by."""
        return self.moved.pose_correction

    @property
    def forces(self) -> Floats:
        """Nodal forces, (n, 3), newtons."""
        return self.moved.forces

    @property
    def unknown_forces(self) -> Floats:
        """Nodal forces of the basis, (n, 3), without those of inputs: newtons on a body as stiff as expected."""
        return self.prepared.forces.forces(self.coefficients[self.problem.force_part])

    @property
    def net_force(self) -> Floats:
        """(3,), newtons."""
        return self.moved.net_force

    @property
    def net_force_covariance(self) -> Floats:
        """Given the noise found and the prior, (3, 3), newtons^2."""
        return self.moved.net_force_covariance

    @property
    def net_force_deviation(self) -> Floats:
        """Standard deviation of each component of the net force, (3,), newtons."""
        return np.sqrt(np.diag(self.net_force_covariance))

    @property
    def problem(self) -> Problem:
        """What was solved, for the cloud and the model's error as they were taken in the end."""
        return self.solved.local.problem

    @property
    def local(self) -> LocalModel:
        """The objective's model there."""
        return self.solved.local

    @property
    def evaluation(self) -> Evaluation:
        """The problem at the coefficients found."""
        return self.solved.evaluation

    @property
    def posterior(self) -> Posterior:
        """Of the coefficients."""
        return self.solved.posterior

    @property
    def coefficients(self) -> Floats:
        """Of all parameter blocks, (k,)."""
        return self.posterior.mean

    @property
    def eta(self) -> Floats:
        """Logarithms of the hyperparameters found, (5,)."""
        return self.local.eta

    @property
    def noise(self) -> float:
        """Standard deviation of a point's distance that was found, metres."""
        return self.posterior.scales.noise

    @property
    def force_scale(self) -> float:
        """Standard deviation of the force coefficients that was found, newtons."""
        return self.posterior.scales.force

    @property
    def discrepancy_scale(self) -> float:
        """Factor found of the discrepancy's prior standard deviation; 1 where none is known."""
        return self.posterior.scales.discrepancy

    @property
    def informed(self) -> float:
        """Number of likelihood-informed directions of all that is unknown: forces, pose, inputs, error patterns."""
        return self.posterior.informed

    @property
    def rms_distance(self) -> float:
        """Root mean square distance of the cloud to the registered surface, metres, without the outliers."""
        return self.solved.rms_distance

    @property
    def points(self) -> int:
        """Points that were used, after thinning."""
        return len(self.problem.cloud)

    @property
    def outliers(self) -> float:
        """Share of the points that pulled nothing: no other figure of the fit counts them."""
        return float(np.mean(~self.solved.is_kept))

    @property
    def outcome(self) -> Outcome:
        """How the solver ended."""
        return self.solved.outcome

    @property
    def evaluations(self) -> int:
        """Forward solves."""
        return self.solved.evaluations

    @property
    def trace(self) -> tuple[IterationRecord, ...]:
        """One entry an iteration."""
        return self.solved.trace

    @property
    def shared_noise(self) -> tuple[float, float] | None:
        """Size and length of the noise that neighbours share, metres; None where it is less than any camera's."""
        scales = self.posterior.scales
        if self.problem.shared is None or scales.shared < POLICY.noise_minimum:
            return None
        return scales.shared, scales.length

    @property
    def shared_noise_dominates(self) -> bool:
        """Whether neighbouring points share more noise than each has alone."""
        return self.shared_noise is not None and self.shared_noise[0] > self.noise

    @cached_property
    def scatter(self) -> float:
        """Standard deviation of a point's distance with what neighbours share of its noise, metres."""
        return float(np.sqrt(self.noise**2 + np.mean(self.problem.shared_noise(self.evaluation) ** 2)))

    @cached_property
    def estimates(self) -> tuple[Estimate, ...]:
        """What is known of stiffness and other unknowns beside the forces; none where there are none."""
        found, covariance, parts = self.coefficients, self.posterior.covariance, self.problem.parts
        return tuple(each for block, part in parts for each in block.estimates(found[part], covariance[part, part]))

    @cached_property
    def chance_of_pose(self) -> float:
        """Chance that a pose which is just as expected seems so far from it; 1 where none is unknown.

        The distance between the two in the posterior's deviations, against chi-square's law.
        """
        part = self.problem.pose_part
        off, covariance = self.coefficients[part], self.posterior.covariance[part, part]
        return float(chdtrc(len(off), off @ np.linalg.solve(covariance, off))) if len(off) else 1.0

    @cached_property
    def force_over_modulus(self) -> tuple[Floats, Floats] | None:
        """Net force over Young's modulus, (3,), square metres, and its standard deviation, (3,).

        It is all that a state under nodal forces and fixed supports depends on. None where the modulus is no unknown.
        """
        inputs, problem = self.problem.inputs, self.problem
        unknown = None if inputs is None else inputs.modulus
        if inputs is None or unknown is None:
            return None
        place, deviation = problem.input_part.start + unknown[0], unknown[1]
        modulus = float(np.mean(inputs.inputs(self.coefficients[problem.input_part]).parameters["young_modulus"]))
        slopes = problem.net_forces(self.evaluation) / modulus
        slopes[:, place] -= deviation * self.net_force / modulus
        left_out = (self.evaluation.stiffness_scaling / modulus) ** 2 * problem.forces.left_out
        covariance = self.posterior.net_force_covariance(slopes, left_out)
        return self.net_force / modulus, np.sqrt(np.diag(covariance))

    @property
    def left_out(self) -> int:
        """Number of the points that pulled nothing."""
        return round(self.outliers * self.points)

    @property
    def explained(self) -> Floats:
        """The points used without these, (q, 3), metres, in the coordinates in which positions are told."""
        kept = self.problem.cloud[self.solved.is_kept]
        return kept if self.problem.pose is None else self.pose.inverse().apply(kept)

    @property
    def has_free_pose(self) -> bool:
        """Whether a pose was found that nobody said to be known: positions in the two frames differ by it."""
        return self.problem.pose is not None and not self.problem.pose.is_said

    @property
    def frame(self) -> CoordinateFrame:
        """In which the displacement is told: the body's, or the camera's where the pose was said to be known.

        In the latter what the pose is off by counts as displacement, and `pose` is the one that was said.
        """
        return "camera" if self.problem.pose is not None and self.problem.pose.is_said else "body"

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """How far each point may be from where it is told, `x + displacement`; computed when it is first asked for.

        It holds for what the problem reckons with: noise, forces like those expected, the model's error where its
        patterns are known, what a linear law leaves out. Wrong stiffness, attachment or shape of the body are not among
        them.
        """
        return self.camera_uncertainty.turned(self.pose.rotation.T) if self.frame == "camera" else self._known("body")

    @cached_property
    def camera_uncertainty(self) -> Uncertainty:
        """The same of where the camera sees each point, `pose.apply(x + displacement)`, on the camera's axes.

        Where the pose is unknown it may be far less than `uncertainty`: a cloud that does not tell a turn of the organ
        from forces that bend it as far shows all the same where its points are.
        """
        if self.problem.pose is None:  # the cloud was brought to the body by a pose that is exact
            return self.uncertainty.turned(self.pose.rotation)
        return self._known("camera")

    def _known(self, frame: CoordinateFrame) -> Uncertainty:
        is_linear = getattr(self.prepared.whole, "is_linear", False)
        law_error = linear_law_error(self.problem.observed.body, self.state.displacement) if is_linear else 0.0
        return uncertainty(self.problem, self.evaluation, self.posterior, self.prepared.unseen, frame, law_error)


def badness(result: Registration) -> tuple[int, float]:
    """By which results for one cloud are ordered, the best first."""
    return list(Verdict).index(result.judgement.verdict), result.scatter
