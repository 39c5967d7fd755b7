"""The fast path on a GPU: equilibria, training, accuracy, latency and memory, from one tensors file, with torch alone.

    softtwin tensors beam/organ.toml beam.safetensors --precision double --no-jacobians
    python benchmarks/gpu_frames.py TWIN frames
    python benchmarks/gpu.py beam.safetensors OUTPUT [--frames frames] [--device cuda] [--small] [--minutes 8]
                             [--only PHASE ...]

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
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file

from softtwin.meshes.metrics import nodal_distances, thesis_error
from softtwin.reference.data.dataset import DataSet, Samples, Split
from softtwin.reference.data.samplers import LoadPlan, draw_load
from softtwin.registration.device.arrays import DeviceArrays, Start
from softtwin.registration.device.frames import DeviceFrames, Execution, Frames
from softtwin.surrogate.architecture import Architecture
from softtwin.surrogate.equilibria import Equilibria, NewtonSettings
from softtwin.surrogate.equilibria_layer import EquilibriaLayer
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
        large: in double precision a prediction takes seconds.
        samples: training samples that are made here; None for those of the data set.
    """

    name: str
    architecture: Architecture
    epochs: int | None
    seconds: float = 60.0
    precision: Any = "single"
    large: bool = False
    samples: int | None = None


def rows(small: bool) -> tuple[Row, ...]:
    """The trainings, the most valuable first."""
    if small:
        return (
            Row("reduced", Reduced(width=32), None, 3.0),
            Row("mlp", Perceptron(width=64), 2),
            Row("umesh", UMesh(channels=4, levels=2), 1, samples=16),
        )
    return (
        Row("umesh_128_full", UMesh(channels=128), None, 290.0, "mixed", large=True, samples=THESIS_SAMPLES),
        Row("reduced", Reduced(), None, 45.0),
        Row("mlp", Perceptron(), 100),
        Row("umesh_128_single", UMesh(channels=128), None, 60.0, large=True),
    )


class Enlarged(DataSet):
    """A data set with other training samples.

    Args:
        path: of the tensors file.
        train: the samples.
    """

    def __init__(self, path: Path, train: Samples) -> None:
        super().__init__(path)
        self._train = train

    def samples(self, split: Split, limit: int | None = None) -> Samples:
        """The samples of a split; those of training are the others."""
        return self._train if split == "train" else super().samples(split, limit)


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


def whole(data: DataSet, forces: Floats) -> torch.Tensor:
    """Forces at the loaded nodes, (s, l, 3), as forces at all, (s, n, 3)."""
    return torch.from_numpy(data.response.spread(forces))


def equilibria(data: DataSet, device: str, few: int | None) -> dict[str, Any]:
    """The held-out loads solved together: how far from the reference's states, what failed, how many a second."""
    samples = data.samples("test", few)
    forces, truth = whole(data, samples.forces), samples.displacements
    peak = np.abs(truth).max(axis=(1, 2))
    found: dict[str, Any] = {"loads": len(truth)}
    for precision, settings in (("double", NewtonSettings()), ("single", NewtonSettings(1e-4))):
        solver = Equilibria(data.body, data.material, device, precision, settings)
        solver.solve(forces)  # libraries load what they need
        began = time.perf_counter()
        states = solver.solve(forces)
        displacement = states.displacement.cpu().double().numpy()
        seconds = time.perf_counter() - began
        off = np.abs(displacement - truth).max(axis=(1, 2)) / peak
        iterations = states.iterations.cpu().numpy()
        found[precision] = {
            "tolerance": settings.tolerance,
            "not_converged": int((~states.is_converged).sum()),
            "unstable": int((~states.is_stable).sum()),
            "in_load_steps": int((states.load_steps > 1).sum()),
            "iterations": dict(zip(("mean", "p95", "max"), summary(iterations), strict=True)),
            "off_from_reference": dict(zip(("mean", "p95", "max"), summary(off), strict=True)),
            "off_median": float(np.median(off)),
            "more_than_1e_8_off": int((off > 1e-8).sum()),
            "seconds": seconds,
            "states_per_s": len(truth) / seconds,
        }
    return found


