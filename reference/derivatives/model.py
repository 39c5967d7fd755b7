"""The reference as a forward model for registration: forces to a state, which carries its own exact derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

from ..data.discrepancy import Discrepancy
from ..data.inputs import Change, Inputs
from ..data.loading import Loading, checked_array
from ..data.materials import Material, with_parameters
from ..data.outcome import Equilibrium
from ..solve.predictor import Adviser, Predictor, check_predictor, knows_material
from ..solve.problem import Problem
from .linearisation import Linearisation

Floats = NDArray[np.float64]


class Start(Protocol):
    """Any forward model's state, as far as a search starts from it."""

    @property
    def displacement(self) -> Floats:
        """Of the nodes, (n, 3), metres."""


class ReferenceModel:
    """Forces to equilibrium by finite elements, from where a network says if there is one (hybrid Newton).

    It remembers no state: what a solve found is the value that it returns. Of a predictor it remembers how long it has
    been of no use, and asks it the more seldom. Where it is asked for other parameters than its problem's, the problem
    is left with those of the last call.

    Args:
        problem: body, material and options; stays owned by the caller.
        patient: try every other way where the state to start from is too far; False refuses at once, for a search that
            can shorten its step.
        loading: what acts beside the nodal forces at all times (weight, pressures, prescribed displacements).
        predictor: proposes where to start when no neighbour is given. Its proposal is weighed against the warped linear
            response, Newton's method goes on from the better one to the same tolerance, and a state that is no minimum
            is not taken: a poor network costs the time of its prediction and changes nothing (after Odot 2023,
            algorithm 5, which compares residuals). It is not asked while the problem has been given another material
            than it has learned (`Problem.set_material`), as it is not where other `inputs` are given.
        discrepancy: what is not known of the organ, as patterns that the model may be wrong by (see `alternatives`).

    Raises:
        ValueError: a predictor of another body or material.
    """

    def __init__(
        self,
        problem: Problem,
        patient: bool = True,
        loading: Loading | None = None,
        predictor: Predictor | None = None,
        discrepancy: Discrepancy | None = None,
    ) -> None:
        self.discrepancy = discrepancy
        self.problem, self.patient, self.loading = problem, patient, loading or Loading()
        if predictor is not None:
            check_predictor(predictor, problem)
        self._adviser = None if predictor is None else Adviser(predictor)
        self._own, self._knows_own = problem.material, True
        self._lent: tuple[Inputs, Material] | None = None  # what the problem has been given in place of its own

    @property
    def body(self) -> Body:
        """The body that deforms."""
        return self.problem.body

    @property
    def error(self) -> float:
        """0: it is what others are measured by."""
        return 0.0

    @property
    def is_linear(self) -> bool:
        """Whether the law is linear: it holds where nothing turns or stretches much."""
        return self.problem.material.is_linear

    def solve(self, forces: ArrayLike, near: Start | None = None, inputs: Inputs | None = None) -> ReferenceState:
        """The state under nodal forces, (n, 3) newtons.

        Args:
            forces: nodal forces.
            near: a state to start from. The neighbour of one of this model's is wanted: it is first moved along its
                tangent by the change of the forces. Another model's is a proposal, which is weighed against the
                warped linear response. If not given, the predictor's proposal, or that response alone.
            inputs: parameters and prescribed displacements in place of the problem's own; no predictor is asked then.

        Raises:
            ValueError: parameters or node sets that the problem does not have.
            NotConverged: no equilibrium was found; states that were found before stay as they are.
        """
        given = checked_array("ReferenceModel.forces", forces, self.body.points.shape).copy()
        given.flags.writeable = False
        others = [self.loading.forces, None if inputs is None else inputs.forces]
        whole = sum((np.asarray(other) for other in others if other is not None), start=given)
        load = replace(self.loading, forces=whole)
        if inputs is not None:
            load = replace(load, displacement={**load.displacement, **inputs.displacement})
        self._take(inputs)
        guess = near.equilibrium if isinstance(near, ReferenceState) else None
        proposal: Any = None
        if near is not None and guess is None:
            proposal = near.displacement
        adviser = self._adviser if near is None and inputs is None and self._knows_own else None
        if adviser is not None:
            proposal = adviser.proposal(given)
        found = self.problem.solve(
            load, guess, proposal=proposal, stability=False, fallback=self.patient or guess is None
        )
        if adviser is not None and proposal is not None:
            adviser.learn(found.start == "proposal")
        springs = {} if inputs is None else inputs.springs
        return ReferenceState(given, found, self, self.problem.material, self._own, springs)

    def _take(self, inputs: Inputs | None) -> None:
        """Give the problem the parameters that are asked for, or its own ones back."""
        self._look()
        if inputs is None:
            if self._lent is not None:
                self._give(Inputs(), self._own)
                self._lent = None
            return
        unknown = inputs.parameters.keys() - self._own.parameters.keys()
        if unknown:
            raise ValueError(
                f"ReferenceModel.inputs: expected parameters among {sorted(self._own.parameters)}, "
                f"got {sorted(unknown)}."
            )
        if self._lent is None or not inputs.has_same_parameters(self._lent[0]):
            self._lend(inputs, with_parameters(self._own, inputs.parameters))

    def _look(self) -> None:
        """What the problem has been given by somebody else is its own."""
        here = self.problem.material
        if self._lent is not None and here is self._lent[1]:
            return
        if here is not self._own:
            self._knows_own = self._adviser is None or knows_material(self._adviser.predictor, here)
        self._own, self._lent = here, None

    def _lend(self, inputs: Inputs, material: Material) -> None:
        self._give(inputs, material)
        self._lent = inputs, material

    def _give(self, inputs: Inputs, material: Material) -> None:
        before = {} if self._lent is None else self._lent[0].springs
        if inputs.springs != before:
            self.problem.set_springs(inputs.springs)
        self.problem.set_material(material)

    def take_again(self, material: Material, own: Material, springs: Mapping[str, float]) -> None:
        """Give the problem back what one of this model's states was found with.

        Args:
            material: the state's.
            springs: factors of its springs.
            own: the problem's own at that time.

        Raises:
            RuntimeError: the problem has been given another one by somebody else since.
        """
        self._look()
        if own is not self._own:
            raise RuntimeError(
                f"ReferenceState: expected the material that it was found with, {own!r}, "
                f"got {self._own!r}; solve again after set_material."
            )
        if self.problem.material is not material:
            self._lend(Inputs(material.parameters, springs=springs), material)


