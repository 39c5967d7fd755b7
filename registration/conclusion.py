"""What a registration says of where a strategy has ended: forces, state and pose with their doubt, and the verdict."""

from __future__ import annotations

from .checks import judge
from .pose import Pose
from .result import Moved, Registration
from .setup import Ended, Setup


def conclude(setup: Setup, ended: Ended, modulus_deviation: float, seconds: float) -> Registration:
    """The result.

    Args:
        setup: what was registered.
        ended: where the solver ended.
        modulus_deviation: of the logarithm of Young's modulus, where that is no unknown.
        seconds: that it took.
    """
    found, prepared = ended.found, ended.prepared
    problem, evaluation, posterior = found.local.problem, found.evaluation, found.posterior
    nodal = problem.nodal_forces(evaluation)
    total = nodal.sum(axis=0)
    left_out = evaluation.stiffness_scaling**2 * prepared.forces.left_out
    covariance = posterior.net_force_covariance(problem.net_forces(evaluation), left_out)
    covariance += modulus_deviation**2 * total[:, None] * total
    state = evaluation.state.full
    pose, pose_correction = _told_in(setup, evaluation.pose or Pose.identity())
    correction = problem.correction(evaluation)
    moved = setup.model.body.points + state.displacement + correction
    correction += pose_correction.apply(moved) - moved
    return Registration(
        Moved(state, correction, pose, pose_correction, nodal, total, covariance),
        found,
        judge(problem, found, state, setup.expectations),
        prepared,
        seconds,
    )


def _told_in(setup: Setup, pose: Pose) -> tuple[Pose, Pose]:
    """The pose that a result is told in, and what the one found is beside it: a motion of the body."""
    if setup.pose is None or not setup.pose.is_said:
        return pose, Pose.identity()
    return setup.pose.mean, pose.then(setup.pose.mean.inverse())
