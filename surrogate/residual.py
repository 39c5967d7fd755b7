"""Energy, internal forces and residual of a body in torch, whole batches at a time: physics for a loss, no FEniCSx."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType, SimpleNamespace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from torch import Tensor, nn

from softtwin.meshes.body import Body
from softtwin.meshes.elements import linear_kind
from softtwin.meshes.quadrature import quadrature, quadrature_degree, shape_functions
from softtwin.reference.data.materials import Energy, Material
from softtwin.reference.data.springs import Support, cell_springs, on_surfaces

from .algebra import TorchAlgebra
from .jets import JetAlgebra
from .ligaments import Ligaments

Ints = NDArray[np.int64]


class ElasticBody(nn.Module):
    """A body of one compressible material, its displacements in batches, (s, n, 3), metres.

    Displacements and forces of another shape, or of another type than the body's own (float64 before `to`), are refused
    with a ValueError. The same cells, quadrature and energies as the reference's `Problem`; `to` moves it to a device
    or a precision.

    Args:
        body: the body, in space.
        material: strain energy; not mixed, and not an own `Energy`, which is written in UFL.
        weights: factor of each cell's energy, (cells,), in place of the body's own fractions.
        springs: that hold named surfaces; their energy, forces and stiffness count with the cells' own.
        minimum_jacobian: for training: det F below it counts more (`TorchAlgebra`), and nothing is NaN; 0 leaves all
            as it is.

    Raises:
        ValueError: a plane body, a material of the kinds above, or weights of another shape.
    """

    gradients: Tensor
    volumes: Tensor
    cells: Tensor
    free: Tensor
    sprung: Tensor
    spring_parts: Tensor
    spring_factors: Tensor
    spring_areas: Tensor

    def __init__(
        self,
        body: Body,
        material: Material,
        weights: ArrayLike | None = None,
        *,
        springs: Mapping[str, Support] = MappingProxyType({}),
        minimum_jacobian: float = 0.0,
    ) -> None:
        super().__init__()
        if body.dimension != 3:
            raise ValueError(f"ElasticBody.body: expected a body in space, got one of {body.dimension} dimensions.")
        if material.is_mixed or isinstance(material, Energy):
            raise ValueError(
                f"ElasticBody.material: expected a compressible law of this package, got {type(material).__name__}."
            )
        own = np.ones(len(body.cells)) if body.fractions is None else body.fractions
        part = own if weights is None else np.asarray(weights, dtype=np.float64)
        if part.shape != (len(body.cells),):
            raise ValueError(f"ElasticBody.weights: expected shape ({len(body.cells)},), got {part.shape}.")
        self.material, self.nodes, self.minimum_jacobian = material, len(body.points), minimum_jacobian
        points, factors = quadrature(body.kind, quadrature_degree(body))
        shaped = linear_kind(body.kind) if body.is_straight else body.kind
        corners = body.points[body.cells[:, : shaped.nodes]]
        jacobians = np.einsum("cki,qkj->cqij", corners, shape_functions(shaped, points)[1])
        slopes = shape_functions(body.kind, points)[1]
        gradients = np.einsum("qkj,cqji->cqki", slopes, np.linalg.inv(jacobians))
        self.register_buffer("gradients", torch.from_numpy(gradients))
        self.register_buffer("volumes", torch.from_numpy(part[:, None] * factors * np.linalg.det(jacobians)))
        self.register_buffer("cells", torch.from_numpy(body.cells.astype(np.int64)))
        is_free = np.ones((self.nodes, 1))
        is_free[body.fixed] = 0.0
        self.register_buffer("free", torch.from_numpy(is_free))
        held = cell_springs(body, on_surfaces(springs))
        self.register_buffer("sprung", torch.from_numpy(held.cells))
        self.register_buffer("spring_parts", torch.from_numpy(held.stiffness))
        self.register_buffer("spring_factors", torch.ones(len(held.stiffness), dtype=torch.float64))
        self.springs = tuple(on_surfaces(springs))
        self.register_buffer("spring_areas", torch.from_numpy(held.areas))
        self.ligaments = Ligaments(body, springs)
        for name, values in self._named(material).items():
            self.register_buffer(name, values)

    def _named(self, material: Material) -> dict[str, Tensor]:
        """Parameters of a law by the names of their buffers, (1, 1) or (cells, 1)."""
        count, found = len(self.cells), {}
        for name, value in material.parameters.items():
            values = np.asarray(value, dtype=np.float64)
            if values.shape not in ((), (count,)):
                raise ValueError(
                    f"ElasticBody.material.{name}: expected a number or one for each of the {count} cells, "
                    f"got shape {values.shape}."
                )
            found[f"parameter_{name}"] = torch.from_numpy(values.reshape(-1, 1).copy())
        return found

    def with_material(self, material: Material) -> ElasticBody:
        """The same with other parameters of the same law.

        Args:
            material: of that law.

        Raises:
            ValueError: another law, or parameters of another shape.
        """
        if type(material) is not type(self.material):
            raise ValueError(
                f"ElasticBody.with_material: expected a {type(self.material).__name__}, got {type(material).__name__}."
            )
        other = copy.copy(self)
        values = {name: value.to(self.gradients) for name, value in self._named(material).items()}
        other._buffers = {**self._buffers, **values}
        other.material = material
        return other

    def with_springs(self, factors: Mapping[str, float]) -> ElasticBody:
        """The same with springs that are stiffer or softer than given.

        Args:
            factors: how many times as stiff, by the surface that they hold; others as given.

        Raises:
            ValueError: no springs there.
        """
        known = {*self.springs, *self.ligaments.names}
        strange = sorted(factors.keys() - known)
        if strange:
            raise ValueError(
                f"ElasticBody.with_springs: expected names of springs, {sorted(known)}, got {strange[0]!r}."
            )
        other = copy.copy(self)
        other._modules = {**self._modules, "ligaments": self.ligaments.scaled(factors)}
        given = [factors.get(name, 1.0) for name in self.springs]
        values = torch.tensor(given, dtype=torch.float64).to(self.spring_factors)
        other._buffers = {**self._buffers, "spring_factors": values}
        return other

    @property
    def spring_stiffness(self) -> Tensor:
        """Of all springs in the cells that they hold, (c, 3k, 3k), N/m."""
        return torch.einsum("n,ncij->cij", self.spring_factors, self.spring_parts)

    def spring_forces(self, name: str, displacement: Tensor) -> Tensor:
        """Forces, (s, n, 3), newtons, that springs, or a ligament, of one name need as they were given."""
        if name in self.ligaments.names:
            return self.ligaments.forces(displacement, name)
        cells = self.cells[self.sprung]
        moved = displacement[:, cells].flatten(2)
        pulled = torch.einsum("cij,scj->sci", self.spring_parts[self.springs.index(name)], moved)
        return torch.zeros_like(displacement).index_add(
            1, cells.reshape(-1), pulled.reshape(len(moved), cells.numel(), 3)
        )

    def _check(self, name: str, field: Tensor) -> None:
        if not isinstance(field, Tensor):
            raise ValueError(f"ElasticBody.{name}: expected a tensor, got {type(field).__name__}.")
        if field.ndim != 3 or field.shape[1:] != (self.nodes, 3):
            raise ValueError(f"ElasticBody.{name}: expected shape (s, {self.nodes}, 3), got {tuple(field.shape)}.")
        if field.dtype != self.gradients.dtype:
            raise ValueError(f"ElasticBody.{name}: expected {self.gradients.dtype}, got {field.dtype}; see `to`.")

    def deformation_gradients(self, displacement: Tensor) -> Tensor:
        """F at the points of the quadrature, (s, cells, q, 3, 3)."""
        self._check("displacement", displacement)
        nodal = displacement[:, self.cells]
        unit = torch.eye(3, dtype=self.gradients.dtype, device=self.gradients.device)
        return unit + torch.einsum("scki,cqkj->scqij", nodal, self.gradients)

    def jacobians(self, displacement: Tensor) -> Tensor:
        """Det F there, (s, cells, q): not positive where a cell is inside out."""
        F = self.deformation_gradients(displacement)
        return TorchAlgebra(F).det(F)

    def energy(self, displacement: Tensor) -> Tensor:
        """Strain energy, and that of springs, (s,), joules; NaN where the law is none for a cell inside out."""
        F = self.deformation_gradients(displacement)
        stored = (self.density(F) * self.volumes).sum(dim=(1, 2))
        return stored + self._support_energy(displacement)

    def _support_energy(self, displacement: Tensor) -> Tensor:
        """Of springs and ligaments, (s,), joules."""
        found = self.ligaments.energy(displacement)
        return found + self._spring_energy(displacement) if len(self.sprung) else found

    def _pulled(self, displacement: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements of the cells that springs hold, and what these need for it, (s, c, 3k) each."""
        moved = displacement[:, self.cells[self.sprung]].flatten(2)
        return moved, torch.einsum("cij,scj->sci", self.spring_stiffness, moved)

    def _spring_energy(self, displacement: Tensor) -> Tensor:
        moved, pulled = self._pulled(displacement)
        return 0.5 * (moved * pulled).sum(dim=(1, 2))

    def _with_spring_forces(self, forces: Tensor, displacement: Tensor) -> Tensor:
        if self.ligaments.names:
            forces = forces + self.ligaments.forces(displacement)
        if not len(self.sprung):
            return forces
        cells = self.cells[self.sprung]
        pulled = self._pulled(displacement)[1].reshape(len(forces), cells.numel(), 3)
        return forces.index_add(1, cells.reshape(-1), pulled)

    def internal_forces(self, displacement: Tensor) -> Tensor:
        """Derivative of the stored energy, (s, n, 3), newtons; itself differentiable."""
        F = self.deformation_gradients(displacement)
        is_differentiated = F.requires_grad
        with torch.enable_grad():
            at = F if is_differentiated else F.requires_grad_()
            (stress,) = torch.autograd.grad(self.density(at).sum(), at, create_graph=is_differentiated)
        return self._with_spring_forces(self.assembled(stress), displacement)

    def energy_and_forces(self, displacement: Tensor) -> tuple[Tensor, Tensor]:
        """Stored energy, (s,), joules, and its derivative, (s, n, 3), newtons, of states that carry no derivatives.

        Where a cell is inside out, the energy is infinite.
        """
        F = self.deformation_gradients(displacement).detach()
        with torch.enable_grad():
            at = F.requires_grad_()
            density = self.density(at)
            (stress,) = torch.autograd.grad(density.sum(), at)
        density = density.detach()
        is_sound = (TorchAlgebra(F).det(F.detach()) > 0.0) | self.material.is_linear
        energy = torch.where(is_sound, density * self.volumes, torch.inf).sum(dim=(1, 2))
        energy = energy + self._support_energy(displacement).detach()
        return energy, self._with_spring_forces(self.assembled(stress), displacement.detach())

    def assembled(self, stress: Tensor) -> Tensor:
        """Nodal forces, (s, n, 3), newtons, of stresses P at the points of the quadrature, (s, cells, q, 3, 3)."""
        shares = torch.einsum("scqij,cqkj,cq->scki", stress, self.gradients, self.volumes)
        forces = torch.zeros(len(stress), self.nodes, 3, dtype=stress.dtype, device=stress.device)
        return forces.index_add(1, self.cells.reshape(-1), shares.reshape(len(stress), self.cells.numel(), 3))

    def cell_stiffnesses(self, displacement: Tensor) -> Tensor:
        """Tangents of the cells, node by node, N/m: (cells, 3k, 3k) at one state, (n, 3), metres; (s, ...) at many."""
        if displacement.ndim == 2:
            return self.cell_stiffnesses(displacement[None])[0]
        F = self.deformation_gradients(displacement)
        moduli = self.moduli(F) * self.volumes[..., None, None, None, None]
        cells, _, nodes, _ = self.gradients.shape
        ahead = torch.einsum("scqijml,cqnl->scqjinm", moduli, self.gradients).reshape(len(F), cells, -1, 9 * nodes)
        behind = self.gradients.transpose(1, 2).reshape(cells, nodes, -1)
        found = (behind @ ahead).reshape(len(F), cells, 3 * nodes, 3 * nodes)
        if len(self.sprung):
            found = found.index_add(1, self.sprung, self.spring_stiffness.expand(len(F), -1, -1, -1))
        if self.ligaments.names:
            found = found.index_add(1, self.ligaments.cells, self.ligaments.stiffness(displacement))
        return found

    def moduli(self, F: Tensor) -> Tensor:
        """Second derivatives of the energy density by F, pascals: (..., 3, 3, 3, 3) for (..., 3, 3)."""
        if self.minimum_jacobian:
            return self._moduli_by_autograd(F)
        algebra, shape = JetAlgebra(2), F.shape[:-2]
        parameters = {
            name: values.reshape(-1) if values.numel() == 1 else values.expand(shape).reshape(-1)
            for name, values in ((n, getattr(self, f"parameter_{n}")) for n in self.material.parameters)
        }
        at = algebra.variable(F.reshape(-1, 3, 3))
        second = self.material.energy(at, None, SimpleNamespace(**parameters), algebra).second
        found: Tensor = second.expand(at.value.shape[0], 9, 9).reshape(*shape, 3, 3, 3, 3)
        return found

    def _moduli_by_autograd(self, F: Tensor) -> Tensor:
        stress = torch.func.grad(lambda at: self.density(at).sum())

        def component(i: int, j: int) -> Callable[[Tensor], Tensor]:
            return lambda at: stress(at)[..., i, j].sum()

        rows = [torch.func.grad(component(i, j))(F) for i in range(3) for j in range(3)]
        return torch.stack(rows, dim=-3).unflatten(-3, (3, 3))

    def stiffness(self, displacement: Tensor) -> csr_matrix:
        """The tangent at one state, (n, 3), metres: (3n, 3n), N/m, fixed nodes included, no following pressure."""
        blocks = self.cell_stiffnesses(displacement).detach().double().cpu().numpy()
        unknowns = (3 * self.cells[:, :, None].cpu().numpy() + np.arange(3)).reshape(len(blocks), -1)
        rows, columns = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
        size = 3 * self.nodes
        return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsr()

    @cached_property
    def _pattern(self) -> tuple[Ints, Ints, Ints]:
        """Rows and starts of the columns of the free unknowns' tangent, and where each number of the cells' goes.

        What belongs to a fixed node goes to one place behind all others.
        """
        is_free = np.repeat(self.free[:, 0].cpu().numpy() > 0.0, 3)
        count = int(is_free.sum())
        number = np.where(is_free, np.cumsum(is_free) - 1, -1)
        unknowns = number[(3 * self.cells[:, :, None].cpu().numpy() + np.arange(3)).reshape(len(self.cells), -1)]
        rows, columns = unknowns[:, :, None], unknowns[:, None, :]
        keys = np.where((rows >= 0) & (columns >= 0), columns * count + rows, count * count)
        known, place = np.unique(keys, return_inverse=True)
        known = known[known < count * count]
        return known % count, np.searchsorted(known, count * np.arange(count + 1)), place.ravel()

    def free_stiffness(self, displacement: Tensor) -> csc_matrix:
        """The tangent of the free unknowns at one state, (n, 3), metres, N/m: `stiffness` without the fixed nodes."""
        rows, starts, place = self._pattern
        blocks = self.cell_stiffnesses(displacement).detach().double().cpu().numpy()
        values = np.bincount(place, blocks.ravel(), len(rows))[: len(rows)]
        return csc_matrix((values, rows, starts), shape=(len(starts) - 1, len(starts) - 1))

    def residual(self, displacement: Tensor, forces: Tensor) -> Tensor:
        """Out-of-balance forces at the free nodes relative to the forces there, |R(u) - b| / |b|, (s,).

        Args:
            displacement: u, (s, n, 3), metres.
            forces: b, (s, n, 3), newtons.
        """
        self._check("forces", forces)
        missing = (self.internal_forces(displacement) - forces) * self.free
        sizes = torch.linalg.vector_norm(forces * self.free, dim=(1, 2))
        return torch.linalg.vector_norm(missing, dim=(1, 2)) / sizes

    def potential(self, displacement: Tensor, forces: Tensor) -> Tensor:
        """Strain energy less the work of dead forces, (s,), joules: least in equilibrium."""
        self._check("forces", forces)
        return self.energy(displacement) - (forces * displacement).sum(dim=(1, 2))

    def density(self, F: Tensor) -> Tensor:
        """Strain energy of deformation gradients, (..., 3, 3), joules a cubic metre, (...)."""
        return self.density_of(F, {name: getattr(self, f"parameter_{name}") for name in self.material.parameters})

    def density_of(self, F: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """The same of other parameters of the law, each (1, 1) or (cells, 1)."""
        algebra = TorchAlgebra(F, self.minimum_jacobian)
        density: Tensor = self.material.energy(F, None, SimpleNamespace(**parameters), algebra)
        return density

    def energy_of(self, displacement: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Stored energy of all states together, joules, as a function of displacements and parameters."""
        F = self.deformation_gradients(displacement)
        stored = (self.density_of(F, parameters) * self.volumes).sum()
        return stored + self._support_energy(displacement).sum()
