"""Muon and AdamW as one optimizer."""

from __future__ import annotations

import io

import pytest
import torch
from torch import Tensor, nn

from softtwin.surrogate import optimizers
from softtwin.surrogate.optimizers import MuonWithAdamW, orthogonalised

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


def test_each_weight_moves_as_by_its_own_optimizer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Muon as torch has it, which multiplies in bfloat16 on every machine."""
    monkeypatch.setattr(optimizers, "_fast_type", lambda weight: torch.bfloat16)
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
    moved = (together[0] - _weights()[0]).norm()
    assert (together[0] - apart[0]).norm() < 0.02 * moved  # the norm is taken in another order
    torch.testing.assert_close(together[1], apart[1], rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    ("shape", "dtype"), [((8, 8), torch.float32), ((5, 9), torch.float64), ((9, 5), torch.float32)]
)
def test_steps_have_singular_values_near_one_and_the_vectors_of_the_gradient(
    shape: tuple[int, int], dtype: torch.dtype
) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(2), dtype=dtype)
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    matrix = left * torch.linspace(0.2, 30.0, len(values), dtype=dtype) @ right
    found = left.T @ orthogonalised(matrix, dtype) @ right.T
    assert found.diagonal().min() > 0.5 and found.diagonal().max() < 1.3
    torch.testing.assert_close(found, torch.diag(found.diagonal()), rtol=0.0, atol=1e-4)


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
