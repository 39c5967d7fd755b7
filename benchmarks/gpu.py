"""The fast path on a GPU: training, accuracy, latency and memory, from one tensors file, with torch alone.

    softtwin tensors beam/organ.toml beam.safetensors
    python benchmarks/gpu.py beam.safetensors OUTPUT [--device cuda] [--small] [--minutes 8]

It asks for torch, NumPy, SciPy, safetensors and Lightning; no Zarr, VTK or FEniCSx. Phases run in the order of their
worth; each is written into OUTPUT/gpu.json when it is finished, and the same command goes on with those missing.
No phase begins after the minutes are over. `--small` runs all of them on any machine in about a minute.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softtwin.meshes.metrics import nodal_distances, thesis_error
from softtwin.reference.data.dataset import DataSet, Samples
from softtwin.surrogate.architecture import Architecture
from softtwin.surrogate.evaluate import spread
from softtwin.surrogate.export import Value
from softtwin.surrogate.fast import FastSurrogate
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.precision import without_tf32
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.residual import ElasticBody
from softtwin.surrogate.train import train
from softtwin.surrogate.umesh import UMesh

Floats = NDArray[np.float64]
THESIS_SAMPLES = 20480  # that tables 4.1 to 4.3 were trained on
BATCH = 256  # loads of one call
CALLS = 200  # timed, after those that warm up
DIRECTIONS = 64


@dataclass(frozen=True)
class Row:
    """One training.

    Args:
        name: of the phase.
        architecture: what is trained.
        epochs: passes over the samples; None: by seconds.
        seconds: wall time where there are no epochs.
        precision: of the training.
    """

    name: str
    architecture: Architecture
    epochs: int | None
    seconds: float = 60.0
    precision: Any = "single"
    large: bool = False  # in double precision a prediction takes seconds


def rows(small: bool) -> tuple[Row, ...]:
    """The trainings, the most valuable first."""
    if small:
        return (
            Row("reduced", Reduced(width=32), None, 3.0),
            Row("mlp", Perceptron(width=64), 2),
            Row("umesh", UMesh(channels=4, levels=2), 1),
        )
    return (
        Row("reduced", Reduced(), None, 45.0),
        Row("mlp", Perceptron(), 100),
        Row("umesh_128_mixed", UMesh(channels=128), None, 90.0, "mixed", large=True),
        Row("umesh_128_single", UMesh(channels=128), None, 60.0, large=True),
    )


class Record:
    """Phases in a JSON file, each written when it is finished.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.phases: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    def phase(self, name: str, work: Callable[[], Any], deadline: float) -> None:
        """Do what is missing; a phase that fails says how, and the next begins."""
        if name in self.phases and "failed" not in self.phases[name]:
            return print(f"{name}: there already")
        if time.monotonic() > deadline:
            return print(f"{name}: not run, the minutes are over")
        began = time.monotonic()
        try:
            found = work()
        except Exception as error:  # what one phase cannot do costs the others nothing
            traceback.print_exc()
            found = {"failed": f"{type(error).__name__}: {error}"}
        self.phases[name] = {**found, "phase_seconds": time.monotonic() - began}
        self.path.write_text(json.dumps(self.phases, indent=1) + "\n")
        print(f"{name}: {json.dumps(self.phases[name])}", flush=True)


def environment(data: DataSet, device: str) -> dict[str, Any]:
    """The card, its driver, torch, and the data."""
    card = "none"
    if device == "cuda":
        query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
        card = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    return {
        "card": card,
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "data": data.header.get("tensors", {}),
        "samples": {split: len(data.samples(split)) for split in ("train", "validation", "test")},  # type: ignore[arg-type]
        "nodes": len(data.body.points),
    }


def trained(row: Row, data: DataSet, device: Any) -> tuple[Surrogate, dict[str, Any]]:
    """A network of a row, and what its training took."""
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    plan = TrainingPlan(
        architecture=row.architecture,
        epochs=row.epochs,
        seconds=row.seconds,
        precision=row.precision if device == "cuda" else "single",
        device=device,
    )
    began = time.monotonic()
    surrogate = train(data, plan)
    wall = time.monotonic() - began
    told = surrogate.card["training"]
    count = surrogate.card["samples"]["train"]
    epochs = told["steps"] * plan.batch_size(count) / count
    memory = torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else None
    return surrogate, {
        "samples": count,
        "is_starved": count < THESIS_SAMPLES,
        "epochs": epochs,
        "steps": told["steps"],
        "steps_per_s": told["steps"] / told["seconds"],
        "seconds": told["seconds"],
        "wall_seconds": wall,
        "parameters": told["parameters"],
        "validation_error": told["validation_error"],
        "precision": plan.precision,
        "training_memory_mib": memory,
    }


def errors(found: Floats, samples: Samples) -> dict[str, Any]:
    """Of predictions, (s, n, 3), metres: the thesis's definition, nodal and relative."""
    distances = nodal_distances(found, samples.displacements)
    sizes = np.linalg.norm(samples.displacements, axis=(1, 2))
    relative = np.linalg.norm(found - samples.displacements, axis=(1, 2)) / sizes
    return {
        "thesis_error_m": asdict(spread(thesis_error(found, samples.displacements))),
        "nodal_error_m": asdict(spread(distances.mean(axis=1))),
        "largest_error_m": asdict(spread(distances.max(axis=1))),
        "relative_error": asdict(spread(relative)),
    }


