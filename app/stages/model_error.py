"""The model-error ensemble: perturbed models of the organ, solved once, so that margins cover the model's error."""

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
from ..inputs import changes, current_data, model_error_inputs
from ..twin import FORMER_MODEL_ERROR, MODEL_ERROR
from ..workspace import Workspace, open_workspace, record_stage

_MAXIMUM_PATTERNS = 16  # patterns: more are a hundredth of the errors
_MINIMUM_MODELS = 8  # fewer perturbed models say nothing of a covariance


def model_error_stage(configuration: Path) -> str | None:
    """Draw perturbed models of the organ, solve them under the twin's loads, and keep how far they lie from it.

    Collective where mpirun started it. What was solved before an interruption is not solved again.

    Args:
        configuration: the configuration file, read on rank 0 alone.

    Returns:
        What was found, in words, on rank 0; None on the others.

    Raises:
        ConfigError: [model_error] asks for nothing, or most of its models have no equilibrium; see `current_data`.
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
    section = space.config.model_error
    alternatives = ensemble_of(space.config)
    found = differences(space.data, alternatives, section.draws, section.seed, comm)
    assert found is not None
    if len(found.errors) < _MINIMUM_MODELS:
        raise ConfigError(
            f"model_error: expected at least {_MINIMUM_MODELS} perturbed models, got {len(found.errors)}; "
            f"{found.failed} of the draws have no equilibrium, or fewer than three nodes hold them; lower "
            "model_error.attachment, or ask for more "
            "model_error.draws."
        )
    patterns, _ = discrepancy_of(found.errors, data.body, _MAXIMUM_PATTERNS)
    made_of = {**asdict(alternatives), "draws": section.draws, "failed": found.failed}
    made_of["material"] = space.config.material.law
    space.twin.mkdir(parents=True, exist_ok=True)
    write_discrepancy(space.twin / MODEL_ERROR, patterns, data.body, made_of)
    (space.twin / FORMER_MODEL_ERROR).unlink(missing_ok=True)
    record_stage(space, "model_error", time.perf_counter() - begin, model_error_inputs(space, data))
    forget(space.data)
    return describe_model_error(found.errors, found.failed)


def ensemble_of(config: Config) -> Any:
    """What [model_error] perturbs, as the reference takes it.

    Raises:
        ConfigError: nothing, or what cannot be.
    """
    from softtwin.reference.model_error import ModelErrorEnsemble

    section = config.model_error
    try:
        return ModelErrorEnsemble(section.attachment, section.poisson_ratio or None, section.meshes)
    except ValueError as error:
        raise ConfigError(f"model_error: {error}") from None


def describe_model_error(errors: Any, failed: int) -> str:
    """How far perturbed models lie from the twin, in the mean over nodes and at the worst, in parts of the movement."""
    lengths = np.linalg.norm(errors.reshape(len(errors), -1, 3), axis=2)
    left = f"; {failed} without an equilibrium are left out" if failed else ""
    return (
        f"{len(errors)} perturbed models: a node lies {100 * lengths.mean():.1f} % of the largest movement away, "
        f"the worst node {100 * lengths.max(axis=1).mean():.0f} %{left}"
    )


def is_current(space: Workspace, data: DataSet) -> bool:
    """Whether what was found is of these inputs."""
    is_there = any((space.twin / name).is_file() for name in (MODEL_ERROR, FORMER_MODEL_ERROR))
    return is_there and changes(space, "model_error", model_error_inputs(space, data)) == []


def _read(configuration: Path) -> tuple[Workspace, DataSet]:
    space = open_workspace(configuration)
    if not space.config.model_error.draws:
        raise ConfigError("model_error.draws: expected at least 1 to draw perturbed models, got 0.")
    ensemble_of(space.config)
    return space, current_data(space)[0]
