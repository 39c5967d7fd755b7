"""From a surface file to a finished twin, by stage: the real liver's boundary as an STL in millimetres, or a kidney.

    python benchmarks/build_time.py [--nodes 2000] [--samples 512] [--seconds 120]
    python benchmarks/build_time.py --organ kidney --architecture galerkin

The kidney is a file of another program (../shared/data/surfaces) with holes and crumbs, held on one side. Samples are
the architecture's own number where none is given.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from harness import Benchmark, Given, Setting, run
from liver import POISSON_RATIO, YOUNG_MODULUS, liver
from organs import SIMULATED, SURFACES
from record import RUNS

from softtwin.app.config import default_samples


def kidney_words() -> list[Any]:
    """What `softtwin build` is told of the kidney."""
    file, fixed, _ = SIMULATED["simulated kidney"]
    return [SURFACES / file, "--unit", "mm", "--fixed", fixed]


def liver_words(folder: Path) -> list[Any]:
    """What `softtwin build` is told of the liver, whose files are written into a folder."""
    body = liver()
    meshio.Mesh(1e3 * body.points, [("triangle", body.boundary)]).write(folder / "liver_mm.stl")
    np.savetxt(folder / "veins_mm.txt", 1e3 * body.points[body.fixed])
    np.savetxt(folder / "reach_mm.txt", 1e3 * body.points[body.node_sets["s1"]])
    words = [folder / "liver_mm.stl", "--unit", "mm", "--fixed", folder / "veins_mm.txt"]
    words += ["--zone", f"reach={folder / 'reach_mm.txt'}", "--displacement", 0.05, "--load-path", 8]
    return [*words, "--young-modulus", YOUNG_MODULUS, "--poisson-ratio", POISSON_RATIO]


def work(row: str, given: Given) -> dict[str, Any]:
    folder = RUNS / "build"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    words = ["build", *(liver_words(folder) if given.organ == "liver" else kidney_words())]
    out = folder / "out"
    words += ["--output", out, "--nodes", given.nodes, "--seconds", given.seconds]
    words += ["--samples", given.samples or default_samples(given.architecture), "--architecture", given.architecture]
    begin = time.perf_counter()
    program = str(Path(sys.executable).parent / "softtwin")  # as a user starts it: what loading takes counts
    subprocess.run([program, *map(str, words)], check=True)
    seconds = time.perf_counter() - begin
    validation = json.loads((out / "validation.json").read_text())["figures"]
    stages = {name: entry["seconds"] for name, entry in json.loads((out / "stages.json").read_text()).items()}
    return {"asked": given.settings, "seconds": seconds, "stages": stages, "held_out": validation}


def _name(options: argparse.Namespace) -> str:
    return f"build_time_{options.organ}_{options.architecture}"


BENCHMARK = Benchmark(
    name="build_time",
    title="From a surface file to a finished twin: the real liver's boundary as an STL in millimetres, by stage",
    about=("app", "meshes", "reference", "surrogate"),
    work=work,
    settings={
        "nodes": Setting(2000),
        "samples": Setting(None, "to learn from", int),
        "seconds": Setting(120.0, "of training"),
        "organ": Setting("liver", choices=("liver", "kidney")),
        "architecture": Setting("reduced", choices=("reduced", "galerkin")),
    },
    also=("build_time_kidney_galerkin", "build_time_liver_galerkin"),
    named=lambda o: "build_time" if (o.organ, o.architecture) == ("liver", "reduced") else _name(o),
    small={"nodes": 300, "samples": 32, "seconds": 5.0},
)


if __name__ == "__main__":
    run(BENCHMARK)