def derivatives(data: DataSet, device: str, count: int) -> dict[str, Any]:
    """Gradients of a misfit through equilibria, by forces and stiffness: how far from the processor's, how fast."""
    samples = data.samples("test", count)
    forces, misfit = whole(data, samples.forces), torch.from_numpy(0.9 * samples.displacements)

    def gradients(device: str) -> tuple[list[torch.Tensor], float]:
        layer = EquilibriaLayer(Equilibria(data.body, data.material, device))
        given = forces.to(device).requires_grad_()
        stiffness = torch.tensor(
            float(data.material.parameters["young_modulus"]), dtype=torch.float64, requires_grad=True
        )
        (layer(given, young_modulus=stiffness) - misfit.to(device)).square().sum().backward()  # libraries are loaded
        given.grad = stiffness.grad = None
        began = time.perf_counter()
        (layer(given, young_modulus=stiffness) - misfit.to(device)).square().sum().backward()
        found = [given.grad.cpu(), stiffness.grad.cpu()]
        return found, time.perf_counter() - began

    found, seconds = gradients(device)
    wanted, alone = gradients("cpu") if device != "cpu" else (found, seconds)
    off = [float((one - other).abs().max() / other.abs().max()) for one, other in zip(found, wanted, strict=True)]
    return {
        "loads": len(forces),
        "off_from_processor": {"forces": off[0], "young_modulus": off[1]},
        "seconds": seconds,
        "seconds_on_processor": alone,
        "states_per_s": len(forces) / seconds,
    }


def summary(values: NDArray[Any]) -> tuple[float, float, float]:
    """Mean, 95th percentile and largest."""
    return float(values.mean()), float(np.percentile(values, 95)), float(values.max())


def drawn(path: Path, numbers: range) -> Floats:
    """Loads of some draws as `generate` draws them, (s, l, 3), newtons; their numbers lie behind those of the set."""
    data = DataSet(path)
    plan = data.header["plan"]
    entries = {**plan["loads"], "zones": tuple(plan["loads"]["zones"]), "radius": tuple(plan["loads"]["radius"])}
    loads, loaded = LoadPlan(**entries), data.response.loaded
    chances = (np.random.default_rng([plan["seed"], 2, number]) for number in numbers)
    return np.stack([plan["loads"]["amplitude"] * draw_load(data.body, data.shapes, loads, rng) for rng in chances])[
        :, loaded
    ]


