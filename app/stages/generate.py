"""The data set of a configuration: equilibria under the drawn loads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.ranks import on_first

from ..inputs import current_body, generate_inputs, plan_entries
from ..workspace import Workspace, open_workspace, record_stage


def generate_stage(configuration: Path, redo: Sequence[int] = (), again: bool = False) -> DataSet | None:
    """Solve the equilibria of the data set; collective where mpirun started it. Returns None on ranks other than 0.

    Args:
        configuration: the configuration file, read on rank 0 alone.
        redo: numbers of blocks to make again.
        again: throw away what is there.

    Raises:
        ConfigError: there is no body yet, or one of another configuration.
        DataSetError: the folder holds a data set of another configuration, or somebody else writes it.
        FailedElsewhere: on the other ranks, where rank 0 raises one of these.
    """
    from softtwin.reference.fem.fenicsx import MPI  # FEniCSx is needed by this stage alone
    from softtwin.reference.generate import generate, plan_from_header

    comm, begin = MPI.COMM_WORLD, time.perf_counter()
    asked = on_first(comm, lambda: _read(configuration))
    if asked is None:
        return generate(None, None, None, comm)
    space, body = asked
    plan = plan_from_header({"plan": plan_entries(space.config)})
    data = generate(space.data, body, plan, comm, redo, again)
    record_stage(space, "generate", time.perf_counter() - begin, generate_inputs(space, body))
    return data


def describe_data(data: DataSet) -> str:
    """Counts of accepted and rejected draws, with the reasons of the rejected."""
    rejected = data.rejected()
    counts = {reason: rejected.reasons.count(reason) for reason in sorted(set(rejected.reasons))}
    total = sum(data.header["samples"].values())
    because = f" ({', '.join(f'{count} {reason}' for reason, count in counts.items())})" if counts else ""
    return f"{total - len(rejected.draws)} equilibria accepted, {len(rejected.draws)} rejected{because}"


def _read(configuration: Path) -> tuple[Workspace, Body]:
    space = open_workspace(configuration)
    return space, current_body(space)
