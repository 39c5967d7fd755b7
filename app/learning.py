"""A twin that learns while it is used: a second process adapts its surrogate, and frames go on with what there is."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.outcome import NotConverged
from softtwin.surrogate.adaptation import OnlineLearner
from softtwin.surrogate.error_indicators import CalibrationError
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import CARD, WEIGHTS, load, packed, save, unpacked

from .config import ConfigError
from .scenario import Scenario
from .twin import Frame, Twin

Floats = NDArray[np.float64]
AS_BUILT = "as-built"  # in a twin: its surrogate before it learned while it was used
_WAITING = 32  # newest frames that wait to be learned from
_LEARNED = 4  # newest frames that are learned from where several have come; the others are tests alone
_AHEAD, _IDLE = 2, 12  # states ahead that are solved for then, and where no other frame has come
_NICENESS = 10


@dataclass(frozen=True, eq=False)
class _Asked:
    """A frame's load, newtons, and its exact state, metres, (n, 3) each; None where that has to be solved for."""

    forces: Floats
    displacement: Floats | None


@dataclass(frozen=True, eq=False)
class _Tested:
    """Bounds as they are after a test of them, and what the test was."""

    known: dict[str, Any] | None
    error: float
    bound: float


@dataclass(frozen=True, eq=False)
class _Adapted:
    """A surrogate, packed."""

    weights: bytes
    card: dict[str, Any]


@dataclass(frozen=True)
class _Refused:
    """What was not learned from, and why."""

    reason: str


_READY, _END = "ready", "end"


@dataclass
class Learned:
    """What has been learned so far.

    Args:
        frames: whose exact states have tested the surrogate.
        within: of these, how many mean errors were within their bounds.
        refused: what was not learned from: how often, by reason.
        adaptations: how often the surrogate was exchanged.
        errors: relative errors on states that were kept back, before and after the last of them.
    """

    frames: int
    within: int
    refused: dict[str, int]
    adaptations: int
    errors: tuple[float, float] | None


