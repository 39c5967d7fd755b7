"""What a prediction costs, host to host, on a CPU (one thread) or a GPU: batch 1, Jacobians, and batches of many.

    python benchmarks/prediction.py [--device auto] [--data FOLDER] [--graphs]

Networks of the beam of 304 hexahedra at the sizes of `networks.py`, with fresh weights: their cost does not depend on
what they have learned. Times are medians. Of a batch the weights are read once, and every sample needs its operations:
both are given as shares of what a large product or convolution reaches on the same machine. `off` says how far fast
predictions lie from the surrogate's own, `push_ms` what 64 tangents take by the network's own derivatives and by
torch.func. Without --data a small data set is made (a minute).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from columns import Column
from harness import Benchmark, Given, Setting, run
from networks import CHANNELS, data_of
from numpy.typing import NDArray

from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.architecture import Architecture, Differentiated
from softtwin.surrogate.export import export
from softtwin.surrogate.exported import ExportedTwin
from softtwin.surrogate.fast import FastSurrogate
from softtwin.surrogate.mlp import Perceptron
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.transolver import Transolver
from softtwin.surrogate.umesh import UMesh

BATCHES = (1, 16, 256)
LEAST_SECONDS = 1.0
CACHED = 2**23  # bytes: so much of weights stays in a core's cache


def surrogate_of(architecture: Architecture, data: DataSet) -> Surrogate:
    """One with fresh weights."""
    torch.manual_seed(0)
    samples = data.samples("train")
    objective = architecture.objective(data, samples, data.samples("validation"))
    return Surrogate(data.body, objective.encoder_decoder(), objective.trained(), {"architecture": architecture.name})


def median_ms(task: Callable[[], Any]) -> float:
    """Milliseconds of one call, after a few that warm up."""
    for _ in range(3):
        task()
    times: list[float] = []
    while sum(times) < LEAST_SECONDS or len(times) < 5:
        began = time.perf_counter()
        task()
        times.append(time.perf_counter() - began)
    return 1e3 * float(np.median(times))


def peak(device: str) -> dict[str, float]:
    """What large products and convolutions reach in single precision: operations and bytes a second.

    Bytes are those of a matrix that is far larger than any cache, and of one that stays in it.
    """
    matrix, vector = torch.ones(2048, 2048, device=device), torch.ones(2048, 1, device=device)
    wide, few = torch.ones(16384, 2048, device=device), torch.ones(int(CACHED / 8192), 2048, device=device)
    image, kernel = torch.ones(1, 64, 24, 24, 24, device=device), torch.ones(64, 64, 3, 3, 3, device=device)

    def timed(task: Callable[[], Any]) -> float:
        def whole() -> None:
            task()
            if device == "cuda":
                torch.cuda.synchronize()

        return 1e-3 * median_ms(whole)

    product = 2 * 2048**3 / timed(lambda: matrix @ matrix)
    convolution = 2 * kernel.numel() * 24**3 / timed(lambda: torch.nn.functional.conv3d(image, kernel, padding=1))
    return {
        "operations_per_s": max(product, convolution),
        "bytes_per_s": 4 * wide.numel() / timed(lambda: wide @ vector),
        "cached_bytes_per_s": 4 * few.numel() / timed(lambda: few @ vector),
    }


def counted(surrogate: Surrogate) -> tuple[float, float]:
    """Floating-point operations of one sample, and bytes of all weights in single precision."""
    from torch.utils.flop_counter import FlopCounterMode

    from softtwin.surrogate.export import Value

    inputs = 3 * len(surrogate.encoder_decoder.loaded)
    module = Value(surrogate, np.eye(inputs))
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        module(torch.zeros(1, inputs))
    arrays = [*module.parameters(), *(b for b in module.buffers() if b.is_floating_point())]
    return float(counter.get_total_flops()), float(sum(4 * a.numel() for a in arrays))


def apart(surrogate: Surrogate, load: NDArray[np.float64], displacement: NDArray[np.float64]) -> float:
    """How far a displacement lies from the surrogate's own, largest component over the largest."""
    own = surrogate.solve(load).displacement
    return float(np.abs(displacement - own).max() / np.abs(own).max())


def pushed(surrogate: Surrogate, count: int = 64) -> dict[str, float]:
    """Tangents of the network alone in single precision: by its own derivatives, and by torch.func."""
    network, width = (
        surrogate.single,
        len(surrogate.encoder_decoder.encoded(np.zeros(3 * len(surrogate.encoder_decoder.loaded)))),
    )
    at, tangents = torch.ones(width), torch.ones(width, count)
    ways = {"own": network.linearised(at), "torch.func": Differentiated(network, at)}
    return {name: median_ms(lambda way=way: way.jvp(tangents)) for name, way in ways.items()}