def latency(task: Callable[[], Any], calls: int) -> dict[str, float]:
    """Milliseconds of a call, host to host: median and 95th percentile."""
    for _ in range(min(5, calls)):
        task()
    times = []
    for _ in range(calls):
        began = time.perf_counter()
        task()
        times.append(1e3 * (time.perf_counter() - began))
    return {"median_ms": float(np.median(times)), "p95_ms": float(np.percentile(times, 95))}


def prediction(surrogate: Surrogate, data: DataSet, device: Any, calls: int, large: bool) -> dict[str, Any]:
    """Errors on the test split by the device, how far they are from the processor's in double, and times."""
    samples = data.samples("test")
    forces = np.zeros((len(samples), *data.body.points.shape))
    forces[:, data.response.loaded] = samples.forces
    batch = np.resize(forces, (BATCH, *forces.shape[1:]))
    found: dict[str, Any] = {}
    few = 2 if large else min(16, len(forces))
    exact = np.stack([surrogate.solve(one).displacement for one in forces[:few]])
    for precision in ("single",) if large else ("single", "double"):
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        fast = FastSurrogate(surrogate, device, DIRECTIONS, BATCH, precision)  # type: ignore[arg-type]
        many = np.concatenate(
            [
                fast.solve_many(np.resize(forces[i : i + BATCH], batch.shape))[: len(forces[i : i + BATCH])]
                for i in range(0, len(forces), BATCH)
            ]
        )
        one_by_one = np.stack([fast.solve(one) for one in forces[:few]])
        peak = np.abs(exact).max()
        load = np.zeros(fast.directions.shape[1])
        found[precision] = {
            **errors(many, samples),
            "off_from_double_on_processor": float(np.abs(one_by_one - exact).max() / peak),
            "batch_off_from_double_on_processor": float(np.abs(many[:few] - exact).max() / peak),
            "solve": latency(lambda fast=fast: fast.solve(forces[0]), calls),  # type: ignore[misc]
            "solve_many_256": latency(lambda fast=fast: fast.solve_many(batch), max(5, calls // 10)),  # type: ignore[misc]
            "linearised_64": latency(lambda fast=fast, load=load: fast.linearised(load), calls),  # type: ignore[misc]
            "memory_mib": torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else None,
        }
        del fast
    inputs = 3 * len(surrogate.encoder_decoder.loaded)
    plain = Value(surrogate, np.eye(inputs)).to(device).eval().requires_grad_(False)
    host = torch.from_numpy(forces[:1, data.response.loaded].reshape(1, -1)).float()
    with torch.no_grad(), without_tf32():
        found["solve_without_graph"] = latency(lambda: plain(host.to(device)).cpu(), calls)
    found["double_on_processor"] = latency(lambda: surrogate.solve(forces[0]), 2 if large else max(5, calls // 10))
    found["parameters"] = sum(p.numel() for p in surrogate.network.parameters())
    return found


def elastic(data: DataSet, device: str, count: int, calls: int) -> dict[str, Any]:
    """Energies and forces of many states of the test split at once: what a solver in torch is made of."""
    body = ElasticBody(data.body, data.material).to(device)
    states = np.resize(data.samples("test").displacements, (count, *data.body.points.shape))
    on_device = torch.from_numpy(np.ascontiguousarray(states)).to(device)

    def task() -> Any:
        forces = body.internal_forces(on_device)
        if device == "cuda":
            torch.cuda.synchronize()
        return forces

    taken = latency(task, calls)
    return {"states": count, **taken, "states_per_s": 1e3 * count / taken["median_ms"], "precision": "double"}


def main() -> None:
    """All phases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="tensors file of a body of hexahedra")
    parser.add_argument("output", type=Path, help="folder of gpu.json")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--small", action="store_true", help="tiny networks and few calls")
    parser.add_argument("--minutes", type=float, default=8.0, help="no phase begins after them")
    chosen = parser.parse_args()
    if chosen.device == "cuda" and not torch.cuda.is_available():
        parser.error(f"--device: expected a GPU that torch can use, found none (torch {torch.__version__}).")
    chosen.output.mkdir(parents=True, exist_ok=True)
    record, deadline = Record(chosen.output / "gpu.json"), time.monotonic() + 60.0 * chosen.minutes
    data = DataSet(chosen.data)
    calls = 5 if chosen.small else CALLS
    record.phase("environment", lambda: environment(data, chosen.device), deadline)
    for row in rows(chosen.small):

        def whole(row: Row = row) -> dict[str, Any]:
            surrogate, told = trained(row, data, chosen.device)
            return {"training": told, "prediction": prediction(surrogate, data, chosen.device, calls, row.large)}

        record.phase(row.name, whole, deadline)
    few = 4 if chosen.small else 1000
    record.phase("elastic_forces", lambda: elastic(data, chosen.device, few, max(5, calls // 10)), deadline)


if __name__ == "__main__":
    main()
