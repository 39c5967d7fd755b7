"""What a registered cloud says: the state with its forces, their doubt, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .evaluation import Evaluation
from .forward import State
from .gauss_newton import IterationRecord
from .local_model import LocalModel
from .loss import REJECTED
from .options import NOISE
from .outcome import Outcome
from .parameters.block import Estimate
from .pose import Pose
from .posterior import Posterior
from .prepared import Prepared
from .problem import Problem
from .uncertainty import CoordinateFrame, Uncertainty, uncertainty
from .verdict import Check, Judgement, Verdict

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Registration:
    """One registered cloud.

    Args:
        prepared: the forces' basis that its coefficients belong to.
        evaluation: where the solver ended; the next frame starts there.
        forces: nodal forces, (n, 3), newtons.
        state: the body's state as the model has it, with its derivatives.
        correction: what the cloud asks for beside it within what the model is known to get wrong, (n, 3), metres; with
            it what a pose that was said to be known is off by.
        discrepancy_scale: factor found of the discrepancy's prior standard deviation; 1 where none is known.
        pose: from the body's coordinates to the cloud's.
        pose_correction: what a pose that was said to be known is off by: a motion in the body's coordinates.
        net_force: (3,), newtons.
        net_force_covariance: given the noise found and the prior, (3, 3), newtons^2.
        noise: standard deviation of a point's distance that was found, metres.
        force_scale: standard deviation of the force coefficients that was found, newtons.
        rms_distance: of the cloud to the registered surface, metres, without the outliers.
        outliers: share of the points that pulled nothing: no other figure of the fit counts them.
        informed: number of likelihood-informed directions of force and pose.
        points: points that were used, after thinning.
        outcome: how the solver ended.
        judgement: whether the result can be used, and why not.
        evaluations: forward solves.
        seconds: wall time.
        trace: one entry an iteration.
        problem: what was solved, for the cloud and the model's error as they were taken in the end.
        posterior: of the coefficients.
        local: the objective's model there; None for a result that was put together otherwise.
        draft: what a faster model had found, where this one went on from there.
    """

    prepared: Prepared
    evaluation: Evaluation
    forces: Floats
    state: State
    correction: Floats
    discrepancy_scale: float
    pose: Pose
    pose_correction: Pose
    net_force: Floats
    net_force_covariance: Floats
    noise: float
    force_scale: float
    rms_distance: float
    outliers: float
    informed: float
    points: int
    outcome: Outcome
    judgement: Judgement
    evaluations: int
    seconds: float
    trace: tuple[IterationRecord, ...]
    problem: Problem
    posterior: Posterior
    local: LocalModel | None = None
    draft: Registration | None = None

    def with_check(self, check: Check) -> Registration:
        """The same with a check more; what is refused stays so."""
        return replace(self, judgement=self.judgement.with_check(check))

    @property
    def coefficients(self) -> Floats:
        """Of forces, pose, conditions and model error, (k,)."""
        return self.evaluation.coefficients

    @property
    def eta(self) -> Floats | None:
        """Logarithms of the hyperparameters found, (5,); None for a result that was put together otherwise."""
        return None if self.local is None else self.local.eta

    @property
    def shared_noise(self) -> tuple[float, float] | None:
        """Size and length of the noise that neighbours share, metres; None where it is less than any camera's."""
        if self.local is None or self.problem.shared is None or self.local.scales.shared < NOISE.minimum:
            return None
        return self.local.scales.shared, self.local.scales.length

    @cached_property
    def scatter(self) -> float:
        """Standard deviation of a point's distance with what neighbours share of its noise, metres."""
        return float(np.sqrt(self.noise**2 + np.mean(self.problem.shared_noise(self.evaluation) ** 2)))

    @property
    def unknown_forces(self) -> Floats:
        """Nodal forces of the basis, (n, 3), without those of conditions: newtons on a body as stiff as expected."""
        return self.prepared.forces.forces(self.coefficients[self.problem.force_part])

    @property
    def displacement(self) -> Floats:
        """Of all nodes, (n, 3), metres, in the body's coordinates: the state's with the correction."""
        return self.state.displacement + self.correction

    @property
    def net_force_deviation(self) -> Floats:
        """Standard deviation of each component of the net force, (3,), newtons."""
        return np.sqrt(np.diag(self.net_force_covariance))

    @cached_property
    def estimates(self) -> tuple[Estimate, ...]:
        """What is known of stiffness and other unknowns beside the forces; none where there are none."""
        known = self.problem.known(self.evaluation, self.posterior)
        return tuple(each for block, own in known for each in block.estimates(own.mean, own.covariance))

    @cached_property
    def chance_of_pose(self) -> float:
        """Chance that a pose which is just as expected seems so far from it; 1 where none is unknown.

        The distance between the two in the posterior's deviations, against chi-square's law.
        """
        part = self.problem.pose_part
        off, covariance = self.coefficients[part], self.posterior.covariance[part, part]
        return float(chi2.sf(off @ np.linalg.solve(covariance, off), len(off))) if len(off) else 1.0

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
        covariance = self.posterior.net_force_covariance(slopes, problem.forces.left_out / modulus**2)
        return self.net_force / modulus, np.sqrt(np.diag(covariance))

    @property
    def left_out(self) -> int:
        """Number of the points that pulled nothing."""
        return round(self.outliers * self.points)

    @property
    def explained(self) -> Floats:
        """The points used without these, (q, 3), metres, in the coordinates in which positions are told."""
        points, local = self.problem.cloud, self.local
        kept = points if local is None else points[local.weights >= REJECTED]
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
        patterns are known. Wrong stiffness, attachment or shape of the body are not among them.
        """
        if self.frame == "camera":
            return self.camera_uncertainty.turned(self.pose.rotation.T)
        return uncertainty(self.problem, self.evaluation, self.posterior, self.prepared.unseen)

    @cached_property
    def camera_uncertainty(self) -> Uncertainty:
        """The same of where the camera sees each point, `pose.apply(x + displacement)`, on the camera's axes.

        Where the pose is unknown it may be far less than `uncertainty`: a cloud that does not tell a turn of the organ
        from forces that bend it as far shows all the same where its points are.
        """
        if self.problem.pose is None:  # the cloud was brought to the body by a pose that is exact
            return self.uncertainty.turned(self.pose.rotation)
        return uncertainty(self.problem, self.evaluation, self.posterior, self.prepared.unseen, "camera")


def badness(result: Registration) -> tuple[int, float]:
    """By which results for one cloud are ordered, the best first."""
    return list(Verdict).index(result.judgement.verdict), result.scatter
