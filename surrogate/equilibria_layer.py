"""Equilibria in torch as a function that autograd knows: `u = layer(forces, young_modulus=E)`, differentiable twice.

Nothing is traced through Newton's method. With R(u, p) the internal forces, K their derivative by u, f the forces and g
the gradient by u, the gradient by f is l = K^-1 g, and that by parameters p is -l dR/dp (implicit function theorem;
Odot 2023, section 7.1.4). The adjoint l is a function of u, p and g that autograd knows, too: its derivative is
dl = K^-1 (dg - dK l), where dK l is a third derivative of the energy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from softtwin.reference.data.outcome import NotConverged

from .equilibria import Equilibria, Tangent


class EquilibriaLayer:
    """Equilibria of a batch as a differentiable function of nodal forces and material parameters.

    Args:
        solver: body, law, device and precision; for gradients of more than 1e-5, double.
    """

    def __init__(self, solver: Equilibria) -> None:
        self.solver = solver
        self.names = tuple(solver.material.parameters)

    def __call__(self, forces: Tensor, **parameters: Tensor | float) -> Tensor:
        """Displacements, (s, n, 3), metres.

        Args:
            forces: nodal forces, (s, n, 3), newtons; what they have at held nodes moves nothing.
            parameters: of the law by name, for the whole batch: numbers, or (cells,); others stay.

        Raises:
            TypeError: unknown names.
            ValueError: forces of another shape, or parameters out of their range.
            NotConverged: no equilibrium was found for some of the loads.
        """
        if not set(parameters) <= set(self.names):
            raise TypeError(f"EquilibriaLayer: expected parameters among {self.names}, got {sorted(parameters)}.")
        like = self.solver.elastic.gradients
        values = []
        for name in self.names:
            known = getattr(self.solver.elastic, f"parameter_{name}")
            given = parameters.get(name)
            values.append(known if given is None else torch.as_tensor(given).to(like).reshape(-1, 1))
        given_now = {name: values[self.names.index(name)].detach().cpu().numpy()[:, 0] for name in parameters}
        numbers = {name: value[0] if len(value) == 1 else value for name, value in given_now.items()}
        solver = self.solver.with_parameters(**numbers) if numbers else self.solver
        found: Tensor = _Equilibria.apply(_Place(solver), forces.to(like), *values)
        return found


class _Place:
    """Where a batch was solved, what its derivatives share: the tangent's factors, made once."""

    def __init__(self, solver: Equilibria) -> None:
        self.solver = solver
        self.displacement: Tensor | None = None

    @cached_property
    def tangent(self) -> Tangent:
        assert self.displacement is not None
        return self.solver.tangent(self.displacement)

    def energy(self, displacement: Tensor, values: tuple[Tensor, ...]) -> Tensor:
        """Strain energy of the batch, joules, at displacements and parameters."""
        return self.solver.elastic.energy_of(
            displacement, dict(zip(self.solver.material.parameters, values, strict=True))
        )

    def along(self, way: Tensor) -> Callable[[Tensor, tuple[Tensor, ...]], Tensor]:
        """Change of the energy along a way, (s, n, 3): the work of the internal forces."""

        def work(displacement: Tensor, values: tuple[Tensor, ...]) -> Tensor:
            return (torch.func.grad(self.energy)(displacement, values) * way).sum()

        return work


class _Equilibria(torch.autograd.Function):
    """Forces and parameters to displacements."""

    @staticmethod
    def forward(ctx: Any, place: _Place, forces: Tensor, *values: Tensor) -> Tensor:
        free = forces.detach() * place.solver.elastic.free
        found = place.solver.solve(free)
        lost = torch.nonzero(~found.is_converged)[:, 0].tolist()
        if lost:
            raise NotConverged(
                f"EquilibriaLayer: no equilibrium was found for {len(lost)} of {len(forces)} loads, first {lost[:5]}; "
                "these may be too large."
            )
        place.displacement = found.displacement
        ctx.place = place
        ctx.save_for_backward(found.displacement, *values)
        return found.displacement

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        displacement, *values = ctx.saved_tensors
        adjoint = _Adjoint.apply(ctx.place, gradient, displacement, *values)
        pulled: tuple[Tensor | None, ...] = (None,) * len(values)
        if any(ctx.needs_input_grad[2:]):
            by_values = torch.func.grad(ctx.place.along(adjoint), argnums=1)(displacement, tuple(values))
            pulled = tuple(-one for one in by_values)
        return None, adjoint, *pulled


class _Adjoint(torch.autograd.Function):
    """Gradients by displacements to those by forces, K^-1 g."""

    @staticmethod
    def forward(ctx: Any, place: _Place, gradient: Tensor, displacement: Tensor, *values: Tensor) -> Tensor:
        found = place.tangent.inverse(gradient.detach()[..., None])[..., 0]
        ctx.place = place
        ctx.save_for_backward(found, displacement, *values)
        return found

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        adjoint, displacement, *values = ctx.saved_tensors
        turned = _Adjoint.apply(ctx.place, cotangent, displacement, *values)

        def stretched(at: Tensor, parameters: tuple[Tensor, ...]) -> Tensor:
            return (torch.func.grad(ctx.place.along(adjoint))(at, parameters) * turned).sum()

        by_place, by_values = torch.func.grad(stretched, argnums=(0, 1))(displacement, tuple(values))
        return None, turned, -by_place, *(-one for one in by_values)
