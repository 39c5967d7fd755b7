"""OpenIGTLink over real sockets with a second process: clouds in, answers out, the newest alone, and broken peers."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pyigtl", reason="pyigtl is absent")

from softtwin.app import openigtlink
from softtwin.app.address import Address, parse_source
from softtwin.app.answer import Answer
from softtwin.app.config import ConfigError
from softtwin.app.live import register_live
from softtwin.app.messages import FIGURES, POSE, Header, MessageError, Speaker, cloud_in, cloud_message, device_names
from softtwin.app.openigtlink import LIMIT, Link, LinkError
from softtwin.app.register import Scene
from softtwin.app.streams import Arrival, Mailbox
from softtwin.app.twin import Sequence, Twin
from softtwin.meshes.body import Surface
from softtwin.meshes.export import Coordinates
from softtwin.registration.pose import Pose

from .conftest import pulled, run, seen_cloud

PEER = Path(__file__).with_name("openigtlink_peer.py")
PLACE = Coordinates("mm", "ras")
PLACES = [[1.5, -20.25, 300.125], [0.0, 1.0, 2.0], [-7.0, 8.0, 1e-3]]
GIGABYTE = 10**9
LONG = 120.0  # seconds that nothing takes unless it hangs


class Other:
    """The second process; its methods are those of `openigtlink_peer.Peer`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def start(self, name: str, **arguments: Any) -> None:
        """Tell it to do something, without waiting."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([name, arguments]) + "\n")
        self._process.stdin.flush()

    def answer(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(**arguments: Any) -> Any:
            self.start(name, **arguments)
            return self.answer()

        return call


@contextmanager
def process() -> Iterator[Other]:
    command = [sys.executable, "-S", "-E", str(PEER)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None and child.stdout.readline() == "ready\n"
            yield Other(child)
        finally:
            child.kill()


@pytest.fixture
def other() -> Iterator[Other]:
    with process() as found:
        yield found


@contextmanager
def joined(other: Other, role: str, place: Coordinates = PLACE, room: int = 0, **options: Any) -> Iterator[Link]:
    """A link with the other process at its other end; `role` is ours."""
    port = other.listen(room=room) if role == "client" else 0
    address = Address("127.0.0.1" if role == "client" else "", port, role == "server", options.pop("device", ""))
    with Link(address, Mailbox(), place, **{"say": lambda line: None, **options}) as link:
        if role == "client":
            other.accept()
        else:
            other.connect(port=link.port)
        until(lambda: link.peers == 1)
        yield link


def until(happened: Callable[[], bool]) -> None:
    """Wait for what another thread or process does."""
    end = time.monotonic() + LONG
    while not happened():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.005)


def taken(link: Link) -> Arrival:
    arrival = link.box.take()
    assert arrival is not None
    return arrival


# ---------------------------------------------------------------------- clouds in


@pytest.mark.parametrize("role", ["client", "server"])
@pytest.mark.parametrize("kind", ["POINT", "POLYDATA"])
@pytest.mark.parametrize("version", [1, 2])
def test_a_cloud_comes_in_as_it_was_sent(other: Other, role: str, kind: str, version: int) -> None:
    """Both roles, both messages, both headers; the one of protocol 3 has metadata behind the points."""
    with joined(other, role) as link:
        other.send(kind=kind, device="camera", places=PLACES, polygons=[[0, 1, 2]], version=version, time=1234.5)
        arrival = taken(link)
        assert arrival.name == "camera 1234.500000"
        assert np.abs(1e3 * np.asarray(arrival.cloud) - np.array(PLACES) * [-1, -1, 1]).max() < 1e-3


@pytest.mark.parametrize(("unit", "per_metre"), [("mm", 1e3), ("m", 1.0)])
@pytest.mark.parametrize(("axes", "sign"), [("lps", 1), ("ras", -1)])
def test_unit_and_axes_of_the_network(other: Other, unit: Any, per_metre: float, axes: Any, sign: int) -> None:
    with joined(other, "server", Coordinates(unit, axes)) as link:
        other.send(kind="POINT", device="camera", places=PLACES)
        found = per_metre * np.asarray(taken(link).cloud)
        assert found == pytest.approx(np.array(PLACES) * [sign, sign, 1], rel=1e-6)  # float32


def test_a_message_in_pieces_is_whole(other: Other) -> None:
    with joined(other, "server") as link:
        other.drip(kind="POINT", device="camera", places=PLACES)
        assert len(np.asarray(taken(link).cloud)) == 3 and link.counts["damaged"] == 0


def test_a_message_of_no_points_is_an_empty_cloud(other: Other) -> None:
    with joined(other, "server") as link:
        for kind in ("POINT", "POLYDATA"):
            other.send(kind=kind, device="camera", places=[])
            assert np.asarray(taken(link).cloud).shape == (0, 3)


def test_the_newest_cloud_is_taken(other: Other) -> None:
    with joined(other, "server") as link:
        for count in (1, 2, 3):
            other.send(kind="POINT", device="camera", places=PLACES[:count])
        until(lambda: link.counts["clouds"] == 3)
        arrival = taken(link)
        assert len(np.asarray(arrival.cloud)) == 3 and arrival.dropped == 2


def test_only_the_device_that_is_meant_is_heard(other: Other) -> None:
    with joined(other, "server", device="camera") as link:
        for device, count in (("organ", 1), ("camera", 2)):
            other.send(kind="POINT", device=device, places=PLACES[:count])
        assert len(np.asarray(taken(link).cloud)) == 2 and link.counts["ignored"] == 1


def test_what_is_our_own_is_no_cloud_and_other_messages_are_passed_over(other: Other) -> None:
    """A peer that sends back the surface that it got would have it registered otherwise."""
    with joined(other, "server", ours=["organ"]) as link:
        other.send(kind="POLYDATA", device="organ", places=PLACES)
        for kind in ("IMAGE", "STATUS", "GET_CAPABIL", "NEVERSEEN"):
            other.send_body(kind=kind, device="camera", body="00" * 90)
        other.send(kind="POINT", device="camera", places=PLACES)
        assert len(np.asarray(taken(link).cloud)) == 3 and link.counts["ignored"] == 5


def test_several_peers_of_a_server(other: Other) -> None:
    """A camera sends, a display that says nothing gets the answers, too."""
    with process() as display, joined(other, "server") as link:
        display.connect(port=link.port)
        until(lambda: link.peers == 2)
        other.send(kind="POINT", device="camera", places=PLACES)
        assert len(np.asarray(taken(link).cloud)) == 3
        link.send([cloud_message(np.zeros((1, 3)), "organ")])
        for each in (display, other):
            assert each.receive()[0]["device"] == "organ"


# ---------------------------------------------------------------------- answers out


@pytest.fixture(scope="module")
def cloud(plain_twin: Twin) -> np.ndarray:
    return seen_cloud(plain_twin, pulled(plain_twin.body, (0.0, 0.06, -0.2)))


@pytest.mark.parametrize("role", ["client", "server"])
@pytest.mark.parametrize(("unit", "axes"), [("mm", "ras"), ("mm", "lps"), ("m", "ras")])
def test_an_answer_is_right_to_a_micrometre(
    other: Other, plain_twin: Twin, cloud: np.ndarray, role: str, unit: Any, axes: Any
) -> None:
    """Surfaces, pose and figures as the peer reads them, against the registration; a camera that is turned and far."""
    place = Coordinates(unit, axes)
    stands = Pose(Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix(), np.array([0.1, -0.05, 0.4]))
    frame = Sequence(plain_twin, "tip", stands).register(stands.apply(cloud))
    found = frame.registration
    assert found is not None and frame.judgement.is_usable
    speaker = Speaker(plain_twin, place)
    with joined(other, role, place) as link:
        link.send(speaker.messages(Answer(frame, "camera 7.000000", 0.02, 3, False), link.counts))
        got = {each["device"]: each for each in other.receive(count=4)}
    assert list(got) == ["organ", "tumour", POSE, FIGURES]
    turn, scale = np.array([-1, -1, 1]) if axes == "ras" else np.ones(3), {"m": 1e3, "mm": 1.0}[unit]  # to mm
    for name, whole in plain_twin.surfaces(found).items():
        used, local = np.unique(whole.triangles, return_inverse=True)  # inner nodes of the volume are not sent
        surface = Surface(whole.points[used], local.reshape(-1, 3))
        assert np.abs(scale * np.array(got[name]["points"]) - 1e3 * turn * surface.points).max() < 1e-3
        assert got[name]["polygons"] == surface.triangles.tolist()
        matrix = np.array(got[POSE]["matrix"])  # what a display does with it
        moved = scale * (np.array(got[name]["points"]) @ matrix[:, :3].T + matrix[:, 3])
        assert np.abs(moved - 1e3 * turn * stands.apply(surface.points)).max() < 1e-3
    figures = json.loads(got[FIGURES]["text"])
    assert figures["notice"] == "Research software: not a medical device."
    assert (figures["unit"], figures["axes"]) == (unit, axes) and figures["cloud"] == "camera 7.000000"
    assert figures["verdict"] == frame.judgement.verdict.value and figures["reasons"] == list(frame.judgement.reasons)
    assert figures["net_force_N"] == pytest.approx((turn * found.net_force).tolist())
    margins = {"organ": found.uncertainty.margin(), "tumour": found.uncertainty.margin(plain_twin.embeddings["tumour"])}
    assert figures["margin95_mm"] == pytest.approx({name: 1e3 * margin.max() for name, margin in margins.items()})
    assert (figures["age_s"], figures["dropped"], figures["frame_s"]) == (0.02, 3, frame.seconds)


def test_a_refused_frame_takes_the_surfaces_away(other: Other, plain_twin: Twin) -> None:
    """Whoever looks at the display does not see what an earlier cloud had shown."""
    frame = Sequence(plain_twin, "tip").register(np.full((50, 3), np.nan))
    with joined(other, "server") as link:
        link.send(Speaker(plain_twin, PLACE).messages(Answer(frame, "", 0.01, 0, False)))
        got = {each["device"]: each for each in other.receive(count=3)}
    assert got["organ"]["points"] == got["tumour"]["points"] == []
    figures = json.loads(got[FIGURES]["text"])
    assert figures["verdict"] == "refused" and "NaN" in figures["reasons"][0]


def test_the_loop_goes_on_over_garbage(other: Other, plain_twin: Twin, cloud: np.ndarray, tmp_path: Path) -> None:
    """A program that registers: a cloud, NaN, a cloud far off, a damaged message, a cloud."""
    speaker = Speaker(plain_twin, PLACE)
    good = (1e3 * cloud * [-1, -1, 1]).tolist()
    verdicts, rows = [], []
    with joined(other, "server") as link:
        looping = threading.Thread(
            target=lambda: rows.extend(
                register_live(
                    plain_twin, link.box, tmp_path, zone="tip", formats=(), say=lambda line: None,
                    reply=lambda answer, row: link.send(speaker.messages(answer, link.counts, row)),
                )
            )
        )  # fmt: skip
        looping.start()
        for places in (good, [[float("nan")] * 3] * 50, [[9e4, 0, 0]] * 50, good):
            if places is good and verdicts:
                other.send(kind="POINT", device="camera", places=good, crc=1)
            other.send(kind="POINT", device="camera", places=places)
            got = other.receive(count=4 if places is good else 3)
            verdicts.append(json.loads(got[-1]["text"])["verdict"])
        assert json.loads(got[-1]["text"])["network"]["damaged"] == 1
        link.box.close()
        looping.join(LONG)
    assert verdicts == ["accepted", "refused", "refused", "accepted"] == [row["verdict"] for row in rows]
    assert rows[0]["cloud"].startswith("camera ")


def test_a_slow_peer_gets_the_newest_and_what_was_replaced_is_counted(other: Other) -> None:
    """It stops reading; 300 answers later it goes on. By their numbers: what lay in the sockets, then the last one."""
    room, count, filler = 2**15, 300, "x" * 60_000
    with joined(other, "client", room=room) as link:
        from pyigtl.messages import StringMessage

        for number in range(count):
            link.send([bytes(StringMessage(f"{number} {filler}", device_name="a").pack()) for _ in range(2)])
            time.sleep(0.001)
        got = [int(each["text"].split()[0]) for each in other.receive(count=2)]
        while got[-1] != count - 1 or got[-2] != count - 1:
            got += [int(each["text"].split()[0]) for each in other.receive(count=2)]
        assert got[::2] == got[1::2], "the messages of an answer stay together"
        numbers = got[::2]
        assert numbers == sorted(set(numbers))
        between = 2 * room + 4 * openigtlink._BUFFER  # the system takes twice what it is asked for
        assert len(numbers) <= 2 + between / (2 * len(filler)) < count / 10
        assert link.counts["replaced"] == count - len(numbers)


def test_the_last_answer_still_goes_out_when_the_link_is_closed(other: Other) -> None:
    with joined(other, "server") as link:
        link.send([cloud_message(np.zeros((1, 3)), "last")])
    assert [each.get("device", each["kind"]) for each in other.receive(count=2)] == ["last", "END"]


# ---------------------------------------------------------------------- broken peers


def header(kind: str = "POINT", size: int = 0, version: int = 1) -> str:
    return (
        version.to_bytes(2, "big") + kind.encode().ljust(12, b"\0") + b"camera".ljust(28, b"\0")
        + size.to_bytes(8, "big") + bytes(8)
    ).hex()  # fmt: skip


REQUEST = b"GET / HTTP/1.1\r\nHost: localhost:18944\r\nAccept: everything\r\n\r\n"
BROKEN = {
    "a gigabyte announced": (header(size=GIGABYTE), f"POINT of {GIGABYTE} bytes announced, more than {LIMIT}"),
    "more than there are numbers for": (header(size=2**64 - 1), "bytes announced"),
    "another protocol": (REQUEST.hex(), "expected a header"),
    "zeros": ("00" * 58, "expected a header"),
    "a version of the future": (header(version=900), "expected a header"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_peer_that_cannot_be_followed_is_dropped_and_the_next_is_served(other: Other, name: str) -> None:
    data, words = BROKEN[name]
    said: list[str] = []
    with joined(other, "server", say=said.append) as link:
        other.raw(data=data)
        assert other.receive() == [{"kind": "END"}]
        until(lambda: any(words in line and "connection dropped" in line for line in said))
        assert link.counts["dropped"] == 1 and link.peers == 0
        other.connect(port=link.port)
        other.send(kind="POINT", device="camera", places=PLACES)
        assert len(np.asarray(taken(link).cloud)) == 3


@pytest.mark.parametrize("cut", [1, 29, 57, 58, 100])
@pytest.mark.parametrize("role", ["client", "server"])
def test_a_peer_that_closes_in_the_middle_is_told_and_may_come_back(other: Other, role: str, cut: int) -> None:
    """In the header, between header and body, in the body."""
    said: list[str] = []
    whole = header(size=136) + "00" * 136
    with joined(other, role, say=said.append) as link:
        other.raw(data=whole[: 2 * cut])
        other.close()
        words = f"closed after {cut if cut < 58 else cut - 58} of {58 if cut < 58 else 136} bytes"
        until(lambda: any(words in line for line in said))
        assert link.counts["dropped"] == 1
        other.accept() if role == "client" else other.connect(port=link.port)
        other.send(kind="POINT", device="camera", places=PLACES)
        assert len(np.asarray(taken(link).cloud)) == 3


@pytest.mark.parametrize("count", [20, 90])
def test_a_peer_that_falls_silent_in_the_middle_is_dropped(other: Other, count: int, monkeypatch: Any) -> None:
    monkeypatch.setattr(openigtlink, "_STALL", 0.2)
    with joined(other, "server") as link:
        other.raw(data=(header(size=136) + "00" * 136)[: 2 * count])
        assert other.receive() == [{"kind": "END"}]
        until(lambda: link.counts["dropped"] == 1)


def test_a_peer_that_has_nothing_to_say_is_kept(other: Other, monkeypatch: Any) -> None:
    monkeypatch.setattr(openigtlink, "_STALL", 0.0)
    with joined(other, "server") as link:
        time.sleep(3 * openigtlink._TICK)
        other.send(kind="POINT", device="camera", places=PLACES)
        assert len(np.asarray(taken(link).cloud)) == 3


DAMAGED = {
    "a point cut off": ("POINT", "00" * 135, {}),
    "more points than bytes": ("POLYDATA", "ffffffff" + "00" * 36, {}),
    "more cells than bytes": ("POLYDATA", "00000000" + "00" * 20 + "fffffff0" + "00" * 12, {}),
    "no counts": ("POLYDATA", "00" * 39, {}),
    "no extended header": ("POINT", "", {"version": 2}),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_message_is_counted_and_the_next_is_read(other: Other, name: str) -> None:
    kind, body, more = DAMAGED[name]
    if more:
        raw = header(kind, 4, version=2) + "00000000"
    with joined(other, "server") as link:
        if more:
            other.raw(data=raw)
        else:
            other.send_body(kind=kind, device="camera", body=body)
        other.send(kind="POINT", device="camera", places=PLACES)
        assert len(np.asarray(taken(link).cloud)) == 3
        assert link.counts["damaged"] == 1 and link.counts["dropped"] == 0


def test_a_wrong_checksum_drops_the_message_and_is_said_once(other: Other) -> None:
    said: list[str] = []
    with joined(other, "server", say=said.append) as link:
        for _ in range(3):
            other.send(kind="POINT", device="camera", places=PLACES, crc=12345)
        other.send(kind="POINT", device="camera", places=PLACES[:1])
        assert len(np.asarray(taken(link).cloud)) == 1 and link.counts["damaged"] == 3 and link.peers == 1
    assert sum("the checksum is wrong" in line for line in said) == 1


@pytest.mark.parametrize(("begin", "index", "metadata"), [(0, 0, 0), (12, 60000, 0), (12, 0, 2**32 - 1), (60000, 0, 0)])
def test_sizes_in_the_extended_header_are_not_believed(begin: int, index: int, metadata: int) -> None:
    from pyigtl.messages import CRC64

    body = b"".join(size.to_bytes(width, "big") for size, width in ((begin, 2), (index, 2), (metadata, 4), (0, 4)))
    body += bytes(136)
    with pytest.raises(MessageError, match="larger than the body"):
        cloud_in(Header(2, "POINT", "camera", 0.0, len(body), CRC64(body)), body, PLACE)


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_refused_and_never_an_error_of_another_kind(seed: int) -> None:
    from pyigtl.messages import CRC64

    rng = np.random.default_rng(seed)
    for _ in range(300):
        body = rng.bytes(int(rng.integers(0, 400)))
        for kind in ("POINT", "POLYDATA"):
            for version in (1, 2):
                try:
                    found = cloud_in(Header(version, kind, "", 0.0, len(body), CRC64(body)), body, PLACE)
                except MessageError:
                    continue
                assert found.ndim == 2 and found.shape[1] == 3
        with pytest.raises(MessageError):
            Header.parse(b"\xff" + rng.bytes(57))


def test_a_client_waits_for_its_server_and_comes_back_to_it(other: Other) -> None:
    said: list[str] = []
    port = other.listen()
    with joined(other, "client", say=said.append) as link:
        port = link.port
        other.send(kind="POINT", device="camera", places=PLACES)
        taken(link)
        other.close(all=True)
        until(lambda: any("trying again" in line for line in said))
        other.listen(port=port)
        other.accept()
        other.send(kind="POINT", device="camera", places=PLACES[:2])
        assert len(np.asarray(taken(link).cloud)) == 2


# ---------------------------------------------------------------------- pyigtl at the other end

PYIGTL = """
import sys, time
import numpy as np, pyigtl
role, port = sys.argv[1], int(sys.argv[2])
node = pyigtl.OpenIGTLinkServer(port) if role == "server" else pyigtl.OpenIGTLinkClient("127.0.0.1", port)
print("ready", flush=True)
while not node.is_connected():
    time.sleep(0.01)
