"""Host to host: what the surrogate says, to 1e-6 or to rounding; on a GPU too, where there is one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.fast import FastSurrogate, Precision
from softtwin.surrogate.model import Surrogate

from .conftest import DEVICES

CLOSE = {"single": 1e-6, "double": 1e-12}  # of the largest


@pytest.fixture(params=CLOSE)
def precision(request: pytest.FixtureRequest) -> Precision:
    return request.param


@pytest.fixture(params=DEVICES)
def fast(request: pytest.FixtureRequest, surrogate: Surrogate, precision: Precision) -> FastSurrogate:
    return FastSurrogate(surrogate, request.param, directions=7, batch=5, precision=precision)


@pytest.fixture
def loads(data: DataSet) -> np.ndarray:
    samples = data.samples("test")
    given = np.zeros((5, *data.body.points.shape))
    given[:, data.response.loaded] = samples.forces[:5]
    return given


def test_displacements_alone_and_in_batches(fast: FastSurrogate, surrogate: Surrogate, loads: np.ndarray) -> None:
    expected = np.stack([surrogate.solve(one).displacement for one in loads])
    size = np.abs(expected).max()
    first = fast.solve(loads[0])
    assert np.abs(fast.solve_many(loads) - expected).max() < CLOSE[fast.precision] * size
    again = np.stack([fast.solve(one) for one in loads])
    assert np.abs(again - expected).max() < CLOSE[fast.precision] * size
    np.testing.assert_array_equal(first, again[0])  # what a call returned is not changed by the next


def test_jacobians(fast: FastSurrogate, surrogate: Surrogate) -> None:
    coefficients = 0.05 * np.random.default_rng(0).standard_normal(7)
    columns = np.zeros((surrogate.body.points.size, 7))
    columns[surrogate.rows] = fast.directions
    state = surrogate.solve((columns @ coefficients).reshape(-1, 3))
    displacement, jacobian = fast.linearised(coefficients)
    expected = state.jvp(columns)
    assert np.abs(displacement - state.displacement).max() < CLOSE[fast.precision] * np.abs(state.displacement).max()
    assert np.abs(jacobian - expected).max() < CLOSE[fast.precision] * np.abs(expected).max()


def test_wrong_input_is_named(surrogate: Surrogate, loads: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    fast = FastSurrogate(surrogate, "cpu", directions=3)
    with pytest.raises(ValueError, match=r"FastSurrogate\.forces: expected shape \(45, 3\), got \(44, 3\)"):
        fast.solve(loads[0, 1:])
    with pytest.raises(ValueError, match=r"FastSurrogate\.coefficients: expected finite"):
        fast.linearised(np.full(3, np.nan))
    with pytest.raises(ValueError, match=r"FastSurrogate\.batch: expected a number of loads when it was built"):
        fast.solve_many(loads)
    many = FastSurrogate(surrogate, "cpu", directions=3, batch=5)
    ragged = [loads[0].tolist(), loads[1].tolist()[1:]]
    for wrong, message in (
        (loads[:4], r"expected shape \(5, 45, 3\), got \(4, 45, 3\)"),
        (loads[0], r"expected shape \(5, 45, 3\), got \(45, 3\)"),
        (loads.astype(str), r"expected real numbers, got <U\d+"),
        (loads.astype(complex), "expected real numbers, got complex128"),
        (loads.astype(object), "expected real numbers, got object"),
        (None, "expected real numbers, got object"),
        (ragged, r"expected shape \(5, 45, 3\), got rows of different lengths"),
        (np.full_like(loads, np.inf), "expected finite numbers"),
    ):
        with pytest.raises(ValueError, match=rf"FastSurrogate\.forces: {message}"):
            many.solve_many(wrong)
    with pytest.raises(ValueError, match=r"FastSurrogate\.precision: expected one of .*, got 'half'"):
        FastSurrogate(surrogate, "cpu", precision="half")  # type: ignore[arg-type]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"FastSurrogate\.device: expected a GPU that torch can use, found none"):
        FastSurrogate(surrogate, "cuda")
