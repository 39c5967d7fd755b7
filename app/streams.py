"""Clouds as they come: one place for the newest, fed by any source, or by a folder that is watched."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from softtwin.meshes.clouds import CloudError
from softtwin.meshes.io import is_companion

from .register import CLOUDS, CloudFile, by_numbers

Cloud = CloudFile | ArrayLike
Clock = Callable[[], float]


@dataclass(frozen=True, eq=False)
class Arrival:
    """A cloud that has come.

    Args:
        cloud: it: points (p, 3) in metres, or a file.
        at: when it came, seconds of the monotonic clock.
        dropped: how many came and were replaced since the one before was taken.
        name: by which its sender knows it; empty where it has none.
    """

    cloud: Cloud
    at: float
    dropped: int
    name: str = ""


class Mailbox:
    """One place for a cloud: a newer one replaces it, so that nothing old is ever waited for.

    `put` is what a camera's driver calls, from any thread.

    Args:
        clock: seconds of a monotonic clock.
    """

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock, self._news = clock, threading.Condition()
        self._slot: tuple[Cloud, float, str] | None = None
        self._dropped = 0
        self._failure: BaseException | None = None
        self._is_closed = False

    def put(self, cloud: Cloud, name: str = "") -> None:
        """Leave a cloud, in the place of one that was not taken yet.

        Args:
            cloud: it.
            name: by which its sender knows it.

        Raises:
            CloudError: the mailbox was closed.
        """
        with self._news:
            if self._is_closed:
                raise CloudError("Mailbox.put: expected an open mailbox, got one that was closed.")
            self._dropped += self._slot is not None
            self._slot = cloud, self._clock(), name
            self._news.notify()

    def close(self, failure: BaseException | None = None) -> None:
        """Say that nothing more will come; what lies there can still be taken.

        Args:
            failure: why, if something went wrong: it is raised where the next one is taken.
        """
        with self._news:
            self._is_closed, self._failure = True, self._failure or failure
            self._news.notify_all()

    def take(self) -> Arrival | None:
        """The newest cloud, waiting for one; None where the mailbox was closed and is empty.

        Raises:
            BaseException: what it was closed with.
        """
        with self._news:
            self._news.wait_for(lambda: self._slot is not None or self._is_closed)
            if self._slot is None:
                if self._failure is not None:
                    raise self._failure
                return None
            (cloud, at, name), dropped = self._slot, self._dropped
            self._slot, self._dropped = None, 0
            return Arrival(cloud, at, dropped, name)


def fed(source: Iterable[Cloud], clock: Clock = time.monotonic) -> Mailbox:
    """A mailbox into which a thread of its own puts what comes; closed where the source ends or fails.

    Args:
        source: clouds, at their own pace.
        clock: seconds of a monotonic clock.
    """
    box = Mailbox(clock)

    def run() -> None:
        try:
            for cloud in source:
                box.put(cloud)
        except BaseException as error:  # whatever it is, who takes is told
            box.close(error)
        else:
            box.close()

    threading.Thread(target=run, name="softtwin clouds", daemon=True).start()
    return box


class WatchedFolder:
    """Clouds that are written into a folder, each once and only when it is whole, in the order of their numbers.

    A file is whole when its size and time have not changed from one look to the next and it is not empty. What is there
    when the watch begins counts, too; so does all that is in a folder that was taken away and comes back.

    Args:
        folder: to look into; it may come later, go and come back.
        read: makes a cloud of a file.
        every: seconds between two looks.
        idle: seconds without anything new after which the watch ends; never if not given.
        clock: seconds of a monotonic clock.
        sleep: waits so many seconds.
        say: prints a line where the folder is not there, and when it is again.
    """

    def __init__(
        self,
        folder: Path,
        read: Callable[[Path], CloudFile],
        every: float = 0.02,
        idle: float | None = None,
        clock: Clock = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        say: Callable[[str], None] = print,
    ) -> None:
        if not 0.0 < every < np.inf:
            raise ValueError(f"WatchedFolder.every: expected a positive time in seconds, got {every}.")
        if idle is not None and not 0.0 < idle < np.inf:
            raise ValueError(f"WatchedFolder.idle: expected a positive time in seconds, got {idle}.")
        self._folder, self._read, self._every, self._idle = folder, read, every, idle
        self._clock, self._sleep, self._say = clock, sleep, say

    def __iter__(self) -> Iterator[CloudFile]:
        given: dict[Path, tuple[int, int]] = {}
        seen: dict[Path, tuple[int, int]] = {}
        last, is_there = self._clock(), True
        while True:
            if is_there != self._folder.is_dir():
                is_there = not is_there
                self._say(f"{self._folder}: there again" if is_there else f"{self._folder}: no such folder, waiting")
                if is_there:
                    given = {path: state for path, state in self._look({}).items() if given.get(path) == state}
            now = self._look(given)
            whole = [path for path, state in now.items() if seen.get(path) == state]
            for path in sorted(whole, key=lambda path: by_numbers(str(path))):
                given[path] = now[path]
                yield self._read(path)
            if now != seen or whole:
                last = self._clock()
            elif self._idle is not None and self._clock() - last >= self._idle:
                return
            seen = {path: state for path, state in now.items() if path not in given}
            self._sleep(self._every)

    def _look(self, given: Container[Path]) -> dict[Path, tuple[int, int]]:
        """Size and time of the files that were not given yet."""
        found: dict[Path, tuple[int, int]] = {}
        try:
            paths = list(self._folder.iterdir())
        except OSError:  # the folder is not there, or not now
            return found
        for path in paths:
            if path.suffix.lower() not in CLOUDS or path in given or is_companion(path):
                continue
            try:
                status = path.stat()
            except OSError:  # gone between two looks
                continue
            if status.st_size > 0:
                found[path] = status.st_size, status.st_mtime_ns
        return found
