"""Learn from your own simulator: forces and displacements in arrays, no FEniCSx.

    python examples/own_simulator.py [FOLDER]

The simulator here is a cantilever that stiffens as it bends; it answers in millimetres. What it gave becomes a data
set, a reduced network learns it in seconds, and the held-out samples judge it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.from_arrays import data_set_from_arrays
from softtwin.surrogate.plan import TrainingPlan
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.train import train

Floats = NDArray[np.float64]


def simulate(body: Body, forces: Floats) -> Floats:
    """Displacement in millimetres, (n, 3), under nodal forces in newtons, (n, 3)."""
    x = body.points[:, 0] / body.points[:, 0].max()
    line = 0.5 * x**2 * (3.0 - x)
    pull = line @ forces / 5.0  # newtons over newtons per metre: what a linear beam would do at its tip
    bend = np.linalg.norm(pull)
    return 1e3 * np.outer(line, pull / (1.0 + 20.0 * bend))


def main(folder: Path) -> float:
    """Median relative error on the held-out samples."""
    body = beam((12, 3, 3), (0.30, 0.06, 0.06))
    rng = np.random.default_rng(0)
    forces = np.zeros((400, *body.points.shape))
    tip = body.node_sets["tip"]
    forces[:, tip] = 0.5 / len(tip) * rng.standard_normal((400, 1, 3)) * [0.1, 1.0, 1.0]
    displacements = np.stack([simulate(body, one) for one in forces])

    data = data_set_from_arrays(
        folder / "data.zarr", body, forces, displacements, length_unit="mm", force_unit="N", source="cantilever"
    )
    surrogate = train(data, TrainingPlan(Reduced(modes=4, width=32, depth=2), epochs=150))
    found = evaluate(surrogate, data)
    print(found)
    return found.relative_error.median


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