def measured(
    architecture: Architecture, data: DataSet, device: str, graphs: bool, limits: dict[str, float]
) -> dict[str, Any]:
    """All figures of one network."""
    surrogate = surrogate_of(architecture, data)
    samples = data.samples("test")
    loads = data.response.spread(np.resize(samples.forces, (max(BATCHES), *samples.forces.shape[1:])))
    fast = FastSurrogate(surrogate, device)  # type: ignore[arg-type]
    coefficients = np.full(fast.directions.shape[1], 1e-3)
    operations, size = counted(surrogate)
    found: dict[str, Any] = {
        "device": fast.device,
        "weights_bytes": size,
        "operations": operations,
        "double_ms": median_ms(lambda: surrogate.solve(loads[0])),
        "single_ms": median_ms(lambda: fast.solve(loads[0])),
        "with_jacobian_ms": median_ms(lambda: fast.linearised(coefficients)),
        "batches": {},
    }
    for batch in BATCHES:
        many = FastSurrogate(surrogate, device, batch=batch)  # type: ignore[arg-type]
        seconds = 1e-3 * median_ms(lambda many=many, batch=batch: many.solve_many(loads[:batch]))
        found["batches"][batch] = {
            "samples_per_s": batch / seconds,
            "share_of_operations": batch * operations / seconds / limits["operations_per_s"],
            "share_of_bytes": size / seconds / limits["cached_bytes_per_s" if size <= CACHED else "bytes_per_s"],
        }
    found["off"] = {"fast": apart(surrogate, loads[0], fast.solve(loads[0]))}
    found["push_ms"] = pushed(surrogate)
    if graphs:
        with tempfile.TemporaryDirectory() as temporary:
            runtime = ExportedTwin(export(surrogate, Path(temporary) / "graphs"))
        found["off"]["onnxruntime"] = apart(surrogate, loads[0], runtime.solve(loads[0]))
        found["onnxruntime_ms"] = median_ms(lambda: runtime.solve(loads[0]))
        found["onnxruntime_with_jacobian_ms"] = median_ms(lambda: runtime.linearised(coefficients))
    return found


def kinds(device: str) -> dict[str, Architecture]:
    """The networks, by their names in the record."""
    found = {"reduced": Reduced(), "mlp": Perceptron(), f"umesh, {CHANNELS} channels": UMesh(CHANNELS)}
    found["transolver"] = Transolver()
    return found | ({"umesh, 128 channels": UMesh(128)} if device == "cuda" else {})


def device_of(options: Any) -> str:
    """`cuda` or `cpu`."""
    return options.device if options.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"


def data_for(path: Path | None) -> DataSet:
    """The data set that is given, or a small one that is made."""
    return DataSet(path) if path else data_of("modal", {"train": 64, "validation": 256, "test": 512}, 1)


def work(row: str, given: Given) -> dict[str, Any]:
    torch.set_num_threads(1)
    device, limits = device_of(given), given.once(peak, device_of(given))
    graphs = given.graphs and row != "transolver"  # half a minute, for a baseline
    return measured(kinds(device)[row], given.once(data_for, given.data), device, graphs, limits)


def machine(figures: dict[str, Any], given: Given) -> dict[str, Any]:
    """What was measured on, and what it reaches."""
    device = device_of(given)
    name = torch.cuda.get_device_name() if device == "cuda" else "one CPU thread"
    return {"device": name, "peak": given.once(peak, device)}


def at_once(batch: int) -> str:
    """The cell of a batch."""
    path = f"batches.{batch}"
    return f"{{{path}.samples_per_s:,.0f}}; {{{path}.share_of_operations*100:.0f}}; {{{path}.share_of_bytes*100:.1f}}"


BENCHMARK = Benchmark(
    name="prediction",
    title="What a prediction costs, host to host: one sample, Jacobians, batches, and shares of the machine",
    about=("surrogate",),
    work=work,
    rows=lambda given: kinds(device_of(given)),
    columns=(
        Column("double", "ms", "{double_ms:.2f}"),
        Column("single", "ms", "{single_ms:.2f}"),
        Column("with Jacobian", "ms", "{with_jacobian_ms:.1f}"),
        Column("onnxruntime: value; with Jacobian", "ms", "{onnxruntime_ms:.2f}; {onnxruntime_with_jacobian_ms:.2f}"),
        Column("weights", "MB", "{weights_bytes*1e-6:.1f}"),
        Column("operations a sample", "millions", "{operations*1e-6:.0f}"),
        *(Column(f"{n} at once: a second; % of operations; % of bytes (weights)", "", at_once(n)) for n in BATCHES),
    ),
    settings={
        "device": Setting("auto", choices=("auto", "cpu", "cuda")),
        "data": Setting(None, "a data set of the beam", Path, picks=True),
        "graphs": Setting(False, "also export to ONNX and time onnxruntime (CPU)"),
    },
    under="networks",
    finish=machine,
    also=("prediction_*",),
    named=lambda options: f"prediction_{slug()}" if device_of(options) == "cuda" else "prediction",
)


def slug() -> str:
    """The GPU's name as part of a file's."""
    return torch.cuda.get_device_name().replace(" ", "_").lower()


if __name__ == "__main__":
    run(BENCHMARK)
