"""The checkpoint that training goes on from, and the data that it belongs to."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from softtwin.reference.data.dataset import DataSet, Samples
from softtwin.reference.data.jacobians import mark

from .plan import TrainingPlan

CHECKPOINT = "training.ckpt"
VERSION = 2  # of how training goes on: raised where another optimizer or its usual settings would


class CheckpointError(ValueError):
    """A checkpoint that training cannot go on from: truncated, or of another version, plan or data set."""


def fingerprint(data: DataSet, splits: Mapping[str, Samples]) -> str:
    """SHA-256 of all that training reads: body, linear response, training and validation samples, Jacobians."""
    digest = hashlib.sha256(data.body.fingerprint.encode())
    arrays = [data.response.loaded, data.response.left, data.response.right, data.shapes]
    for samples in splits.values():
        arrays += [samples.draws, samples.forces, samples.displacements, samples.probes, samples.adjoints]
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    digest.update(mark(data).encode())
    return digest.hexdigest()


def read_checkpoint(path: Path, plan: TrainingPlan, mark: str) -> dict[str, Any]:
    """What `TrainingModule.take_back` goes on from.

    Args:
        path: of the checkpoint.
        plan: the plan that it must belong to.
        mark: fingerprint of the data that it must belong to.

    Raises:
        CheckpointError: it is truncated, or of another version of this program, plan or data set.
    """
    try:
        training_module: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)["course"]
        if "steps_made" not in training_module:
            raise KeyError("steps_made")
    except Exception as error:  # a damaged file fails in whichever layer reads it: zip, pickle, or the keys
        raise CheckpointError(
            f"train.folder: {path} cannot be read ({type(error).__name__}); it is truncated or no checkpoint of "
            "this program. Delete it to train from the start."
        ) from error
    if training_module.get("version", 1) != VERSION:
        raise CheckpointError(
            f"train.folder: {path} is of another version of this program, which trains in another way; choose another "
            "folder, or train from the start (`softtwin train --fresh`)."
        )
    wanted, usual = plan.entries(), TrainingPlan(type(plan.architecture)()).entries()
    stored = {**usual, **training_module["plan"]}  # a setting that is newer than the checkpoint was as usual
    differing = [name for name in wanted if stored[name] != wanted[name]]
    if differing:
        raise CheckpointError(
            f"train.folder: {path} belongs to another plan (differs in {', '.join(differing)}); choose another folder, "
            "the plan it was made with to go on, or train from the start (`softtwin train --fresh`)."
        )
    if training_module["data"] != mark:
        raise CheckpointError(
            f"train.folder: {path} belongs to another data set; choose another folder, or train "
            "from the start (`softtwin train --fresh`)."
        )
    return training_module
