"""Bodies that many tests share, and the real liver where it is."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam

LIVER = Path(__file__).parents[2] / "shared" / "data" / "liver"
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))


@pytest.fixture(scope="session")
def hexahedral_beam() -> Body:
    return beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron")


@pytest.fixture(scope="session")
def tetrahedral_beam() -> Body:
    return beam((6, 2, 2), (0.6, 0.2, 0.2), "tetrahedron")


@pytest.fixture(params=["hexahedral_beam", "tetrahedral_beam"])
def any_beam(request: pytest.FixtureRequest) -> Body:
    return request.getfixturevalue(request.param)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def liver_folder() -> Path:
    if not LIVER.exists():
        pytest.skip("the real liver (../shared/data/liver) is absent")
    return LIVER