@dataclass(frozen=True, eq=False)
class ReferenceState:
    """An equilibrium with its derivatives, which share one factorisation.

    The problem keeps the factorisation of one state: two states used by turns are right, and factored by turns.

    Args:
        forces: nodal forces in balance, (n, 3), newtons.
        equilibrium: what they led to.
        model: where it was found.
        material: that the body had then.
        own: the problem's own material then.
        springs: how many times as stiff as the problem's own they were, by the surface that they hold.
    """

    forces: Floats
    equilibrium: Equilibrium
    model: ReferenceModel
    material: Material
    own: Material
    springs: Mapping[str, float]

    @property
    def displacement(self) -> Floats:
        """Of the nodes, (n, 3), metres."""
        return self.equilibrium.displacement

    @property
    def extrapolation_ratio(self) -> None:
        """None: the reference has learned nothing that it could leave."""

    @cached_property
    def negative_pivots(self) -> int | None:
        """Negative pivots of the tangent, counted when first asked for: 0 is stable, None is not known."""
        if self.equilibrium.negative_pivots is not None:
            return self.equilibrium.negative_pivots
        return self._problem.negative_pivots(self.equilibrium)

    @property
    def _problem(self) -> Problem:
        """The problem, while its tangents are still this state's."""
        self.model.take_again(self.material, self.own, self.springs)
        return self.model.problem

    def jvp(self, changes: ArrayLike) -> Floats:
        """Changes of the displacement, (3n, k), for small changes of the forces, (3n, k).

        Raises:
            RuntimeError: the problem has been given another material since.
        """
        return self._problem.apply_inverse(changes, self.equilibrium)

    def jvp_inputs(self, changes: Sequence[Change]) -> Floats:
        """Changes of the displacement, (3n, k), for small changes of parameters and prescribed displacements.

        Raises:
            ValueError: parameters that the material does not have.
            RuntimeError: the problem has been given another material since.
        """
        at = Linearisation(self._problem, self.equilibrium.load, self.equilibrium)
        return np.stack([at.tangent(change).ravel() for change in changes], axis=1)

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3), from the one with respect to the displacement.

        It is the adjoint K^-T g at this state (Odot 2023, eq. 6.8-6.10), zero at fixed nodes.

        Args:
            cotangent: g, (n, 3), or several, (k, n, 3).

        Raises:
            ValueError: another shape.
            RuntimeError: the problem has been given another material since.
        """
        given = np.asarray(cotangent, dtype=np.float64)
        shape = self.model.body.points.shape
        if given.ndim not in (2, 3) or given.shape[-2:] != shape:
            raise ValueError(f"State.vjp: expected a cotangent of shape {shape} or (k, *{shape}), got {given.shape}.")
        columns = given.reshape(-1, self.model.body.points.size).T
        return self._problem.apply_inverse(columns, self.equilibrium, transpose=True).T.reshape(given.shape)
