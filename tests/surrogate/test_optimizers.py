"""Muon and AdamW as one optimizer."""

from __future__ import annotations

import io

import torch
from torch import Tensor, nn

from softtwin.surrogate.optimizers import MuonWithAdamW

RATE, DECAY = 3e-3, 0.1


def _weights() -> tuple[nn.Parameter, nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return (
        nn.Parameter(torch.randn(12, 8, generator=generator)),
        nn.Parameter(torch.randn(12, generator=generator)),
    )


def _step(optimizer: torch.optim.Optimizer, weights: tuple[nn.Parameter, ...], count: int = 3) -> None:
    for number in range(count):
        generator = torch.Generator().manual_seed(number)
        for weight in weights:
            weight.grad = torch.randn(weight.shape, generator=generator)
        optimizer.step()


def _both(weights: tuple[nn.Parameter, nn.Parameter]) -> MuonWithAdamW:
    return MuonWithAdamW(weights[:1], weights[1:], RATE, DECAY)


def test_each_weight_moves_as_by_its_own_optimizer() -> None:
    together, apart = _weights(), _weights()
    _step(_both(together), together)
    muon = torch.optim.Muon(apart[:1], RATE, DECAY, adjust_lr_fn="match_rms_adamw")
    adamw = torch.optim.AdamW(apart[1:], RATE, weight_decay=DECAY, fused=True)
    for number in range(3):
        generator = torch.Generator().manual_seed(number)
        for weight in apart:
            weight.grad = torch.randn(weight.shape, generator=generator)
        muon.step()
        adamw.step()
    for one, other in zip(together, apart, strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0)


def test_the_rate_is_set_for_both() -> None:
    weights = _weights()
    before = [weight.detach().clone() for weight in weights]
    optimizer = _both(weights)
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    _step(optimizer, weights)
    for weight, old in zip(weights, before, strict=True):
        torch.testing.assert_close(weight.detach(), old, rtol=0.0, atol=0.0)


def test_it_goes_on_from_what_was_saved() -> None:
    weights = _weights()
    optimizer = _both(weights)
    _step(optimizer, weights)
    file = io.BytesIO()
    torch.save({"optimizer": optimizer.state_dict(), "weights": [weight.detach() for weight in weights]}, file)
    _step(optimizer, weights)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    resumed: tuple[nn.Parameter, nn.Parameter] = tuple(nn.Parameter(weight) for weight in saved["weights"])  # type: ignore[assignment]
    later = _both(resumed)
    later.load_state_dict(saved["optimizer"])
    _step(later, resumed)
    for one, other in zip(weights, resumed, strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0)


def test_a_closure_is_called_once_with_gradients() -> None:
    weights, calls = _weights(), []

    def closure() -> float:
        calls.append(torch.is_grad_enabled())
        loss: Tensor = sum((weight.square().sum() for weight in weights), torch.zeros(()))
        loss.backward()
        return float(loss.detach())

    first = _both(weights).step(closure)
    assert calls == [True] and first is not None and first > 0.0
