"""What is compiled is told of, once."""

from __future__ import annotations

import numpy as np
import pytest

from softtwin.meshes import compiled as compiled_module
from softtwin.meshes.compiled import compiled, said_when_compiling


def test_the_first_loop_that_is_compiled_is_told_of() -> None:
    """Not one that is there already, nor a second one, nor any outside the context."""
    numba = pytest.importorskip("numba")

    def made() -> object:
        return numba.njit(lambda values: values.sum())  # kept nowhere: compiled anew

    first, second, said = made(), made(), list[str]()
    first(np.ones(3))
    with said_when_compiling(lambda: said.append("compiling")):
        first(np.ones(4))
        assert not said
        second(np.ones(3))
        assert said == ["compiling"]
        second(np.ones(3, dtype=np.float32))
        assert said == ["compiling"]
    made()(np.ones(3))
    assert said == ["compiling"]


def test_without_a_compiler_nothing_is_told(monkeypatch) -> None:
    monkeypatch.setattr(compiled_module, "numba", None)
    with said_when_compiling(lambda: pytest.fail("told")):
        assert compiled(abs) is abs
