"""The script that times predictions runs on the CPU, with tiny networks, and measures nothing twice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

prediction = pytest.importorskip("prediction", reason="torch is absent")

import harness
from record import recorded
from repository import Repository

from softtwin.reference.data.dataset import DataSet


@pytest.fixture
def quick(tmp_path: Path, data: DataSet, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Few calls, small batches, no look at what the machine can do; a repository in place of this one."""
    Repository(tmp_path / "code", monkeypatch)
    for name, value in {"LEAST_SECONDS": 0.0, "BATCHES": (1, 2), "CHANNELS": 2}.items():
        monkeypatch.setattr(prediction, name, value)
    limits = {"operations_per_s": 1e12, "bytes_per_s": 1e12, "cached_bytes_per_s": 1e12}
    monkeypatch.setattr(prediction, "peak", lambda device: limits)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_every_network_is_timed_once(quick: None, data: DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--data", str(data.path), "--device", "cpu"]
    harness.run(prediction.BENCHMARK, words)
    found = recorded("prediction")
    assert found["device"] == "one CPU thread"
    assert set(found["networks"]) == {"reduced", "mlp", "umesh, 2 channels", "transolver"}
    for figures in found["networks"].values():
        assert figures["device"] == "cpu" and figures["weights_bytes"] > 0.0 and figures["operations"] > 0.0
        assert min(figures[name] for name in ("double_ms", "single_ms", "with_jacobian_ms")) > 0.0
        assert set(figures["batches"]) == {"1", "2"}
        assert figures["off"]["fast"] < 1e-6 and set(figures["push_ms"]) == {"own", "torch.func"}
    monkeypatch.setattr(prediction, "measured", None)
    harness.run(prediction.BENCHMARK, words)
    assert recorded("prediction") == found
