"""Registration while the camera runs: the newest cloud, an answer within a time, its age and what was dropped."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softtwin.meshes.io import Axes, Unit

from .address import Address
from .answer import Answer, Reply
from .config import ConfigError
from .export import WRITTEN, Exporter
from .landmarks import LandmarkFiles
from .record import Recorder, counts, describe
from .register import Scene, Start, check_any, check_budget, check_output, name_of, registered, say_coordinates
from .searching import searching
from .sources import check_idle, opened
from .streams import Clock, Mailbox
from .twin import Camera, Learner, Sequence, Twin

if TYPE_CHECKING:
    from .learning import BackgroundLearner


def answers(
    sequence: Sequence,
    box: Mailbox,
    budget: float | None = None,
    clock: Clock = time.monotonic,
    frame_landmarks: LandmarkFiles | None = None,
) -> Iterator[Answer]:
    """The newest cloud registered, again and again, until the mailbox is closed.

    Args:
        sequence: the twin's.
        box: where clouds come.
        budget: seconds from a cloud's coming to its answer: no step is begun after it, and the answer is the best so
            far; no limit if not given. One step of the reference can take longer than all of it.
        clock: seconds of the monotonic clock that the mailbox has, too.
        frame_landmarks: landmarks that pull beside clouds in files.

    Raises:
        ConfigError: a budget that is no positive number.
    """
    check_budget(budget)
    while (arrival := box.take()) is not None:
        until = np.inf if budget is None else arrival.at + budget
        frame = registered(sequence, arrival.cloud, until, frame_landmarks)
        age = clock() - arrival.at
        name = arrival.name or name_of(arrival.cloud)
        yield Answer(frame, name, age, arrival.dropped, budget is not None and age > budget)


def register_live(
    twin: Twin,
    box: Mailbox,
    output: Path,
    *,
    zone: str | None = None,
    camera: Camera = None,
    formats: tuple[str, ...] = WRITTEN,
    budget: float | None = None,
    frame_landmarks: LandmarkFiles | None = None,
    reply: Reply | None = None,
    learner: Learner | None = None,
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
        frame_landmarks: landmarks that pull beside clouds in files.
        reply: is given each answer and its figures before files are written.
        learner: as for `Sequence`.
        say: prints one line a frame.

    Raises:
        CloudError: none of the clouds could be registered at all; their frames are written all the same.
        ConfigError: a budget that is no positive number; landmarks that this twin cannot take.
    """
    if frame_landmarks is not None:
        frame_landmarks.check(twin)
    with (
        searching(twin) as search,
        closing(Sequence(twin, zone, camera, is_live=True, learner=learner, search=search)) as sequence,
        Recorder(Exporter(twin, output, formats), zone) as recorder,
    ):
        for answer in answers(sequence, box, budget, frame_landmarks=frame_landmarks):
            figures = {"age_s": answer.age, "dropped": answer.dropped, "is_late": answer.is_late}
            row = recorder.figures(answer.frame, answer.cloud, **figures)
            if reply is not None:
                reply(answer, row)
            recorder.enter(row, answer.frame)
            say(describe(row))
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


def watch_source(
    place: Path,
    source: Path | Address,
    output: Path,
    options: Mapping[str, Any],
    *,
    unit: Unit | None = None,
    axes: Axes | None = None,
    start: Start | None = None,
    formats: tuple[str, ...] = (),
    budget: float | None = None,
    idle: float | None = None,
    learn: bool = False,
    keep: bool = False,
    say: Callable[[str], None] = print,
) -> dict[str, int]:
    """Register the clouds of a source, the newest first; returns how many frames bear each verdict.

    A peer of OpenIGTLink gets every answer back.

    Args:
        place: the twin; see `find_twin`.
        source: of `parse_source`.
        output: folder to write to.
        options: entries of [registration] that replace the twin's.
        unit: of the clouds; if not given that of the twin's files, millimetres for a peer.
        axes: of the clouds; if not given those of the twin's files, RAS for a peer.
        start: where the camera stands; in the body's coordinates if not given.
        formats: of the files of each frame; VTU and VTP if none.
        budget: as for `answers`.
        idle: seconds without a cloud after which the watch ends; never if not given.
        learn: adapt the surrogate in a second process while frames come.
        keep: put what was learned into the twin at the end.
        say: prints a line.

    Raises:
        ConfigError, FileError, CloudError, PoseError, TwinError, LinkError: what cannot be used, and why.
    """
    check_budget(budget)
    check_idle(idle)
    check_keep(learn, keep)
    if isinstance(source, Address):
        unit, axes = unit or "mm", axes or "ras"
    elif source.exists() and not source.is_dir():
        raise ConfigError(f"--watch: expected a folder, got the file {source}.")
    scene = Scene.of(place, options, unit, axes)
    check_output(output, scene.home, [] if isinstance(source, Address) else [source])
    budget = scene.budget(budget)
    start = start or Start()
    frame_landmarks = scene.frame_landmarks(start)
    if frame_landmarks is not None and isinstance(source, Address):
        raise ConfigError(
            f"--frame-landmarks: expected clouds in files, which landmarks go with by their names, got {source}."
        )
    with scene.opened(start, say) as (twin, camera):
        say_coordinates(twin, say)
        twin.registrar()  # prepared before the first cloud is waited for
        kept_in = scene.home.folder if keep else None
        with learning(twin, learn, kept_in, say) as learner, opened(source, scene, twin, idle, say) as feed:
            rows = register_live(
                twin, feed.box, output, camera=camera, formats=formats or WRITTEN, budget=budget,
                frame_landmarks=frame_landmarks, reply=feed.reply, learner=learner, say=say,
            )  # fmt: skip
            say(keeping_up(rows))
            if told := feed.summary():
                say(told)
    return counts(rows)


def check_keep(learn: bool, keep: bool) -> None:
    """Refuse to keep what is not learned.

    Raises:
        ConfigError: `--keep` alone.
    """
    if keep and not learn:
        raise ConfigError("--keep: expected --learn beside it.")


def check_learning(twin: Twin) -> None:
    """Refuse a twin that cannot learn.

    Raises:
        ConfigError: why it cannot.
    """
    from .learning import check  # torch is needed here alone

    check(twin)


@contextmanager
def learning(
    twin: Twin, learn: bool, kept_in: Path | None, say: Callable[[str], None]
) -> Iterator[BackgroundLearner | None]:
    """What adapts a twin's surrogate while frames come, and says in the end what it has learned.

    Args:
        twin: that registers.
        learn: whether it learns; None is given if not.
        kept_in: folder of the twin that keeps what was learned; None to throw it away.
        say: prints a line.

    Raises:
        ConfigError: a twin that cannot learn, and why.
    """
    if not learn:
        yield None
        return
    from .learning import BackgroundLearner  # torch is needed here alone

    with BackgroundLearner(twin, say=say) as learner:
        try:
            yield learner
        finally:  # frames end by Ctrl-C as a rule
            say(str(learner))
            if kept_in is not None:
                _keep(learner, kept_in, say)


def _keep(learner: BackgroundLearner, folder: Path, say: Callable[[str], None]) -> None:
    try:
        is_kept = learner.keep(folder)
    except OSError as error:
        say(f"--keep: {folder} cannot be written ({error}); the twin is as it was")
        return
    say(f"kept in {folder}; as it was built: {folder / 'as-built'}" if is_kept else "nothing to keep")
