"""From a surface file to a finished twin: the real liver's boundary as an STL in millimetres, by stage.

python benchmarks/build_time.py [--nodes 2000] [--samples 512] [--seconds 120]
"""

from __future__ import annotations

import json
import shutil
import time
from typing import Any

import meshio
import numpy as np
from harness import Benchmark, Given, Setting, run
from liver import POISSON_RATIO, YOUNG_MODULUS, liver
from record import RUNS

from softtwin.app.cli import main as softtwin


def work(row: str, given: Given) -> dict[str, Any]:
    folder, body = RUNS / "build", liver()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    meshio.Mesh(1e3 * body.points, [("triangle", body.boundary)]).write(folder / "liver_mm.stl")
    np.savetxt(folder / "veins_mm.txt", 1e3 * body.points[body.fixed])
    np.savetxt(folder / "reach_mm.txt", 1e3 * body.points[body.node_sets["s1"]])
    out, begin = folder / "out", time.perf_counter()
    words = ["build", folder / "liver_mm.stl", "--unit", "mm", "--fixed", folder / "veins_mm.txt", "--output", out]
    words += ["--zone", f"reach={folder / 'reach_mm.txt'}", "--displacement", 0.05, "--load-path", 8]
    words += ["--young-modulus", YOUNG_MODULUS, "--poisson-ratio", POISSON_RATIO]
    words += ["--nodes", given.nodes, "--samples", given.samples, "--seconds", given.seconds]
    softtwin([str(word) for word in words])
    seconds = time.perf_counter() - begin
    validation = json.loads((out / "validation.json").read_text())["figures"]
    stages = {name: entry["seconds"] for name, entry in json.loads((out / "stages.json").read_text()).items()}
    return {"asked": given.settings, "seconds": seconds, "stages": stages, "held_out": validation}


BENCHMARK = Benchmark(
    name="build_time",
    title="From a surface file to a finished twin: the real liver's boundary as an STL in millimetres, by stage",
    about=("app", "meshes", "reference", "surrogate"),
    work=work,
    settings={"nodes": Setting(2000), "samples": Setting(512), "seconds": Setting(120.0, "of training")},
    small={"nodes": 300, "samples": 32, "seconds": 5.0},
)


if __name__ == "__main__":
    run(BENCHMARK)
