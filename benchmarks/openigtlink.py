"""Round trips over OpenIGTLink with a second process: a cloud in, a surface of 2,500 vertices, pose and figures out.

    python benchmarks/openigtlink.py [--rounds 300] [--twin softtwin-quickstart]

The second process sends the next cloud when it has read the whole answer and checked every checksum of it. `network`
answers each cloud with one registration that was found before, packed anew each time as the live loop does: that is
what the network costs. With --twin, `registered` is the live loop itself on that twin, its record included.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from numpy.typing import NDArray
from pyigtl.messages import CRC64, PointMessage

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


def play_peer(port: str, file: str, kind: str, rounds: str) -> None:
    """The second process: seconds of each round, and bytes of an answer, as JSON."""
    cloud, seconds, size = np.load(file), list[float](), 0
    points = PLACE.lengths(cloud)
    message = PointMessage(points, device_name="camera").pack() if kind == "POINT" else cloud_message(cloud, "camera")
    with socket.create_connection(("127.0.0.1", int(port))) as connection:
        for _ in range(WARM + int(rounds)):
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
        command = [sys.executable, __file__, "peer", str(link.port), str(file), kind, str(rounds)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as peer:
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


def bent() -> tuple[Twin, Floats]:
    """A cantilever of 2,500 vertices, and a cloud of it under a load."""
    body = beam((48, 12, 12), (0.30, 0.08, 0.08), "tetrahedron")
    twin, forces = Twin(Cantilever(body)), np.zeros_like(body.points)
    forces[body.node_sets["tip"]] = np.array([0.0, 0.06, -0.2]) / len(body.node_sets["tip"])
    displacement = twin.predict(forces).displacement
    return twin, partial_view(body, displacement, (1.0, 1.0, 1.0), POINTS, 5e-4, np.random.default_rng(0))


def work(row: str, given: Given) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        if row == REGISTERED:
            cloud = np.load(given.twin / "demo" / "cloud.npy")
            with Twin.open(given.twin, pose="fixed") as twin:
                return measured(twin, cloud, "POINT", given.rounds, True, Path(folder))
        own, cloud = bent()
        with own as twin:
            return measured(twin, cloud, row.split(", ")[1], given.rounds, False, Path(folder))


REGISTERED = "registered"
BENCHMARK = Benchmark(
    name="openigtlink",
    title="Round trips over OpenIGTLink with a second process: a cloud in; surface, pose and figures out",
    about=("app",),
    work=work,
    rows=lambda given: ["network, POINT", "network, POLYDATA", *([REGISTERED] if given.twin else [])],
    columns=(
        Column("points in", "", "{points_in}"),
        Column("vertices out", "", lambda f: f["surface_vertices"] + f["inner_vertices"]),
        Column("in; out", "kB", "{bytes_in*0.001:.0f}; {bytes_out*0.001:.0f}"),
        Column("rate", "Hz", "{rate_hz:.1f}"),
        Column("round (95 %)", "ms", "{round_ms.p50:.1f} ({round_ms.p95:.1f})"),
    ),
    settings={
        "rounds": Setting(300),
        "twin": Setting(None, "folder of softtwin quickstart", Path, picks=True),
    },
    seeds=(0,),
    small={"rounds": 5},
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"peer": play_peer})
