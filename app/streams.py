"""Clouds as they come: one place for the newest, a folder that is watched, answers within a time with their age."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softtwin.meshes.clouds import CloudError
from softtwin.meshes.files import Unit

from .config import ConfigError
from .export import WRITTEN, Exporter
from .record import Recorder, counts, describe
from .register import (
    CLOUDS,
    CloudFile,
    Scene,
    Start,
    by_numbers,
    check_any,
    check_budget,
    name_of,
    registered,
)
from .twin import Camera, Frame, Sequence, Twin

Cloud = CloudFile | ArrayLike
Clock = Callable[[], float]


@dataclass(frozen=True, eq=False)
class Arrival:
    """A cloud that has come.

    Args:
        cloud: it: points (p, 3) in metres, or a file.
        at: when it came, seconds of the monotonic clock.
        dropped: how many came and were replaced since the one before was taken.
    """

    cloud: Cloud
    at: float
    dropped: int


class Mailbox:
    """One place for a cloud: a newer one replaces it, so that nothing old is ever waited for.

    `put` is what a camera's driver calls, from any thread.

    Args:
        clock: seconds of a monotonic clock.
    """

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock, self._news = clock, threading.Condition()
        self._slot: tuple[Cloud, float] | None = None
        self._dropped = 0
        self._failure: BaseException | None = None
        self._is_closed = False

    def put(self, cloud: Cloud) -> None:
        """Leave a cloud, in the place of one that was not taken yet.

        Raises:
            CloudError: the mailbox was closed.
        """
        with self._news:
            if self._is_closed:
                raise CloudError("Mailbox.put: expected an open mailbox, got one that was closed.")
            self._dropped += self._slot is not None
            self._slot = cloud, self._clock()
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
            (cloud, at), dropped = self._slot, self._dropped
            self._slot, self._dropped = None, 0
            return Arrival(cloud, at, dropped)


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
    when the watch begins counts, too.

    Args:
        folder: to look into; it may come later.
        read: makes a cloud of a file.
        every: seconds between two looks.
        idle: seconds without anything new after which the watch ends; never if not given.
        clock: seconds of a monotonic clock.
        sleep: waits so many seconds.
    """

    def __init__(
        self,
        folder: Path,
        read: Callable[[Path], CloudFile],
        every: float = 0.02,
        idle: float | None = None,
        clock: Clock = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not 0.0 < every < np.inf:
            raise ValueError(f"WatchedFolder.every: expected a positive time in seconds, got {every}.")
        if idle is not None and not 0.0 < idle < np.inf:
            raise ValueError(f"WatchedFolder.idle: expected a positive time in seconds, got {idle}.")
        self._folder, self._read, self._every, self._idle = folder, read, every, idle
        self._clock, self._sleep = clock, sleep

    def __iter__(self) -> Iterator[CloudFile]:
        given: set[Path] = set()
        seen: dict[Path, tuple[int, int]] = {}
        last = self._clock()
        while True:
            now = self._look(given)
            whole = [path for path, state in now.items() if seen.get(path) == state]
            for path in sorted(whole, key=lambda path: by_numbers(str(path))):
                given.add(path)
                yield self._read(path)
            if now != seen or whole:
                last = self._clock()
            elif self._idle is not None and self._clock() - last >= self._idle:
                return
            seen = {path: state for path, state in now.items() if path not in given}
            self._sleep(self._every)

    def _look(self, given: set[Path]) -> dict[Path, tuple[int, int]]:
        """Size and time of the files that were not given yet."""
        found = {}
        for path in self._folder.glob("*"):
            if path.suffix.lower() not in CLOUDS or path in given or path.name.startswith("."):
                continue
            try:
                status = path.stat()
            except OSError:  # gone between two looks
                continue
            if status.st_size > 0:
                found[path] = status.st_size, status.st_mtime_ns
        return found


@dataclass(frozen=True, eq=False)
class Answer:
    """A frame, and how it kept up with the camera.

    Args:
        frame: the frame.
        cloud: name of its file; empty for points.
        age: from the cloud's coming to the answer, seconds.
        dropped: clouds that came and went unregistered since the frame before.
        is_late: whether the age is more than was allowed.
    """

    frame: Frame
    cloud: str
    age: float
    dropped: int
    is_late: bool


def answers(
    sequence: Sequence, box: Mailbox, budget: float | None = None, clock: Clock = time.monotonic
) -> Iterator[Answer]:
    """The newest cloud registered, again and again, until the mailbox is closed.

    Args:
        sequence: the twin's.
        box: where clouds come.
        budget: seconds from a cloud's coming to its answer: no step is begun after it, and the answer is the best so
            far; no limit if not given. One step of the reference can take longer than all of it.
        clock: seconds of the monotonic clock that the mailbox has, too.

    Raises:
        ValueError: a budget that is no positive number.
    """
    if budget is not None and not 0.0 < budget < np.inf:
        raise ValueError(f"answers.budget: expected a positive time in seconds, got {budget}.")
    while (arrival := box.take()) is not None:
        until = np.inf if budget is None else arrival.at + budget
        frame = registered(sequence, arrival.cloud, until)
        age = clock() - arrival.at
        yield Answer(frame, name_of(arrival.cloud), age, arrival.dropped, budget is not None and age > budget)


def register_live(
    twin: Twin,
    box: Mailbox,
    output: Path,
    *,
    zone: str | None = None,
    camera: Camera = None,
    formats: tuple[str, ...] = WRITTEN,
    budget: float | None = None,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Register what comes into a mailbox and write each frame as it is found; returns the figures of all frames.

    Args:
        twin: the twin.
        box: where clouds come.
        output: folder of the results.
        zone: as for `Twin.register`.
        camera: where the camera stands.
        formats: of the files of each frame; none are written for `()`, which is the quickest.
        budget: as for `answers`.
        say: prints one line a frame.

    Raises:
        CloudError: none of the clouds could be registered at all; their frames are written all the same.
        ConfigError: a budget that is no positive number.
    """
    check_budget(budget)
    sequence = Sequence(twin, zone, camera)
    with Recorder(Exporter(twin, output, formats), zone) as recorder:
        for answer in answers(sequence, box, budget):
            figures = {"age_s": answer.age, "dropped": answer.dropped, "is_late": answer.is_late}
            say(describe(recorder.add(answer.frame, answer.cloud, **figures)))
    check_any(recorder.rows)
    return recorder.rows


def keeping_up(rows: Collection[Mapping[str, Any]]) -> str:
    """One line for a person: how old the answers were, and what was dropped."""
    ages = [1e3 * row["age_s"] for row in rows]
    if not ages:
        return "no cloud has come"
    median, most = np.quantile(ages, (0.5, 0.95))
    dropped, late = sum(row["dropped"] for row in rows), sum(row["is_late"] for row in rows)
    return f"{len(ages)} frames, {median:.0f} ms old (95 %: {most:.0f} ms), {late} late, {dropped} clouds dropped"


def watch_folder(
    place: Path,
    folder: Path,
    output: Path,
    options: Mapping[str, Any],
    *,
    unit: Unit | None = None,
    start: Start | None = None,
    formats: tuple[str, ...] = (),
    budget: float | None = None,
    idle: float | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, int]:
    """Register the clouds that are written into a folder, the newest first; returns how many frames bear each verdict.

    Args:
        place: the twin; see `find_twin`.
        folder: of the clouds.
        output: folder to write to.
        options: entries of [registration] that replace the twin's.
        unit: of the clouds; that of the twin's files if not given.
        start: where the camera stands; in the body's coordinates if not given.
        formats: of the files of each frame; VTU and VTP if none.
        budget: as for `answers`.
        idle: as for `WatchedFolder`.
        say: prints a line.

    Raises:
        ConfigError, FileError, CloudError, PoseError, TwinError: what cannot be used, and why.
    """
    check_budget(budget)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--watch: expected a folder, got the file {folder}.")
    scene = Scene.of(place, options, unit)
    try:
        source = WatchedFolder(folder, lambda path: CloudFile(path, scene.outside), idle=idle)
    except ValueError as error:
        raise ConfigError(f"--idle: {error}") from None
    with scene.opened(start or Start(), say) as (twin, camera):
        twin.registrar()  # prepared before the first cloud is waited for
        chosen = formats or WRITTEN
        rows = register_live(twin, fed(source), output, camera=camera, formats=chosen, budget=budget, say=say)
    say(keeping_up(rows))
    return counts(rows)
