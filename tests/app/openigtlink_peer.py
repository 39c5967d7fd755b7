"""A peer that speaks OpenIGTLink by sockets and struct alone, and does as it is told on its standard input.

Nothing of softtwin or pyigtl is in here: it is written from the protocol's documents, the checksum bit by bit, so that
both ends cannot share a mistake. A line in is a command, `["send", {...}]`; a line out is what it returns, in JSON.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time
from typing import Any

PATIENCE = 100.0  # seconds after which whoever waits has waited in vain
TABLE = []
for byte in range(256):
    rest = byte << 56
    for _ in range(8):
        rest = (rest << 1) ^ 0x142F0E1EBA9EA3693 if rest >> 63 else rest << 1
    TABLE.append(rest)


def checksum(body: bytes) -> int:
    value = 0
    for byte in body:
        value = TABLE[(value >> 56) ^ byte] ^ (value << 8 & 0xFFFFFFFFFFFFFFFF)
    return value


def message(kind: str, device: str, content: bytes, version: int = 1, time: float = 0.0, **spoiled: int) -> bytes:
    if version > 1:  # a table with one entry, TOLD: yes
        index = struct.pack(">HHHI", 1, 4, 3, 3)
        extended = struct.pack(">HHII", 12, len(index), 7, 0)
        content = extended + content + index + b"TOLDyes"
    seconds = int(time)
    head = struct.pack(">H12s20sII", version, kind.encode(), device.encode(), seconds, int((time - seconds) * 2**32))
    size, crc = spoiled.get("size", len(content)), spoiled.get("crc", checksum(content))
    return head + struct.pack(">QQ", size, crc) + content


def points(places: list[list[float]]) -> bytes:
    one = struct.Struct(">64s32s4B3ff20s")
    return b"".join(one.pack(b"", b"", 255, 255, 0, 255, *place, 0.0, b"") for place in places)


def polydata(places: list[list[float]], polygons: list[list[int]]) -> bytes:
    """With what Slicer sends along: a value at each point, named `seen`."""
    cells = b"".join(struct.pack(f">{len(cell) + 1}I", len(cell), *cell) for cell in polygons)
    counts = struct.pack(">10I", len(places), 0, 0, 0, 0, len(polygons), len(cells), 0, 0, 1)
    vertices = b"".join(struct.pack(">3f", *place) for place in places)
    attribute = (
        struct.pack(">HI", 1 << 8, len(places)) + b"seen\0\0" + struct.pack(f">{len(places)}f", *[1.0] * len(places))
    )
    return counts + vertices + cells + attribute


def read_polydata(body: bytes) -> dict[str, Any]:
    counts = struct.unpack_from(">10I", body)
    flat = struct.unpack_from(f">{3 * counts[0]}f", body, 40)
    start = 40 + 12 * counts[0] + counts[2] + counts[4]
    words, cells = list(struct.unpack_from(f">{counts[6] // 4}I", body, start)), []
    while words:
        cells.append(words[1 : 1 + words[0]])
        words = words[1 + words[0] :]
    assert len(cells) == counts[5] and len(body) == start + counts[6]
    return {"points": [flat[i : i + 3] for i in range(0, len(flat), 3)], "polygons": cells}


def read_transform(body: bytes) -> dict[str, Any]:
    columns = struct.unpack(">12f", body)
    return {"matrix": [[*columns[row::3]] for row in range(3)]}


def read_string(body: bytes) -> dict[str, Any]:
    encoding, length = struct.unpack_from(">HH", body)
    assert encoding == 3 and len(body) == 4 + length
    return {"text": body[4:].decode("ascii")}


READ = {"POLYDATA": read_polydata, "TRANSFORM": read_transform, "STRING": read_string}


class Peer:
    def __init__(self) -> None:
        self.listener = self.connection = None

    def listen(self, port: int = 0, room: int = 0) -> int:
        self.listener = socket.socket()
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if room:  # bytes that the system keeps for us, before there is a connection
            self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)
        self.listener.bind(("127.0.0.1", port))
        self.listener.listen()
        return self.listener.getsockname()[1]

    def accept(self) -> None:
        self.connection, _ = self.listener.accept()
        self.connection.settimeout(PATIENCE)

    def connect(self, port: int) -> None:
        self.connection = socket.create_connection(("127.0.0.1", port), PATIENCE)

    def close(self, all: bool = False) -> None:
        self.connection.close()
        if all:
            self.listener.close()

    def raw(self, data: str) -> None:
        self.connection.sendall(bytes.fromhex(data))

    def send(self, kind: str, device: str, places: list[list[float]], polygons: Any = (), **more: Any) -> None:
        body = points(places) if kind == "POINT" else polydata(places, polygons)
        self.connection.sendall(message(kind, device, body, **more))

    def send_body(self, kind: str, device: str, body: str, **more: Any) -> None:
        self.connection.sendall(message(kind, device, bytes.fromhex(body), **more))

    def drip(self, kind: str, device: str, places: list[list[float]]) -> None:
        """A message in pieces, with the header torn, too."""
        whole = message(kind, device, points(places))
        for start in range(0, len(whole), 29):
            self.connection.sendall(whole[start : start + 29])
            time.sleep(0.001)

    def _exactly(self, count: int) -> bytes:
        found = b""
        while len(found) < count:
            piece = self.connection.recv(min(count - len(found), 2**16))
            if not piece:
                raise EOFError
            found += piece
        return found

    def receive(self, count: int = 1) -> list[dict[str, Any]]:
        found = []
        for _ in range(count):
            try:
                version, kind, device, _, _, size, crc = struct.unpack(">H12s20sIIQQ", self._exactly(58))
            except (EOFError, ConnectionError):
                return [*found, {"kind": "END"}]
            body = self._exactly(size)
            assert version == 1 and crc == checksum(body)
            word = kind.rstrip(b"\0").decode()
            found.append({"kind": word, "device": device.rstrip(b"\0").decode(), **READ[word](body)})
        return found


if __name__ == "__main__":
    peer = Peer()
    print("ready", flush=True)
    for line in sys.stdin:
        name, arguments = json.loads(line)
        print(json.dumps(getattr(peer, name)(**arguments)), flush=True)
