"""Predict from exported graphs: onnxruntime and NumPy, neither torch nor FEniCSx.

    softtwin export softtwin-quickstart/twin
    python examples/run_exported_graphs.py softtwin-quickstart/twin

The second graph gives the displacement and its whole derivative at once, for coefficients of the directions of force
that move the body most: enough for a registration in any language that has an ONNX runtime.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from softtwin.surrogate.exported import ExportedTwin


def main(twin: Path) -> float:
    """How far the derivative is off for one per cent more load, relative to the change that the graph itself gives."""
    graphs = ExportedTwin(twin / "onnx", twin)
    coefficients = np.zeros(graphs.directions.shape[1])
    coefficients[0] = 0.5  # newtons
    displacement, jacobian = graphs.linearised(coefficients)
    print(f"{graphs.nodes} nodes, moved by up to {1e3 * np.linalg.norm(displacement, axis=1).max():.1f} mm")
    change = graphs.linearised(1.01 * coefficients)[0] - displacement
    predicted = (jacobian @ (0.01 * coefficients)).reshape(-1, 3)
    error = float(np.linalg.norm(predicted - change) / np.linalg.norm(change))
    print(f"one per cent more load: its derivative tells the change to {100 * error:.1f} %")
    return error


if __name__ == "__main__":
    main(Path(sys.argv[1]))
