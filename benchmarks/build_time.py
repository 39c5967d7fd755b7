"""From a surface file to a finished twin: the real liver's boundary as an STL in millimetres, by stage.

python benchmarks/build_time.py [--nodes 2000] [--samples 512] [--seconds 120]
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path

import meshio
import numpy as np
from liver import POISSON_RATIO, YOUNG_MODULUS, liver
from record import write

from softtwin.app.cli import main as softtwin

RUNS = Path(__file__).parent / "runs"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=2000)
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--seconds", type=float, default=120.0)
    arguments = parser.parse_args()
    folder = RUNS / "build"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    body = liver()
    meshio.Mesh(1e3 * body.points, [("triangle", body.boundary)]).write(folder / "liver_mm.stl")
    np.savetxt(folder / "veins_mm.txt", 1e3 * body.points[body.fixed])
    np.savetxt(folder / "reach_mm.txt", 1e3 * body.points[body.node_sets["s1"]])
    begin = time.perf_counter()
    words = [
        "build",
        folder / "liver_mm.stl",
        "--unit",
        "mm",
        "--fixed",
        folder / "veins_mm.txt",
        "--output",
        folder / "out",
    ]
    words += ["--zone", f"reach={folder / 'reach_mm.txt'}", "--displacement", 0.05, "--ramp", 8]
    words += ["--young-modulus", YOUNG_MODULUS, "--poisson-ratio", POISSON_RATIO]
    words += ["--nodes", arguments.nodes, "--samples", arguments.samples, "--seconds", arguments.seconds]
    softtwin([str(word) for word in words])
    seconds = time.perf_counter() - begin
    out = folder / "out"
    validation = json.loads((out / "validation.json").read_text())["figures"]
    stages = {name: entry["seconds"] for name, entry in json.loads((out / "stages.json").read_text()).items()}
    print({"seconds": seconds, **stages})
    write("build_time", {"asked": vars(arguments), "seconds": seconds, "stages": stages, "held_out": validation})


if __name__ == "__main__":
    main()
