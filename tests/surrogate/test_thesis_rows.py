"""The rows that wait for a GPU run where there is none."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

networks = pytest.importorskip("networks", reason="torch is absent")

from record import recorded

from softtwin.reference.data.dataset import DataSet


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where records go, in place of those that are kept."""
    folder = tmp_path / "records"
    monkeypatch.setattr("record.RESULTS", folder)
    return folder


def test_all_networks_are_trained_and_judged_and_not_again(
    results: Path, soft: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("softtwin.reference.generate", "softtwin.reference.solve.problem"):
        monkeypatch.setitem(sys.modules, module, None)  # that machine has no FEniCSx
    monkeypatch.setattr(networks, "DataSet", lambda path: soft)
    words = ["--tables", "thesis", "--data", str(soft.path), "--device", "cpu", "--epochs", "1"]
    words += ["--channels", "2", "--width", "8", "--name", "waiting"]
    networks.main(words)
    found = recorded("waiting")
    assert len(found) == 5  # U-Mesh in mixed precision, too
    for figures in found.values():
        assert figures["plan"]["epochs"] == 1
        assert figures["modal"]["nodal_error"]["mean"] > 0.0
    monkeypatch.setattr(networks, "train", None)
    networks.main(words)
    assert recorded("waiting") == found
