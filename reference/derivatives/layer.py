"""The reference as a torch layer: `u = equilibrium(forces, young_modulus, poisson_ratio)`, differentiable twice.

A network and the reference can be chained this way (Odot 2023, section 7.1.4). Everything is computed in float64 on the
processor; tensors of another type or device come and go by conversion.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.inputs import Change
from ..data.materials import with_parameters
from ..data.outcome import Equilibrium
from ..solve.problem import Problem
from .linearisation import Linearisation

Floats = NDArray[np.float64]


class EquilibriumLayer:
    """Equilibria as a differentiable function of nodal forces and material parameters.

    Args:
        problem: body and material; stays owned by the caller. A call changes its material's parameters.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.names = tuple(problem.material.parameters)
        self.last: Equilibrium | None = None

    def __call__(self, forces: torch.Tensor, *parameters: torch.Tensor | float, **named: Any) -> torch.Tensor:
        """Displacement, (n, 3) or (b, n, 3), metres.

        Args:
            forces: nodal forces, (n, 3) or (b, n, 3), newtons.
            parameters: of the material, in its order: numbers or (cells,), as the problem was built with; those that
                are not given stay as they are.
            named: the same by name.

        Raises:
            TypeError: too many parameters, or unknown names.
            NotConverged: no equilibrium was found.
        """
        values = self._parameters(parameters, named)
        if forces.ndim == 3:
            return torch.stack([_Equilibrium.apply(self, one, *values) for one in forces])
        return _Equilibrium.apply(self, forces, *values)  # type: ignore[no-any-return]

    def _parameters(self, given: tuple[Any, ...], named: dict[str, Any]) -> list[torch.Tensor]:
        if len(given) > len(self.names) or not set(named) <= set(self.names[len(given) :]):
            raise TypeError(
                f"EquilibriumLayer: expected the parameters {self.names}, got {len(given)} and {sorted(named)}."
            )
        chosen = {**self.problem.material.parameters, **dict(zip(self.names, given, strict=False)), **named}
        return [torch.as_tensor(chosen[name], dtype=torch.float64) for name in self.names]

    def _use(self, parameters: tuple[torch.Tensor, ...]) -> None:
        """Give the problem these parameters, unless it has them."""
        wanted = {name: _array(value) for name, value in zip(self.names, parameters, strict=True)}
        if any(not np.array_equal(wanted[name], value) for name, value in self.problem.material.parameters.items()):
            self.problem.set_material(with_parameters(self.problem.material, wanted))


class _Equilibrium(torch.autograd.Function):
    """Forward: an equilibrium. Backward: its adjoint."""

    @staticmethod
    def forward(ctx: Any, layer: EquilibriumLayer, forces: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        layer._use(parameters)
        state = layer.problem.solve(_array(forces), stability=False)
        layer.last = state
        ctx.layer, ctx.state = layer, state
        ctx.save_for_backward(forces, *parameters)
        return _tensor(state.displacement, forces)

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> Any:
        return None, *_Pullback.apply(ctx.layer, ctx.state, cotangents[0], *ctx.saved_tensors)


class _Pullback(torch.autograd.Function):
    """Forward: the gradient by forces and parameters. Backward: its derivative, a Hessian product."""

    @staticmethod
    def forward(
        ctx: Any,
        layer: EquilibriumLayer,
        state: Equilibrium,
        cotangent: torch.Tensor,
        forces: torch.Tensor,
        *parameters: torch.Tensor,
    ) -> Any:
        ctx.layer, ctx.state = layer, state
        ctx.save_for_backward(cotangent, forces, *parameters)
        layer._use(parameters)
        gradient = Linearisation(layer.problem, _array(forces), state).gradient(_array(cotangent))
        return _tensors(gradient.forces, gradient.parameters, layer.names, forces, parameters)

    @staticmethod
    def backward(ctx: Any, *seeds: torch.Tensor) -> Any:
        cotangent, forces, *parameters = ctx.saved_tensors
        layer = ctx.layer
        layer._use(parameters)
        at = Linearisation(layer.problem, _array(forces), ctx.state)
        change = Change(_array(seeds[0]), {n: _array(s) for n, s in zip(layer.names, seeds[1:], strict=True)})
        product = at.hessian_product(_array(cotangent), change)
        by_cotangent = _tensor(at.tangent(change), cotangent)
        return None, None, by_cotangent, *_tensors(product.forces, product.parameters, layer.names, forces, parameters)


def _array(tensor: torch.Tensor) -> Floats:
    return tensor.detach().cpu().numpy().astype(np.float64)


def _tensor(values: Any, like: torch.Tensor) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values), dtype=like.dtype, device=like.device)


def _tensors(
    forces: Floats, by_name: dict[str, Floats], names: tuple[str, ...], like: torch.Tensor, parameters: Any
) -> tuple[torch.Tensor, ...]:
    found = [_tensor(by_name[name], value) for name, value in zip(names, parameters, strict=True)]
    return (_tensor(forces, like), *found)
