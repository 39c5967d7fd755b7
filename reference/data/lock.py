"""One process at a time: a lock that the system lets go of when its holder ends in any way."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


@contextmanager
def locked(path: Path, refusal: Exception, patience: float) -> Iterator[None]:
    """Keep others out while this is at work.

    Args:
        path: file that stands for what is locked.
        refusal: raised where another process holds it.
        patience: how long a lock that is about to be let go is waited for, seconds.
    """
    lock = FileLock(path, timeout=patience)
    try:
        lock.acquire()
    except Timeout:
        raise refusal from None
    try:
        yield
    finally:
        lock.release()
