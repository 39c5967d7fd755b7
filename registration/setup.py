"""All of a registration but the cloud: the model, what is unknown, what is believed; and the problems it makes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.clouds import check_cloud

from .cloud import Cloud
from .expectations import Expectations
from .forward import ForwardModel, ReducedModel, reduce_model
from .gauss_newton import GaussNewton, SolverResult
from .hyperparameters import LogNormalPrior
from .lbfgs import LBFGS
from .options import RegistrationOptions
from .outcome import Outcome
from .parameters.block import ParameterBlock
from .parameters.correlated_noise import CorrelatedNoise
from .parameters.discrepancy import ModelError
from .parameters.inputs import InputBlocks
from .parameters.nodal_forces import NodalForces
from .parameters.pose import PosePrior
from .policy import POLICY
from .prepared import Prepared
from .problem import Problem
from .residuals.normals import Normals
from .residuals.term import ResidualTerm
from .surface_distance import SurfaceDistance

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ended:
    """Where a strategy has ended.

    Args:
        prepared: the forces that were sought.
        found: the solver's result.
    """

    prepared: Prepared
    found: SolverResult


def after(first: SolverResult, second: SolverResult) -> SolverResult:
    """The second result, with what the first took."""
    return replace(second, evaluations=first.evaluations + second.evaluations, trace=(*first.trace, *second.trace))


@dataclass(frozen=True, eq=False)
class Setup:
    """What strategies work with.

    Args:
        model: forward model.
        observed: the observed side.
        forces: the unknown forces.
        options: noise, solver, thinning, search for the place of the forces.
        expectations: what a usable result looks like.
        noise: of the points, with the model's error as the least of it where that is not known in patterns.
        pose: prior of the pose; None for clouds in the body's coordinates.
        inputs: unknown inputs of the model beside the forces; None for none.
        blocks: further parameters.
        terms: what pulls beside the clouds.
        error: what the model gets wrong; None where it is not known in patterns.
        unlocalised: the forces, with the model that they are reduced with.
    """

    model: ForwardModel
    observed: SurfaceDistance
    forces: NodalForces
    options: RegistrationOptions
    expectations: Expectations
    noise: LogNormalPrior
    pose: PosePrior | None
    inputs: InputBlocks | None
    blocks: tuple[ParameterBlock, ...]
    terms: tuple[ResidualTerm, ...]
    error: ModelError | None
    unlocalised: Prepared
    _fast: list[tuple[ForwardModel, NodalForces, ReducedModel]] = field(default_factory=list, repr=False)

    @classmethod
    def of(
        cls,
        model: ForwardModel,
        observed: SurfaceDistance,
        forces: NodalForces,
        options: RegistrationOptions,
        *,
        expectations: Expectations | None = None,
        pose: PosePrior | None = None,
        inputs: InputBlocks | None = None,
        blocks: tuple[ParameterBlock, ...] = (),
    ) -> Setup:
        """The same, prepared: arguments as above.

        Raises:
            ValueError: inputs that the model does not take.
        """
        error = None if model.discrepancy is None else ModelError(model.discrepancy, observed)
        # Where it is not known what the model gets wrong, points tell no more than the model can meet.
        noise = options.noise.with_minimum(model.error)
        usual = expectations or Expectations.of(model, noise)
        unlocalised = Prepared.of(model, observed, forces, inputs)
        return cls(model, observed, forces, options, usual, noise, pose, inputs, blocks, (), error, unlocalised)

    @property
    def is_exact(self) -> bool:
        """Whether the model gets nothing wrong: each state of it costs much."""
        return self.model.error == 0.0

    def with_solver(self, **given: object) -> Setup:
        """The same with other values of the solver."""
        solver: GaussNewton | LBFGS = replace(self.options.solver, **given)  # type: ignore[arg-type]
        return replace(self, options=replace(self.options, solver=solver))

    def with_model(self, model: ForwardModel) -> Setup:
        """The same with another model of the same body."""
        other = Setup.of(
            model,
            self.observed,
            self.forces,
            self.options,
            expectations=self.expectations,
            pose=self.pose,
            inputs=self.inputs,
            blocks=self.blocks,
        )
        return replace(other, terms=self.terms)

    def prepared(self, forces: NodalForces) -> Prepared:
        """Other forces, with the model that they are reduced with."""
        return Prepared.of(self.model, self.observed, forces, self.inputs)

    def followed(self, last: Prepared) -> Prepared:
        """The forces of a frame before, with this model where another one was reduced with them."""
        return last if last.whole is self.model else self.prepared(last.forces)

    def reduced(self, fast: ForwardModel, forces: NodalForces) -> ReducedModel:
        """A faster model between forces and the observed nodes; that of the last forces is kept."""
        if not self._fast or self._fast[0][0] is not fast or self._fast[0][1] is not forces:
            self._fast[:] = [(fast, forces, reduce_model(fast, self.observed.nodes, forces.basis))]
        return self._fast[0][2]

    # ------------------------------------------------------------------ clouds and problems

    def checked(self, cloud: ArrayLike) -> Cloud:
        """A cloud's points, thinned.

        Raises:
            CloudError: a cloud without one point of finite coordinates, or one that lies too far from the body.
        """
        given = Cloud.of(cloud)
        if given.is_finite:
            given = given.thinned(self.options.maximum_points).distinct()
            if self.pose is not None:
                check_cloud(self.pose.mean.inverse().apply(given.points), self.model.body)
                return given
        check_cloud(given.points, self.model.body)
        return given

    def plain(self, points: Cloud, prepared: Prepared) -> Problem:
        """The problem with the model's error as the least noise."""
        return self._posed(points, prepared, self.noise)

    def problem(self, points: Cloud, prepared: Prepared, positions: Floats, rms_distance: float) -> Problem:
        """The problem with the model's error in patterns, of the size that belongs to a movement.

        Args:
            points: of the cloud.
            prepared: forces.
            positions: displacement of the observed nodes found so far, (m, 3), metres.
            rms_distance: of the cloud to the surface there, metres.
        """
        if self.error is None:
            return self.plain(points, prepared)
        moved = float(np.linalg.norm(positions, axis=1).max() + rms_distance)
        return self._posed(points, prepared, self.options.noise, self.error.with_amplitude(moved))

    def _posed(
        self, points: Cloud, prepared: Prepared, noise: LogNormalPrior, error: ModelError | None = None
    ) -> Problem:
        """The problem of a cloud: all blocks of parameters, and all that pulls."""
        shared = CorrelatedNoise(self.observed.modes) if self.options.correlated else None
        blocks = (prepared.forces, self.pose, self.inputs, error, *self.blocks, shared)
        basis = points.tangent_basis
        normals = None if basis is None else Normals(basis, self.options.normal_deviation)
        return Problem.of(prepared.model, self.observed, points.points, noise, blocks, (*self.terms, normals))

    # ------------------------------------------------------------------ whether to go on

    @property
    def is_late(self) -> bool:
        """Whether the time for a frame is over."""
        return time.monotonic() >= self.options.solver.until

    def is_hopeless(self, found: SolverResult) -> bool:
        """Whether what was found is so far off that it is no state of this organ."""
        if found.outcome is Outcome.OUT_OF_TIME:  # who knows
            return False
        return found.local.noise > POLICY.excess * self.expectations.noise
