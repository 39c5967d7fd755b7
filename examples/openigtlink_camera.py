"""A camera that speaks OpenIGTLink: it sends clouds to softtwin, and reads what softtwin answers.

    softtwin register softtwin-quickstart igtl://:18944 --watch --output live     # in one terminal
    python examples/openigtlink_camera.py softtwin-quickstart                     # in another

The demo's cloud is given new noise for every frame. 3D Slicer takes this program's place, or only listens: a connector
of its module OpenIGTLinkIF, client of localhost and port 18944, gets the moved surfaces, `pose` and `figures`.

Research software: not a medical device.
"""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyigtl
from pyigtl.messages import message_type_to_class_constructor

TO_THE_NETWORK = 1e3 * np.array([-1.0, -1.0, 1.0])  # metres and LPS to millimetres and RAS


class SurfaceMessage(pyigtl.PolyDataMessage):
    """A POLYDATA that can be read, which pyigtl's own cannot."""

    def _unpack_content(self, content: bytes) -> None:
        (count,) = struct.unpack_from(">I", content)
        self.points = np.frombuffer(content, ">f4", 3 * count, 40).reshape(-1, 3)


def main(folder: Path, port: int = 18944, frames: int = 5) -> list[str]:
    """Verdict of every frame."""
    message_type_to_class_constructor["POLYDATA"] = SurfaceMessage
    cloud = np.load(folder / "demo" / "cloud.npy")
    noise = np.random.default_rng(0)
    camera = pyigtl.OpenIGTLinkClient("127.0.0.1", port)  # goes on trying until somebody listens
    verdicts = []
    for number in range(frames):
        seen = TO_THE_NETWORK * (cloud + 5e-4 * noise.standard_normal(cloud.shape))
        camera.send_message(pyigtl.PointMessage(seen, device_name="camera"))  # returns when it is sent
        figures: dict[str, Any] = json.loads(camera.wait_for_message("figures", timeout=300).string)
        surfaces = {each.device_name: each for each in camera.get_latest_messages()}
        verdicts.append(figures["verdict"])
        centre = surfaces["tumour"].points.mean(axis=0).round(1)
        print(f"frame {number}: {verdicts[-1]}, tumour at {centre} mm, {1e3 * figures['age_s']:.0f} ms old", flush=True)
    camera.stop()
    return verdicts


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "softtwin-quickstart"), *map(int, sys.argv[2:]))