node.send_message(pyigtl.PointMessage(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), device_name="camera"), wait=False)
string = node.wait_for_message("figures", timeout=60)
print(string.string, flush=True)
print(node.wait_for_message("pose", timeout=60).matrix.tolist(), flush=True)
"""


def free_port() -> int:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


@pytest.mark.parametrize("role", ["client", "server"])
def test_pyigtl_itself_understands_us(plain_twin: Twin, cloud: np.ndarray, role: str) -> None:
    """`role` is pyigtl's. It knows no POLYDATA, and passes them over."""
    frame = Sequence(plain_twin, "tip").register(cloud)
    port = free_port() if role == "server" else 0
    address = Address("127.0.0.1", port) if role == "server" else Address("", 0, True)
    with Link(address, Mailbox(), PLACE, say=lambda line: None) as link:
        command = [sys.executable, "-c", PYIGTL, role, str(link.port)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            try:
                assert child.stdout is not None and child.stdout.readline() == "ready\n"
                assert 1e3 * np.asarray(taken(link).cloud) == pytest.approx(np.array([[-1, -2, 3], [-4, -5, 6]]))
                link.send(Speaker(plain_twin, PLACE).messages(Answer(frame, "", 0.01, 0, False)))
                assert json.loads(child.stdout.readline())["verdict"] == frame.judgement.verdict.value
                assert np.array(json.loads(child.stdout.readline())) == pytest.approx(np.eye(4))
            finally:
                child.kill()


# ---------------------------------------------------------------------- words


def test_axes_of_the_clouds(mesh_folder: Path) -> None:
    assert Scene.of(mesh_folder, {}, None).outside == Coordinates("m", "lps")
    assert Scene.of(mesh_folder, {}, "mm", "ras").outside == Coordinates("mm", "ras")


def test_sources() -> None:
    assert parse_source("camera/folder") == Path("camera/folder")
    for text, address in {
        "igtl://localhost:18945": Address("localhost", 18945),
        "igtl://10.0.0.7": Address("10.0.0.7", 18944),
        "igtl://[::1]:5": Address("::1", 5),
        "igtl://:18944": Address("", 18944, True),
        "igtl://:5?bind=10.0.0.7&device=a%20camera": Address("10.0.0.7", 5, True, "a camera"),
    }.items():
        assert parse_source(text) == address
        assert parse_source(str(address)) == address


@pytest.mark.parametrize(
    "text",
    ["http://host:1", "igtl://host:1/path", "igtl://host:70000", "igtl://host:x", "igtl://host:1?bind=other",
     "igtl://:1?who=me", "igtl://:1?device=", "igtl://me@host:1"],
)  # fmt: skip
def test_sources_that_are_none(text: str) -> None:
    with pytest.raises(ConfigError, match="source: expected"):
        parse_source(text)


def test_a_server_is_open_to_this_machine_alone_unless_it_is_told(other: Other) -> None:
    said: list[str] = []
    with Link(Address("", 0, True), Mailbox(), PLACE, say=said.append) as link:
        assert link._listener is not None and link._listener.getsockname()[0] == "127.0.0.1"
        until(lambda: bool(said))
        assert "no password" not in said[0]
        with pytest.raises(LinkError, match="nothing can listen there"):
            Link(Address("", link.port, True), Mailbox(), PLACE)
    assert "no password" in Address("0.0.0.0", 5, True).warning


def test_a_link_that_hears_nothing_for_long_ends(other: Other) -> None:
    now = [0.0]
    with joined(other, "server", idle=10.0, clock=lambda: now[0]) as link:
        now[0] = 9.0
        other.send(kind="POINT", device="camera", places=PLACES)
        assert taken(link).cloud is not None
        now[0] = 18.0
        time.sleep(3 * openigtlink._TICK)
        other.send(kind="POINT", device="camera", places=PLACES)
        taken(link)
        now[0] = 29.0
        assert link.box.take() is None


def test_names_of_devices_are_short_and_no_two_alike() -> None:
    names = device_names(
        ["organ", POSE, FIGURES, "hepatic vein of the left lobe", "hepatic vein of the left side", "ä"]
    )
    assert len(set(names.values())) == 6 and not {POSE, FIGURES} & set(names.values())
    assert all(name.isascii() and 0 < len(name) <= 20 for name in names.values())


def test_words_of_the_command_line(mesh_folder: Path, capsys: Any) -> None:
    for arguments, words in (
        (("igtl://:18944",), "expected --watch beside a place of OpenIGTLink"),
        (("igtl://:1/x", "--watch"), "source: expected igtl://HOST:PORT"),
        (("tcp://:1", "--watch"), "source: expected a folder or igtl://HOST:PORT"),
        (("igtl://:18944", "--watch", "--idle", "0"), "--idle: expected a finite number > 0, in seconds"),
    ):
        assert words in run(capsys, "register", mesh_folder, *arguments, code=2)
