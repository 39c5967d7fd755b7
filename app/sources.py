"""Where clouds come from while a camera runs: a folder that is written to, or a peer that speaks OpenIGTLink."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .address import Address
from .answer import Answer, Reply
from .arguments import WatchArguments
from .config import ConfigError
from .register import CloudFile, Scene
from .schema import option_of
from .streams import Mailbox, WatchedFolder, fed
from .twin import Twin


def check_idle(idle: float | None) -> None:
    """Refuse seconds without a cloud that are no positive number.

    Raises:
        ConfigError: they are not.
    """
    option_of(WatchArguments, "idle").check(idle, "--idle")


@dataclass(frozen=True, eq=False)
class Feed:
    """Clouds as they come, and the way back.

    Args:
        box: where they come.
        reply: is given each answer; None where nobody listens.
        summary: one line for a person about what came and went; empty where there is nothing to say.
    """

    box: Mailbox
    reply: Reply | None = None
    summary: Callable[[], str] = lambda: ""


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

        def summary() -> str:
            return "OpenIGTLink: " + ", ".join(f"{count} {name}" for name, count in link.counts.items())

        yield Feed(box, reply, summary)
