"""What registration needs of a forward model, whoever provides it: states that carry their own derivatives."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class UnknownInputs(Protocol):
    """Inputs of a model beside nodal forces, as a function of coefficients: see `parameters.inputs.InputBlocks`."""

    @property
    def size(self) -> int:
        """Number of coefficients, c."""

    @property
    def has_forces_alone(self) -> bool:
        """Whether nodal forces are all that they change."""

    def inputs(self, coefficients: Floats) -> Inputs:
        """The inputs at coefficients, (c,)."""

    def changes(self, coefficients: Floats) -> list[Change]:
        """Derivative of the inputs by each coefficient."""

    def forces(self, coefficients: Floats) -> Floats:
        """Nodal forces among the inputs, (n, 3), newtons."""

    def stiffness_scaling(self, coefficients: Floats) -> tuple[float, Floats]:
        """Factor by which other forces grow with the body's stiffness, and its derivative, (c,)."""


class State(Protocol):
    """A displacement with its derivatives by the nodal forces: a value, whatever its model solves afterwards."""

    @property
    def displacement(self) -> Floats:
        """(n, 3), metres."""

    @property
    def negative_pivots(self) -> int | None:
        """Negative pivots of the tangent: 0 is stable, None where the model does not know."""

    @property
    def extrapolation_ratio(self) -> float | None:
        """How far the load lies out: 1 at the largest that the model has learned; None for a model without a limit."""

    def jvp(self, changes: ArrayLike) -> Floats:
        """Change of the displacement, (3n, k), for small changes of the forces, (3n, k)."""

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3), from the one with respect to the displacement, (n, 3).

        Several at once have the shape (k, n, 3), and so have their gradients.
        """


class Discrepancy(Protocol):
    """What a model gets wrong: u = u_model + size (modes a + rest) with a of unit variance.

    The size is the largest displacement of a node.
    """

    @property
    def modes(self) -> Floats:
        """Patterns of the error over the body for a largest displacement of one metre, (3n, m)."""

    @property
    def rest(self) -> Floats:
        """Standard deviation of what they leave out in a component of each node, (n,), for the same displacement."""

    @property
    def places(self) -> float:
        """Number of places on the boundary where what they leave out is independent: neighbours share it."""


class ForwardModel(Protocol):
    """Nodal forces to states.

    The reference and every surrogate satisfy it; all arrays are in the body's node order.
    """

    @property
    def body(self) -> Body:
        """The body that deforms."""

    @property
    def error(self) -> float:
        """Error of the displacement to be reckoned with where it is worst, metres; 0 for the reference."""

    @property
    def discrepancy(self) -> Discrepancy | None:
        """The same as patterns, which tell error from noise; None where they are not known."""

    def solve(self, forces: ArrayLike, near: Any = None) -> State:
        """The state under nodal forces, (n, 3) newtons.

        Args:
            forces: nodal forces, (n, 3), newtons.
            near: a state of this model to start from, where that helps; from rest if not given.
        """


class ReducedState(Protocol):
    """A state as a function of a few force coefficients, seen at chosen nodes."""

    @property
    def positions(self) -> Floats:
        """Displacement of the chosen nodes, (p, 3), metres."""

    @property
    def full(self) -> State:
        """The whole state."""

    def jacobian(self, rows: csr_array) -> Floats:
        """Derivative of linear functions of the chosen displacements, (q, k), for rows (q, 3p)."""

    def moved(self, change: Floats, every: int = 1) -> Floats:
        """First-order displacement of every so-manieth chosen node, (p, 3), for a change of the coefficients, (k,)."""


class ParametrisedState(ReducedState, Protocol):
    """One that also depends on inputs: what the body is made of, and how it is moved."""

    def by_parameters(self) -> Floats:
        """Derivative of all nodes' displacement by the inputs' coefficients, (3n, c)."""

    def rows_by_parameters(self, rows: csr_array) -> Floats:
        """Derivative of linear functions of the chosen displacements, (q, c), for rows (q, 3p)."""


class ReducedModel(Protocol):
    """A forward model between the coefficients of a force basis and chosen nodes."""

    @property
    def count(self) -> int:
        """Number of coefficients, k."""

    def combined(self, matrix: Floats) -> ReducedModel:
        """The same model for the basis times a matrix, (k, j): without going through the whole body again."""

    def solve(self, coefficients: Floats, near: Any = None) -> ReducedState:
        """The state for coefficients (k,)."""


class ParametrisedModel(ReducedModel, Protocol):
    """One whose states also depend on inputs."""

    def solve(self, coefficients: Floats, near: Any = None, unknown: Floats | None = None) -> ParametrisedState:
        """The state for coefficients of forces, (k,), and of inputs, (c,)."""


class _PickedState:
    """Any state behind a force basis: rows of the whole."""

    def __init__(self, model: _PickedModel, coefficients: Floats, unknown: Floats, full: Any) -> None:
        self.model, self.coefficients, self.unknown, self.full = model, coefficients, unknown, full

    @property
    def positions(self) -> Floats:
        found: Floats = self.full.displacement[self.model.nodes]
        return found

    @cached_property
    def _basis_pushed(self) -> Floats:
        if self.model.count == 0:
            return np.zeros((len(self.model.rows), 0))
        pushed: Floats = self.full.jvp(self.model.basis)[self.model.rows]
        return self.model.stiffness_scaling(self.unknown)[0] * pushed

    def jacobian(self, rows: csr_array) -> Floats:
        return rows @ self._basis_pushed

    def moved(self, change: Floats, every: int = 1) -> Floats:
        return self._basis_pushed.reshape(len(self.model.nodes), 3, len(change))[::every] @ change

    @cached_property
    def _inputs_pushed(self) -> Floats:
        inputs = self.model.inputs
        assert inputs is not None
        changes = inputs.changes(self.unknown)
        forces, (_, slopes) = self.model.forces(self.coefficients), self.model.stiffness_scaling(self.unknown)
        for place in np.flatnonzero(slopes):
            changes[place] = replace(changes[place], forces=slopes[place] * forces)
        if inputs.has_forces_alone:
            pushed: Floats = self.full.jvp(
                np.stack([np.asarray(change.forces, dtype=np.float64).ravel() for change in changes], axis=1)
            )
        else:
            pushed = self.full.jvp_inputs(changes)
        return pushed

    def by_parameters(self) -> Floats:
        return self._inputs_pushed

    def rows_by_parameters(self, rows: csr_array) -> Floats:
        return rows @ self._inputs_pushed[self.model.rows]

    def is_at(self, model: _PickedModel, coefficients: Floats, unknown: Floats) -> bool:
        """Whether it is the state of a model at coefficients."""
        is_there = np.array_equal(self.coefficients, coefficients) and np.array_equal(self.unknown, unknown)
        return self.model is model and is_there


class _PickedModel:
    """Any forward model, reduced by multiplying with the basis and picking rows."""

    def __init__(self, model: Any, nodes: Ints, basis: Floats, inputs: UnknownInputs | None) -> None:
        self.model, self.nodes, self.basis, self.inputs = model, nodes, basis, inputs
        self.rows = (3 * nodes[:, None] + np.arange(3)).ravel()

    @property
    def count(self) -> int:
        return self.basis.shape[1]

    def forces(self, coefficients: Floats) -> Floats:
        """Nodal forces, (n, 3), newtons, on a body as stiff as expected."""
        found: Floats = (self.basis @ coefficients).reshape(-1, 3)
        return found

    def stiffness_scaling(self, unknown: Floats) -> tuple[float, Floats]:
        """See `UnknownInputs.stiffness_scaling`."""
        return (1.0, np.zeros(0)) if self.inputs is None else self.inputs.stiffness_scaling(unknown)

    def combined(self, matrix: Floats) -> _PickedModel:
        return _PickedModel(self.model, self.nodes, self.basis @ matrix, self.inputs)

    def solve(self, coefficients: Floats, near: ReducedState | None = None, unknown: Floats | None = None) -> Any:
        """The state; inputs are as expected where no coefficients of theirs are given."""
        if unknown is None:
            unknown = np.zeros(0 if self.inputs is None else self.inputs.size)
        if isinstance(near, _PickedState) and near.is_at(self, coefficients, unknown):
            return near
        forces = self.stiffness_scaling(unknown)[0] * self.forces(coefficients)
        start = None if near is None else near.full
        if self.inputs is None:
            return _PickedState(self, coefficients, unknown, self.model.solve(forces, start))
        if self.inputs.has_forces_alone:
            full = self.model.solve(forces + self.inputs.forces(unknown), start)
        else:
            full = self.model.solve(forces, start, self.inputs.inputs(unknown))
        return _PickedState(self, coefficients, unknown, full)


def _takes(model: Any) -> bool:
    """Whether it takes inputs though it can be reduced."""
    return bool(getattr(model, "takes_inputs", False))


def reduce_model(model: Any, nodes: Ints, basis: Floats, inputs: UnknownInputs | None = None) -> ReducedModel:
    """A model from force coefficients to the displacement of some nodes.

    A model that has a `reduced` of its own (surrogates multiply beforehand) is asked for it.

    Args:
        model: a forward model.
        nodes: numbers of the nodes whose displacement is wanted, (p,).
        basis: nodal forces of each coefficient, (3n, k), newtons.
        inputs: unknowns beside the forces, which the model takes as inputs.

    Raises:
        ValueError: the model was learned for one material and one support, and there are such unknowns.
    """
    every_model_takes_them = inputs is not None and inputs.has_forces_alone
    if not hasattr(model, "reduced") or every_model_takes_them or (inputs is not None and _takes(model)):
        return _PickedModel(model, nodes, basis, inputs)
    if inputs is not None:
        raise ValueError(
            "inputs: expected a model that takes parameters and prescribed displacements (the reference, or "
            f"hybrid), got a {type(model).__name__}, which has learned one material and one support."
        )
    found: ReducedModel = model.reduced(nodes, basis)
    return found
