"""Where clouds come from while a camera runs: a folder that is written to, or a peer that speaks OpenIGTLink."""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlsplit

from .config import ConfigError
from .register import CloudFile, Scene
from .streams import Mailbox, WatchedFolder, fed
from .twin import Twin

if TYPE_CHECKING:
    from .live import Answer, Reply

SCHEME = "igtl"
PORT = 18944  # that OpenIGTLink programs take where nothing is said
_FORMS = "igtl://HOST:PORT, igtl://:PORT or igtl://:PORT?bind=HOST, with device=NAME behind ? if only that one is meant"


@dataclass(frozen=True)
class Address:
    """A place of OpenIGTLink.

    Args:
        host: to connect to; where it listens, the address of this machine that it does so on, 127.0.0.1 if empty.
        port: of it.
        is_server: whether to listen.
        device: name of the device whose clouds are meant; empty for any.
    """

    host: str
    port: int
    is_server: bool = False
    device: str = ""

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        asked = [
            f"bind={self.host}" if self.is_server and self.host else "",
            f"device={self.device}" if self.device else "",
        ]
        words = "&".join(filter(None, asked))
        return f"{SCHEME}://{'' if self.is_server else host}:{self.port}{'?' if words else ''}{words}"

    def at(self, port: int | None = None) -> str:
        """Host and port for a person.

        Args:
            port: in place of its own.
        """
        return f"{self.host or '127.0.0.1'}:{self.port if port is None else port}"

    @property
    def warning(self) -> str:
        """What a person is to know of a port that others than this machine reach; empty otherwise."""
        try:
            is_open = not ipaddress.ip_address(self.host or "127.0.0.1").is_loopback
        except ValueError:
            is_open = self.host != "localhost"
        return "; whoever reaches it can send and listen: OpenIGTLink has no password" if is_open else ""


def parse_source(text: str) -> Path | Address:
    """What a person means by a source: a folder, or `igtl://...`.

    Args:
        text: as it was typed.

    Raises:
        ConfigError: another scheme, no port, or words that are not known.
    """
    scheme, separator, _ = text.partition("://")
    if not separator:
        return Path(text)
    if scheme != SCHEME:
        raise ConfigError(f"source: expected a folder or {_FORMS}, got {text!r}.")
    return _address(text)


def _address(text: str) -> Address:
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or "", PORT if parts.port is None else parts.port
    except ValueError as error:
        raise ConfigError(f"source: expected {_FORMS}, got {text!r} ({error}).") from None
    asked = dict(parse_qsl(parts.query, keep_blank_values=True))
    unknown = sorted(asked.keys() - {"device", "bind"})
    if unknown or parts.path.strip("/") or parts.username or not all(asked.values()) or ("bind" in asked and host):
        raise ConfigError(f"source: expected {_FORMS}, got {text!r}.")
    return Address(asked.get("bind", host), port, not host, asked.get("device", ""))


def check_idle(idle: float | None) -> None:
    """Refuse seconds without a cloud that are no positive number.

    Raises:
        ConfigError: they are not.
    """
    if idle is not None and not 0.0 < idle < math.inf:
        raise ConfigError(f"--idle: expected a positive time in seconds, got {idle}.")


@dataclass(frozen=True, eq=False)
class Feed:
    """Clouds as they come, and the way back.

    Args:
        box: where they come.
        reply: is given each answer; None where nobody listens.
        told: one line for a person about what came and went; empty where there is nothing to say.
    """

    box: Mailbox
    reply: Reply | None = None
    told: Callable[[], str] = lambda: ""


def watched(folder: Path, scene: Scene, idle: float | None, say: Callable[[str], None]) -> WatchedFolder:
    """The clouds that are written into a folder, in the unit and axes that a scene says of them.

    Args:
        folder: to look into.
        scene: unit and axes of the clouds, and whether their normals are wanted.
        idle: seconds without anything new after which it ends; never if not given.
        say: prints a line.
    """
    return WatchedFolder(folder, lambda path: CloudFile(path, scene.outside, scene.normals), idle=idle, say=say)


@contextmanager
def opened(
    source: Path | Address,
    scene: Scene,
    twin: Twin,
    idle: float | None = None,
    say: Callable[[str], None] = print,
) -> Iterator[Feed]:
    """The clouds of a source, which is let go at the end.

    Args:
        source: of `parse_source`.
        scene: unit and axes of the clouds, and whether their normals are wanted.
        twin: that answers.
        idle: seconds without a cloud after which it ends; never if not given.
        say: prints a line.

    Raises:
        ConfigError: a time that is none, or normals of a peer that sends none.
        LinkError: a port that cannot be had.
    """
    check_idle(idle)
    if isinstance(source, Path):
        yield Feed(fed(watched(source, scene, idle, say)))
        return
    if scene.normals:
        raise ConfigError(
            f"--normals: expected files that hold some, got {source}: its clouds are read as points alone."
        )
    from .messages import Speaker  # pyigtl is needed here alone
    from .openigtlink import Link

    box, speaker = Mailbox(), Speaker(twin, scene.outside)
    with Link(source, box, scene.outside, ours=list(speaker.names.values()), idle=idle, say=say) as link:

        def reply(answer: Answer, row: Mapping[str, Any]) -> None:
            if link.peers:
                link.send(speaker.messages(answer, link.counts, row))

        def told() -> str:
            return "OpenIGTLink: " + ", ".join(f"{count} {name}" for name, count in link.counts.items())

        yield Feed(box, reply, told)
