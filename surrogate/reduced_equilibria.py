"""Equilibria among the displacements that a few modes span, by a few weighted cells: Galerkin's method, hyper-reduced.

To whoever asks it is a network: coordinates of the load in, coordinates of the displacement out, with derivatives by
the implicit function theorem. `galerkin` chooses modes and cells.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf, dpotrs
from torch import Tensor

from softtwin.reference.data.materials import MATERIALS, Material
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.secants import Secants

from .algebra import TorchAlgebra
from .architecture import Linearisation, Network
from .invariants import densities, has_invariants, invariants_of
from .jets import Jet, JetAlgebra

Floats = NDArray[np.float64]
_PARAMETER = "parameter_"
_TOLERANCE, _ROUGH = 1e-10, 1e-6  # out-of-balance forces relative to the load's, exact and rounded
_DIFFERENCE = 1e-2  # of the linear response: a step of a central difference of the forces
_ITERATIONS, _ESCAPES = 200, 3  # of Newton's method; from balanced states that are not stable
_DESCENT = 1e-4  # of what the slope promises
_SHORTEST = 1e-6
_FAST = 0.4  # by which out-of-balance forces are to fall in a step, or the tangent is made anew
_SHIFTS = tuple(1e-3 * 4.0**i for i in range(14))  # of the stiffness at rest, added to a tangent that is indefinite
_LEAST_JACOBIAN = 0.1  # in any cell of a state that cells are chosen by
_EPSILONS = 8.0  # of machine precision, by which sums that cancel are off


@dataclass(frozen=True, eq=False)
class _Cells:
    """What a search for a state reads again and again, as NumPy's arrays: see `GalerkinNetwork`.

    Args:
        flat: slopes, (9p, r).
        slopes: (p, 9, r), and `turned`, (r, 9p), in single precision.
        turned: see slopes.
        weights: (p,).
        support: (r, r).
        parameters: of the law, by name, (p,) or (1,).
    """

    flat: Floats
    slopes: NDArray[np.float32]
    turned: NDArray[np.float32]
    weights: Floats
    support: Floats
    parameters: SimpleNamespace


class GalerkinNetwork(Network):
    """Correction to the linear response, (s, r), metres, from coordinates of the load, (s, r), newtons.

    Args:
        law: name of the strain energy, one of `MATERIALS`.
        parameters: of the law, by name, one for each cell that is taken, (p,), or one for all, (1,).
        slopes: gradients of the modes in the cells that are taken, (p, 9, r), 1/m.
        weights: volume that each of them stands for, (p,), m^3.
        support: stiffness of springs that hold the body, between modes, (r, r), N/m, by the surface that they hold.
        cells: number of the body's cell that each of them lies in, (p,).
        cell_count: of the body.

    Raises:
        ValueError: cells that leave a direction of the modes without stiffness.
    """

    is_graph = False
    slopes: Tensor
    weights: Tensor
    spring_names: Tensor
    spring_parts: Tensor
    spring_factors: Tensor
    law: Tensor
    cells: Tensor
    cell_count: Tensor
    at_rest: Tensor

    def __init__(
        self,
        law: str,
        parameters: Mapping[str, Tensor],
        slopes: Tensor,
        weights: Tensor,
        support: Mapping[str, Tensor],
        cells: Tensor,
        cell_count: int,
    ) -> None:
        super().__init__()
        self.register_buffer("slopes", slopes.contiguous())
        self.register_buffer("weights", weights)
        size = slopes.shape[2]
        parts = [part.to(slopes) for part in support.values()]
        self.register_buffer("spring_names", torch.tensor(list("\n".join(support).encode()), dtype=torch.uint8))
        self.register_buffer("spring_parts", torch.stack(parts) if parts else slopes.new_zeros(0, size, size))
        self.register_buffer("spring_factors", slopes.new_ones(len(parts)))
        self.register_buffer("cells", cells)
        self.register_buffer("cell_count", torch.tensor(cell_count))
        self.register_buffer("law", torch.tensor(list(law.encode()), dtype=torch.uint8))
        for name, values in parameters.items():
            self.register_buffer(f"{_PARAMETER}{name}", values)
        self.is_exact = True
        at_rest = self.stiffness(np.zeros(slopes.shape[2]))
        self.register_buffer("at_rest", torch.from_numpy(at_rest))
        if int(torch.linalg.cholesky_ex(self.at_rest)[1]):
            raise ValueError(
                f"GalerkinNetwork: expected cells that hold all of {slopes.shape[2]} modes, got {len(slopes)} points, "
                "which leave some without stiffness; take more cells, or a smaller tolerance."
            )

    @property
    def parameters_of_law(self) -> dict[str, Tensor]:
        """By name, (p,) or (1,)."""
        return {n.removeprefix(_PARAMETER): values for n, values in self.named_buffers() if n.startswith(_PARAMETER)}

    @property
    def springs(self) -> tuple[str, ...]:
        """The surfaces that springs hold."""
        return tuple(bytes(self.spring_names.tolist()).decode().split("\n")) if len(self.spring_parts) else ()

    @property
    def support(self) -> Tensor:
        """Stiffness of all springs, (r, r), N/m."""
        return torch.einsum("n,nij->ij", self.spring_factors, self.spring_parts)

    def stiffening(self, values: Mapping[str, ArrayLike]) -> float:
        """How many times as stiff as its own a tissue is, in the geometric mean over cells: what scales loads alone.

        1 where springs hold the body, which do not grow with it.

        Args:
            values: as for `with_parameters`.
        """
        if "young_modulus" not in values or bool(self.spring_parts.any()):
            return 1.0
        given, own = np.asarray(values["young_modulus"], dtype=np.float64), self.parameters_of_law["young_modulus"]
        if not (given > 0.0).all() or bool((own != own[0]).any()):
            return 1.0  # no tissue, which `with_parameters` says; or one of several parts
        return float(np.exp(np.log(given).mean() - np.log(own.cpu().numpy()).mean()))

    def rounded(self) -> GalerkinNetwork:
        """The same, good to six digits and faster: forces in double precision, tangents in single."""
        other = copy.copy(self)
        other.is_exact = False
        return other

    def with_parameters(self, values: Mapping[str, ArrayLike]) -> GalerkinNetwork:
        """The same of other parameters of the law; what is corrected stays the linear response of its own.

        Args:
            values: a number, or one for each cell of the body, by the parameters' names; others stay.

        Raises:
            ValueError: a parameter that the law does not have, values that it cannot have, or not one for each cell.
        """
        found = {f"{_PARAMETER}{name}": self._in_points(name, value) for name, value in values.items()}
        type(self._law)(**{**self._law.parameters, **values})  # refuses what no tissue has
        other = copy.copy(self)
        other._buffers = {**self._buffers, **found}
        return other._forgetful()

    def with_springs(self, factors: Mapping[str, float]) -> GalerkinNetwork:
        """The same on springs that are stiffer or softer than its own; what is corrected stays the response on those.

        Args:
            factors: how many times as stiff, by the surface that they hold; others as they were.

        Raises:
            ValueError: no springs there, or a factor that is negative.
        """
        self._check_springs(factors)
        wrong = {name: factor for name, factor in factors.items() if not 0.0 <= factor < np.inf}
        if wrong:
            raise ValueError(f"GalerkinNetwork.with_springs: expected factors of at least 0, got {wrong}.")
        other = copy.copy(self)
        given = [factors.get(name, float(own)) for name, own in zip(self.springs, self.spring_factors, strict=True)]
        other._buffers = {**self._buffers, "spring_factors": torch.tensor(given, dtype=torch.float64).to(self.slopes)}
        return other._forgetful()

    def _check_springs(self, values: Mapping[str, float]) -> None:
        strange = sorted(values.keys() - set(self.springs))
        if strange:
            raise ValueError(
                f"GalerkinNetwork.springs: expected names among {sorted(self.springs)}, got {strange[0]!r}."
            )

    def _forgetful(self) -> GalerkinNetwork:
        """Itself, without what depends on parameters and springs."""
        for name in ("noise", "_read"):
            self.__dict__.pop(name, None)
        return self

    def _in_points(self, name: str, value: ArrayLike) -> Tensor:
        """A parameter, or its change, in the cells that are taken, (p,) or (1,)."""
        if name not in self.parameters_of_law:
            raise ValueError(
                f"GalerkinNetwork.{name}: expected parameters among {sorted(self.parameters_of_law)}, got another one."
            )
        given = np.asarray(value, dtype=np.float64)
        if given.shape not in ((), (int(self.cell_count),)):
            raise ValueError(
                f"GalerkinNetwork.{name}: expected a number or one for each of the {int(self.cell_count)} cells, got "
                f"shape {given.shape}."
            )
        return torch.from_numpy(given.reshape(1) if given.ndim == 0 else given[self.cells.numpy()]).to(self.slopes)

    def forces_by_parameters(self, q: Tensor, changes: Mapping[str, ArrayLike]) -> Tensor:
        """Change of the internal forces along the modes, (r,), newtons, as parameters change.

        Args:
            q: coordinates of the displacement, (r,).
            changes: a number, or one for each cell of the body, by the parameters' names.
        """
        known, F, count = self.parameters_of_law, self.gradients(q), len(self.slopes)
        ways = {name: torch.zeros_like(values) for name, values in known.items()}
        ways |= {name: self._in_points(name, value) for name, value in changes.items()}
        at = {name: values.expand(count).clone() for name, values in known.items()}
        along = {name: values.expand(count).clone() for name, values in ways.items()}

        def stress(parameters: dict[str, Tensor]) -> Tensor:
            algebra = JetAlgebra(1)
            found: Jet = self._law.energy(algebra.variable(F), None, SimpleNamespace(**parameters), algebra)
            return found.first.expand(count, 9)

        pushed = torch.func.jvp(stress, (at,), (along,))[1]
        return self.flat.mT @ (pushed * self.weights[:, None]).reshape(-1)

    def forces_by_springs(self, q: Tensor, changes: Mapping[str, float]) -> Tensor:
        """Change of the forces along the modes, (r,), newtons, as springs become stiffer.

        Args:
            q: coordinates of the displacement, (r,), metres.
            changes: of how many times as stiff they are, by the surface that they hold.
        """
        self._check_springs(changes)
        rates = torch.tensor([changes.get(name, 0.0) for name in self.springs], dtype=torch.float64).to(self.slopes)
        return torch.einsum("n,nij,j->i", rates, self.spring_parts, q)

    def forward(self, coordinates: Tensor) -> Tensor:
        """Corrections for coordinates of loads, one after the other.

        Raises:
            NotConverged: no equilibrium was found.
        """
        return torch.stack([self.linearised(load).values for load in coordinates])

    def linearised(self, coordinates: Tensor, near: Linearisation | None = None) -> GalerkinState:
        """The state under one load, (r,).

        Args:
            coordinates: of the load.
            near: a state to start from, where there is one.

        Raises:
            NotConverged: no equilibrium was found.
        """
        load = coordinates.to(self.slopes)
        start = near if isinstance(near, GalerkinState) and near.network.slopes is self.slopes else None
        q, factor = _Search(self, load.numpy()).found(start)
        return GalerkinState(self, load, torch.from_numpy(q), torch.from_numpy(factor))

    @staticmethod
    def from_state_dict(tensors: Mapping[str, Tensor]) -> GalerkinNetwork:
        """The network from what its `state_dict` was."""
        law = bytes(tensors["law"].tolist()).decode()
        parameters = {n.removeprefix(_PARAMETER): v for n, v in tensors.items() if n.startswith(_PARAMETER)}
        slopes, weights, cells = (tensors[name] for name in ("slopes", "weights", "cells"))
        if "support" in tensors:  # of before springs had names
            support = {"": tensors["support"]} if bool(tensors["support"].any()) else {}
        else:
            names = bytes(tensors["spring_names"].tolist()).decode().split("\n")
            support = dict(zip(names, tensors["spring_parts"], strict=False))
        return GalerkinNetwork(law, parameters, slopes, weights, support, cells, int(tensors["cell_count"]))

    def shares(self, q: Tensor) -> NDArray[np.float32]:
        """Of each cell in the forces along the modes, (r, p), in the energy norm at rest, as shares of a force of one.

        Where a cell of the state is nearly inside out, it is that of a smaller one.

        Args:
            q: coordinates of the displacement, (r,), metres.
        """
        F = self.gradients(q)
        while not self._law.is_linear and float(TorchAlgebra(F).det(F).min()) < _LEAST_JACOBIAN:
            q = 0.8 * q
            F = self.gradients(q)
        algebra, parameters = JetAlgebra(1), SimpleNamespace(**self.parameters_of_law)
        stress = self._law.energy(algebra.variable(F), None, parameters, algebra).first
        stress = (stress * self.weights[:, None]).float()
        forces = (self._turned @ stress[:, :, None])[:, :, 0].mT
        size = torch.linalg.vector_norm(forces.sum(dim=1, dtype=torch.float64)).clamp_min(1e-300)
        found: NDArray[np.float32] = (forces / size).contiguous().numpy()
        return found

    @cached_property
    def _turned(self) -> Tensor:
        """Slopes in coordinates whose stiffness at rest is one, (p, r, 9), in single precision."""
        size = self.slopes.shape[2]
        flat = torch.linalg.solve_triangular(self.rest_factor, self.flat.mT, upper=False)
        return flat.reshape(size, -1, 9).transpose(0, 1).float().contiguous()

    # ------------------------------------------------------------------ energy, forces, stiffness

    @cached_property
    def flat(self) -> Tensor:
        """Slopes, (9p, r)."""
        return self.slopes.flatten(0, 1)

    @cached_property
    def _read(self) -> _Cells:
        flat = self.flat.numpy()
        single = self.slopes.float().numpy()
        parameters = {name: values.numpy() for name, values in self.parameters_of_law.items()}
        return _Cells(
            flat,
            single,
            np.ascontiguousarray(single.reshape(flat.shape).T),
            self.weights.numpy(),
            self.support.numpy(),
            SimpleNamespace(**parameters),
        )

    @cached_property
    def _law(self) -> Material:
        """The law, whatever its constants: those that count are the buffers'."""
        return MATERIALS[bytes(self.law.tolist()).decode()](1.0, 0.0)

    @property
    def is_linear(self) -> bool:
        """Whether forces are linear in the displacement."""
        return self._law.is_linear

    @cached_property
    def rest_factor(self) -> Tensor:
        """Cholesky factor of the stiffness at rest."""
        return torch.linalg.cholesky(self.at_rest)

    @cached_property
    def noise(self) -> tuple[float, float]:
        """What rounding makes of energies, joules, and of forces, newtons: a density is rounded as its terms are."""
        moduli = self._moduli(np.zeros(len(self.at_rest)))
        stiffest = _EPSILONS * float(np.finfo(np.float64).eps) * float(np.abs(moduli).max())
        size = torch.linalg.vector_norm(self.slopes * self.weights[:, None, None])
        return stiffest * float(self.weights.sum()), stiffest * float(size)

    def gradients(self, q: Tensor) -> Tensor:
        """F, (p, 3, 3)."""
        unit = torch.eye(3, dtype=q.dtype, device=q.device)
        return unit + (self.flat @ q).reshape(-1, 3, 3)

    def energy_and_forces(self, q: Floats) -> tuple[float, Floats]:
        """Stored energy, joules, infinite where a cell is inside out, and its derivative, (r,).

        Args:
            q: coordinates of the displacement, (r,), metres.
        """
        read = self._read
        held = read.support @ q
        F = _gradients(read, q)
        if self._has_invariants:
            flat = F.reshape(-1, 9)
            invariants = invariants_of(flat)
            if not invariants[:, 2].min() > 0.0:
                return np.inf, held
            density, stress = densities(self._law, read.parameters, flat, invariants, 1)
        else:
            if not self._law.is_linear and not _determinants(F).min() > 0.0:
                return np.inf, held
            algebra = JetAlgebra(1)
            jet = self._law.energy(algebra.variable(F), None, read.parameters, algebra)
            density, stress = jet.value, jet.first
        energy = float(density @ read.weights + 0.5 * (held @ q))
        return energy, (stress * read.weights[:, None]).ravel() @ read.flat + held

    def stiffness(self, q: Floats, exact: bool = True) -> Floats:
        """Second derivative of the stored energy, (r, r), N/m; in single precision where six digits are enough.

        Args:
            q: coordinates of the displacement, (r,), metres.
            exact: all digits.
        """
        read, size = self._read, len(q)
        moduli = self._moduli(q) * read.weights[:, None, None]
        if exact:
            return read.flat.T @ np.matmul(moduli, read.flat.reshape(-1, 9, size)).reshape(-1, size) + read.support
        # In single precision torch's products are the faster ones.
        bent = torch.bmm(torch.from_numpy(moduli.astype(np.float32)), torch.from_numpy(read.slopes))
        found: Floats = (torch.from_numpy(read.turned) @ bent.reshape(-1, size)).numpy().astype(np.float64)
        return found + read.support

    def _moduli(self, q: Floats) -> Floats:
        """Second derivatives of the energy density by F, (p, 9, 9), pascals."""
        read, F = self._read, _gradients(self._read, q)
        if self._has_invariants:
            flat = F.reshape(-1, 9)
            return densities(self._law, read.parameters, flat, invariants_of(flat), 2)[1]
        algebra = JetAlgebra(2)
        second = self._law.energy(algebra.variable(F), None, read.parameters, algebra).second
        return np.broadcast_to(second, (len(read.weights), 9, 9))

    @cached_property
    def _has_invariants(self) -> bool:
        return has_invariants(self._law)


