"""The code in docs/reference.md runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")


def test_the_guide_runs(capsys) -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference.md").read_text()
    names: dict[str, object] = {}
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.S)
    assert len(blocks) == 4
    for block in blocks:
        exec(compile(block, "docs/reference.md", "exec"), names)
    said = capsys.readouterr().out
    assert "converged" in said and "True" in said
