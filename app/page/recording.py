"""A scene recorded into one HTML file that plays without a server."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import viser


class Recording:
    """What is drawn from now on, with its pace.

    Args:
        server: whose scene is recorded.
        seconds: after which it ends.
        done: gets the page, in a thread of its own.
    """

    def __init__(self, server: viser.ViserServer, seconds: float, done: Callable[[str], None]) -> None:
        self._serializer = server.get_scene_serializer()
        self._lock, self._done = threading.Lock(), done
        self._last = time.monotonic()
        self._end, self._is_over = self._last + seconds, False
        timer = threading.Timer(seconds, self._finish)
        timer.daemon = True
        timer.start()

    def mark(self) -> None:
        """Say that something is about to be drawn."""
        with self._lock:
            if not self._is_over:
                now = time.monotonic()
                self._serializer.insert_sleep(now - self._last)
                self._last = now

    def _finish(self) -> None:
        self.mark()
        with self._lock:
            self._is_over = True
            page = self._serializer.as_html()
        self._done(page)
