"""Ranks that end together: a rank that fails tells the others before any of them waits for it again."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

Result = TypeVar("Result")


class FailedElsewhere(RuntimeError):  # noqa: N818 - a way to end
    """Another rank has failed and says why: here nothing is left to be said."""


def on_first(comm: Any, task: Callable[[], Result]) -> Result | None:
    """Do a task on rank 0 while the others wait; collective. Returns its result there, None on the others.

    Args:
        comm: the ranks.
        task: what rank 0 does.

    Raises:
        FailedElsewhere: on the others, where the task failed on rank 0, which raises what the task raised.
    """
    result, failure = None, None
    if comm.rank == 0:
        try:
            result = task()
        except BaseException as error:  # whatever it is, the others wait for word of it
            failure = error
    tell_all(comm, failure)
    return result


def tell_all(comm: Any, failure: BaseException | None) -> None:
    """Raise a failure of rank 0 on every rank; collective.

    Args:
        comm: the ranks.
        failure: what happened on rank 0, None for nothing; not read on the others.

    Raises:
        FailedElsewhere: on the others; rank 0 raises the failure itself.
    """
    _wait_for_all(comm)
    if not comm.bcast(failure is not None, root=0):
        return
    if failure is not None and comm.rank == 0:
        raise failure
    raise FailedElsewhere("rank 0 has failed; its message says why.")


def _wait_for_all(comm: Any) -> None:
    """A barrier that leaves the cores to the rank that is still at work: MPI's own spins."""
    request = comm.Ibarrier()
    while not request.Test():
        time.sleep(0.02)
