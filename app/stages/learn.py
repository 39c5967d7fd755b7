"""The stages that need torch: training the surrogate, writing the twin, measuring it on held-out samples."""

from __future__ import annotations

import json
import shutil

import numpy as np

from softtwin.meshes.files import read_body
from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.dataset import DataSet
from softtwin.surrogate.domain import with_domain
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.predictor import Surrogate, load, save
from softtwin.surrogate.train import TrainingPlan, train

from ..config import to_toml
from ..workspace import Workspace, timed


def train_stage(space: Workspace) -> Surrogate:
    """Train on the data set and write the twin: body, weights, card, configuration. Goes on from the last checkpoint.

    Raises:
        DataSetError: the data set is missing, damaged or not complete.
        CheckpointError: the checkpoint is truncated, or of another plan or data set.
    """
    section = space.config.training
    plan = TrainingPlan(
        architecture=section.architecture,
        modes=section.modes,
        width=section.width,
        seconds=section.seconds,
        seed=section.seed,
    )
    with timed(space, "train"):
        data = DataSet(space.data)
        surrogate = with_domain(train(data, plan, space.training), data)
        save(surrogate, space.twin)
    shutil.copyfile(space.body, space.twin / "body.vtu")
    (space.twin / "organ.toml").write_text(to_toml(space.config))
    return surrogate


def validate_stage(space: Workspace) -> str:
    """Errors of the twin on the held-out samples, written beside it and into its card; returns the table.

    Raises:
        TwinError: the twin is missing, damaged or of another body.
        DataSetError: the held-out samples are not complete.
    """
    data = DataSet(space.data)
    with timed(space, "validate"):
        surrogate = load(space.twin, read_body(space.body))
        evaluation = evaluate(surrogate, data)
        _write_predictions(space, surrogate, data)
    figures = evaluation.as_dict()
    (space.folder / "validation.json").write_text(json.dumps({"table": str(evaluation), "figures": figures}, indent=1))
    save(surrogate.with_card(held_out=figures), space.twin)
    return str(evaluation)


def _write_predictions(space: Workspace, surrogate: Surrogate, data: DataSet) -> None:
    """Errors of all held-out samples, and the fields of the median and the worst, for the report."""
    samples = data.samples("test")
    predicted = np.zeros_like(samples.displacements)
    for i, loads in enumerate(samples.forces):
        forces = np.zeros_like(data.body.points)
        forces[data.response.loaded] = loads
        predicted[i] = surrogate.solve(forces).displacement
    errors = nodal_distances(predicted, samples.displacements).mean(axis=1)
    order = np.argsort(errors)
    shown = order[[len(order) // 2, -1]]
    np.savez(
        space.folder / "validation.npz",
        displacements_true=samples.displacements[shown],
        displacements_predicted=predicted[shown],
        errors_mean_m=errors,
        sizes_m=np.linalg.norm(samples.displacements, axis=2).max(axis=1),
    )
