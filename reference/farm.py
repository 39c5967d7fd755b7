"""Blocks of work shared out over MPI ranks: rank 0 hands them out and takes part itself."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any

from mpi4py.futures import MPICommExecutor
from tqdm import tqdm

from .ranks import tell_all

Task = Callable[[str, int], int]


def share_out(task: Task, path: str, blocks: Sequence[int], comm: Any, words: str) -> None:
    """Do a task for each block, on all ranks; collective.

    Args:
        task: a function of a module, called with the path and the number of a block, which it returns.
        path: what the task works on.
        blocks: their numbers; read on rank 0 alone.
        comm: the ranks.
        words: what is done, for the progress bar.

    Raises:
        FailedElsewhere: on the others, where a task failed on any rank; rank 0 raises what the task raised.
    """
    if comm.size == 1:
        for block in tqdm(blocks, desc=words, unit="block", disable=quiet()):
            task(path, block)
        return
    failure: BaseException | None = None
    with MPICommExecutor(comm, root=0) as pool:
        if pool is not None:
            try:
                _shared(pool, task, path, blocks, comm.size - 1, words)
            except BaseException as error:  # whatever it is, the others wait for word of it
                failure = error
    tell_all(comm, failure)


def _shared(pool: Any, task: Task, path: str, blocks: Sequence[int], workers: int, words: str) -> None:
    """Keep two blocks with every worker, and do one here whenever they are all busy."""
    waiting = iter(blocks)
    busy: set[Future[int]] = set()
    with tqdm(total=len(blocks), desc=words, unit="block", disable=quiet()) as bar:
        while True:
            for block in _take(waiting, 2 * workers - len(busy)):
                busy.add(pool.submit(task, path, block))
            own = next(waiting, None)
            if own is not None:
                task(path, own)
                bar.update()
            done, busy = wait(busy, timeout=0 if own is not None else None, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
                bar.update()
            if own is None and not busy:
                return


def quiet() -> bool:
    """No bar where nobody looks; mpirun hides the terminal, so whoever started it may ask for the bar."""
    return not (sys.stderr.isatty() or os.environ.get("SOFTTWIN_PROGRESS") == "1")


def _take(source: Iterator[int], count: int) -> Iterator[int]:
    for _ in range(count):
        item = next(source, None)
        if item is None:
            return
        yield item
