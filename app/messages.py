"""OpenIGTLink messages: clouds out of what a peer sends, and an answer as what it can show.

Lengths and axes of the network are `Coordinates`. The protocol says millimetres (Documents/Protocol/transform.md and
point.md of the OpenIGTLink library) and no axes; 3D Slicer takes points and matrices over into its scene, which is RAS,
without turning them (Converter/igtlioPolyDataConverter.cxx of OpenIGTLinkIO), so that mm and RAS are what it expects.

pyigtl 0.3.4 packs the messages and has the checksum. What comes is read here: its header drops the checksum, its
POLYDATA cannot be unpacked, its POINT takes a body that ends in the middle of a point.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyigtl.messages import CRC64, MessageBase, PolyDataMessage, StringMessage, TransformMessage

from softtwin.meshes.body import Surface
from softtwin.meshes.export import Coordinates
from softtwin.registration.result import Registration
from softtwin.registration.uncertainty import Uncertainty

from .answer import Answer
from .record import NOTICE, finite
from .twin import Twin

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
HEADER_SIZE = 58
POSE, FIGURES = "pose", "figures"
_HEADER = struct.Struct("> H 12s 20s I I Q Q")
_EXTENDED = struct.Struct("> H H I I")
_POLYDATA = struct.Struct("> 10I")
_POINT = np.dtype(
    [
        ("name", "S64"),
        ("group", "S32"),
        ("rgba", "u1", 4),
        ("position", ">f4", 3),
        ("diameter", ">f4"),
        ("owner", "S20"),
    ]
)
_VERSIONS = (1, 2, 3)  # of the header; protocol 3 says 2
_NAME = 20  # bytes of a device's name
_LONGEST = 2**16 - 1  # bytes of a STRING


class MessageError(ValueError):
    """What a peer has sent is no message of OpenIGTLink, or a damaged one."""


@dataclass(frozen=True)
class Header:
    """What stands before the body of a message.

    Args:
        version: of the header.
        kind: type of the message, `POINT` for example.
        device: name of the sender's device.
        timestamp: when the sender says that it was made, seconds since 1970; 0 where it does not say.
        size: bytes of the body.
        checksum: of the body, CRC-64 of ECMA-182.
    """

    version: int
    kind: str
    device: str
    timestamp: float
    size: int
    checksum: int

    @classmethod
    def parse(cls, raw: bytes) -> Header:
        """The header in 58 bytes.

        Raises:
            MessageError: they are none.
        """
        version, kind, device, seconds, fraction, size, checksum = _HEADER.unpack(raw)
        word = _text(kind)
        if version not in _VERSIONS or not re.fullmatch(r"[A-Z0-9_]+", word):
            raise MessageError(f"expected a header of OpenIGTLink, got {bytes(raw[:14])!r}...")
        return cls(version, word, _text(device), seconds + fraction / 2**32, size, checksum)

    @property
    def name(self) -> str:
        """Device and time, by which a peer knows the cloud that an answer is to."""
        return f"{self.device} {self.timestamp:.6f}"


def _text(padded: bytes) -> str:
    return padded.split(b"\0", 1)[0].decode("utf-8", "replace").strip()


def cloud_in(header: Header, body: bytes, place: Coordinates) -> Floats:
    """The points of a message, (p, 3), metres and LPS; polygons and whatever else it carries are left.

    Args:
        header: of a `POINT` or a `POLYDATA`.
        body: all of it.
        place: unit and axes of the network.

    Raises:
        MessageError: the checksum is wrong, or the body is not what its kind says.
    """
    if CRC64(body) != header.checksum:
        raise MessageError(f"{header.kind} of {header.device!r}: the checksum is wrong")
    content = _content(header, body)
    points = _points(content) if header.kind == "POINT" else _vertices(content)
    return place.metres(points)


def _content(header: Header, body: bytes) -> memoryview:
    """The body without the extended header before and the metadata behind it."""
    view = memoryview(body)
    if header.version == 1:
        return view
    if len(view) < _EXTENDED.size:
        raise MessageError(f"{header.kind}: expected an extended header of {_EXTENDED.size} bytes, got {len(view)}")
    begin, index, metadata, _ = _EXTENDED.unpack_from(view)
    end = len(view) - index - metadata
    if not _EXTENDED.size <= begin <= end:
        raise MessageError(f"{header.kind}: extended header and metadata are larger than the body of {len(view)} bytes")
    return view[begin:end]


def _points(content: memoryview) -> Floats:
    if len(content) % _POINT.itemsize:
        raise MessageError(f"POINT: expected a multiple of {_POINT.itemsize} bytes, got {len(content)}")
    return np.frombuffer(content, _POINT)["position"].astype(np.float64)


def _vertices(content: memoryview) -> Floats:
    if len(content) < _POLYDATA.size:
        raise MessageError(f"POLYDATA: expected {_POLYDATA.size} bytes at least, got {len(content)}")
    counts = _POLYDATA.unpack_from(content)
    said = 12 * counts[0] + sum(counts[2:9:2])
    if said > len(content) - _POLYDATA.size:
        raise MessageError(f"POLYDATA: {counts[0]} points and their cells need {said} bytes, got {len(content)}")
    points = np.frombuffer(content, ">f4", 3 * counts[0], _POLYDATA.size)
    return points.reshape(-1, 3).astype(np.float64)


def device_names(structures: Iterable[str]) -> dict[str, str]:
    """For each structure a device's name: ASCII, 20 bytes at most, no two alike, and none of the other messages'.

    Args:
        structures: their names.
    """
    taken, named = {POSE, FIGURES}, {}
    for structure in structures:
        plain = re.sub(r"[^\x21-\x7e]+", "_", structure)[:_NAME] or "structure"
        name, count = plain, 2
        while name in taken:
            name, count = f"{plain[: _NAME - len(str(count)) - 1]}-{count}", count + 1
        taken.add(name)
        named[structure] = name
    return named


@dataclass(frozen=True, eq=False)
class Speaker:
    """Says an answer in messages: a POLYDATA for each structure, the TRANSFORM `pose`, the STRING `figures`.

    Surfaces are in the coordinates of the body at rest; `pose` takes them to the camera's. A refused frame has surfaces
    without points and no pose, so that nobody looks at what was found for an earlier cloud or is not to be used.

    Args:
        twin: the twin.
        place: unit and axes of the network.
    """

    twin: Twin
    place: Coordinates = field(default_factory=lambda: Coordinates("mm", "ras"))

    @cached_property
    def names(self) -> Mapping[str, str]:
        """The device of each structure."""
        return device_names([self.twin.organ, *self.twin.body.inner])

    def messages(
        self, answer: Answer, counts: Mapping[str, int] | None = None, row: Mapping[str, Any] | None = None
    ) -> list[bytes]:
        """The messages of one answer, in the order in which they are sent.

        Args:
            answer: the answer.
            counts: what happened on the network, for the figures.
            row: its figures in the record, where they are at hand: margins are not worked out twice.
        """
        found, said = answer.frame.registration, []
        usable = found is not None and answer.frame.judgement.is_usable
        if found is not None and usable:
            said += [self._surface(name, surface) for name, surface in self.twin.surfaces(found).items()]
            said.append(TransformMessage(self._pose(found), device_name=POSE))
        else:
            said += [PolyDataMessage(points=np.empty((0, 3)), device_name=name) for name in self.names.values()]
        said.append(StringMessage(self._figures(answer, counts or {}, row), device_name=FIGURES))
        return [_packed(message) for message in said]

    def _surface(self, name: str, surface: Surface) -> MessageBase:
        """Vertices that no triangle uses (a volume's inner nodes) are left out; triangles stay from frame to frame."""
        if name not in self._cells:
            used, local = np.unique(surface.triangles, return_inverse=True)
            self._cells[name] = used, np.insert(local.reshape(-1, 3), 0, 3, axis=1).ravel()
        used, polygons = self._cells[name]
        points = self.place.lengths(surface.points[used])
        return PolyDataMessage(points=points, polygons=polygons, device_name=self.names[name])

    @cached_property
    def _cells(self) -> dict[str, tuple[Ints, Ints]]:
        return {}

    def _pose(self, found: Registration) -> Floats:
        matrix = self.place.motion(found.pose.matrix)
        matrix[:3, 3] = self.place.distances(matrix[:3, 3])
        return matrix

    def _figures(self, answer: Answer, counts: Mapping[str, int], row: Mapping[str, Any] | None) -> str:
        figures = {"notice": NOTICE, **figures_of(self.twin, answer, self.place, row), "network": dict(counts)}
        text = json.dumps(finite(figures))  # ASCII, which is all that pyigtl packs without an error
        if len(text) > _LONGEST:
            few = {name: {} for name in figures if name.endswith("margin95_mm")} | {"reasons": figures["reasons"][:1]}
            text = json.dumps(finite({**figures, **few}))
        return text


def figures_of(twin: Twin, answer: Answer, place: Coordinates, row: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What an answer says beside its surfaces: verdict, reasons, net force, margins, how it kept up.

    Args:
        twin: the twin.
        answer: the answer.
        place: unit and axes of the network, which the net force is on, too.
        row: as for `Speaker.messages`.
    """
    frame, found = answer.frame, answer.frame.registration
    figures: dict[str, Any] = {
        "frame": frame.number,
        "cloud": answer.cloud,
        "verdict": frame.judgement.verdict.value,
        "reasons": list(frame.judgement.reasons),
        "unit": place.unit,
        "axes": place.axes,
        "frame_s": frame.seconds,
        "age_s": answer.age,
        "dropped": answer.dropped,
        "is_late": answer.is_late,
    }
    if found is None:
        return figures
    figures["margin95_mm"] = _margins(twin, found.uncertainty, row, "margin95_m")
    if found.has_free_pose:
        figures["camera_margin95_mm"] = _margins(twin, found.camera_uncertainty, row, "camera_margin95_m")
    if any(outside.any() for outside in twin.outside.values()):
        figures["outside_share"] = {name: float(outside.mean()) for name, outside in twin.outside.items()}
    return figures | {
        "net_force_N": place.directions(found.net_force).tolist(),
        "net_force_deviation_N": found.net_force_deviation.tolist(),
        "rms_distance_mm": 1e3 * found.rms_distance,
        "points": found.points,
        "points_left_out": found.left_out,
        "margins_in": found.frame,
    }


def _margins(twin: Twin, known: Uncertainty, row: Mapping[str, Any] | None, entry: str) -> dict[str, float]:
    """The largest 95 % margin of each structure, of inner ones inside the organ, millimetres.

    Those of inner ones are from the record's row, if given.
    """
    every = {twin.organ: float(known.margin().max())}
    if row is None:
        every |= {name: twin.margin_inside(name, known.margin(points)) for name, points in twin.embeddings.items()}
    else:
        every |= {name: target[entry] for name, target in row["targets"].items()}
    return {name: 1e3 * margin for name, margin in every.items()}


def _packed(message: MessageBase) -> bytes:
    return bytes(message.pack())


def cloud_message(points: ArrayLike, device: str = "cloud", place: Coordinates | None = None) -> bytes:
    """A cloud as a POLYDATA without cells, for programs that send one.

    Args:
        points: (p, 3), metres and LPS.
        device: its name.
        place: unit and axes of the network; millimetres and RAS if not given.
    """
    chosen = place or Coordinates("mm", "ras")
    return _packed(PolyDataMessage(points=chosen.lengths(points), device_name=device))
