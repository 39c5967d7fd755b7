"""A hand at the organ: one at a time, the newest place of the mouse wins, and it lets go when its browser goes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..twin import Home, Twin
from .brush import Brush
from .pull import Place, Prediction, Pull, is_calibrated

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Hold:
    owner: int  # client
    place: Floats  # that was taken hold of
    displacement: Floats
    forces: Floats


class Hand:
    """Predicts pulls in a thread of its own, with the network of the twin whatever engine registers.

    Args:
        home: of the twin, which has a network.
        brush: that draws.
        show: is called with each prediction, after it was drawn.
        let_go: is called when a pull has ended.
    """

    def __init__(
        self, home: Home, brush: Brush, show: Callable[[Prediction], None], let_go: Callable[[], None]
    ) -> None:
        self._home, self._brush, self._show, self._ended = home, brush, show, let_go
        self._news = threading.Condition()
        self._hold: _Hold | None = None
        self._place: Place | None = None
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="softtwin hand", daemon=True)
        self._thread.start()

    @property
    def is_pulling(self) -> bool:
        """Whether somebody pulls."""
        return self._hold is not None

    def take_hold(self, owner: int, place: Floats, forces: Floats) -> None:
        """Begin a pull; nothing happens while another has hold.

        Args:
            owner: number of the browser.
            place: that the mouse took hold of, (3,), metres.
            forces: nodal, that act already, (n, 3), newtons.
        """
        with self._news:
            if self._hold is None:
                self._hold, self._place = _Hold(owner, place, self._brush.shown, forces), None

    def move(self, owner: int, place: Floats) -> None:
        """Pull to a place, (3,), metres; an older one that was not answered yet is forgotten."""
        with self._news:
            if self._hold is not None and self._hold.owner == owner:
                self._place = Place(place - self._hold.place, time.monotonic())
                self._news.notify()

    def let_go(self, owner: int) -> None:
        """End the pull of a browser, if it has one."""
        with self._news:
            if self._hold is None or self._hold.owner != owner:
                return
            self._hold = self._place = None
        self._ended()

    def close(self) -> None:
        """End the thread."""
        with self._news:
            self._is_closed = True
            self._news.notify()
        self._thread.join(timeout=60.0)  # a thread that is at work when Python ends takes the process down with it

    def _run(self) -> None:
        with self._home.twin("surrogate") as twin:
            _warm(twin)
            pull: tuple[_Hold, Pull] | None = None
            while (asked := self._next()) is not None:
                hold, place = asked
                if pull is None or pull[0] is not hold:
                    pull = hold, Pull(twin, hold.place, hold.displacement, hold.forces)
                self._answer(hold, pull[1].to(place))

    def _next(self) -> tuple[_Hold, Place] | None:
        with self._news:
            self._news.wait_for(lambda: self._is_closed or (self._hold is not None and self._place is not None))
            if self._is_closed or self._hold is None or self._place is None:
                return None
            asked = self._hold, self._place
            self._place = None
            return asked

    def _answer(self, hold: _Hold, found: Prediction) -> None:
        if self._hold is hold:  # else it was let go in the meantime
            self._brush.jump(found.displacement)
            self._show(found)


def _warm(twin: Twin) -> None:
    """Do once what the first prediction would otherwise wait for."""
    nothing = np.zeros_like(twin.body.points)
    twin.predict(nothing)
    if is_calibrated(twin):
        twin.bound_error(nothing)
