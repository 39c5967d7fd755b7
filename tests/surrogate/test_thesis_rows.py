"""The rows that wait for a GPU run where there is none."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

networks = pytest.importorskip("networks", reason="torch is absent")

import harness
from record import recorded
from repository import Repository

from softtwin.reference.data.dataset import DataSet


def test_all_networks_are_trained_and_judged_and_not_again(
    tmp_path: Path, soft: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    Repository(tmp_path / "code", monkeypatch)
    for module in ("softtwin.reference.generate", "softtwin.reference.solve.problem"):
        monkeypatch.setitem(sys.modules, module, None)  # that machine has no FEniCSx
    monkeypatch.setattr(networks, "DataSet", lambda path: soft)
    words = ["--tables", "thesis", "--data", str(soft.path), "--device", "cpu", "--epochs", "1"]
    words += ["--channels", "2", "--width", "8", "--name", "waiting"]
    harness.run(networks.BENCHMARK, words)
    found = recorded("waiting")
    assert len(found) == 5  # U-Mesh in mixed precision, too
    for figures in found.values():
        assert figures["plan"]["epochs"] == 1
        assert figures["modal"]["nodal_error"]["mean"] > 0.0
    monkeypatch.setattr(networks, "train", None)
    harness.run(networks.BENCHMARK, words)
    assert recorded("waiting") == found
