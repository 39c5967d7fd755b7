"""Reduced Jacobians of the training equilibria of a data set, over MPI ranks as the equilibria themselves."""

from __future__ import annotations

from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from .data.dataset import DataSet
from .data.jacobians import prepare_jacobians, stored_modes, write_jacobians
from .farm import share_out
from .fem.fenicsx import MPI
from .generate import opened, writing
from .ranks import on_first

Floats = NDArray[np.float64]


def differentiate(path: Path | str | None, modes: Floats | None, comm: Any = MPI.COMM_WORLD) -> None:
    """Make the reduced Jacobians of all accepted training samples, or go on where that was interrupted; collective.

    One factorisation and as many solves as there are modes for each sample.

    Args:
        path: folder of the data set, whose training split is finished; as the modes read on rank 0 alone.
        modes: V, (3n, r), zero at fixed nodes; Jacobians by other modes that are there are thrown away.
        comm: the ranks that share the work.

    Raises:
        DataSetError: the training split is not finished, or somebody else writes the data set.
        FailedElsewhere: on the others, where rank 0 raises one of these or what else went wrong, on any rank.
        ValueError: modes of another body.
    """
    with threadpool_limits(1), ExitStack() as held:

        def prepare() -> tuple[str, list[int]]:
            assert path is not None and modes is not None, "rank 0 gives both"
            data = DataSet(path)
            if modes.ndim != 2 or len(modes) != data.body.points.size:
                raise ValueError(
                    f"differentiate.modes: expected shape ({data.body.points.size}, r), got {modes.shape}."
                )
            data.check_complete("train")
            held.enter_context(writing(Path(path)))
            return str(path), prepare_jacobians(data, modes)

        folder, blocks = on_first(comm, prepare) or ("", [])
        share_out(differentiate_block, comm.bcast(folder, root=0), blocks, comm, "differentiating")


def differentiate_block(path: str, block: int) -> int:
    """Make and write the Jacobians of one block; returns its number.

    Args:
        path: folder of the data set.
        block: number of the block.
    """
    data, plan, problem = opened(path)
    modes = _modes(path, (Path(path) / "jacobians" / "zarr.json").stat().st_mtime_ns)
    rows = (3 * data.response.loaded[:, None] + np.arange(3)).ravel()
    draws, rank = np.arange(block * plan.block, (block + 1) * plan.block), modes.shape[1]
    values, squares = np.zeros((plan.block, rank, rank)), np.zeros(plan.block)
    with threadpool_limits(1):
        for draw, displacement in data.accepted(draws):
            at = draw - draws[0]
            columns = problem.apply_inverse(modes, displacement)[rows]
            values[at], squares[at] = modes[rows].T @ columns, np.square(columns).sum()
    write_jacobians(Path(path), block, values, squares)
    return block


@lru_cache(maxsize=1)
def _modes(path: str, made: int) -> Floats:
    """`made`, the time of their header, tells modes that were put in the place of others."""
    modes = stored_modes(DataSet(path))
    assert modes is not None
    return modes
