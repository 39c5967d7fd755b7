"""What the organ may be otherwise than its twin has it: margins that know of it."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.discrepancy import discrepancy_of, write_discrepancy
from softtwin.reference.ranks import on_first

from ..config import Config, ConfigError
from ..inputs import changes, current_data, doubt_inputs
from ..twin import DOUBT
from ..workspace import Workspace, open_workspace, record_stage

_MOST = 16  # patterns: more are a hundredth of the errors
_LEAST = 8  # alternatives that anything is said of


def doubt_stage(configuration: Path) -> str | None:
    """Draw alternatives of the organ, solve them under the twin's loads, and keep how far they lie from it.

    Collective where mpirun started it. What was solved before an interruption is not solved again.

    Args:
        configuration: the configuration file, read on rank 0 alone.

    Returns:
        What was found, in words, on rank 0; None on the others.

    Raises:
        ConfigError: [doubt] asks for nothing, or most of its alternatives have no equilibrium; see `current_data`.
        DataSetError: the training samples are not complete, or of another body or configuration.
        FailedElsewhere: on the other ranks, where rank 0 raises one of these.
    """
    from softtwin.reference.fem.fenicsx import MPI
    from softtwin.reference.model_error import differences, forget  # FEniCSx is needed by this stage alone

    comm, begin = MPI.COMM_WORLD, time.perf_counter()
    asked = on_first(comm, lambda: _read(configuration))
    if asked is None:
        differences(None, None, comm=comm)
        return None
    space, data = asked
    section = space.config.doubt
    alternatives = alternatives_of(space.config)
    found = differences(space.data, alternatives, section.draws, section.seed, comm)
    assert found is not None
    if len(found.errors) < _LEAST:
        raise ConfigError(
            f"doubt: expected at least {_LEAST} alternatives, got {len(found.errors)}; {found.failed} of the draws "
            "have no equilibrium, or fewer than three nodes hold them; lower doubt.attachment, or ask for more "
            "doubt.draws."
        )
    patterns, _ = discrepancy_of(found.errors, data.body, _MOST)
    made_of = {**asdict(alternatives), "draws": section.draws, "failed": found.failed}
    made_of["material"] = space.config.material.law
    space.twin.mkdir(parents=True, exist_ok=True)
    write_discrepancy(space.twin / DOUBT, patterns, data.body, made_of)
    record_stage(space, "doubt", time.perf_counter() - begin, doubt_inputs(space, data))
    forget(space.data)
    return describe_doubt(found.errors, found.failed)


def alternatives_of(config: Config) -> Any:
    """What [doubt] says may be otherwise.

    Raises:
        ConfigError: nothing, or what cannot be.
    """
    from softtwin.reference.model_error import ModelErrorEnsemble

    section = config.doubt
    try:
        return ModelErrorEnsemble(section.attachment, section.poisson_ratio or None, section.meshes)
    except ValueError as error:
        raise ConfigError(f"doubt: {error}") from None


def describe_doubt(errors: Any, failed: int) -> str:
    """How far alternatives lie from the twin, in the mean over nodes and at the worst, in parts of the movement."""
    lengths = np.linalg.norm(errors.reshape(len(errors), -1, 3), axis=2)
    left = f"; {failed} without an equilibrium are left out" if failed else ""
    return (
        f"{len(errors)} alternatives: a node lies {100 * lengths.mean():.1f} % of the largest movement away, the worst "
        f"node {100 * lengths.max(axis=1).mean():.0f} %{left}"
    )


def is_current(space: Workspace, data: DataSet) -> bool:
    """Whether what was found is of these inputs."""
    return (space.twin / DOUBT).is_file() and changes(space, "doubt", doubt_inputs(space, data)) == []


def _read(configuration: Path) -> tuple[Workspace, DataSet]:
    space = open_workspace(configuration)
    if not space.config.doubt.draws:
        raise ConfigError("doubt.draws: expected at least 1 to draw alternatives, got 0.")
    alternatives_of(space.config)
    return space, current_data(space)[0]
