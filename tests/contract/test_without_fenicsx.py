"""What holds without FEniCSx: the fast path imports; a packaged twin predicts, registers, and says what it cannot do.

Each program runs in a process of its own where FEniCSx cannot be imported, whether it is installed or not.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is absent")

from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import target_points
from softtwin.meshes.io import read_body

pytestmark = pytest.mark.contract
FENICSX = ("dolfinx", "dolfinx_solver", "ufl", "basix", "ffcx", "petsc4py", "slepc4py", "mpi4py")
BLOCKED = f"import sys; blocked = {FENICSX}; sys.modules.update(dict.fromkeys(blocked))\n"

IMPORTS = """
import importlib, pkgutil
names = []
for package in ("softtwin.meshes", "softtwin.reference.data", "softtwin.surrogate", "softtwin.registration"):
    found = importlib.import_module(package)
    names += [package, *(module.name for module in pkgutil.walk_packages(found.__path__, package + "."))]
left = 0
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:  # what trains, meshes and writes data sets is of other extras than `register`
        meshing, training = {"gmsh", "nibabel", "nrrd", "pyacvd", "pytetwild", "pyvista"}, {"lightning", "tensorboardX"}
        if error.name not in meshing | training | {"zarr"}:
            raise
        left += 1
assert all(sys.modules[name] is None for name in blocked), "somebody has put it there"
print(len(names) - left)
"""

PREDICTION = """
import json
import numpy as np
from pathlib import Path
import softtwin.app.twin
from softtwin.app.twin import Twin
PHANTOM = Path(softtwin.app.twin.__file__).parent / "twins" / "phantom"
with Twin.open(PHANTOM) as twin:
    nodes = np.setdiff1d(np.unique(twin.body.surfaces["observed"]), twin.body.fixed)
    forces, change = np.zeros((2, *twin.body.points.shape))
    forces[nodes, 1] = -0.5 / len(nodes)
    change[nodes] = np.random.default_rng(0).standard_normal((len(nodes), 3)) / len(nodes)
    rest, state = twin.predict(np.zeros_like(forces)), twin.predict(forces)
    ends = [[twin.predict(forces + sign * size * change).displacement for sign in (1.0, -1.0)] for size in (0.1, 0.05)]
    slopes = [(up - down).ravel() / (2.0 * size) for (up, down), size in zip(ends, (0.1, 0.05))]
    cotangent = np.random.default_rng(1).standard_normal(forces.shape)
    along = float(np.vdot(state.vjp(cotangent), change))
    off = [abs(float(cotangent.ravel() @ slope) - along) for slope in slopes]
    print(json.dumps({
        "rest": float(np.abs(rest.displacement).max()), "moved": float(np.abs(state.displacement).max()),
        "fixed": float(np.abs(state.displacement[twin.body.fixed]).max()), "off": off, "along": abs(along),
    }))
"""

COMMAND = "from softtwin.app.cli import main; main(sys.argv[1:])\n"


def blocked(program: str, *words: object, code: int = 0) -> str:
    """What a program says that finds no FEniCSx."""
    command = [sys.executable, "-W", "error::DeprecationWarning:softtwin", "-c", BLOCKED + program, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def phantom() -> Path:
    import softtwin.app.twin

    return Path(softtwin.app.twin.__file__).parent / "twins" / "phantom"


@pytest.fixture(scope="module")
def truth(phantom: Path) -> np.ndarray:
    """A true state of the phantom, (n, 3), metres, far from that under no load."""
    with np.load(phantom / "truth.npz") as stored:
        size = np.linalg.norm(stored["coefficients"], axis=1)
        return (stored["modes"] @ stored["coefficients"][size.argmax()]).reshape(-1, 3).astype(np.float64)


@pytest.fixture(scope="module")
def cloud(phantom: Path, truth: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a camera sees of it, as a file."""
    body, path = read_body(phantom / "body.vtu"), tmp_path_factory.mktemp("contract") / "cloud.npy"
    np.save(path, partial_view(body, truth, (-0.3, -1.0, 0.25), 1000, 5e-4, np.random.default_rng(3), "observed"))
    return path


def test_every_module_of_the_fast_path_is_imported() -> None:
    assert int(blocked(IMPORTS)) > 60


def test_a_packaged_twin_predicts_with_derivatives() -> None:
    found = json.loads(blocked(PREDICTION))
    assert found["rest"] == found["fixed"] == 0.0
    assert 1e-3 < found["moved"] < 0.1
    assert max(found["off"]) < 0.02 * found["along"]
    assert np.log2(found["off"][0] / found["off"][1]) > 1.5  # central differences: of second order


@pytest.mark.parametrize("model", ["surrogate", "torch"])
def test_a_packaged_twin_registers_a_cloud(
    phantom: Path, cloud: Path, truth: np.ndarray, tmp_path: Path, model: str
) -> None:
    """Its tumour is found to a quarter of what it moved, by its network or by equilibria; nothing reads `truth`."""
    body = read_body(phantom / "body.vtu")
    np.save(tmp_path / "truth.npy", body.points + truth)
    words = ["register", phantom, cloud, "--truth", tmp_path / "truth.npy", "--output", tmp_path / "out"]
    blocked(COMMAND, *words, "--model", model)
    (frame,) = json.loads((tmp_path / "out" / "registration.json").read_text())["frames"]
    assert frame["verdict"] in ("accepted", "doubtful")
    moved = np.linalg.norm(target_points(body)["tumour"].displace(truth), axis=1).mean()
    assert moved > 2e-3 and frame["targets"]["tumour"]["error_m"] < 0.25 * moved
    assert (tmp_path / "out" / "frame_0000.vtu").exists()


@pytest.mark.parametrize("model", ["reference", "hybrid"])
def test_what_needs_fenicsx_says_so(phantom: Path, cloud: Path, tmp_path: Path, model: str) -> None:
    said = blocked(COMMAND, "register", phantom, cloud, "--model", model, "--output", tmp_path / "out", code=2)
    assert "FEniCSx" in said and "Traceback" not in said
