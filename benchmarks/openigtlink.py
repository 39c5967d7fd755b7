"""Round trips over OpenIGTLink with a second process: a cloud in, a surface of 2,500 vertices, pose and figures out.

    python benchmarks/openigtlink.py [--rounds 300] [--twin softtwin-quickstart]

The second process sends the next cloud when it has read the whole answer and checked every checksum of it. `network`
answers each cloud with one registration that was found before, packed anew each time as the live loop does: that is
what the network costs. With --twin, `registered` is the live loop itself on that twin, its record included.
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyigtl.messages import CRC64, PointMessage
from record import write
from threadpoolctl import threadpool_limits

from softtwin.app.address import Address
from softtwin.app.answer import Answer
from softtwin.app.live import register_live
from softtwin.app.messages import FIGURES, HEADER_SIZE, Header, Speaker, cloud_message
from softtwin.app.openigtlink import Link
from softtwin.app.streams import Mailbox
from softtwin.app.twin import Sequence, Twin
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import outer
from softtwin.meshes.export import Coordinates
from softtwin.meshes.shapes import beam

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from own_forward_model import Cantilever

Floats = NDArray[np.float64]
PLACE = Coordinates("mm", "ras")
WARM = 10  # rounds that are not counted
POINTS = 2500


def exactly(connection: socket.socket, count: int) -> bytes:
    found = bytearray()
    while len(found) < count:
        piece = connection.recv(count - len(found))
        if not piece:
            raise EOFError
        found += piece
    return bytes(found)


def play_peer(port: int, file: Path, kind: str, rounds: int) -> None:
    """The second process: seconds of each round, and bytes of an answer, as JSON."""
    cloud, seconds, size = np.load(file), list[float](), 0
    points = PLACE.lengths(cloud)
    message = PointMessage(points, device_name="camera").pack() if kind == "POINT" else cloud_message(cloud, "camera")
    with socket.create_connection(("127.0.0.1", port)) as connection:
        for _ in range(WARM + rounds):
            begin, size, device = time.perf_counter(), 0, ""
            connection.sendall(message)
            while device != FIGURES:
                header = Header.parse(exactly(connection, HEADER_SIZE))
                assert CRC64(exactly(connection, header.size)) == header.checksum
                size, device = size + HEADER_SIZE + header.size, header.device
            seconds.append(time.perf_counter() - begin)
    print(json.dumps({"seconds": seconds[WARM:], "bytes": size, "sent": len(message)}))


def measured(twin: Twin, cloud: Floats, kind: str, rounds: int, registers: bool, folder: Path) -> dict[str, Any]:
    """Figures of one row."""
    file = folder / "cloud.npy"
    np.save(file, cloud)
    speaker, box, sequence = Speaker(twin, PLACE), Mailbox(), Sequence(twin)
    frame = sequence.register(cloud)
    assert frame.registration is not None
    with Link(Address("", 0, True), box, PLACE, ours=list(speaker.names.values()), say=lambda line: None) as link:
        command = [sys.executable, __file__, "--peer", str(link.port), "--cloud", str(file), "--kind", kind]
        with subprocess.Popen([*command, "--rounds", str(rounds)], stdout=subprocess.PIPE, text=True) as peer:
            begin = time.process_time()
            if registers:

                def reply(answer: Answer, row: Mapping[str, Any]) -> None:
                    link.send(speaker.messages(answer, link.counts, row))
                    if answer.frame.number == WARM + rounds - 1:
                        box.close()

                register_live(twin, box, folder / "live", formats=(), reply=reply, say=lambda line: None)
            else:
                for _ in range(WARM + rounds):
                    arrival = box.take()
                    assert arrival is not None
                    age = time.monotonic() - arrival.at
                    link.send(speaker.messages(Answer(frame, arrival.name, age, arrival.dropped, False), link.counts))
            used = time.process_time() - begin
            told = json.loads(peer.communicate(timeout=60)[0])
        counts = link.counts
    seconds = np.array(told["seconds"])
    return {
        "message": kind,
        "points_in": len(cloud),
        "surface_vertices": len(np.unique(outer(twin.body).rest.triangles)),
        "inner_vertices": sum(len(surface.points) for surface in twin.body.inner.values()),
        "bytes_in": told["sent"],
        "bytes_out": told["bytes"],
        "rounds": rounds,
        "cpu_ms_per_round": 1e3 * used / (WARM + rounds),
        "rate_hz": rounds / float(seconds.sum()),
        "round_ms": {name: 1e3 * float(np.quantile(seconds, q)) for name, q in (("p50", 0.5), ("p95", 0.95))},
        **counts,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--twin", type=Path, help="folder of softtwin quickstart")
    parser.add_argument("--peer", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--cloud", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--kind", default="POINT", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peer is not None:
        play_peer(arguments.peer, arguments.cloud, arguments.kind, arguments.rounds)
        return
    import tempfile

    rows = {}
    with threadpool_limits(1), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        body = beam((48, 12, 12), (0.30, 0.08, 0.08), "tetrahedron")
        with Twin(Cantilever(body)) as twin:
            forces = np.zeros_like(body.points)
            forces[body.node_sets["tip"]] = np.array([0.0, 0.06, -0.2]) / len(body.node_sets["tip"])
            bent = twin.predict(forces).displacement
            cloud = partial_view(body, bent, (1.0, 1.0, 1.0), POINTS, 5e-4, np.random.default_rng(0))
            for kind in ("POINT", "POLYDATA"):
                rows[f"network, {kind}"] = measured(twin, cloud, kind, arguments.rounds, False, folder)
        if arguments.twin is not None:
            cloud = np.load(arguments.twin / "demo" / "cloud.npy")
            with Twin.open(arguments.twin, pose="fixed") as twin:
                rows["registered"] = measured(twin, cloud, "POINT", arguments.rounds, True, folder)
    for row, figures in rows.items():
        print(f"{row}: {figures['surface_vertices']} vertices, {figures['rate_hz']:.1f} Hz, {figures['round_ms']}")
    write("openigtlink", rows)


if __name__ == "__main__":
    main()
