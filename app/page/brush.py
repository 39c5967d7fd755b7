"""Moves the picture to the newest answer in small steps, and rests once it is there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

EVERY = 1.0 / 45.0  # seconds between two steps
_LONGER = 1.25  # times the time between two answers: the next one comes before the picture stands still
_LONGEST = 0.4  # seconds that a glide takes at most: slower engines are not to look smooth
_REST = 1e-5  # metres that nobody sees


class Brush:
    """A thread that moves what is drawn.

    Figures are those of answers; what lies between two answers is a straight line between them, for the eye.

    Args:
        move: draws nodal displacements, (n, 3), metres.
        shown: what is drawn to begin with.
    """

    def __init__(self, move: Callable[[Floats], None], shown: Floats) -> None:
        self._move, self._news = move, threading.Condition()
        self._from = self._to = self._shown = shown
        self._begin = self._asked = time.monotonic()
        self._span = 0.0
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="softtwin brush", daemon=True)
        self._thread.start()

    @property
    def shown(self) -> Floats:
        """What is drawn now, (n, 3), metres."""
        with self._news:
            return self._shown

    def glide(self, displacement: Floats) -> None:
        """Go to an answer in about the time that lay between it and the one before."""
        with self._news:
            now = time.monotonic()
            self._span = min(_LONGER * (now - self._asked), _LONGEST)
            self._asked = self._begin = now
            self._from, self._to = self._shown, displacement
            self._news.notify()

    def jump(self, displacement: Floats) -> None:
        """Draw an answer at once, in the calling thread."""
        with self._news:
            self._from = self._to = self._shown = displacement
            self._span = 0.0
            self._move(displacement)

    def close(self) -> None:
        """End the thread."""
        with self._news:
            self._is_closed = True
            self._news.notify()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        due = 0.0
        while True:
            with self._news:
                self._news.wait_for(lambda: self._is_closed or self._shown is not self._to)
                if self._is_closed:
                    return
                now = time.monotonic()
                self._step(now)
            due = max(due + EVERY, now)  # a step that was late does not make the next one late
            time.sleep(max(0.0, due - time.monotonic()))

    def _step(self, now: float) -> None:
        part = 1.0 if self._span <= 0.0 else min(1.0, (now - self._begin + EVERY) / self._span)
        reached = self._to if part >= 1.0 else self._from + part * (self._to - self._from)
        if np.abs(reached - self._shown).max() > _REST:
            self._move(reached)
        self._shown = reached