def _gradients(read: _Cells, q: Floats) -> Floats:
    """F, (p, 3, 3)."""
    return np.eye(3) + (read.flat @ q).reshape(-1, 3, 3)


def _determinants(F: Floats) -> Floats:
    """Of 3 x 3 matrices, (p,)."""
    a, b, c, d, e, f, g, h, i = F.reshape(-1, 9).T
    found: Floats = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
    return found


class _Search:
    """Newton's method for the state of least potential energy under one load; tangents serve while they do well."""

    def __init__(self, network: GalerkinNetwork, load: Floats) -> None:
        self.network, self.load, self.size = network, load, _norm(load)
        noise_of_energy, noise_of_forces = network.noise
        self.noise = noise_of_energy
        self.enough = max((_TOLERANCE if network.is_exact else _ROUGH) * self.size, noise_of_forces)

    def _look(self, q: Floats) -> tuple[float, Floats]:
        stored, forces = self.network.energy_and_forces(q)
        return stored - float(self.load @ q), self.load - forces

    def _begun(self, near: GalerkinState | None) -> tuple[Floats, Floats, bool, tuple[float, Floats]]:
        """Coordinates to start from, a factor, whether it is the tangent's there, energy and out-of-balance forces."""
        if near is not None:
            factor = near.factor.numpy()
            start = near.q.numpy() + _solved(factor, self.load - near.load.numpy())
            there = self._look(start)
            if there[0] < np.inf:
                return start, factor, False, there
        rest, factor = np.zeros_like(self.load), self.network.rest_factor.numpy()
        at_rest = self._look(rest)
        for start in self._expanded(factor):
            there = self._look(start)
            if there[0] < at_rest[0]:
                if _norm(there[1]) > _FAST * self.size:
                    return start, self._factor(start)[0], True, there
                return start, factor, False, there
        return rest, factor, True, at_rest

    def _expanded(self, factor: Floats) -> Iterator[Floats]:
        """Where the expansion of the state to second order leads for the load, and for half of it."""
        if self.network.is_linear:
            return
        first = _solved(factor, self.load)
        ways = [self.network.energy_and_forces(sign * _DIFFERENCE * first)[1] for sign in (1.0, -1.0)]
        second = _solved(factor, -0.5 * (ways[0] + ways[1]) / _DIFFERENCE**2)
        yield from (share * first + share**2 * second for share in (1.0, 0.5))

    def found(self, near: GalerkinState | None) -> tuple[Floats, Floats]:
        """Coordinates of the state, and the factor of its tangent, which is positive definite."""
        escapes, secants = 0, Secants(np.dot)
        q, factor, is_fresh, (energy, missing) = self._begun(near)
        for _ in range(_ITERATIONS):
            left = _norm(missing)
            if left <= self.enough:
                factor, is_stable = self._factor(q)
                if is_stable:
                    return q, factor
                q, (energy, missing) = self._off_the_saddle(q, energy)
                escapes, is_fresh = escapes + 1, True
                factor, _ = self._factor(q)
                secants.clear()
                if escapes > _ESCAPES:
                    break
                continue
            step = -secants.improved(q, -missing, -_solved(factor, missing), 0)
            length, there = self._length(q, step, energy, missing)
            if length:
                q, (energy, missing) = q + length * step, there
            elif is_fresh:
                break
            is_slow = length < 1.0 or _norm(missing) > _FAST * left
            is_fresh = is_slow
            if is_slow:
                factor, _ = self._factor(q)
                secants.clear()
        raise NotConverged(
            f"GalerkinNetwork: no stable equilibrium was found; out-of-balance forces are {left / self.size:.1e} of "
            "the load's. The load may be too large: try a smaller one."
        )

    def _off_the_saddle(self, q: Floats, energy: float) -> tuple[Floats, tuple[float, Floats]]:
        """A state of less energy in the direction in which a balanced one gives way most."""
        way = np.linalg.eigh(self.network.stiffness(q))[1][:, 0]
        length = _norm(q)
        while length > self.noise:
            for sign in (1.0, -1.0):
                there = self._look(q + sign * length * way)
                if there[0] < energy - self.noise:
                    return q + sign * length * way, there
            length *= 0.5
        return q, self._look(q)

    def _length(self, q: Floats, step: Floats, energy: float, missing: Floats) -> tuple[float, tuple[float, Floats]]:
        """Length of a step that lowers the energy, or leaves it and brings forces nearer to balance; 0 for none."""
        slope, before, length = float(missing @ step), _norm(missing), 1.0
        while length >= _SHORTEST:
            there = self._look(q + length * step)
            change = there[0] - energy
            if change <= -_DESCENT * length * slope:
                return length, there
            if abs(change) <= self.noise and _norm(there[1]) < before:
                return length, there
            length *= 0.5
        return 0.0, (energy, missing)

    def _factor(self, q: Floats) -> tuple[Floats, bool]:
        """Of the tangent, or of a positive definite one beside it, and whether it is the tangent's own."""
        tangent = self.network.stiffness(q, self.network.is_exact)
        factor, info = dpotrf(tangent, lower=True)
        is_own = not info
        for shift in _SHIFTS:
            if not info:
                break
            factor, info = dpotrf(tangent + shift * self.network.at_rest.numpy(), lower=True)
        return factor, is_own


