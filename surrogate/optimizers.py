"""Muon and AdamW as one optimizer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

_MOMENTUM, _RMS = 0.95, 0.2  # the second: of AdamW's steps, so that one learning rate serves both (arXiv 2502.16982)
_QUINTIC = (3.4445, -4.7750, 2.0315)  # Keller Jordan's, steep at zero; they end between 0.7 and 1.2, which is enough
_ITERATIONS = 5


class Muon(torch.optim.Optimizer):
    """Momentum whose steps are made orthogonal (https://kellerjordan.github.io/posts/muon/).

    As `torch.optim.Muon`, which multiplies in bfloat16 everywhere: a processor without instructions for it is slower by
    orders of magnitude then. Here bfloat16 is used where there are such.

    Args:
        weights: matrices.
        lr: learning rate, as AdamW's.
        weight_decay: decoupled, as AdamW's.
    """

    def __init__(self, weights: Iterable[Tensor], lr: float, weight_decay: float) -> None:
        super().__init__(weights, {"lr": lr, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """One step of all matrices that have a gradient."""
        for group in self.param_groups:
            rate, decay = group["lr"], group["weight_decay"]
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if not state:
                    state["momentum"] = torch.zeros_like(weight)
                momentum = state["momentum"].lerp_(weight.grad, 1.0 - _MOMENTUM)
                step = orthogonalised(weight.grad.lerp(momentum, _MOMENTUM), _fast_type(weight))
                weight.mul_(1.0 - rate * decay).sub_(step, alpha=rate * _RMS * max(weight.shape) ** 0.5)


def orthogonalised(matrix: Tensor, dtype: torch.dtype) -> Tensor:
    """A matrix with the same singular vectors and singular values near one, by Newton and Schulz's iteration.

    Args:
        matrix: (m, n).
        dtype: of the iteration.
    """
    a, b, c = _QUINTIC
    turned = matrix.shape[0] > matrix.shape[1]
    x = (matrix.T if turned else matrix).to(dtype)
    x = x / torch.linalg.matrix_norm(x).clamp(min=1e-7)
    for _ in range(_ITERATIONS):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return (x.T if turned else x).to(matrix.dtype)


def _fast_type(weight: Tensor) -> torch.dtype:
    known = getattr(torch.cpu, "_is_avx512_bf16_supported", None)  # not public, nor is there another way to ask
    fast = weight.is_cuda or (known is not None and known())
    return torch.bfloat16 if fast else weight.dtype


class MuonWithAdamW(torch.optim.Optimizer):
    """Muon for matrices between hidden layers, AdamW for all other weights, as Muon's authors advise.

    Muon makes the singular values of each step nearly equal, so that directions with small gradients are learned, too.

    Args:
        hidden: weights for Muon, matrices.
        others: weights for AdamW.
        lr: learning rate of both.
        weight_decay: of both; what keeps the network tame beyond its training loads.
    """

    def __init__(self, hidden: Iterable[Tensor], others: Iterable[Tensor], lr: float, weight_decay: float) -> None:
        self._parts: tuple[torch.optim.Optimizer, ...] = (
            Muon(hidden, lr, weight_decay),
            torch.optim.AdamW(others, lr, weight_decay=weight_decay, fused=True),
        )
        super().__init__([group for part in self._parts for group in part.param_groups], {})
        self._share()

    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step of both."""
        loss = None if closure is None else torch.enable_grad()(closure)()
        for part in self._parts:
            part.step()
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take back what `state_dict` was."""
        super().load_state_dict(state_dict)
        self._share()

    def _share(self) -> None:
        """Let the parts work on the groups and the state that are seen from outside."""
        for part, group in zip(self._parts, self.param_groups, strict=True):
            part.param_groups, part.state = [group], self.state
