"""Clouds of a camera in their order: what is tried with each, and what is searched for beside them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from numpy.typing import ArrayLike

from softtwin.meshes.clouds import CloudError
from softtwin.reference.data.outcome import NotConverged

from .result import Registration, badness
from .verdict import Check, Code, Verdict

_CATCHING_UP = 2  # newest clouds that a search tracks: the first takes longer than frames are apart
_LONGEST_WAIT = 0.05  # seconds that a step of a search waits for an answer


class _Closed(Exception):  # noqa: N818 - no error
    """Nobody waits for what is searched for."""


class Phase(Enum):
    """What a tracker knows."""

    LOST = "lost"
    FOLLOWING = "following"
    SEARCHING = "searching"


class Ways(Protocol):
    """How one cloud can be registered; `Registrar` is one."""

    def beside(self, before_step: Callable[[], None]) -> Ways:
        """The same for a thread beside the frames: in no hurry, with what is called before each step."""

    def track(self, cloud: ArrayLike, last: Registration) -> Registration:
        """From the last state alone."""

    def follow(self, cloud: ArrayLike, last: Registration | None) -> Registration:
        """From the last state, and from rest where that does not do, before there is an answer."""

    def is_lost(self, found: Registration, last: Registration) -> bool:
        """Whether what was tracked has to be searched for from rest."""

    def is_missed(self, found: Registration) -> bool:
        """Whether it has to be asked if forces outside the zone explain what is left."""

    def asked(self, cloud: ArrayLike, found: Registration) -> Registration:
        """The result with the answer to that, a check more."""


@dataclass(frozen=True, eq=False)
class _Tracked:
    """A cloud with what tracking has found for it, which a search may better.

    Args:
        cloud: that it is for, or has caught up with.
        ways: how that can be registered.
        tracked: what tracking has found for it.
    """

    cloud: ArrayLike
    ways: Ways
    tracked: Registration

    def better(self, before_step: Callable[[], None], last: Registration | None = None) -> Registration | None:
        """A better result from rest, or from a last one; None where there is none."""
        ways = self.ways.beside(before_step)
        try:
            found = ways.follow(self.cloud, None) if last is None else ways.track(self.cloud, last)
        except (CloudError, NotConverged):
            return None
        return found if badness(found) < badness(self.tracked) else None


class Tracker:
    """Registers clouds one after the other, each from what is known of the last.

    | phase | the next cloud | its answer | next phase |
    |---|---|---|---|
    | LOST | | from rest | FOLLOWING where that is usable, else LOST |
    | FOLLOWING | is tracked | that | FOLLOWING |
    | FOLLOWING | is lost; nothing runs in the background | the better of that and of a search from rest | FOLLOWING |
    | FOLLOWING | is lost; a search from rest begins beside the frames | what was tracked, doubtful | SEARCHING |
    | FOLLOWING, SEARCHING | the model finds no state from the last | from rest | FOLLOWING |
    | SEARCHING | comes before the search ends | what is tracked, doubtful | SEARCHING |
    | SEARCHING | comes after the search has found better | tracked from there | FOLLOWING |
    | SEARCHING | comes after the search has not | what is tracked | FOLLOWING |

    A tracked cloud is lost where it is not accepted, or is met much worse than the last (`Registrar.is_lost`). A search
    has found better where its result for the cloud that it was begun with is the better one (`badness`), and the one
    for the newest cloud that is tracked from it is, too. Refused results are answers, and nothing follows from them.

    Whether forces outside the zone explain what a tracked frame leaves is asked beside the frames, too, and the answer
    goes with all frames until the next one is known.

    A search takes the time between the frames: each of its steps waits for the answer that is being found, yet no
    longer than 50 ms, so that it ends where clouds come without a pause.

    Args:
        background: searches run in a thread of their own, and no answer waits for them. The model has to give states to
            two threads at a time.
    """

    def __init__(self, *, background: bool = False) -> None:
        self._background = background
        self._last: Registration | None = None
        self._search: Future[Registration | None] | None = None
        self._newest: _Tracked | None = None
        self._inquiry: Future[Registration] | None = None
        self._elsewhere: Check | None = None
        self._threads: ThreadPoolExecutor | None = None
        self._is_between, self._is_closed = threading.Event(), False

    @property
    def phase(self) -> Phase:
        """What is known after the last cloud."""
        if self._last is None:
            return Phase.LOST
        return Phase.FOLLOWING if self._search is None else Phase.SEARCHING

    def take(self, cloud: ArrayLike, ways: Ways) -> Registration:
        """The next cloud's result.

        Args:
            cloud: observed points, (p, 3), metres.
            ways: how it can be registered.

        Raises:
            CloudError: a cloud without one point of finite coordinates, or one that lies too far from the body.
            NotConverged: the model found no state at rest.
        """
        self._is_between.clear()
        try:
            return self._taken(cloud, ways)
        finally:
            self._is_between.set()

    def _taken(self, cloud: ArrayLike, ways: Ways) -> Registration:
        self._end_search()
        if self._last is None or not self._background:
            return self._kept(ways.follow(cloud, self._last))
        try:
            found = ways.track(cloud, self._last)
        except NotConverged:
            self._search = self._newest = None  # what is being searched for is of a cloud before this one
            return self._kept(ways.follow(cloud, None))
        self._newest = _Tracked(cloud, ways, found)
        if self._search is None and ways.is_lost(found, self._last):
            self._search = self._begun(self._newest)
        self._kept(found)
        self._inquire(self._newest)
        if self._elsewhere is not None:
            found = found.with_check(self._elsewhere)
        return found if self._search is None else found.with_check(_searching())

    def _inquire(self, tracked: _Tracked) -> None:
        """Ask beside the frames whether forces elsewhere explain what one leaves, and take the answer to the last."""
        if self._inquiry is not None and self._inquiry.done():
            inquiry, self._inquiry = self._inquiry, None
            checks = inquiry.result().judgement.checks
            self._elsewhere = next((check for check in checks if check.code is Code.FORCES_ELSEWHERE), None)
        if not tracked.ways.is_missed(tracked.tracked):
            self._elsewhere = None
        elif self._inquiry is None:
            ways = tracked.ways.beside(self._wait)
            self._inquiry = self._beside().submit(ways.asked, tracked.cloud, tracked.tracked)

    def close(self) -> None:
        """End: what is still searched for is forgotten."""
        self._is_closed = True
        self._is_between.set()
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)
        self._threads, self._search, self._inquiry = None, None, None

    def _wait(self) -> None:
        self._is_between.wait(_LONGEST_WAIT)
        if self._is_closed:
            raise _Closed

    def _begun(self, lost: _Tracked) -> Future[Registration | None]:
        return self._beside().submit(self._searched, lost)

    def _beside(self) -> ThreadPoolExecutor:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(1, thread_name_prefix="beside the frames")
        return self._threads

    def _searched(self, lost: _Tracked) -> Registration | None:
        """In the other thread: the cloud from rest, then the newest from there, as long as that is better."""
        found = lost.better(self._wait)
        for _ in range(_CATCHING_UP):
            newest = self._newest
            if found is None or newest is None or newest is lost:
                break
            self._wait()
            found, lost = newest.better(self._wait, found), newest
        return found

    def _end_search(self) -> None:
        """Go on from what a search has found, where it has ended and that is better."""
        search = self._search
        if search is None or not search.done():
            return
        self._search = None
        found = search.result()
        if found is not None:
            self._kept(found)

    def _kept(self, found: Registration) -> Registration:
        if found.judgement.is_usable:
            self._last = found
        return found


def _searching() -> Check:
    reason = "the last clouds are not met as well as those before: the state is being searched for from rest"
    return Check(Code.TRACKING, Verdict.DOUBTFUL, 1.0, None, "searches that have not ended", reason=reason)
