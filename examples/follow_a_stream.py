"""Follow an organ through a stream of clouds, one of which is worthless: the stream goes on, and says which one.

    python examples/follow_a_stream.py softtwin-quickstart

A real stream comes from a camera; here the demo's cloud is given new noise for every frame. What the loop does is
the same: take a frame, look at its verdict, use its registration only if the verdict allows it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtwin.app.twin import Twin


def camera(folder: Path) -> Iterator[NDArray[np.float64]]:
    """Five clouds, (p, 3), metres; somebody's hand is before the lens in the third."""
    cloud = np.load(folder / "demo" / "cloud.npy")
    noise = np.random.default_rng(0)
    for number in range(5):
        seen = cloud + 5e-4 * noise.standard_normal(cloud.shape)
        yield seen if number != 2 else np.empty((0, 3))


def main(folder: Path) -> list[str]:
    """Verdict of every frame."""
    verdicts = []
    with Twin.open(folder / "twin") as twin:
        for frame in twin.stream(camera(folder)):
            verdicts.append(frame.judgement.verdict.value)
            if frame.registration is None or not frame.judgement.is_usable:
                print(f"frame {frame.number}: {verdicts[-1]}: {'; '.join(frame.judgement.reasons)}")
                continue
            found = frame.registration
            centre = (1e3 * twin.targets(found)["tumour"].mean(axis=0)).round(1)
            print(f"frame {frame.number}: {verdicts[-1]}, tumour at {centre} mm, noise {1e3 * found.noise:.2f} mm")
    return verdicts


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "softtwin-quickstart"))
