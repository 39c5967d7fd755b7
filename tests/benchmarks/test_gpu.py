"""The script for a GPU machine runs all of its phases here, small, where nothing can be imported that is not there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.meshes.shapes import beam
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.tensors import export_tensors
from softtwin.reference.generate import Plan, generate

pytestmark = pytest.mark.fenicsx
SCRIPT = Path(__file__).parents[2] / "benchmarks" / "gpu.py"
MISSING = ("vtkmodules", "zarr", "meshio", "pydantic", "pyvista", "dolfinx", "petsc4py", "mpi4py", "gmsh")
PROGRAM = f"""
import runpy, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {MISSING!r}:
            raise ModuleNotFoundError(f"kept out: {{name}}", name=name)

sys.meta_path.insert(0, Refuse())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.chain
def test_every_phase_runs_without_a_gpu_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    plan = Plan(loads=LoadPlan(modes=4, amplitude=0.05), samples={"train": 12, "validation": 4, "test": 4}, block=4)
    made = generate(tmp_path / "data.zarr", beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron"), plan)
    assert made is not None
    tensors = export_tensors(made, tmp_path / "set.safetensors", "double")
    command = [sys.executable, "-c", PROGRAM, SCRIPT, tensors, tmp_path / "out", "--device", "cpu", "--small"]
    words = [str(word) for word in command]
    done = subprocess.run([*words, "--only", "environment"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    first = json.loads((tmp_path / "out" / "gpu.json").read_text())
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    found = json.loads((tmp_path / "out" / "gpu.json").read_text())
    assert found["environment"] == first["environment"]  # not run again
    failed = {name: entry for name, entry in found.items() if "failed" in entry}
    assert not failed, failed
    assert {"equilibria", "derivatives", "generation", "elastic_forces"} < found.keys() and len(found) > 7
    assert found["equilibria"]["double"]["not_converged"] == 0
    assert found["equilibria"]["double"]["off_from_reference"]["max"] < 1e-7
    assert found["derivatives"]["off_from_processor"] == {"forces": 0.0, "young_modulus": 0.0}
    absent = subprocess.run([*words[:-2], "cuda"], capture_output=True, text=True, check=False)
    assert absent.returncode == 0 or "expected a GPU that torch can use, found none" in absent.stderr
