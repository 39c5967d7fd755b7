"""A connection of OpenIGTLink: the newest cloud in, the newest answer out; a peer that misbehaves harms itself alone.

pyigtl 0.3.4 has a client and a server of its own, which are not used: they spin for ever on half a header whose sender
has gone, lose their place where a header comes in two pieces, ask for whatever size is announced, never look at the
checksum, do not notice that the peer has closed, keep a hundred old messages to be sent, and the server takes the
process's signals. Its messages and its checksum are used (`messages.py`).
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress

from softtwin.meshes.clouds import CloudError
from softtwin.meshes.export import Coordinates

from .address import Address
from .messages import HEADER_SIZE, Header, MessageError, cloud_in
from .streams import Clock, Mailbox

LIMIT = 64 * 2**20  # bytes of a body; two hundred thousand points are 27 MB as POINT
_CLOUDS = ("POINT", "POLYDATA")
_TICK = 0.1  # seconds between two looks whether the link was closed
_STALL = 5.0  # seconds without a byte in the middle of a message
_LAST = 1.0  # seconds for what was not sent yet when the link closes
_AGAIN = 0.5  # seconds between two attempts to connect
_BUFFER = 64 * 2**10  # of what the system may keep for us to be sent: there newer answers replace nothing
_PIECE = 256 * 2**10
_MOST_PEERS = 8


class LinkError(RuntimeError):
    """A connection that cannot be had."""


class _GoneError(Exception):
    """The peer has closed, or the link was."""


class Outbox:
    """One place for an answer to one peer: a newer one replaces what was not begun to be sent."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._slot: Sequence[bytes] | None = None
        self._is_closed = False
        self.replaced = 0

    def put(self, messages: Sequence[bytes]) -> None:
        """Leave the messages of an answer."""
        with self._news:
            self.replaced += self._slot is not None
            self._slot = messages
            self._news.notify()

    def take(self) -> Sequence[bytes] | None:
        """The newest answer, waiting for one; None once it is closed and empty."""
        with self._news:
            self._news.wait_for(lambda: self._slot is not None or self._is_closed)
            taken, self._slot = self._slot, None
            return taken

    def close(self) -> None:
        """Say that nothing more will come; what lies there can still be taken."""
        with self._news:
            self._is_closed = True
            self._news.notify_all()


class Peer:
    """One connection: a thread that reads, a thread that writes.

    Args:
        connection: the socket, which is closed at the end.
        name: of the peer, for a person.
        limit: most bytes of a body.
        hear: is given each message, whole.
        tell: is given the reason where the connection is dropped; empty where the peer has closed.
    """

    def __init__(
        self,
        connection: socket.socket,
        name: str,
        limit: int,
        hear: Callable[[Header, bytes], None],
        tell: Callable[[Peer, str], None],
    ) -> None:
        self.name, self.outbox = name, Outbox()
        self._socket, self._limit, self._hear, self._tell = connection, limit, hear, tell
        self._ended, self._once = threading.Event(), threading.Lock()
        connection.settimeout(_TICK)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._reader = threading.Thread(target=self._read, name=f"softtwin from {name}", daemon=True)
        self._writer = threading.Thread(target=self._write, name=f"softtwin to {name}", daemon=True)
        self._writer.start()
        self._reader.start()

    def wait(self, seconds: float) -> bool:
        """Whether the connection has ended, looked at for so long."""
        return self._ended.wait(seconds)

    def close(self) -> None:
        """End the connection, after a second at most in which the last answer may still go out."""
        self.outbox.close()
        self._writer.join(_LAST)
        self._end("")
        self._reader.join()

    def _end(self, reason: str) -> None:
        if not self._once.acquire(blocking=False):
            return
        self._ended.set()
        self.outbox.close()
        with suppress(OSError):
            self._socket.shutdown(
                socket.SHUT_RDWR
            )  # wakes both threads; the number is free for others once they are done
        self._tell(self, reason)

    def _read(self) -> None:
        try:
            while True:
                header = Header.parse(self._exactly(HEADER_SIZE, begun=False))
                if header.size > self._limit:
                    raise MessageError(f"{header.kind} of {header.size} bytes announced, more than {self._limit}")
                self._hear(header, self._exactly(header.size, begun=True))
        except (MessageError, OSError) as error:
            self._end(_said(error))
        except _GoneError:
            self._end("")
        finally:
            self._writer.join()
            self._socket.close()

    def _exactly(self, count: int, begun: bool) -> bytes:
        """So many bytes, for the first of which one may wait for ever where no message has begun."""
        found, last = bytearray(), time.monotonic()
        while len(found) < count:
            try:
                piece = self._socket.recv(min(count - len(found), _PIECE))
            except TimeoutError:
                if (begun or found) and time.monotonic() - last > _STALL:
                    raise MessageError(f"{len(found)} of {count} bytes, then none for {_STALL:.0f} s") from None
                piece = None
            if self._ended.is_set() or (piece == b"" and not (begun or found)):
                raise _GoneError
            if piece == b"":
                raise MessageError(f"closed after {len(found)} of {count} bytes")
            if piece:
                found += piece
                last = time.monotonic()
        return bytes(found)

    def _write(self) -> None:
        try:
            while (messages := self.outbox.take()) is not None:
                for message in messages:
                    self._send(memoryview(message))
        except OSError as error:
            self._end(_said(error))

    def _send(self, rest: memoryview) -> None:
        while rest:
            try:
                rest = rest[self._socket.send(rest) :]
            except TimeoutError:
                if self._ended.is_set():
                    return


