"""Active rounds: further draws to learn from, chosen where the network trained on those before is least in balance."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.writing import write_chosen
from softtwin.reference.generate import candidate_loads, plan_from_header, solve_block
from softtwin.surrogate.acquisition import most_informative
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import CARD, load, save

from ..config import Config
from ..workspace import Workspace
from .plan import training_plan

Floats = NDArray[np.float64]
_SHARE = 0.25  # of the time to train in the end that a round's network is given


def next_round(config: Config, data: DataSet) -> int | None:
    """Number of the first round whose draws nobody has chosen yet; None where all have been."""
    free = np.flatnonzero(data.chosen < 0)
    return int(free[0]) * config.samples.load_path // config.samples.chosen if len(free) else None


def choose(space: Workspace, data: DataSet, number: int) -> None:
    """Train on all draws of before, choose those of a round, and keep the network for its solves to start from.

    Args:
        space: the workspace.
        data: its data set, complete up to this round.
        number: of the round, from 0.

    Raises:
        CalibrationError: the residual of the material is not known.
        DataSetError: blocks of before are missing or damaged.
    """
    samples, training = space.config.samples, space.config.training
    before = samples.train + number * samples.chosen
    plan = replace(
        training_plan(training), seconds=_SHARE * training.seconds, epochs=None, samples=before, patience=None
    )
    surrogate = train(data, plan)
    made, each = plan_from_header(data.header), samples.chosen // samples.load_path
    pool = range(number * each * samples.candidates, (number + 1) * each * samples.candidates)

    def forces(candidate: int) -> Floats:
        loads, factors = candidate_loads(data, made, candidate)
        return np.asarray(factors[:, None, None] * loads)

    known = data.samples("train", before).forces
    places = most_informative(surrogate, map(forces, pool), each, known)
    save(surrogate, _network(space.data, number))
    write_chosen(space.data, number * each, pool.start + places)


def solver(config: Config) -> Callable[[str, int], int]:
    """What solves a block, an active one from the prediction of its round's network."""
    return partial(solve_from_network, chosen=config.samples.chosen)


def solve_from_network(path: str, block: int, chosen: int) -> int:
    """As `solve_block`, from the network of the block's round where that is kept, from rest with a warning where not.

    Args:
        path: folder of the data set.
        block: number of the block.
        chosen: draws of a round.
    """
    data = DataSet(path)
    draws, first = data.split_draws("active"), block * data.header["block"]
    if first not in draws:
        return solve_block(path, block)
    network = _network(Path(path), (first - draws.start) // chosen)
    if not (network / CARD).exists():
        warnings.warn(
            f"{network}: the network that chose these draws is not there; they are solved from rest, to the same "
            "equilibria in more iterations.",
            stacklevel=2,
        )
        return solve_block(path, block)
    return solve_block(path, block, _opened(str(network), path, (network / CARD).stat().st_mtime_ns))


def _network(data: Path, number: int) -> Path:
    return data.parent / "rounds" / str(number + 1)


@lru_cache(maxsize=1)
def _opened(network: str, data: str, made: int) -> Surrogate:
    """`made`, the time of its card, tells a network that was trained again in the same place."""
    return load(Path(network), DataSet(data).body)
