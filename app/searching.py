"""Searches from rest in a process of their own, beside the frames that are tracked meanwhile.

In a thread a search shares the interpreter with the frames. The other process holds the same twin; what it finds
is gone on from here, so that nothing depends on where it was found.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.strategies.resuming import Found

from .config import Config, ConfigError
from .twin import Camera, SearchEnded, Twin

Floats = NDArray[np.float64]
_READY = "ready"
_AT_A_TIME = 0.02  # seconds: so often who waits for an answer looks whether it is still wanted


@dataclass(frozen=True, eq=False)
class _Copy:
    """What another process makes the same twin of."""

    weights: bytes
    card: dict[str, Any]
    body: Body
    known: Floats | None
    config: Config


@dataclass(frozen=True, eq=False)
class _Asked:
    """A cloud, (p, 3) or (p, 6), metres, and how it is to be registered."""

    cloud: Floats
    zone: str | None
    camera: Camera


class SearchProcess:
    """Searches for states of a twin from rest in another process; `close` ends it.

    It is started at once and can be asked some seconds later (`is_ready`). It is a program of its own, so that scripts
    need no `if __name__ == "__main__":` for it.

    Args:
        twin: that registers with its surrogate.

    Raises:
        ConfigError: a twin without a surrogate.
    """

    def __init__(self, twin: Twin) -> None:
        from softtwin.surrogate.twin import packed  # torch is needed here alone

        copy = _Copy(*packed(twin.network), twin.body, twin.known_forces, twin.config)
        self._answers: queue.Queue[Any] = queue.Queue()
        self.is_ready = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", "softtwin.app.searching"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._threads = [
            threading.Thread(target=self._send, args=(copy,), daemon=True),
            threading.Thread(target=self._listen, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def found(self, cloud: ArrayLike, zone: str | None, camera: Camera, wait: Callable[[], None]) -> Found | None:
        """What a search from rest finds for a cloud; None where that is of no use.

        Args:
            cloud: observed points, (p, 3), metres.
            zone: as for `Twin.register`.
            camera: as for `Twin.register`.
            wait: called again and again until there is an answer; may raise, and the answer is thrown away.

        Raises:
            SearchEnded: the other process has ended.
        """
        try:
            while not self.is_ready and self._answers.empty():  # it may end before it has begun
                wait()
                time.sleep(_AT_A_TIME)
            self._send(_Asked(np.asarray(cloud, dtype=np.float64), zone, camera))
            while True:
                wait()
                with suppress(queue.Empty):
                    found = self._answers.get(timeout=_AT_A_TIME)
                    break
        except BaseException:
            self.close()  # else its answer would be taken for that of the next
            raise
        if isinstance(found, SearchEnded):
            raise found
        return found

    def close(self) -> None:
        """End the other process; what it is at is thrown away."""
        self.is_ready = False
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # what was not sent yet
                assert pipe is not None
                pipe.close()

    def _send(self, asked: Any) -> None:
        assert self._process.stdin is not None
        try:
            _write(self._process.stdin, asked)
        except (OSError, ValueError):  # it has ended, or was closed
            self.is_ready = False
            self._answers.put(SearchEnded("the process that searches from rest has ended"))

    def _listen(self) -> None:
        assert self._process.stdout is not None
        while True:
            try:
                told = pickle.load(self._process.stdout)
            except (EOFError, OSError, ValueError, pickle.UnpicklingError):
                self.is_ready = False
                self._answers.put(SearchEnded("the process that searches from rest has ended"))
                return
            if told == _READY:
                self.is_ready = True
            else:
                self._answers.put(told)


@contextmanager
def searching(twin: Twin) -> Iterator[SearchProcess | None]:
    """One for a twin that searches beside its frames; None where a thread has to do, or there is one processor alone.

    Args:
        twin: the twin.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        is_taken = cores > 1 and twin.config.registration.model == "surrogate" and twin.network is not None
    except ConfigError:
        is_taken = False
    if not is_taken:
        yield None
        return
    with closing(SearchProcess(twin)) as process:
        yield process


def _write(pipe: IO[bytes], told: Any) -> None:
    pickle.dump(told, pipe, protocol=pickle.HIGHEST_PROTOCOL)
    pipe.flush()


def _answered(twin: Twin, asked: _Asked) -> Found | None:
    try:
        found = twin.ways(asked.zone, asked.camera).follow(asked.cloud, None)
    except (CloudError, NotConverged, ConfigError):
        return None
    return Found.of(found) if found.judgement.is_usable else None


def main() -> None:
    """The other process: takes a twin, then clouds, from standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the twin's process, which ends this one
    pipe = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what anybody prints is no answer
    import torch

    from softtwin.surrogate.loaded import LoadedSurrogate
    from softtwin.surrogate.twin import unpacked

    torch.set_num_threads(1)
    with suppress(EOFError, OSError):  # the twin has been closed
        copy: _Copy = pickle.load(sys.stdin.buffer)
        surrogate = unpacked(copy.weights, copy.card, copy.body)
        twin = Twin(surrogate if copy.known is None else LoadedSurrogate(surrogate, copy.known), copy.config)
        twin.registrar(None, twin.as_said)
        _write(pipe, _READY)
        cameras: dict[bytes, Camera] = {pickle.dumps(twin.as_said): twin.as_said}
        while True:
            asked: _Asked = pickle.load(sys.stdin.buffer)
            # What was prepared for a camera is known by the object.
            camera = cameras.setdefault(pickle.dumps(asked.camera), asked.camera)
            _write(pipe, _answered(twin, replace(asked, camera=camera)))


if __name__ == "__main__":
    main()