def _norm(vector: Floats) -> float:
    return float(np.sqrt(vector @ vector))


def _solved(factor: Floats, right: Floats) -> Floats:
    found: Floats = dpotrs(factor, right, lower=True)[0]
    return found


class GalerkinState:
    """A state of least energy under one load, with its derivative.

    Args:
        network: that found it.
        load: coordinates of the load, (r,).
        q: coordinates of the displacement, (r,).
        factor: of its tangent, (r, r).
    """

    def __init__(self, network: GalerkinNetwork, load: Tensor, q: Tensor, factor: Tensor) -> None:
        self.network, self.load, self.q, self.factor = network, load, q, factor
        self.values = q - torch.cholesky_solve(load[:, None], network.rest_factor)[:, 0]

    def jvp(self, tangents: Tensor) -> Tensor:
        """Changes of the values, (r, k), for changes of the coordinates, (r, k)."""
        changes = tangents.to(self.q)
        return torch.cholesky_solve(changes, self.factor) - torch.cholesky_solve(changes, self.network.rest_factor)

    def vjp(self, cotangent: Tensor) -> Tensor:
        """Gradient with respect to the coordinates, (r,), for one with respect to the values, (r,): symmetric."""
        return self.jvp(cotangent[:, None])[:, 0]

    def jvp_parameters(self, changes: Mapping[str, ArrayLike], springs: Mapping[str, float]) -> Tensor:
        """Change of the values, (r,), as parameters of the law and springs change.

        Args:
            changes: see `GalerkinNetwork.forces_by_parameters`.
            springs: see `GalerkinNetwork.forces_by_springs`.
        """
        forces = self.network.forces_by_parameters(self.q, changes) + self.network.forces_by_springs(self.q, springs)
        return -torch.cholesky_solve(forces[:, None], self.factor)[:, 0]
