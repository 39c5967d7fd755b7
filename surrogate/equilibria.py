"""Hyperelastic equilibria in torch: many loads of one body at a time, on a processor or a GPU, without FEniCSx.

Each state is a minimum of its potential energy. Newton's method finds it with a line search on that energy, from the
warped linear response; the tangents of all states are factored together, layer by layer (Odot 2023, chapter 7, calls a
solver in torch DiffEn).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from softtwin.meshes.body import Body
from softtwin.reference.data.materials import Material, Parameter, with_parameters
from softtwin.reference.data.springs import Support

from .residual import ElasticBody
from .tangents import Factors, LayeredMatrices, layers_of
from .warping import Warping

_DESCENT = 1e-4  # of what the slope promises (Nocedal and Wright, Numerical Optimization, section 3.1)
_SHORTEST = 1e-8
_LOST = 1e-6  # of the squares of the forces, that may lie on held nodes
_SHARES = (1.0, 0.5, 0.25)  # of the load whose warped response is tried as a start
_SHIFTS = tuple(0.01 * 4.0**i for i in range(10))  # of the stiffness at no load, added where a tangent is indefinite
_TYPES = {"double": "float64", "single": "float32"}
_EPSILONS = 8.0  # of machine precision in sums of energies that cancel: changes below them are none


@dataclass(frozen=True)
class NewtonSettings:
    """When a state is found, and how long it is looked for.

    Args:
        tolerance: out-of-balance forces relative to the load's, in the norm of all free components; rounding is enough
            where it leaves more, as it does in single precision.
        iterations: of Newton's method, for one part of a load.
        load_steps: parts into which a load is cut, at most, where it is not found at once.
        chunk: states that are solved together, at most; None as many as the device's memory holds.

    Raises:
        ValueError: an argument out of its range.
    """

    tolerance: float = 1e-10
    iterations: int = 60
    load_steps: int = 16
    chunk: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"NewtonSettings.tolerance: expected a number between 0 and 1, got {self.tolerance}.")
        for name in ("iterations", "load_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"NewtonSettings.{name}: expected at least 1, got {getattr(self, name)}.")
        if self.chunk is not None and self.chunk < 1:
            raise ValueError(f"NewtonSettings.chunk: expected at least 1, got {self.chunk}.")


@dataclass(frozen=True, eq=False)
class States:
    """What was found for s loads.

    Args:
        displacement: (s, n, 3), metres; what is not converged is where the search ended.
        residual: out-of-balance forces relative to the load's, (s,).
        is_converged: (s,).
        iterations: of Newton's method, all load steps together, (s,).
        load_steps: parts of the load that were solved one after another, (s,).
        is_stable: the tangent there is positive definite, (s,).
    """

    displacement: Tensor
    residual: Tensor
    is_converged: Tensor
    iterations: Tensor
    load_steps: Tensor
    is_stable: Tensor


@dataclass(frozen=True, eq=False)
class _Search:
    """States of a search, and what holds there."""

    displacement: Tensor  # (s, n, 3)
    energy: Tensor  # (s,), potential energy
    residual: Tensor  # (s, u), out-of-balance forces

    def __getitem__(self, chosen: Tensor) -> _Search:
        return _Search(self.displacement[chosen], self.energy[chosen], self.residual[chosen])

    def put(self, chosen: Tensor, other: _Search) -> None:
        self.displacement[chosen], self.energy[chosen] = other.displacement, other.energy
        self.residual[chosen] = other.residual


class Equilibria:
    """Equilibria of a body under dead nodal forces, in batches.

    Args:
        body: the body, in space.
        material: a compressible law of this package.
        device: `cpu`, `cuda`, or a torch device.
        precision: `double`, or `single` where a tolerance of about 1e-5 is enough.
        settings: of Newton's method.
        springs: that hold named surfaces, beside the body's fixed nodes.

    Raises:
        ValueError: a material or a body that `ElasticBody` does not know, a body that nothing holds, or one too large
            for the device.
    """

    def __init__(
        self,
        body: Body,
        material: Material,
        device: str | torch.device = "cpu",
        precision: str = "double",
        settings: NewtonSettings | None = None,
        springs: Mapping[str, Support] = MappingProxyType({}),
    ) -> None:
        if precision not in ("double", "single"):
            raise ValueError(f"Equilibria.precision: expected 'double' or 'single', got {precision!r}.")
        if torch.device(device).type == "cuda" and not torch.cuda.is_available():
            raise ValueError(
                f"Equilibria.device: expected a GPU that torch can use, found none (torch {torch.__version__})."
            )
        self.elastic = ElasticBody(body, material, springs=springs).to(device, getattr(torch, _TYPES[precision]))
        self.dtype, self.device = self.elastic.gradients.dtype, self.elastic.gradients.device
        self.body, self.material, self.settings = body, material, settings or NewtonSettings()
        is_free = self.elastic.free[:, 0].cpu().numpy() > 0.0
        layers = layers_of(body.cells.astype(np.int64), is_free)
        free = np.flatnonzero(is_free)
        numbers = np.full((len(is_free), 3), 3 * len(free))
        numbers[free] = np.arange(3 * len(free)).reshape(-1, 3)
        self._free = torch.from_numpy(free).to(self.device)
        of_cells = torch.from_numpy(numbers).to(self.device)[self.elastic.cells].flatten(1)
        self._matrices = LayeredMatrices(of_cells, np.repeat(layers[free], 3))
        self._warping = None if material.is_linear else Warping(self.elastic, layers, body.size)
        self._stiffen()

    def _stiffen(self) -> None:
        """What depends on the material: the stiffness at no load with its factors, and how large rounding is."""
        self._rest = self._matrices.assembled(self.elastic.cell_stiffnesses(self._field(1)))
        self._at_rest = self._matrices.factor(self._rest)
        # F is 1 + grad u: an energy density is rounded as its terms are, which are as large as the moduli.
        unit = torch.eye(3, dtype=self.dtype, device=self.device).expand(*self.elastic.volumes.shape, 3, 3)
        self._epsilon = torch.finfo(self.dtype).eps
        stiffest = self.elastic.moduli(unit).amax(dim=(2, 3, 4, 5))
        nodes, volume = len(self.body.points), float(self.elastic.volumes.sum())
        self._force_scale = float(stiffest.max()) * (volume / nodes) ** (2 / 3) * nodes**0.5
        self._stiffness_scale = float(self._rest.abs().max())
        self._noise = _EPSILONS * self._epsilon * float((stiffest * self.elastic.volumes).sum())
        if not bool(self._at_rest.is_positive.all()):
            raise ValueError(
                "Equilibria.body: expected a body that something holds; its stiffness at no load has directions that "
                "cost no energy."
            )

    def with_parameters(self, **values: Parameter) -> Equilibria:
        """The same body of the same law with other parameters.

        Args:
            values: numbers, or one for each cell, by the parameters' names; others stay.

        Raises:
            ValueError: a parameter that the law does not have, or values out of their range.
        """
        unknown = values.keys() - self.material.parameters.keys()
        if unknown:
            raise ValueError(
                f"Equilibria.with_parameters: expected parameters among {sorted(self.material.parameters)}, "
                f"got {sorted(unknown)}."
            )
        other = copy.copy(self)
        other.material = with_parameters(self.material, values)
        other.elastic = self.elastic.with_material(other.material)
        other._stiffen()
        return other

    def with_springs(self, factors: Mapping[str, float]) -> Equilibria:
        """The same body on springs that are stiffer or softer than given.

        Args:
            factors: how many times as stiff, by the surface that they hold; others as given.

        Raises:
            ValueError: no springs there.
        """
        other = copy.copy(self)
        other.elastic = self.elastic.with_springs(factors)
        other._stiffen()
        return other

    def tangent(self, displacement: ArrayLike | Tensor) -> Tangent:
        """What equilibria change by, to first order.

        Args:
            displacement: of the equilibria, (s, n, 3), metres.

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        return Tangent(self, self._checked("displacement", displacement))

    def _field(self, count: int) -> Tensor:
        return torch.zeros(count, self.elastic.nodes, 3, dtype=self.dtype, device=self.device)

    def _picked(self, field: Tensor) -> Tensor:
        """Free components of a nodal field, (s, n, 3): (s, u)."""
        return field[:, self._free].reshape(len(field), 3 * len(self._free))

    def _spread(self, values: Tensor) -> Tensor:
        """The field that is zero where nodes are held, (s, n, 3)."""
        return self._field(len(values)).index_copy(1, self._free, values.reshape(len(values), len(self._free), 3))

    def solve(
        self,
        forces: ArrayLike | Tensor,
        start: ArrayLike | Tensor | None = None,
        *,
        load_steps: int | None = None,
        iterations: int | None = None,
    ) -> States:
        """States under loads; each in one step where that succeeds, else in 2, 4, ... parts of the load.

        Args:
            forces: nodal forces, (s, n, 3), newtons; none at held nodes.
            start: displacements to begin at, (s, n, 3), metres; none if not given.
            load_steps: parts of a load, at most; as the settings say if not given.
            iterations: of Newton's method for one part, at most; as the settings say if not given.

        Raises:
            ValueError: another shape, numbers that are not finite, or forces on held nodes, where they would be lost.
        """
        forces = self._checked("forces", forces)
        loads = self._picked(forces)
        if loads.square().sum() < (1.0 - _LOST) * forces.square().sum():
            raise ValueError("Equilibria.forces: expected no force on held nodes, where it would be lost; got some.")
        begin = None
        if start is not None:
            begin = self._spread(self._picked(self._checked("start", start)))
        size, most = self.settings.chunk or self._chunk(), load_steps or self.settings.load_steps
        limit = iterations or self.settings.iterations
        parts = [
            self._solved(loads[i : i + size], None if begin is None else begin[i : i + size], most, limit)
            for i in range(0, max(len(loads), 1), size)
        ]
        if len(parts) == 1:
            return parts[0]
        return States(*(torch.cat([getattr(part, item.name) for part in parts]) for item in fields(States)))

    def _checked(self, name: str, field: ArrayLike | Tensor) -> Tensor:
        if isinstance(field, np.ndarray) and not field.flags.writeable:
            field = field.copy()  # torch knows no arrays that must not be written to, and says so
        field = torch.as_tensor(field, dtype=self.dtype, device=self.device)
        if field.ndim != 3 or field.shape[1:] != (self.elastic.nodes, 3) or not len(field):
            raise ValueError(
                f"Equilibria.{name}: expected shape (s, {self.elastic.nodes}, 3) with s >= 1, got {tuple(field.shape)}."
            )
        if not bool(torch.isfinite(field).all()):
            raise ValueError(f"Equilibria.{name}: expected finite numbers, got NaN or infinity.")
        return field

    def _chunk(self) -> int:
        """States whose tangents fit into a quarter of what is free on a GPU; on a processor what its caches like."""
        cells, points = self.elastic.volumes.shape
        width = 3 * self.elastic.cells.shape[1]
        state = (cells * (2 * width * width + 300 * points) + 4 * self._matrices.entries) * self._rest.element_size()
        free = torch.cuda.mem_get_info(self.device)[0] // 4 if self.device.type == "cuda" else 2**28
        return max(1, int(free // state))

    def _solved(self, loads: Tensor, begin: Tensor | None, most: int, limit: int) -> States:
        start = self._starts(loads) if begin is None else begin
        found = self._newton(loads, start, limit)
        origin = torch.zeros_like(start) if begin is None else begin
        steps, parts = torch.ones_like(found.iterations), 2
        while parts <= most and not bool(found.is_converged.all()):
            missing = torch.nonzero(~found.is_converged)[:, 0]
            now = origin[missing]
            count = torch.zeros_like(missing)
            for part in range(1, parts + 1):
                step = self._newton(loads[missing] * (part / parts), now, limit)
                now, count = step.displacement, count + step.iterations
            changed = {
                item.name: getattr(found, item.name).index_copy(0, missing, getattr(step, item.name))
                for item in fields(States)
            }
            found = replace(found, **{**changed, "iterations": found.iterations.index_add(0, missing, count)})
            steps[missing] = parts
            parts *= 2
        return replace(found, load_steps=steps)

    def _starts(self, loads: Tensor) -> Tensor:
        """Of no displacement and the warped responses to parts of the loads, those of least energy, (s, n, 3)."""
        linear = self._spread(self._at_rest.solve(loads.mT[None])[0].mT)
        if self._warping is None:
            return linear
        best, lowest = torch.zeros_like(linear), torch.zeros(len(loads), dtype=self.dtype, device=self.device)
        for share in _SHARES:
            start = self._warping.warped(share * linear)
            energy = self._at(loads, start).energy
            is_lower = energy < lowest
            best = torch.where(is_lower[:, None, None], start, best)
            lowest = torch.where(is_lower, energy, lowest)
        return best

    def _at(self, loads: Tensor, displacement: Tensor) -> _Search:
        """Energy and out-of-balance forces; the energy is infinite where a cell is inside out."""
        with torch.no_grad():
            stored, internal = self.elastic.energy_and_forces(displacement)
            moved = self._picked(displacement)
            energy = stored - (loads * moved).sum(dim=1)
        return _Search(displacement, energy, loads - self._picked(internal))

    def _newton(self, loads: Tensor, begin: Tensor, limit: int) -> States:
        now = self._at(loads, begin)
        sizes = torch.linalg.vector_norm(loads, dim=1)
        sizes = torch.where(sizes > 0.0, sizes, 1.0)
        relative = torch.linalg.vector_norm(now.residual, dim=1) / sizes
        iterations = torch.zeros(len(loads), dtype=torch.int64, device=self.device)
        is_stable = torch.ones_like(relative, dtype=torch.bool)
        is_rounding = torch.zeros_like(is_stable)
        shifts = torch.zeros_like(iterations)  # that the last tangents needed
        active = torch.nonzero(~(relative <= self.settings.tolerance))[:, 0]
        while len(active):
            here = now[active]
            factors, is_stable[active], shifts[active] = self._factored(here.displacement, shifts[active])
            way = factors.solve(here.residual[:, :, None])[:, :, 0]
            after, is_better = self._line_search(loads[active], here, way)
            now.put(active, after)
            left = torch.linalg.vector_norm(after.residual, dim=1)
            is_stuck = ~is_better | (left > 0.5 * relative[active] * sizes[active])
            is_rounding[active] = is_stuck & (left <= self._round_off(after.displacement))
            relative[active] = left / sizes[active]
            iterations[active] += 1
            goes_on = is_better & ~is_rounding[active] & (relative[active] > self.settings.tolerance)
            active = active[goes_on & (iterations[active] < limit)]
        is_converged = (relative <= self.settings.tolerance) | is_rounding
        return States(now.displacement, relative, is_converged, iterations, torch.ones_like(iterations), is_stable)

    def _round_off(self, displacement: Tensor) -> Tensor:
        """Norm of what rounding leaves of strains, 1 + grad u, and of K u in out-of-balance forces, (s,), newtons."""
        sizes = torch.linalg.vector_norm(displacement, dim=(1, 2))
        return _EPSILONS * self._epsilon * (self._force_scale + self._stiffness_scale * sizes)

    def _factored(self, displacement: Tensor, before: Tensor) -> tuple[Factors, Tensor, Tensor]:
        """Factors of the tangents, shifted until they are positive definite; which of them were, (s,); their shifts.

        Args:
            displacement: (s, n, 3), metres.
            before: shifts that the tangents of the iteration before needed, (s,): 0 none, else the number of it. One
                less is tried first, since tangents are alike from one iteration to the next.
        """
        entries = self._matrices.assembled(self.elastic.cell_stiffnesses(displacement))
        factors = self._matrices.factor(entries)
        is_stable = factors.is_positive.clone()
        shifts = torch.where(is_stable, 0, torch.clamp(before - 1, 1, len(_SHIFTS)))
        sizes = torch.tensor((0.0, *_SHIFTS), dtype=self.dtype, device=self.device)
        wrong = torch.nonzero(~is_stable)[:, 0]
        while len(wrong):
            factors.put(wrong, self._matrices.factor(entries[wrong] + sizes[shifts[wrong], None] * self._rest))
            is_left = ~factors.is_positive[wrong] & (shifts[wrong] < len(_SHIFTS))
            wrong = wrong[is_left]
            shifts[wrong] += 1
        return factors, is_stable, shifts

    def _line_search(self, loads: Tensor, here: _Search, way: Tensor) -> tuple[_Search, Tensor]:
        """Steps by Armijo's rule on the energy with quadratic interpolation, and whether there is one, (s,).

        Where energies are equal to the last digits, the out-of-balance forces have to go down.
        """
        field = self._spread(way)
        slope = -(here.residual * way).sum(dim=1)
        best = _Search(here.displacement.clone(), here.energy.clone(), here.residual.clone())
        length = torch.ones_like(slope)
        left = torch.nonzero(torch.isfinite(way).all(dim=1) & (slope < 0.0))[:, 0]
        is_better = torch.zeros_like(slope, dtype=torch.bool)
        while len(left):
            step = length[left]
            there = self._at(loads[left], here.displacement[left] + step[:, None, None] * field[left])
            change = there.energy - here.energy[left]
            work = (loads[left] * self._picked(there.displacement)).sum(dim=1).abs()
            noise = self._noise + _EPSILONS * self._epsilon * (here.energy[left].abs() + work)
            is_less = torch.linalg.vector_norm(there.residual, dim=1) < torch.linalg.vector_norm(
                here.residual[left], dim=1
            )
            is_good = (change <= _DESCENT * step * slope[left]) | ((change.abs() <= noise) & is_less)
            best.put(left[is_good], there[is_good])
            is_better[left[is_good]] = True
            wanted = -slope[left] * step / (2.0 * (change / step - slope[left]))
            wanted = torch.where(torch.isfinite(change), wanted, 0.5 * step)
            length[left] = torch.minimum(torch.maximum(wanted, 0.1 * step), 0.5 * step)
            left = left[~is_good & (length[left] > _SHORTEST)]
        return best, is_better


class Tangent:
    """Tangents at equilibria, whose inverse is the derivative of displacements by forces: symmetric, its own transpose.

    Where an equilibrium is not stable the tangent is indefinite, and has a factor on the processor in its place.

    Args:
        solver: of the equilibria.
        displacement: of these, (s, n, 3), metres.
    """

    def __init__(self, solver: Equilibria, displacement: Tensor) -> None:
        self.solver, self.displacement = solver, displacement
        entries = solver._matrices.assembled(solver.elastic.cell_stiffnesses(displacement))
        self._factors = solver._matrices.factor(entries)
        self.is_stable: Tensor = self._factors.is_positive

    def inverse(self, columns: ArrayLike | Tensor) -> Tensor:
        """The tangents' inverses times nodal columns, (s, n, 3, k) of each state: forces to displacements, and so back.

        What columns have at held nodes is not looked at, and nothing comes out there.

        Raises:
            RuntimeError: an equilibrium at a bifurcation, where the tangent is singular.
        """
        solver = self.solver
        columns = torch.as_tensor(columns, dtype=solver.dtype, device=solver.device)
        count = columns.shape[3]
        free = columns[:, solver._free].reshape(len(columns), -1, count)
        found = self._factors.solve(free)
        for wrong in torch.nonzero(~self.is_stable)[:, 0].tolist():
            solved = self._indefinite[wrong].solve(free[wrong].double().cpu().numpy())
            found[wrong] = torch.from_numpy(solved).to(found)
        whole = torch.zeros_like(columns)
        return whole.index_copy(1, solver._free, found.reshape(len(columns), -1, 3, count))

    @cached_property
    def _indefinite(self) -> dict[int, SuperLU]:
        """LU factors of the tangents that are not positive definite, by their number."""
        return {
            wrong: splu(self.solver.elastic.free_stiffness(self.displacement[wrong]))
            for wrong in torch.nonzero(~self.is_stable)[:, 0].tolist()
        }