class BackgroundLearner:
    """Adapts a twin's surrogate in a second process; use it in a `with` statement, and give it to a `Sequence`.

    The other process solves for exact states of frames (the hybrid engine's are taken as they are) and of loads that
    may come, adapts the surrogate to them, and sends it; a thread prepares the twin with it, and `renew` exchanges
    both between two frames. Nothing on disk changes before `keep`. A script that makes one begins with
    `if __name__ == "__main__":`, as all do that start processes.

    Args:
        twin: that registers; its engine is `surrogate` or `hybrid`.
        seconds: that an adaptation by training takes.
        seed: of the states that are looked at ahead.
        say: prints a line; called from a thread.

    Raises:
        ConfigError: a twin that cannot learn, and why.
    """

    def __init__(
        self, twin: Twin, *, seconds: float = 4.0, seed: int = 0, say: Callable[[str], None] = lambda line: None
    ) -> None:
        check(twin)
        self._twin, self._say = twin, say
        self._news = threading.Condition()
        self._waiting: deque[_Asked] = deque(maxlen=_WAITING)
        self._is_ready = self._is_closed = False
        self._next: Twin | None = None
        self._bounds: dict[str, Any] | None = None
        self.learned = Learned(0, 0, {}, 0, None)
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, *packed(twin.network), twin.body, seconds, seed)
        self._process = context.Process(target=_learn, args=arguments, name="softtwin learner", daemon=True)
        self._process.start()
        theirs.close()
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._listen, self._send)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> BackgroundLearner:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the other process; what it is at is thrown away."""
        with self._news:
            self._is_closed = True
            self._news.notify_all()
        self._process.terminate()
        self._process.join()
        for thread in self._threads:
            thread.join()
        self._pipe.close()

    # ------------------------------------------------------------------ frames

    def renew(self) -> None:
        """Give the twin what was learned since the last frame."""
        with self._news:
            renewed, self._next = self._next, None
            known, self._bounds = self._bounds, None
        if renewed is not None:
            self._twin.adopt(renewed)
        if known is not None and self._twin.bounds is not None:
            self._twin.take_bounds(known)

    def tell(self, frame: Frame) -> None:
        """Learn from a frame that is usable, when there is time.

        Args:
            frame: of the twin.
        """
        found = frame.registration
        if found is None or not found.judgement.is_usable:
            return
        known = self._twin.known_forces
        forces = found.forces if known is None else found.forces + known
        is_exact = found.draft is not None and found.draft.forces is not found.forces
        with self._news:
            self._waiting.append(_Asked(forces, found.state.displacement if is_exact else None))
            self._news.notify_all()

    # ------------------------------------------------------------------ afterwards

    def keep(self, folder: Path) -> bool:
        """Put what was learned into a twin's folder; False where that is nothing.

        The surrogate as it was built is kept beside it, in `as-built`: its two files put back undo this.

        Args:
            folder: the twin's.

        Raises:
            OSError: it cannot be written; the twin's files are as they were.
        """
        self.renew()
        if not self.learned.adaptations:
            return False
        as_built = folder / AS_BUILT
        if not as_built.is_dir():
            partial = folder / f".{AS_BUILT}"
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            for name in (WEIGHTS, CARD):
                shutil.copy2(folder / name, partial / name)
            os.replace(partial, as_built)
        now, before = self._twin.network, load(folder, self._twin.body)
        # Patterns of its error as the file has them: the model-error ensemble is put beside when a twin is opened.
        maps = replace(
            now.encoder_decoder,
            error_modes=before.encoder_decoder.error_modes,
            error_rest=before.encoder_decoder.error_rest,
        )
        card = {name: entry for name, entry in now.card.items() if name != "discrepancy"}
        known = before.card.get("discrepancy")
        card |= {} if known is None else {"discrepancy": known}
        bounds = self._twin.bounds
        card |= {} if bounds is None else {"certificate": bounds}
        save(Surrogate(now.body, maps, now.network, card), folder, single=before.card.get("stored") == "single")
        return True

    def __str__(self) -> str:
        """One line for a person."""
        now = self.learned
        if not now.frames:
            return "nothing learned: no exact state was found"
        text = f"learned {now.adaptations} times from {now.frames} frames"
        if now.errors is not None:
            before, after = (100.0 * error for error in now.errors)
            text += f"; last: error on states kept back {before:.2g} % before, {after:.2g} % after"
        return text + f"; {now.within} of {now.frames} errors within their bounds beforehand"

    # ------------------------------------------------------------------ threads

    def _send(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._is_closed or (self._is_ready and self._waiting))
                if self._is_closed:
                    return
                # Without exact states the newest frame tells most: each costs the other process an equilibrium.
                asked = list(self._waiting) if self._waiting[-1].displacement is not None else [self._waiting[-1]]
                self._waiting.clear()
                self._is_ready = False
            with suppress(OSError):
                self._pipe.send(asked)

    def _listen(self) -> None:
        with suppress(EOFError, OSError):
            while True:
                message = self._pipe.recv()
                if message == _READY:
                    with self._news:
                        self._is_ready = True
                        self._news.notify_all()
                elif isinstance(message, _Tested):
                    self._hear_test(message)
                elif isinstance(message, _Adapted):
                    self._prepare(message)
                else:
                    self._hear_refusal(cast("_Refused", message))
        if not self._is_closed:
            self._say("learning has ended by itself; the twin goes on as it is")

    def _hear_test(self, seen: _Tested) -> None:
        with self._news:
            self._bounds = seen.known
            self.learned.frames += 1
            self.learned.within += seen.error <= seen.bound

    def _hear_refusal(self, refused: _Refused) -> None:
        kind = refused.reason.partition(", got ")[0]  # figures differ from frame to frame
        count = self.learned.refused.get(kind, 0)
        self.learned.refused[kind] = count + 1
        if not count:
            self._say(f"not learned from: {refused.reason}")

    def _prepare(self, adapted: _Adapted) -> None:
        """In the thread: the twin with a surrogate, for `renew` to give."""
        try:
            renewed = self._twin.with_network(unpacked(adapted.weights, adapted.card, self._twin.body))
        except (ValueError, NotConverged) as error:
            self._hear_refusal(_Refused(str(error)))
            return
        entry = adapted.card["adaptation"]
        with self._news:
            self._next, self._bounds = renewed, None
            self.learned.adaptations += 1
            self.learned.errors = entry["relative_error_before"], entry["relative_error_after"]
        self._say(str(self))


def check(twin: Twin) -> None:
    """Refuse a twin that cannot learn.

    Raises:
        ConfigError: why it cannot.
    """
    section, scenario = twin.config.registration, Scenario.of(twin.config)
    network = twin.network
    if section.parameters or scenario.patch is not None:
        raise ConfigError(
            "--learn: expected forces in known places as all that is unknown: the surrogate is of one tissue and one "
            "support, and what it learned with others would be wrong for its own."
        )
    try:
        OnlineLearner.check(network)
    except (ValueError, CalibrationError) as error:
        raise ConfigError(f"--learn: {error}") from None


# ---------------------------------------------------------------------- the other process


def _learn(pipe: Connection, weights: bytes, card: dict[str, Any], body: Body, seconds: float, seed: int) -> None:
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the twin, which ends this process
    with suppress(AttributeError, OSError):  # not on every system
        os.nice(_NICENESS)
    torch.set_num_threads(1)
    learner = OnlineLearner(unpacked(weights, card, body), seconds, seed)
    with suppress(EOFError, OSError):  # the twin has been closed
        _work(pipe, learner)


def _work(pipe: Connection, learner: OnlineLearner) -> None:
    ahead = _IDLE
    pipe.send(_READY)
    while True:
        if learner.is_due:
            found = learner.adapt()
            if found is not None:
                pipe.send(_Adapted(*packed(found)))
        elif ahead < _AHEAD or (ahead < _IDLE and not pipe.poll()):
            learner.explore()
            ahead += 1
        else:
            asked = pipe.recv()
            for number, each in enumerate(asked, 1):  # neighbours teach the same
                pipe.send(_seen(learner, each, learn=number > len(asked) - _LEARNED))
            ahead = 0
            pipe.send(_READY)


def _seen(learner: OnlineLearner, asked: _Asked, learn: bool) -> _Tested | _Refused:
    try:
        seen = learner.observe(asked.forces, asked.displacement, learn)
    except (ValueError, NotConverged) as error:
        return _Refused(str(error))
    return _Tested(learner.current.card.get("certificate"), seen.error["mean"], seen.bound["mean"])
