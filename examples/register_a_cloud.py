"""Register one cloud with a twin: where the tumour is, which force did it, and whether the answer can be used.

    python examples/register_a_cloud.py softtwin-quickstart

The folder is what `softtwin quickstart` made: a liver phantom's twin, and a cloud of an unseen deformation. The twin
needs torch; FEniCSx is not needed any more.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from softtwin.app.twin import Twin


def main(folder: Path) -> float:
    """Mean error of the tumour's surface after registration, metres."""
    # A camera has seen one side of the organ: points (p, 3) in metres.
    cloud = np.load(folder / "demo" / "cloud.npy")

    # The five lines. The first registration prepares the twin, which takes a second; the ones after it do not.
    with Twin.open(folder / "twin", model="surrogate") as twin:
        result = twin.register(cloud)
        print(result.judgement.verdict.value, *result.judgement.reasons)
        print("net force (N):", result.net_force.round(3), "+-", result.net_force_deviation.round(3))
        tumour = twin.targets(result)["tumour"]
        carried = twin.embeddings["tumour"]

    # The phantom's truth is known, so the answer can be checked.
    truth = np.load(folder / "demo" / "truth.npy")
    error = np.linalg.norm(tumour - (twin.body.inner["tumour"].points + carried.displace(truth)), axis=1).mean()
    before = np.linalg.norm(carried.displace(truth), axis=1).mean()
    print(f"the tumour was {1e3 * before:.1f} mm away from where it is at rest, and was found to {1e3 * error:.2f} mm")
    return float(error)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "softtwin-quickstart"))
