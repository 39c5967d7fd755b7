"""Clouds of the quickstart's twin with what the processor makes of them, in one folder for `gpu.py`.

    softtwin quickstart --output FOLDER
    python benchmarks/gpu_frames.py FOLDER OUTPUT [--states 64]

`tracked.*`: frames of a sequence, each from the one before, as `stream.py` has them, with the pose that the twin
believes to be nearly known. `rest.*`: states that have nothing
to do with each other, each from rest, forces anywhere and not gathered. Each with the arrays that `DeviceFrames` works
with, the clouds, the true states, and displacements and margins by `Registrar`, which searches to the last digit here.
"""

from __future__ import annotations

import argparse
import copy
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from margins import truths_of
from safetensors.numpy import save_file
from stream import clouds_of, path_of

from softtwin.app.quickstart import CAMERA, NOISE, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.clouds import partial_view
from softtwin.registration import evidence
from softtwin.registration.device.from_registration import arrays_of, start_of
from softtwin.registration.policy import ACCURACY
from softtwin.registration.registrar import Registrar

FRAMES = range(60, 80)  # of the sequence: on the way from one state to the next


def searching_closely() -> None:
    """The processor's search ends where nothing is left, and not where it no longer matters."""
    for name, value in {"settled": 1e-4, "enough": 1e-3, "summed": 1e-9}.items():
        object.__setattr__(ACCURACY, name, value)
    evidence._FLAT, evidence._GAIN = 1e-7, 1e-16  # type: ignore[misc]


def tracked(twin: Twin, folder: Path, output: Path) -> None:
    """A sequence."""
    path = path_of(folder)[: FRAMES.stop]
    clouds = clouds_of(twin, path)
    registrar = twin.registrar(None, twin.as_said)
    last = registrar.register(clouds[FRAMES.start])
    arrays_of(registrar.setup, last).save(output / "tracked.arrays.safetensors")
    rows: dict[str, list[Any]] = {
        name: [] for name in ("clouds", "coefficients", "eta", "moved", "truth", "displacement", "margin")
    }
    for number in FRAMES[1:]:
        found = registrar.track(clouds[number], last)
        if found.prepared is not last.prepared:
            break
        begin = start_of(last)
        told = (clouds[number], begin.coefficients[0], begin.eta[0], begin.moved[0], path[number])
        for name, value in zip(rows, (*told, found.displacement, found.uncertainty.margin()), strict=True):
            rows[name].append(value)
        last = found
    print(f"{len(rows['clouds'])} frames tracked")
    save_file({name: np.array(values) for name, values in rows.items()}, output / "tracked.clouds.safetensors")


def from_rest(twin: Twin, folder: Path, output: Path, count: int) -> None:
    """States that have nothing to do with each other."""
    rng = np.random.default_rng(1)
    truths = [truth for _, truth in truths_of(folder, count)]
    clouds = [partial_view(twin.body, u, CAMERA, POINTS, NOISE, rng, surface="observed") for u in truths]
    registrar: Registrar = copy.copy(twin.registrar(None, twin.as_said))
    options = registrar.options
    registrar.setup = replace(
        registrar.setup, options=replace(options, localisation=replace(options.localisation, rounds=0))
    )
    began = time.perf_counter()
    found = [registrar.register(cloud) for cloud in clouds]
    seconds = time.perf_counter() - began
    arrays_of(registrar.setup, found[0]).save(output / "rest.arrays.safetensors")
    rows = {
        "clouds": clouds,
        "truth": truths,
        "displacement": [each.displacement for each in found],
        "margin": [each.uncertainty.margin() for each in found],
        "seconds": [seconds],
        "shares_noise": [float(each.solved.has_shared_noise) for each in found],
    }
    print(f"{count} states from rest by the processor in {seconds:.1f} s")
    save_file({name: np.array(values) for name, values in rows.items()}, output / "rest.clouds.safetensors")


def main() -> None:
    """Both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="of the quickstart's twin")
    parser.add_argument("output", type=Path, help="folder of the files")
    parser.add_argument("--states", type=int, default=64, help="from rest")
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    with Twin.open(chosen.folder, "surrogate", pose="fixed") as twin:
        from_rest(twin, chosen.folder, chosen.output, chosen.states)
    searching_closely()
    with Twin.open(chosen.folder, "surrogate") as twin:
        tracked(twin, chosen.folder, chosen.output)


if __name__ == "__main__":
    main()
