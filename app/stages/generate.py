"""The data set of a configuration: equilibria under the drawn loads."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.jacobians import missing_jacobians, stored_modes
from softtwin.reference.data.shard import Shard
from softtwin.reference.ranks import on_first
from softtwin.surrogate.pod import learned_basis

from ..config import Config, ConfigError
from ..inputs import current_body, generate_inputs, plan_entries
from ..workspace import Workspace, open_workspace, record_stage

if TYPE_CHECKING:
    from ..torch_blocks import TorchBlocks

Floats = NDArray[np.float64]


def generate_stage(
    configuration: Path,
    redo: Sequence[int] = (),
    again: bool = False,
    shard: Shard | None = None,
    torch_device: str = "",
) -> DataSet | None:
    """Solve the equilibria of the data set, those of active rounds after the others, and their Jacobians where wanted.

    Collective where mpirun started it; returns None on ranks other than 0.

    Args:
        configuration: the configuration file, read on rank 0 alone.
        redo: numbers of blocks to make again.
        again: throw away what is there.
        shard: solve the blocks of one shard alone, and of active rounds what they have chosen already; what is missing
            in the end, further rounds and the Jacobians, the whole stage makes.
        torch_device: `cpu` or `cuda`: torch solves the equilibria there, in one process; empty: the reference.

    Raises:
        CalibrationError: active rounds are wanted of a material whose residual torch does not know.
        ConfigError: there is no body yet, or one of another configuration; active rounds are wanted without torch.
        DataSetError: the folder holds a data set of another configuration, or somebody else writes it.
        FailedElsewhere: on the other ranks, where rank 0 raises one of these.
    """
    from softtwin.reference.differentiate import differentiate
    from softtwin.reference.fem.fenicsx import MPI  # FEniCSx is needed by this stage alone
    from softtwin.reference.generate import generate, plan_from_header

    comm, begin = MPI.COMM_WORLD, time.perf_counter()
    if torch_device and comm.size > 1:
        raise ConfigError(f"generate --engine torch: expected one process, got {comm.size} ranks; leave mpirun out.")
    asked = on_first(comm, lambda: _read(configuration, shard))
    if asked is None:
        generate(None, None, None, comm, shard=shard)
        while comm.bcast(None, root=0) is not None:
            on_first(comm, lambda: None)
            generate(None, None, None, comm)
        if comm.bcast(None, root=0):
            on_first(comm, lambda: None)
            differentiate(None, None, comm)
        return None
    space, body, active = asked
    plan = plan_from_header({"plan": plan_entries(space.config)})
    task, torch_blocks = active.solver(space.config) if active else None, None
    if torch_device:
        task = torch_blocks = _torch_blocks(torch_device)
    data = generate(space.data, body, plan, comm, redo, again, shard, task)
    assert data is not None
    while active and shard is None and (number := active.next_round(space.config, data)) is not None:
        comm.bcast(number, root=0)
        on_first(comm, partial(active.choose, space, data, number))
        data = generate(space.data, body, plan, comm, task=task)
        assert data is not None
    if torch_blocks is not None and torch_blocks.draws:
        torch_blocks.record(data)
        data = DataSet(space.data)
    comm.bcast(None, root=0)
    if comm.bcast(shard is None and space.config.wants_jacobians, root=0):
        modes = on_first(comm, lambda: jacobian_modes(space.config, data))
        differentiate(space.data, modes, comm)
    if shard is None:
        record_stage(space, "generate", time.perf_counter() - begin, generate_inputs(space, body))
    return data


def _torch_blocks(device: str) -> TorchBlocks:
    try:
        from ..torch_blocks import TorchBlocks
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"generate --engine torch: expected torch, found no {error.name}; install softtwin[torch]."
        ) from error
    return TorchBlocks(device)


def _active_rounds(config: Config) -> Any:
    """What active rounds are made with; None where none are wanted."""
    if not config.samples.rounds:
        return None
    try:
        from . import rounds
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"samples.rounds: expected torch for the networks that choose draws, found no {error.name}; install "
            "softtwin[torch], or set samples.rounds = 0."
        ) from error
    return rounds


def jacobian_modes(config: Config, data: DataSet) -> Floats:
    """The modes that the reduced network of a configuration has on a data set, (3n, r)."""
    settings = config.training.settings
    symmetric = bool(settings.get("symmetries", True))
    return learned_basis(data, data.samples("train"), config.training.modes, symmetric).modes


def lacks_jacobians(config: Config, data: DataSet) -> bool:
    """Whether Jacobians are wanted that are not there, or not all, or of other modes."""
    if not config.wants_jacobians:
        return False
    modes = stored_modes(data)
    if modes is None or missing_jacobians(data):
        return True
    return not np.array_equal(modes, jacobian_modes(config, data))


def describe_data(data: DataSet) -> str:
    """Counts of accepted and rejected draws, with the reasons of the rejected; what Jacobians there are."""
    rejected = data.rejected()
    counts = {reason: rejected.reasons.count(reason) for reason in sorted(set(rejected.reasons))}
    total = sum(data.header["samples"].values())
    chosen = data.header["samples"].get("active", 0)
    because = f" ({', '.join(f'{count} {reason}' for reason, count in counts.items())})" if counts else ""
    modes = stored_modes(data)
    active = f", {chosen} of them chosen in active rounds" if chosen else ""
    jacobians = "" if modes is None else f", Jacobians of {modes.shape[1]} modes"
    return _solved_elsewhere(data) + (
        f"{total - len(rejected.draws)} equilibria accepted, {len(rejected.draws)} rejected{because}{active}{jacobians}"
    )


def _solved_elsewhere(data: DataSet) -> str:
    """How well the last run of another engine agrees with the reference, a line; nothing where there was none."""
    if not data.engines:
        return ""
    last = data.engines[-1]
    checked = last["agreement"]
    apart = max(checked["differences"], default=0.0)
    lost = f"; of {len(checked['not_found'])} of them it found none" if checked["not_found"] else ""
    return (
        f"{last['accepted']} by {last['engine']} ({last['device']}); {len(checked['draws'])} solved again by the "
        f"reference: at most {apart:.1e} of the largest displacement apart{lost}\n"
    )


def _read(configuration: Path, shard: Shard | None) -> tuple[Workspace, Body, Any]:
    """The workspace, its body, and what active rounds are made with."""
    space = open_workspace(configuration)
    try:
        active = _active_rounds(space.config)
    except ConfigError as error:
        if shard is None:
            raise
        active = None  # a job of a cluster may do without torch
        warnings.warn(
            f"shard {shard}: {error} Draws that such rounds have chosen already are solved from rest, to the same "
            "equilibria in more iterations.",
            stacklevel=2,
        )
    return space, current_body(space), active
