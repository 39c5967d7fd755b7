"""Bodies that many tests share, and the real liver where it is."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam

LIVER = Path(__file__).parents[2] / "shared" / "data" / "liver"

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command line does: else tests on busy cores crawl

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


@pytest.fixture(scope="session")
def mpi_environment() -> dict[str, str]:
    """For mpirun: more ranks than cores, as root, in the words of Open MPI 4 and 5; MPICH asks for none of it."""
    return {
        **os.environ,
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
        "OMPI_MCA_hwloc_base_binding_policy": "none",
        "OMPI_MCA_mpi_yield_when_idle": "1",
        "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
        "PRTE_MCA_hwloc_default_binding_policy": "none",
        "OPENBLAS_NUM_THREADS": "1",
    }


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def liver_folder() -> Path:
    if not LIVER.exists():
        pytest.skip("the real liver (../shared/data/liver) is absent")
    return LIVER
