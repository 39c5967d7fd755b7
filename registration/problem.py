"""One cloud, one model, the parameters: residuals and their derivative as a function of all coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray

from .evaluation import Evaluation, Slopes
from .evidence import Hyperprior, Variances
from .forward import ParametrisedModel, ReducedModel, ReducedState
from .hyperparameters import DISCREPANCY, NOISE, LogNormalPrior
from .parameters.block import ParameterBlock
from .parameters.correlated_noise import CorrelatedNoise
from .parameters.discrepancy import ModelError
from .parameters.stack import ParameterStack
from .policy import ACCURACY, POLICY
from .residuals.term import ResidualTerm
from .surface_distance import SurfaceDistance, expected_distance

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Problem(ParameterStack):
    """What parameters bring the observed side to a cloud.

    Args:
        blocks: the parameters.
        model: reduced forward model between the force coefficients and the observed nodes.
        observed: the observed side.
        cloud: points, (p, 3), metres.
        noise: what is believed of the standard deviation of a point's distance, metres.
        terms: what pulls beside the cloud's distances.
    """

    model: ReducedModel
    observed: SurfaceDistance
    cloud: Floats
    noise: LogNormalPrior
    terms: tuple[ResidualTerm, ...] = ()

    @classmethod
    def of(
        cls,
        model: ReducedModel,
        observed: SurfaceDistance,
        cloud: Floats,
        noise: LogNormalPrior,
        blocks: Sequence[ParameterBlock | None],
        terms: Sequence[ResidualTerm | None] = (),
    ) -> Problem:
        """The problem of the blocks and terms that there are, in the order in which coefficients are kept.

        Args:
            model: reduced forward model.
            observed: the observed side.
            cloud: points, (p, 3), metres.
            noise: what is believed of the standard deviation of a point's distance, metres.
            blocks: the parameters, None for those that are none here; what a model's error leaves out comes with it.
            terms: what pulls beside the cloud's distances, None as above.
        """
        given = [block for block in blocks if block is not None]
        given += [block.remainder for block in given if isinstance(block, ModelError)]
        ordered = sorted(given, key=lambda block: (not block.is_moving, isinstance(block, CorrelatedNoise)))
        pulling = tuple(term for term in terms if term is not None)
        return cls(tuple(ordered), model, observed, cloud, noise, pulling)

    # ------------------------------------------------------------------ what is believed beforehand

    @cached_property
    def hyperprior(self) -> Hyperprior:
        """What is believed of the hyperparameters, in their order."""
        one, none = LogNormalPrior(1.0, 0.0), LogNormalPrior(POLICY.shared_size, 0.0)
        priors = [self.noise, one, none, one, one]
        for block in self.blocks:
            for place, prior in block.hyperpriors(self.observed).items():
                priors[place] = prior
        return Hyperprior.of(priors)

    def noise_variances(self, local_error: Floats) -> Variances:
        """Of points beside which the model's error changes from one to the next.

        Args:
            local_error: standard deviation of a distance by that, (g,), metres; see `local_error`.
        """

        def found(eta: Floats) -> tuple[Floats, Floats]:
            own, beside = np.exp(2.0 * eta[NOISE]), np.exp(2.0 * eta[DISCREPANCY]) * local_error**2
            slopes = np.zeros((len(eta), len(local_error)))
            slopes[NOISE], slopes[DISCREPANCY] = 2.0 * own / (own + beside), 2.0 * beside / (own + beside)
            return np.log(own + beside), slopes

        return found

    # ------------------------------------------------------------------ trials

    def evaluation(self, coefficients: Floats, near: Evaluation | None = None) -> Evaluation:
        """The problem at some coefficients.

        Args:
            coefficients: (k,).
            near: a trial to start the model from, of this cloud or of another.

        Raises:
            NotConverged: the model found no state.
        """
        state, scaling = self._state(coefficients, None if near is None else near.state)
        positions = state.positions
        for block, part in self.parts:
            added = block.added(coefficients[part])
            if added is not None:
                positions = positions + added
        pose = None if self.pose is None else self.pose.pose(coefficients[self.pose_part])
        cloud = self.cloud if pose is None else pose.inverse().apply(self.cloud)
        known = None if near is None or near.given is not self.cloud else near.match
        match = self.observed.match(positions, cloud, known)
        return Evaluation(coefficients, self.observed, state, positions, pose, self.cloud, cloud, match, scaling)

    def _state(self, coefficients: Floats, near: ReducedState | None) -> tuple[ReducedState, float]:
        """The model's state, and by what factor it has scaled the forces."""
        forces = coefficients[self.force_part]
        if self.inputs is None:
            return self.model.solve(forces, near), 1.0
        own = coefficients[self.input_part]
        state = cast(ParametrisedModel, self.model).solve(forces, near, own)
        return state, self.inputs.stiffness_scaling(own)[0]

    def correction(self, evaluation: Evaluation) -> Floats:
        """What blocks add to the displacement of all nodes beside the state, (n, 3), metres."""
        found = np.zeros_like(self.observed.body.points)
        for block, part in self.parts:
            field = block.field(evaluation.coefficients[part])
            if field is not None:
                found += field
        return found

    # ------------------------------------------------------------------ residuals

    def residuals(self, evaluation: Evaluation, noise: float) -> Floats:
        """Distances less what they are in the mean for points of some noise, and what blocks explain, (p,), metres.

        Args:
            evaluation: at some coefficients.
            noise: standard deviation of each coordinate of a point, metres.
        """
        return evaluation.once((self, noise), lambda: self._residuals(evaluation, noise))

    def _residuals(self, evaluation: Evaluation, noise: float) -> Floats:
        curvature = evaluation.once("curvature", lambda: self.observed.curvature(evaluation.match))
        unexplained = evaluation.once(self, lambda: self._unexplained(evaluation))
        return unexplained - expected_distance(curvature, noise)

    def _unexplained(self, evaluation: Evaluation) -> Floats:
        found = evaluation.match.distances
        for block, part in reversed(self.parts):
            explained = block.explained(evaluation, evaluation.coefficients[part])
            if explained is not None:
                found = found - explained
        return found

    def shared_noise(self, evaluation: Evaluation) -> Floats:
        """The part of the distances that is taken for noise that neighbours share, (p,), metres."""
        if self.shared is None:
            return np.zeros(len(self.cloud))
        return self.shared.explained(evaluation, evaluation.coefficients[self.part(CorrelatedNoise)])

    def local_error(self, evaluation: Evaluation) -> Floats:
        """Standard deviation of each distance by what the model gets wrong from point to point, (p,), metres."""
        return np.zeros(len(self.cloud)) if self.error is None else self.error.remainder.local_error(evaluation)

    def slopes(self, evaluation: Evaluation) -> Slopes:
        """How the distances follow from what moves, and from what explains them."""
        match = evaluation.match
        return Slopes(self.observed.rows(match), match.directions, evaluation.cloud, match=match)

    def jacobian(self, evaluation: Evaluation, slopes: Slopes | None = None) -> Floats:
        """Derivative of residuals by the coefficients, (q, k), exact.

        Args:
            evaluation: at some coefficients.
            slopes: of the residuals of a term; of the distances, (p, k), if not given.
        """
        slopes = self.slopes(evaluation) if slopes is None else slopes
        return np.hstack(
            [block.jacobian(evaluation, evaluation.coefficients[part], slopes) for block, part in self.parts]
        )

    def vjp(self, evaluation: Evaluation, cotangent: Floats, slopes: Slopes | None = None) -> Floats:
        """Gradient by the coefficients, (k,), from the one by the residuals, (q,): J^T g with the adjoint."""
        slopes = self.slopes(evaluation) if slopes is None else slopes
        return np.concatenate(
            [block.vjp(evaluation, evaluation.coefficients[part], slopes, cotangent) for block, part in self.parts]
        )

    # ------------------------------------------------------------------ steps, forces

    def moved(self, evaluation: Evaluation, change: Floats) -> Floats:
        """How far some hundred nodes, spread over those observed, move for a change, first order, (m,), metres."""
        every = max(1, len(self.observed.nodes) // ACCURACY.watched)
        shifts = [block.moved(evaluation, change[part], every) for block, part in self.parts]
        shifted = np.asarray(sum(shift for shift in shifts if shift is not None))
        return np.sqrt(np.einsum("pi,pi->p", shifted, shifted))

    def is_too_far(self, change: Floats) -> bool:
        """Whether a change of the coefficients is more than one step may make, however little it moves."""
        return any(block.is_too_far(change[part]) for block, part in self.parts)

    def nodal_forces(self, evaluation: Evaluation) -> Floats:
        """All that is unknown of the nodal forces, (n, 3), newtons."""
        found = evaluation.stiffness_scaling * self.forces.forces(evaluation.coefficients[self.force_part])
        return found if self.inputs is None else found + self.inputs.forces(self._of_inputs(evaluation))

    def _of_inputs(self, evaluation: Evaluation) -> Floats:
        return evaluation.coefficients[self.input_part]

    def net_forces(self, evaluation: Evaluation) -> Floats:
        """Derivative of their net force by the coefficients, (3, k), newtons."""
        whole = np.zeros((3, self.size))
        whole[:, self.force_part] = evaluation.stiffness_scaling * self.forces.net_basis
        if self.inputs is not None:
            own = self._of_inputs(evaluation)
            net = self.forces.net_basis @ evaluation.coefficients[self.force_part]
            slopes = self.inputs.stiffness_scaling(own)[1]
            whole[:, self.input_part] = self.inputs.net_forces(own) + net[:, None] * slopes
        return whole