def _said(error: Exception) -> str:
    """The reason for a person; none where the peer has only gone."""
    return "" if isinstance(error, ConnectionError) else str(error)


class Link:
    """Clouds from peers into a mailbox, answers to all of them; comes back by itself after a connection was lost.

    As a client it has one peer, which it goes on looking for; as a server up to eight, a camera and a display for
    example. Use it in a `with` statement.

    Args:
        address: where to connect to, or to listen.
        box: where clouds go, in metres and LPS, with the device and the time that the sender gave as their name; closed
            with the link.
        place: unit and axes of the network.
        ours: names of our own devices: what a peer sends back under them is no cloud.
        limit: most bytes of a body; more drops the connection.
        idle: seconds without a cloud or an answer after which the link closes; never if not given.
        say: prints a line, from any thread.
        clock: seconds of a monotonic clock.

    Raises:
        LinkError: the port is taken, the host is not known or not this machine's.
    """

    def __init__(
        self,
        address: Address,
        box: Mailbox,
        place: Coordinates,
        *,
        ours: Sequence[str] = (),
        limit: int = LIMIT,
        idle: float | None = None,
        say: Callable[[str], None] = print,
        clock: Clock = time.monotonic,
    ) -> None:
        self.address, self.box, self.place = address, box, place
        self._ours, self._limit, self._idle = frozenset(ours), limit, math.inf if idle is None else idle
        self._say, self._clock = say, clock
        self._lock, self._peers, self._counts = threading.Lock(), list[Peer](), Counter[str]()
        self._closed = threading.Event()
        self._last = clock()
        self._listener = _listening(address) if address.is_server else None
        run = self._connect if self._listener is None else self._accept
        self._thread = threading.Thread(target=self._guarded, args=(run,), name="softtwin OpenIGTLink", daemon=True)
        self._thread.start()

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def port(self) -> int:
        """Of this side where it listens, of the other where it connects."""
        return self.address.port if self._listener is None else int(self._listener.getsockname()[1])

    @property
    def peers(self) -> int:
        """How many are connected."""
        with self._lock:
            return len(self._peers)

    @property
    def counts(self) -> dict[str, int]:
        """What has happened: `clouds`, `ignored` and `damaged` messages, connections `dropped`, answers `replaced`."""
        with self._lock:
            replaced = self._counts["replaced"] + sum(peer.outbox.replaced for peer in self._peers)
            names = ("clouds", "ignored", "damaged", "dropped")
            return {**{name: self._counts[name] for name in names}, "replaced": replaced}

    def send(self, messages: Sequence[bytes]) -> None:
        """Leave an answer for every peer, in the place of one that was not begun to be sent.

        Args:
            messages: whole ones, sent one after the other.
        """
        self._last = self._clock()  # a peer may wait for it before it sends again
        with self._lock:
            for peer in self._peers:
                peer.outbox.put(messages)

    def close(self) -> None:
        """End all connections and close the mailbox."""
        self._closed.set()
        self._thread.join()
        with self._lock:
            peers = list(self._peers)
        for peer in peers:
            peer.close()
        if self._listener is not None:
            self._listener.close()
        self.box.close()

    # ------------------------------------------------------------------ the thread that looks for peers

    def _guarded(self, run: Callable[[], None]) -> None:
        try:
            run()
        except BaseException as error:  # whatever it is, who takes clouds is told
            self.box.close(error)

    def _is_over(self) -> bool:
        if self._clock() - self._last >= self._idle:
            self.box.close()
            return True
        return self._closed.is_set()

    def _accept(self) -> None:
        assert self._listener is not None
        self._say(f"OpenIGTLink: listening on {self.address.at(self.port)}{self.address.warning}")
        while not self._is_over():
            try:
                connection, (host, port, *_) = self._listener.accept()
            except TimeoutError:
                continue
            if self.peers >= _MOST_PEERS:
                self._say(f"OpenIGTLink: {host}:{port}: refused, {_MOST_PEERS} are connected")
                connection.close()
            else:
                self._welcome(connection, f"{host}:{port}")

    def _connect(self) -> None:
        name, silent = self.address.at(), False
        while not self._is_over():
            try:
                connection = socket.create_connection((self.address.host, self.address.port), timeout=2.0)
            except OSError as error:
                if not silent:
                    self._say(f"OpenIGTLink: {name}: {error.strerror or error}; trying again until it is there")
                silent = True
                self._closed.wait(_AGAIN)
                continue
            silent = False
            peer = self._welcome(connection, name)
            while not peer.wait(_TICK) and not self._is_over():
                pass
            self._closed.wait(_AGAIN)  # who closes at once is not asked for ever

    def _welcome(self, connection: socket.socket, name: str) -> Peer:
        with self._lock:
            peer = Peer(connection, name, self._limit, self._hear, self._farewell)
            self._peers.append(peer)
        self._say(f"OpenIGTLink: connected with {name}")
        return peer

    # ------------------------------------------------------------------ called by the threads of peers

    def _farewell(self, peer: Peer, reason: str) -> None:
        with self._lock:
            if peer in self._peers:
                self._peers.remove(peer)
            self._counts["replaced"] += peer.outbox.replaced
            self._counts["dropped"] += bool(reason)
        if not self._closed.is_set():
            self._say(f"OpenIGTLink: {peer.name}: {f'{reason}; connection dropped' if reason else 'has closed'}")

    def _hear(self, header: Header, body: bytes) -> None:
        wanted = self.address.device
        is_cloud = header.kind in _CLOUDS and (header.device == wanted if wanted else header.device not in self._ours)
        try:
            points = cloud_in(header, body, self.place) if is_cloud else None
        except MessageError as error:
            if self._count("damaged") == 1:
                self._say(f"OpenIGTLink: {error}; dropped, as all such will be")
            return
        self._count("ignored" if points is None else "clouds")
        if points is not None:
            self._last = self._clock()
            with suppress(CloudError):  # it was closed: nobody waits for clouds any more
                self.box.put(points, header.name)

    def _count(self, name: str) -> int:
        with self._lock:
            self._counts[name] += 1
            return self._counts[name]


def _listening(address: Address) -> socket.socket:
    host = address.host or "127.0.0.1"
    try:
        family = socket.getaddrinfo(host, address.port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, address.port), family=family, backlog=_MOST_PEERS)
    except OSError as error:
        raise LinkError(f"{address}: nothing can listen there ({error.strerror or error}).") from None
    listener.settimeout(_TICK)
    return listener
