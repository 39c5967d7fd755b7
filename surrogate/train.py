"""Training: a plan in, a surrogate with frozen weights out."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from softtwin.meshes.metrics import relative_error
from softtwin.reference.data.dataset import DataSet, Samples
from softtwin.reference.data.schema import Reason

from .architecture import FittedArchitecture
from .checkpoint import CHECKPOINT, fingerprint, read_checkpoint
from .model import Surrogate
from .physics import with_physics
from .plan import TrainingPlan, chosen_device


def train(
    data: DataSet, plan: TrainingPlan, folder: Path | str | None = None, clock: Callable[[], float] = time.monotonic
) -> Surrogate:
    """A surrogate trained on the training split, its weights the best on the validation split.

    The test split is not read. With a folder, training that was interrupted goes on from its last round, with the
    epochs or seconds that are left; batches depend on the seed and the round alone, so that a training by epochs
    ends where an undisturbed run on the same machine does.

    Args:
        data: the data set.
        plan: what to train.
        folder: for the checkpoint and `logs/`; None for none that outlasts the call.
        clock: seconds since whenever; `plan.seconds` is measured with it.

    Raises:
        CheckpointError: the folder's checkpoint is truncated, or of another version, plan or data set.
        DataSetError: the training or validation split is not complete.
        Diverged: the validation error is no finite number any more.
        ValueError: a GPU is asked for and there is none; a split holds no accepted sample, or numbers that are not
            finite.
    """
    where = chosen_device(plan)
    splits = {"train": data.samples("train", plan.samples), "validation": data.samples("validation")}
    for name, samples in splits.items():
        _check_split(data, name, samples)
    mark = fingerprint(data, splits)
    if isinstance(plan.architecture, FittedArchitecture):
        return _fitted(data, plan, splits, mark, clock)
    import lightning  # takes seconds, which what is made at once, or only evaluated, need not wait for

    from .training_module import TrainingModule, fit

    with tempfile.TemporaryDirectory() as temporary:
        path = Path(folder or temporary) / CHECKPOINT
        resumed = read_checkpoint(path, plan, mark) if path.exists() else None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(plan.seed)
            objective = plan.trained.objective(data, splits["train"], splits["validation"])
        objective = with_physics(objective, data, plan.physics).to(where)
        training_module = TrainingModule(objective, plan, mark, clock)
        if resumed:
            training_module.take_back(resumed)
        if training_module.share < 1.0:
            fit(training_module, path, resumed is not None, log=folder is not None)
    objective.network.load_state_dict(training_module.best)
    training = {
        "parameters": sum(p.numel() for p in training_module.objective.network.parameters()),
        "steps": training_module.steps_made,
        "seconds": training_module.seconds,
        "validation_error": training_module.best_error,
        "device": where,
        "versions": {"torch": torch.__version__, "lightning": lightning.__version__},
    }
    card = _card(data, plan, splits, mark, training)
    return Surrogate(data.body, objective.encoder_decoder(), objective.trained(), card)


def _fitted(
    data: DataSet, plan: TrainingPlan, splits: dict[str, Samples], mark: str, clock: Callable[[], float]
) -> Surrogate:
    """The surrogate of an architecture that is made at once."""
    assert isinstance(plan.architecture, FittedArchitecture)
    if plan.physics is not None:
        raise ValueError(f"train.plan: expected no physics in the loss of {plan.architecture.name}, which has no loss.")
    begin = clock()
    encoder_decoder, network = plan.architecture.fitted(data, splits["train"])
    training = {
        "parameters": sum(values.numel() for values in network.buffers()),
        "steps": 0,
        "seconds": clock() - begin,
        "device": "cpu",
        "versions": {"torch": torch.__version__},
    }
    surrogate = Surrogate(data.body, encoder_decoder, network, _card(data, plan, splits, mark, training))
    found = relative_error(_predicted(surrogate, data, splits["validation"]), splits["validation"].displacements)
    return surrogate.with_card(training={**training, "validation_error": float(np.median(found))})


def _predicted(surrogate: Surrogate, data: DataSet, samples: Samples) -> Any:
    return np.stack([surrogate.solve(load).displacement for load in data.response.spread(samples.forces)])


def _check_split(data: DataSet, name: str, samples: Samples) -> None:
    if len(samples) == 0:
        raise ValueError(f"train.data: expected accepted samples in the {name} split of {data.path}, got none.")
    arrays = (samples.forces, samples.displacements, samples.probes, samples.adjoints)
    wrong = sum(not all(np.isfinite(array[i]).all() for array in arrays) for i in range(len(samples)))
    if wrong:
        raise ValueError(
            f"train.data: expected finite numbers in the {name} split of {data.path}, got {wrong} of {len(samples)} "
            "samples with others; make the data set again with smaller loads."
        )


def _card(
    data: DataSet, plan: TrainingPlan, splits: dict[str, Samples], mark: str, training: dict[str, Any]
) -> dict[str, Any]:
    train_split = splits["train"]
    reasons = data.figures("train")["reason"][: plan.samples]
    rejected = Counter(Reason(reason).words for reason in reasons if reason)
    return {
        "architecture": plan.architecture.name,
        "plan": plan.entries(),
        "data": {
            "path": str(data.path),
            "fingerprint": mark,
            "identity": data.identity,
            "versions": data.header.get("versions", {}),
            "plan": data.header.get("plan", {}),
            **{name: data.header[name] for name in ("merged",) if name in data.header},
        },
        "samples": {**{name: len(samples) for name, samples in splits.items()}, "rejected": dict(rejected)},
        "training": training,
        "domain": {
            "largest_displacement_m": _peak(train_split.displacements),
            "largest_nodal_force_n": _peak(train_split.forces),
            "largest_net_force_n": float(np.linalg.norm(train_split.forces.sum(axis=1), axis=1).max()),
            "loaded_nodes": len(data.response.loaded),
        },
    }


def _peak(fields: Any) -> float:
    return float(np.linalg.norm(fields, axis=-1).max())
