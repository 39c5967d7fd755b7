"""The script for a GPU machine runs all of its phases here, small, where nothing can be imported that is not there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

import numpy as np
from kept_out import refusing
from safetensors.numpy import save_file

from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.samplers import LoadPlan
from softtwin.reference.data.tensors import export_tensors
from softtwin.reference.generate import Plan, generate
from softtwin.registration.device.from_registration import arrays_of, start_of
from softtwin.registration.registrar import prepare
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

pytestmark = pytest.mark.fenicsx
SCRIPT = Path(__file__).parents[2] / "benchmarks" / "gpu.py"
MISSING = ("vtkmodules", "zarr", "meshio", "pydantic", "pyvista", "dolfinx", "petsc4py", "mpi4py", "gmsh")
PROGRAM = f"""{refusing(MISSING)}
import runpy

sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def write_frames(data: DataSet, folder: Path) -> None:
    """Two clouds of held-out states with what the processor makes of them, as `gpu_frames.py` writes them."""
    surrogate = train(data, TrainingPlan(Reduced(width=8, modes=6, depth=1), epochs=2))
    made = prepare(surrogate, surrogate.encoder_decoder.loaded, force_scale=0.05)
    states, nodes = data.samples("test").displacements[:2], data.body.boundary_nodes
    clouds = [(data.body.points + state)[nodes] for state in states]
    found = [made.register(cloud) for cloud in clouds]
    start, arrays = start_of(found[0]), arrays_of(made.setup, found[0])
    rows = {
        "clouds": np.array(clouds),
        "truth": states,
        "displacement": np.array([each.displacement for each in found]),
        "margin": np.array([each.uncertainty.margin() for each in found]),
        "seconds": np.ones(1),
        **{name: np.repeat(getattr(start, name), 2, axis=0) for name in ("coefficients", "eta", "moved")},
    }
    for name in ("tracked", "rest"):
        arrays.save(folder / f"{name}.arrays.safetensors")
        save_file(rows, folder / f"{name}.clouds.safetensors")


@pytest.mark.chain
def test_every_phase_runs_without_a_gpu_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    plan = Plan(loads=LoadPlan(modes=4, amplitude=0.05), samples={"train": 12, "validation": 4, "test": 4}, block=4)
    made = generate(tmp_path / "data.zarr", beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron"), plan)
    assert made is not None
    tensors = export_tensors(made, tmp_path / "set.safetensors", "double")
    write_frames(made, tmp_path)
    command = [sys.executable, "-c", PROGRAM, SCRIPT, tensors, tmp_path / "out", "--frames", tmp_path, "--small"]
    command += ["--device", "cpu"]
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
    assert found["frames_tracked"]["eager"]["off_from_processor_m"]["max"] == 0.0
    assert found["frames_together"]["states"] == 2
    absent = subprocess.run([*words[:-1], "cuda"], capture_output=True, text=True, check=False)
    assert absent.returncode == 0 or "expected a GPU that torch can use, found none" in absent.stderr