def generation(data: DataSet, device: str, count: int) -> tuple[Samples, dict[str, Any]]:
    """Training samples that no other draw of the data set is, and what making them took."""
    began = time.perf_counter()
    first = data.block_count * data.header["block"]
    parts = [range(i, min(i + 256, first + count)) for i in range(first, first + count, 256)]
    with ProcessPoolExecutor(min(16, os.cpu_count() or 1), get_context("fork")) as pool:
        forces = np.concatenate(list(pool.map(drawn, [data.path] * len(parts), parts)))
    drawing = time.perf_counter() - began
    solver = Equilibria(data.body, data.material, device)
    began = time.perf_counter()
    states = solver.solve(whole(data, forces))
    displacement = states.displacement.cpu().numpy()
    seconds = time.perf_counter() - began
    kept = (states.is_converged & states.is_stable).cpu().numpy()
    sizes = np.linalg.norm(displacement[kept], axis=(1, 2))
    none = np.zeros((int(kept.sum()), 1))
    samples = Samples(first + np.flatnonzero(kept), forces[kept], displacement[kept], none, np.zeros_like(forces[kept]))
    return samples, {
        "draws": count,
        "not_converged": int((~states.is_converged).sum()),
        "unstable": int((states.is_converged & ~states.is_stable).sum()),
        "in_load_steps": int((states.load_steps > 1).sum()),
        "iterations": dict(zip(("mean", "p95", "max"), summary(states.iterations.cpu().numpy()), strict=True)),
        "displacement_norm_m": {"mean": float(sizes.mean()), "std": float(sizes.std())},
        "drawing_seconds": drawing,
        "solving_seconds": seconds,
        "states_per_s": count / seconds,
        "memory_mib": torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else None,
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


def held_out(surrogate: Surrogate, data: DataSet, device: Any) -> dict[str, Any]:
    """Errors on the test split, predicted in single precision without graphs."""
    samples = data.samples("test")
    plain = Value(surrogate, np.eye(3 * len(data.response.loaded))).to(device).eval().requires_grad_(False)
    forces = torch.from_numpy(samples.forces.reshape(len(samples), -1)).float()
    with torch.no_grad(), without_tf32():
        found = torch.cat([plain(part.to(device)).cpu() for part in forces.split(64)])
    return errors(found.double().numpy().reshape(samples.displacements.shape), samples)


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
    forces = data.response.spread(samples.forces)
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


def frames_of(folder: Path, name: str) -> tuple[DeviceArrays, dict[str, Floats]]:
    """What `gpu_frames.py` has made."""
    return DeviceArrays.load(folder / f"{name}.arrays.safetensors"), load_file(folder / f"{name}.clouds.safetensors")


def far_off(found: Floats, truth: Floats) -> dict[str, float]:
    """Largest distance of a node in each of several states, (s, n, 3), metres: its spread."""
    return asdict(spread(np.linalg.norm(found - truth, axis=2).max(axis=1)))


def frames_tracked(folder: Path, device: str, repeats: int, few: int | None) -> dict[str, Any]:
    """Frames of a sequence, each from the one before: host to host, and how far from the processor's."""
    arrays, given = frames_of(folder, "tracked")
    count = min(few or len(given["clouds"]), len(given["clouds"]))
    starts = [Start(*(given[name][i : i + 1] for name in ("coefficients", "eta", "moved"))) for i in range(count)]

    def registered(frames: DeviceFrames) -> list[Frames]:
        return [frames.register(given["clouds"][i : i + 1], starts[i]) for i in range(count)]

    def of(found: list[Frames], name: str) -> Floats:
        return np.concatenate([getattr(each, name) for each in found])

    points = given["clouds"].shape[1]
    alone = registered(DeviceFrames(arrays, 1, points, "cpu"))
    found: dict[str, Any] = {
        "frames": count,
        "points": points,
        "nodes": len(arrays.nodes),
        "triangles": len(arrays.triangles),
        "unknowns": arrays.coefficient_count,
        "iterations": float(np.mean([each.iterations for each in alone])),
        "processor": latency(lambda: registered(DeviceFrames(arrays, 1, points, "cpu"))[0], 1),
    }
    close = DeviceFrames(arrays, 1, points, device, settled=1e-4)
    found["off_from_registrar_m"] = far_off(of(registered(close), "displacement"), given["displacement"][:count])

    def measured(execution: Execution) -> dict[str, Any]:
        began = time.monotonic()
        frames = DeviceFrames(arrays, 1, points, device, execution=execution)
        here = registered(frames)  # captured and compiled
        prepared = time.monotonic() - began
        times = [
            latency(partial(frames.register, given["clouds"][i : i + 1], starts[i]), repeats) for i in range(count)
        ]
        missed = np.linalg.norm(of(here, "displacement") - given["truth"][:count], axis=2)
        return {
            "prepared_s": prepared,
            "median_ms": float(np.median([each["median_ms"] for each in times])),
            "p95_ms": float(np.max([each["p95_ms"] for each in times])),
            "iterations": float(np.mean([each.iterations for each in here])),
            "has_converged": int(of(here, "has_converged").sum()),
            "off_from_processor_m": far_off(of(here, "displacement"), of(alone, "displacement")),
            "margin_off_from_processor_m": float(np.abs(of(here, "margin") - of(alone, "margin")).max()),
            "error_m": asdict(spread(missed.mean(axis=1))),
        }

    ways: tuple[Execution, ...] = ("eager", "graphs", "compiled") if device == "cuda" else ("eager",)
    for execution in ways:
        try:
            found[execution] = measured(execution)
        except Exception as error:  # what one way cannot do costs the others nothing
            traceback.print_exc()
            found[execution] = {"failed": f"{type(error).__name__}: {error}"}
    return found


def frames_together(folder: Path, device: str, calls: int, few: int | None) -> dict[str, Any]:
    """States that have nothing to do with each other in one batch: from rest, then from where that has ended."""
    arrays, given = frames_of(folder, "rest")
    clouds, truth = given["clouds"][:few], given["truth"][:few]
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    frames = DeviceFrames(arrays, len(clouds), clouds.shape[1], device)
    found = frames.register(clouds)

    def told(displacement: Floats, margin: Floats) -> dict[str, Any]:
        missed = np.linalg.norm(displacement - truth, axis=2)
        return {
            "error_m": asdict(spread(missed.mean(axis=1))),
            "nodes_within_95_margins": float(np.mean(missed <= np.nan_to_num(margin) + 1e-12)),
        }

    return {
        "states": len(clouds),
        "from_rest": {
            **latency(lambda: frames.register(clouds), calls),
            "iterations": found.iterations,
            "has_converged": int(found.has_converged.sum()),
            "may_share_noise": int(found.may_share_noise.sum()),
            **told(found.displacement, found.margin),
        },
        "tracked": latency(lambda: frames.register(clouds, found.start), calls),
        "registrar": {
            "seconds": float(given["seconds"][0]),
            **told(given["displacement"][:few], given["margin"][:few]),
        },
        "memory_mib": torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else None,
    }


def main() -> None:
    """All phases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="tensors file of a body of hexahedra")
    parser.add_argument("output", type=Path, help="folder of gpu.json")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--frames", type=Path, help="folder that gpu_frames.py has made; without it no frames")
    parser.add_argument("--small", action="store_true", help="tiny networks and few calls")
    parser.add_argument("--only", nargs="*", help="phases; all if not given")
    parser.add_argument("--minutes", type=float, default=8.0, help="no phase begins after them")
    chosen = parser.parse_args()
    if chosen.device == "cuda" and not torch.cuda.is_available():
        parser.error(f"--device: expected a GPU that torch can use, found none (torch {torch.__version__}).")
    chosen.output.mkdir(parents=True, exist_ok=True)
    record, deadline = Record(chosen.output / "gpu.json"), time.monotonic() + 60.0 * chosen.minutes
    data = DataSet(chosen.data)
    calls = 5 if chosen.small else CALLS
    few = 4 if chosen.small else 1000
    made = cache(lambda count: generation(data, chosen.device, count))  # training takes them from memory

    def trained_and_judged(row: Row) -> dict[str, Any]:
        lesson = data if row.samples is None else Enlarged(chosen.data, made(row.samples)[0])
        surrogate, told = trained(row, lesson, chosen.device)
        return {
            "training": told,
            "prediction": prediction(surrogate, data, chosen.device, calls // 10 if row.large else calls, row.large),
        }

    with_frames: dict[str, Callable[[], Any]] = {}
    if chosen.frames is not None:
        counts = (1, 2) if chosen.small else (10, None)
        with_frames = {
            "frames_tracked": lambda: frames_tracked(chosen.frames, chosen.device, *counts),
            "frames_together": lambda: frames_together(chosen.frames, chosen.device, *counts),
        }
    phases: dict[str, Callable[[], Any]] = {
        "environment": lambda: environment(data, chosen.device),
        **with_frames,
        "equilibria": lambda: equilibria(data, chosen.device, few if chosen.small else None),
        "derivatives": lambda: derivatives(data, chosen.device, few if chosen.small else 256),
        "generation": lambda: made(16 if chosen.small else THESIS_SAMPLES)[1],
        **{row.name: partial(trained_and_judged, row) for row in rows(chosen.small)},
        "elastic_forces": lambda: elastic(data, chosen.device, few, max(5, calls // 10)),
    }
    for name in chosen.only or phases:
        if name not in phases:
            parser.error(f"--only: expected some of {', '.join(phases)}, got {name}.")
        record.phase(name, phases[name], deadline)


if __name__ == "__main__":
    main()
