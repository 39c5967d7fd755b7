"""The solver in torch as a forward model: exact states and derivatives where FEniCSx is not at hand, or on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.discrepancy import Discrepancy
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.loading import checked_array
from softtwin.reference.data.outcome import NotConverged

from .equilibria import Equilibria, Tangent

Floats = NDArray[np.float64]
_NEARBY = 8  # Newton iterations from a state nearby: in registrations none that led to a state took more
_COUNTED = 3000  # unknowns, up to which the directions of an indefinite tangent are counted


class EquilibriaModel:
    """Forces to equilibrium by `Equilibria`: a forward model, as the reference is, on a processor or a GPU.

    States are the reference's to 1e-8 of the largest displacement in double precision, and so are their derivatives.

    Args:
        solver: body, material, device and precision.
        forces: nodal forces that act at all times beside those that are asked for, (n, 3), newtons; none if not given.
        discrepancy: what is not known of the organ, as patterns that the model may be wrong by.
        patient: try load steps, and from rest, where the state to start from is too far; False refuses at once, for a
            search that can shorten its step.
    """

    def __init__(
        self,
        solver: Equilibria,
        forces: ArrayLike | None = None,
        *,
        discrepancy: Discrepancy | None = None,
        patient: bool = True,
    ) -> None:
        self.solver = self._last = solver
        self._last_springs: dict[str, float] = {}
        self.discrepancy, self.patient = discrepancy, patient
        shape = solver.body.points.shape
        self._always = np.zeros(shape) if forces is None else checked_array("EquilibriaModel.forces", forces, shape)

    @property
    def body(self) -> Body:
        """The body that deforms."""
        return self.solver.body

    @property
    def error(self) -> float:
        """0: equilibria are solved for."""
        return 0.0

    @property
    def is_linear(self) -> bool:
        """Whether the law is linear: it holds where nothing turns or stretches much."""
        return self.solver.material.is_linear

    def solve(self, forces: ArrayLike, near: Any = None, inputs: Inputs | None = None) -> EquilibriaState:
        """The state under nodal forces, (n, 3) newtons.

        Args:
            forces: nodal forces; what acts at held nodes moves nothing.
            near: a state to start from, moved along its tangent where it is one of this model's; the warped linear
                response if not given.
            inputs: material parameters in place of the solver's own, more forces, stiffer or softer springs.

        Raises:
            ValueError: parameters that the law does not have, or prescribed displacements, which it does not know.
            NotConverged: no equilibrium was found.
        """
        given = checked_array("EquilibriaModel.forces", forces, self.body.points.shape).copy()
        given.flags.writeable = False
        load, solver = given + self._always, self.solver
        if inputs is not None:
            if inputs.displacement:
                raise ValueError(
                    "EquilibriaModel.inputs: expected forces and material parameters, got displacements of "
                    f"{sorted(inputs.displacement)}; the reference knows them (--model reference)."
                )
            load = load if inputs.forces is None else load + inputs.forces
            solver = self._with(inputs)
        load[self.body.fixed] = 0.0
        found = None
        if near is not None:
            start = self._start(solver, load, near)
            found = solver.solve(load[None], start[None], load_steps=1, iterations=_NEARBY)
        if found is None or (self.patient and not bool(found.is_converged[0])):
            found = solver.solve(load[None])
        if not bool(found.is_converged[0]):
            raise NotConverged(
                f"EquilibriaModel.solve: no equilibrium was found in {int(found.load_steps[0])} load steps; "
                f"out-of-balance forces are {float(found.residual[0]):.1e} of the load's. The load may be too "
                "large: try a smaller one."
            )
        displacement = found.displacement[0].double().cpu().numpy()
        displacement.flags.writeable = False
        return EquilibriaState(self, solver, given, load, displacement)

    def _with(self, inputs: Inputs) -> Equilibria:
        """The solver with other parameters; the last ones are kept."""
        wanted = {**self.solver.material.parameters, **inputs.parameters}
        known = self._last.material.parameters
        is_same = wanted.keys() == known.keys() and all(np.array_equal(wanted[name], known[name]) for name in wanted)
        if not is_same or inputs.springs != self._last_springs:
            solver = self.solver.with_springs(inputs.springs) if inputs.springs else self.solver
            self._last = solver.with_parameters(**inputs.parameters) if inputs.parameters else solver
            self._last_springs = dict(inputs.springs)
        return self._last

    def _start(self, solver: Equilibria, load: Floats, near: Any) -> Floats:
        """Of a state nearby and of what its tangent makes of it, that of the lower energy, (n, 3), metres."""
        start: Floats = np.asarray(near.displacement, dtype=np.float64)
        if not isinstance(near, EquilibriaState):
            return start
        moved = start + near.jvp((load - near.load).reshape(-1, 1)).reshape(-1, 3)
        both = torch.from_numpy(np.stack([start, moved])).to(solver.device, solver.dtype)
        stored = solver.elastic.energy_and_forces(both)[0].cpu().numpy()
        energies = stored - np.einsum("sni,ni->s", np.stack([start, moved]), load)
        return moved if energies[1] < energies[0] else start


class EquilibriaState:
    """An equilibrium with its derivatives: a value, whatever its model solves afterwards.

    Args:
        model: that found it.
        solver: with the material parameters that it was found with.
        forces: nodal forces that were asked for, (n, 3), newtons.
        load: all that acted, (n, 3), newtons.
        displacement: (n, 3), metres.
    """

    extrapolation_ratio = None

    def __init__(
        self, model: EquilibriaModel, solver: Equilibria, forces: Floats, load: Floats, displacement: Floats
    ) -> None:
        self.model, self.forces, self.load, self.displacement = model, forces, load, displacement
        self._solver = solver

    @cached_property
    def _tangent(self) -> Tangent:
        return self._solver.tangent(self.displacement[None])

    @cached_property
    def negative_pivots(self) -> int | None:
        """Directions that lower the energy: 0 is stable; None where it is not, of a body too large to count them."""
        if bool(self._tangent.is_stable[0]):
            return 0
        elastic = self._solver.elastic
        if 3 * int(elastic.free.sum()) > _COUNTED:
            return None
        at = torch.from_numpy(self.displacement.copy()).to(self._solver.device, self._solver.dtype)
        return int((np.linalg.eigvalsh(elastic.free_stiffness(at).toarray()) < 0.0).sum())

    def jvp(self, changes: ArrayLike) -> Floats:
        """Change of the displacement, (3n, k), for small changes of the forces, (3n, k).

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        columns = np.asarray(changes, dtype=np.float64)
        size = self.displacement.size
        if columns.ndim != 2 or len(columns) != size:
            raise ValueError(f"EquilibriaState.jvp: expected shape ({size}, k), got {columns.shape}.")
        checked_array("EquilibriaState.jvp", columns, columns.shape)
        return self._inverse(columns)

    def _inverse(self, columns: Floats) -> Floats:
        found = self._tangent.inverse(columns.reshape(1, -1, 3, columns.shape[1]))
        return found[0].reshape(columns.shape).double().cpu().numpy()

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """Gradient by the forces, (n, 3), from the one by the displacement, (n, 3); several at once: (k, n, 3).

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        given = np.asarray(cotangent, dtype=np.float64)
        if given.shape[-2:] != self.displacement.shape or given.ndim > 3:
            raise ValueError(
                f"EquilibriaState.vjp: expected shape {self.displacement.shape} or (k, ...), got {given.shape}."
            )
        checked_array("EquilibriaState.vjp", given, given.shape)
        columns = given.reshape(-1, self.displacement.size).T
        return self._inverse(columns).T.reshape(given.shape)

    def jvp_inputs(self, changes: Sequence[Change]) -> Floats:
        """Change of the displacement, (3n, k), for k changes of forces and material parameters.

        Raises:
            ValueError: a prescribed displacement that changes, or parameters that the law does not have.
        """
        return self.jvp(np.stack([self._pull(change).ravel() for change in changes], axis=1))

    def _pull(self, change: Change) -> Floats:
        """What a change does to the out-of-balance forces, (n, 3), newtons."""
        if change.displacement is not None:
            raise ValueError("EquilibriaState.jvp_inputs: expected forces and material parameters, got displacements.")
        pull = np.zeros_like(self.displacement)
        if change.forces is not None:
            pull = pull + np.asarray(change.forces, dtype=np.float64).reshape(pull.shape)
        if change.parameters:
            pull = pull - self._by_parameters(change.parameters)
        for name, rate in change.springs.items():
            at = torch.from_numpy(self.displacement.copy()).to(self._solver.device, self._solver.dtype)[None]
            pull = pull - rate * self._solver.elastic.spring_forces(name, at)[0].double().cpu().numpy()
        return pull

    def _by_parameters(self, changes: dict[str, ArrayLike] | Any) -> Floats:
        """Change of the internal forces, (n, 3), newtons, as parameters change."""
        elastic = self._solver.elastic
        at = torch.from_numpy(self.displacement.copy()).to(self._solver.device, self._solver.dtype)[None]
        known = {name: getattr(elastic, f"parameter_{name}") for name in elastic.material.parameters}
        unknown = changes.keys() - known.keys()
        if unknown:
            raise ValueError(
                f"EquilibriaState.jvp_inputs: expected parameters among {sorted(known)}, got {sorted(unknown)}."
            )
        ways = {
            name: torch.as_tensor(np.asarray(changes[name], dtype=np.float64).reshape(-1, 1)).to(at)
            if name in changes
            else torch.zeros_like(value)
            for name, value in known.items()
        }
        for name, way in ways.items():  # a number may change cell by cell
            values = torch.broadcast_tensors(known[name], way)
            known[name], ways[name] = values[0].clone(), values[1].clone()
        forces = torch.func.grad(elastic.energy_of)
        pushed = torch.func.jvp(lambda values: forces(at, values), (known,), (ways,))[1]
        return np.asarray(pushed[0].double().cpu().numpy())
