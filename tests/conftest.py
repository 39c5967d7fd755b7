"""Bodies that many tests share, and the real liver where it is."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # before NumPy is imported; programs that tests start inherit it
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command line does: else tests on busy cores crawl

import numpy as np
import pytest

for folder in ("benchmarks", "examples", "tests"):
    sys.path.insert(0, str(Path(__file__).parents[1] / folder))

from shared_twins import built_once, unchanged

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam

LIVER = Path(__file__).parents[2] / "shared" / "data" / "liver"


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


@pytest.fixture(scope="session")
def small_quickstart() -> Iterator[Path]:
    """A finished small quickstart, run as a user runs it; who changes it takes a copy."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    pytest.importorskip("torch", reason="torch is absent")
    with unchanged(built_once("quickstart", _run_quickstart, __file__)) as folder:
        yield folder / "out"


def _run_quickstart(place: Path) -> None:
    command = [sys.executable, "-m", "softtwin.app.cli", "quickstart", "--small", "--output", "out"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (place / "out" / "said.txt").write_text(done.stdout)
    (place / "out" / "complained.txt").write_text(done.stderr)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def liver_folder() -> Path:
    if not LIVER.exists():
        pytest.skip("the real liver (../shared/data/liver) is absent")
    return LIVER
