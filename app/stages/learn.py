"""The stages that need torch: training the surrogate, writing the twin, measuring it on held-out samples."""

from __future__ import annotations

import json
import os
import shutil
import warnings
from typing import Any

import numpy as np

from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.calibration import CalibrationWarning, calibrate, coverage
from softtwin.surrogate.discrepancy import with_discrepancy
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.error_indicators import CalibrationError
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.plan import Device, TrainingPlan
from softtwin.surrogate.train import train
from softtwin.surrogate.twin import load, save

from ..config import ConfigError, to_toml
from ..inputs import check_trained, current_data, train_inputs, validate_inputs
from ..workspace import Workspace, locked, timed, write_whole
from .generate import lacks_jacobians
from .plan import training_plan


def train_stage(space: Workspace, fresh: bool = False, device: Device = "auto", processes: int = 1) -> Surrogate:
    """Train on the data set and write the twin: body, weights, card, configuration. Goes on from the last checkpoint.

    Args:
        space: the workspace.
        fresh: throw earlier checkpoints away instead.
        device: where to train.
        processes: that train together.

    Raises:
        ConfigError: there is no body, or one of another configuration; another `train` is at work there; Jacobians are
            wanted that are not there.
        DataSetError: the data set is missing, damaged, not complete, or of another body or configuration.
        CheckpointError: the checkpoint is truncated, or of another version, plan or data set.
    """
    data, _ = current_data(space)
    if lacks_jacobians(space.config, data):
        raise ConfigError(
            f"samples.jacobians: those in {space.data} are not there, not all, or of other modes than the network is "
            "to have; run `softtwin generate` again, it makes them."
        )
    with locked(space, "train"):
        return _train(space, data, fresh, training_plan(space.config.training, device, processes))


def _train(space: Workspace, data: DataSet, fresh: bool, plan: TrainingPlan) -> Surrogate:
    if fresh:
        shutil.rmtree(space.training, ignore_errors=True)
    with timed(space, "train", train_inputs(space, data)):
        surrogate = with_discrepancy(with_domain(train(data, plan, space.training), data), data)
        if data.header["samples"].get("calibration"):
            surrogate = calibrated(surrogate, data)
        save(surrogate, space.twin)
        partial = space.twin / ".body.vtu.partial"
        shutil.copyfile(space.body, partial)
        os.replace(partial, space.twin / "body.vtu")
        write_whole(space.twin / "organ.toml", to_toml(space.config))
    return surrogate


def calibrated(surrogate: Surrogate, data: DataSet) -> Surrogate:
    """The surrogate with a certificate; without, and said, where none can be given."""
    try:
        return calibrate(surrogate, data)
    except CalibrationError as error:
        warnings.warn(f"the twin has no bounds on its errors: {error}", CalibrationWarning, stacklevel=2)
        return surrogate


def validate_stage(space: Workspace) -> str:
    """Errors of the twin on the held-out samples, written beside it and into its card; returns the table.

    Raises:
        TwinError: the twin is missing, damaged or of another body.
        ConfigError: it was trained otherwise than the configuration says, or on other data.
        DataSetError: the held-out samples are not complete, or of another body or configuration.
    """
    data, body = current_data(space)
    surrogate = load(space.twin, body)
    check_trained(space, data, surrogate.card)
    with timed(space, "validate", validate_inputs(space, data)):
        evaluation = evaluate(surrogate, data)
        _write_predictions(space, surrogate, data)
        figures, text = evaluation.as_dict(), str(evaluation)
        more: dict[str, Any] = {"held_out": figures}
        if surrogate.card.get("certificate"):
            bounds = coverage(surrogate, data)
            text += f"\n\n{bounds}"
            more["certificate"] = {**surrogate.card["certificate"], "held_out": bounds.as_dict()}
        table = json.dumps({"table": text, "figures": figures}, indent=1)
        write_whole(space.folder / "validation.json", table)
        save(surrogate.with_card(**more), space.twin)
    return text


def _write_predictions(space: Workspace, surrogate: Surrogate, data: DataSet) -> None:
    """Errors of all held-out samples, and the fields of the median and the worst, for the report."""
    samples = data.samples("test")
    predicted = np.zeros_like(samples.displacements)
    for i, forces in enumerate(data.response.spread(samples.forces)):
        predicted[i] = surrogate.solve(forces).displacement
    errors = nodal_distances(predicted, samples.displacements).mean(axis=1)
    order = np.argsort(errors)
    shown = order[[len(order) // 2, -1]]
    partial = space.folder / ".validation.partial.npz"
    np.savez(
        partial,
        displacements_true=samples.displacements[shown],
        displacements_predicted=predicted[shown],
        errors_mean_m=errors,
        sizes_m=np.linalg.norm(samples.displacements, axis=2).max(axis=1),
    )
    os.replace(partial, space.folder / "validation.npz")
