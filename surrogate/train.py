"""Training through Lightning: a plan in, a frozen surrogate out; every round leaves a checkpoint to go on from."""

from __future__ import annotations

import hashlib
import logging
import math
import signal
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from torch import Tensor
from tqdm import tqdm

from softtwin.reference.dataset import REASONS, DataSet, Samples

from .mlp import PerceptronLesson
from .predictor import Frame, Surrogate, response_parts
from .reduced import ReducedLesson

Lesson = ReducedLesson | PerceptronLesson

CHECKPOINT = "training.ckpt"
ROUNDS = 40  # a round ends with a look at the validation split and a checkpoint
_WARM_UP = 200  # steps over which the learning rate rises
_RATES = {"reduced": 3e-3, "mlp": 1e-3}
_BATCHES = {"reduced": 128, "mlp": 50}


class CheckpointError(ValueError):
    """A checkpoint that training cannot go on from: truncated, or of another plan or data set."""


class Diverged(RuntimeError):  # noqa: N818 - a way to end, as NotConverged is
    """Training that produced no finite validation error: the message says what to try."""


@dataclass(frozen=True)
class TrainingPlan:
    """What to train, and how long.

    Args:
        architecture: `reduced`, or `mlp` for the thesis's perceptron.
        modes: POD modes of the reduced network at most.
        width: width of its blocks.
        depth: number of its blocks.
        seconds: time to train for; the number of steps is fixed at the start from the measured time of a step.
        epochs: passes over the training samples; given, it replaces `seconds`.
        batch: samples a step; None for the architecture's own: 128, or 50 for the perceptron (thesis: ten to fifty).
        learning_rate: highest of the cosine; None for the architecture's own: 3e-3, or 1e-3 for the perceptron.
        sobolev: weight of the gradient's error in the loss of the reduced network; 0 leaves it out.
        symmetries: use the body's symmetries in the reduced network, if it has any.
        samples: draws of the training split to use; None for all.
        seed: seed of weights and batches.

    Raises:
        ValueError: an argument out of its range.
    """

    architecture: Literal["reduced", "mlp"] = "reduced"
    modes: int = 64
    width: int = 256
    depth: int = 3
    seconds: float = 60.0
    epochs: int | None = None
    batch: int | None = None
    learning_rate: float | None = None
    sobolev: float = 0.03
    symmetries: bool = True
    samples: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.architecture not in _RATES:
            raise ValueError(f"TrainingPlan.architecture: expected one of {sorted(_RATES)}, got {self.architecture!r}.")
        for name in ("modes", "width", "depth", "epochs", "batch", "samples"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"TrainingPlan.{name}: expected at least 1, got {value}.")
        for name in ("seconds", "learning_rate"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"TrainingPlan.{name}: expected a positive number, got {value}.")
        if not 0.0 <= self.sobolev < math.inf:
            raise ValueError(f"TrainingPlan.sobolev: expected a number not below 0, got {self.sobolev}.")

    @property
    def rate(self) -> float:
        """Highest learning rate."""
        return self.learning_rate or _RATES[self.architecture]

    def batch_size(self, count: int) -> int:
        """Samples a step when there are so many."""
        return min(self.batch or _BATCHES[self.architecture], count)


def train(data: DataSet, plan: TrainingPlan, folder: Path | str | None = None) -> Surrogate:
    """A surrogate trained on the training split, its weights the best on the validation split.

    The test split is not read. With a folder, training that was interrupted goes on from its last round; batches
    depend on the seed and the round alone, so that it ends where an undisturbed run on the same machine does.

    Args:
        data: the data set.
        plan: what to train.
        folder: for the checkpoint; None for none that outlasts the call.

    Raises:
        CheckpointError: the folder's checkpoint is truncated, or of another plan or data set.
        DataSetError: the training or validation split is not complete.
        Diverged: no round ended with a finite validation error.
        ValueError: a split holds no accepted sample.
    """
    splits = {"train": data.samples("train", plan.samples), "validation": data.samples("validation")}
    for name, samples in splits.items():
        if len(samples) == 0:
            raise ValueError(f"train.data: expected accepted samples in the {name} split of {data.path}, got none.")
    mark = fingerprint(data, splits)
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(folder or temporary) / CHECKPOINT
        resumed = _read_checkpoint(path, plan, mark) if path.exists() else None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(plan.seed)
            lesson = _build_lesson(data, plan, splits).to(_device())
        steps = resumed["steps"] if resumed else _count_steps(lesson, plan)
        course = Course(lesson, plan, mark, steps)
        _fit(course, path, resumed is not None)
    if not course.best:
        raise Diverged(
            f"train: no finite validation error in {steps} steps at learning rate {plan.rate}; "
            "lower TrainingPlan.learning_rate."
        )
    lesson.network.load_state_dict(course.best)
    return _surrogate(lesson, data, _card(data, plan, splits, course))


def _device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


def _build_lesson(data: DataSet, plan: TrainingPlan, splits: dict[str, Samples]) -> Lesson:
    if plan.architecture == "mlp":
        return PerceptronLesson(splits["train"], splits["validation"])
    return ReducedLesson(
        data,
        splits["train"],
        splits["validation"],
        modes=plan.modes,
        width=plan.width,
        depth=plan.depth,
        sobolev=plan.sobolev,
        use_symmetries=plan.symmetries,
    )


def fingerprint(data: DataSet, splits: dict[str, Samples]) -> str:
    """SHA-256 of all that training reads: body, linear response, training and validation samples."""
    digest = hashlib.sha256(data.body.fingerprint.encode())
    arrays = [data.response.loaded, data.response.left, data.response.right, data.shapes]
    for samples in splits.values():
        arrays += [samples.draws, samples.forces, samples.displacements, samples.probes, samples.adjoints]
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


# ------------------------------------------------------------------ how long


def _count_steps(lesson: Lesson, plan: TrainingPlan) -> int:
    """Steps of the whole training, a multiple of the steps of a round."""
    batch = plan.batch_size(lesson.sample_count)
    if plan.epochs is not None:
        wanted = math.ceil(plan.epochs * lesson.sample_count / batch)
    else:
        wanted = max(1, int(plan.seconds / _step_time(lesson, plan, batch)))
    rounds = min(ROUNDS, wanted)
    return math.ceil(wanted / rounds) * rounds


def _step_time(lesson: Lesson, plan: TrainingPlan, batch: int) -> float:
    """Seconds of a training step, the median of some; the weights are put back."""
    start = {name: value.clone() for name, value in lesson.network.state_dict().items()}
    optimizer = _optimizer(lesson, plan, rate=1e-9)
    numbers = torch.arange(batch, device=next(lesson.network.parameters()).device)
    times: list[float] = []
    end = time.perf_counter() + min(3.0, 0.05 * plan.seconds)
    while len(times) < 8 or (time.perf_counter() < end and len(times) < 200):
        began = time.perf_counter()
        optimizer.zero_grad()
        loss = lesson.loss(numbers)
        loss.backward()
        optimizer.step()
        float(loss.detach())  # waits for an accelerator
        times.append(time.perf_counter() - began)
    lesson.network.load_state_dict(start)
    return float(np.median(times[3:]))


def _optimizer(lesson: Lesson, plan: TrainingPlan, rate: float) -> torch.optim.Optimizer:
    kind = torch.optim.Adam if plan.architecture == "mlp" else torch.optim.AdamW
    return kind(lesson.network.parameters(), lr=rate, fused=True)


@dataclass(frozen=True)
class Batches:
    """Sample numbers of each step of a round, shuffled passes one after the other: a loader without workers.

    Args:
        count: number of samples.
        batch: samples a step.
        steps: steps of the round.
        seed: seed of the training.
        number: number of the round; with the seed it decides the order.
    """

    count: int
    batch: int
    steps: int
    seed: int
    number: int

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[Tensor]:
        rng = np.random.default_rng([self.seed, self.number])
        passes = math.ceil(self.steps * self.batch / self.count)
        numbers = np.concatenate([rng.permutation(self.count) for _ in range(passes)])
        return iter(torch.from_numpy(numbers[: self.steps * self.batch]).split(self.batch))


# ------------------------------------------------------------------ Lightning


class Course(lightning.LightningModule):
    """A lesson under Lightning: one epoch is a round; the best weights on the validation split are kept.

    Args:
        lesson: network, data and loss.
        plan: how to train.
        mark: fingerprint of the data.
        steps: optimiser steps of the whole training, a multiple of the number of rounds.
    """

    def __init__(self, lesson: Lesson, plan: TrainingPlan, mark: str, steps: int) -> None:
        super().__init__()
        self.lesson = lesson
        self.plan, self.mark, self.steps = plan, mark, steps
        self.rounds = min(ROUNDS, steps)
        self.best: dict[str, Tensor] = {}
        self.best_error = math.inf
        self.seconds = 0.0

    def configure_optimizers(self) -> Any:
        """AdamW (Adam for the perceptron) with a short warm-up and a cosine down to zero, step by step."""
        optimizer = _optimizer(self.lesson, self.plan, self.plan.rate)
        warm = min(_WARM_UP, max(1, self.steps // 10))

        def factor(step: int) -> float:
            return min(1.0, (step + 1) / warm) * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / self.steps)))

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def train_dataloader(self) -> Batches:
        """Sample numbers of the steps of the current round."""
        count = self.lesson.sample_count
        steps = self.steps // self.rounds
        return Batches(count, self.plan.batch_size(count), steps, self.plan.seed, self.current_epoch)

    def on_train_epoch_start(self) -> None:
        """Start the round's clock."""
        self._began = time.perf_counter()

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        """Loss of one batch."""
        return self.lesson.loss(batch)

    def on_train_epoch_end(self) -> None:
        """Look at the validation split and keep the weights if they are the best so far."""
        self.seconds += time.perf_counter() - self._began
        self.error = self.lesson.error()
        if self.error < self.best_error:
            self.best_error = self.error
            self.best = {name: value.detach().clone() for name, value in self.lesson.network.state_dict().items()}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what Lightning does not know of."""
        checkpoint["course"] = {
            "plan": asdict(self.plan),
            "data": self.mark,
            "steps": self.steps,
            "best": self.best,
            "best_error": self.best_error,
            "seconds": self.seconds,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take it back."""
        course = checkpoint["course"]
        self.best, self.best_error, self.seconds = course["best"], course["best_error"], course["seconds"]


class _Progress(Callback):
    """One bar over all steps: rate, time left, validation error; quiet when not a terminal."""

    def on_train_start(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        self._bar = tqdm(total=pl_module.steps, initial=trainer.global_step, desc="training", unit="step", disable=None)

    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module: Any, *_: Any) -> None:
        self._bar.update()

    def on_train_epoch_start(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        if pl_module.best:
            self._bar.set_postfix_str(f"validation {pl_module.best_error:.3g}", refresh=False)

    def on_train_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        self._bar.close()

    def on_exception(self, trainer: lightning.Trainer, pl_module: Any, exception: BaseException) -> None:
        if hasattr(self, "_bar"):
            self._bar.close()


def _fit(course: Course, path: Path, resume: bool) -> None:
    with _quiet(), _interruptible():
        keeper = ModelCheckpoint(
            dirpath=path.parent,
            filename=path.stem,
            save_on_train_epoch_end=True,
            enable_version_counter=False,
        )
        trainer = lightning.Trainer(
            accelerator="gpu" if _device() == "cuda" else "cpu",
            devices=1,
            plugins=LightningEnvironment(),  # else it looks for MPI and starts it
            max_epochs=course.rounds,
            reload_dataloaders_every_n_epochs=1,
            callbacks=[keeper, _Progress()],
            logger=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=path.parent,
        )
        trainer.fit(course, ckpt_path=path if resume else None)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Lightning's advice: its hints on hardware, loaders and folders are no concern of the user here."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric", "lightning")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
            warnings.filterwarnings("ignore", message=".*LeafSpec.* is deprecated", category=FutureWarning)
            warnings.filterwarnings("ignore", category=UserWarning, module=r"lightning\.")
            warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"lightning\.")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C stays a KeyboardInterrupt: Lightning turns it into an exit and leaves the signal ignored."""
    main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    except SystemExit as error:
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise
    finally:
        if main:
            signal.signal(signal.SIGINT, handler)


def _read_checkpoint(path: Path, plan: TrainingPlan, mark: str) -> dict[str, Any]:
    try:
        course: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)["course"]
    except Exception as error:  # a damaged file fails in whichever layer reads it: zip, pickle, or the keys
        raise CheckpointError(
            f"train.folder: {path} cannot be read ({type(error).__name__}); it is truncated or no checkpoint of "
            "this program. Delete it to train from the start."
        ) from error
    wanted = asdict(plan)
    differing = [name for name in wanted if course["plan"].get(name, ...) != wanted[name]]
    if differing:
        raise CheckpointError(
            f"train.folder: {path} belongs to another plan (differs in {', '.join(differing)}); choose another folder, "
            "or the plan it was made with to go on."
        )
    if course["data"] != mark:
        raise CheckpointError(f"train.folder: {path} belongs to another data set; choose another folder.")
    return course


# ------------------------------------------------------------------ the result


def _surrogate(lesson: Lesson, data: DataSet, card: dict[str, Any]) -> Surrogate:
    loaded, size = data.response.loaded, data.body.points.size
    if isinstance(lesson, PerceptronLesson):
        first, core, last, bias = lesson.layers()
        frame = Frame(loaded, first, last, bias, np.zeros((size, 0)), np.zeros((0, first.shape[1])))
        return Surrogate(data.body, frame, core, card)
    basis = lesson.basis
    left, right = response_parts(data.response)
    frame = Frame(loaded, np.ascontiguousarray(basis.restricted.T), basis.modes, np.zeros(size), left, right)
    return Surrogate(data.body, frame, lesson.core(), card)


def _card(data: DataSet, plan: TrainingPlan, splits: dict[str, Samples], course: Course) -> dict[str, Any]:
    train_split = splits["train"]
    reasons = data.figures("train")["reason"][: plan.samples]
    rejected = Counter(REASONS[int(reason)] for reason in reasons if reason)
    return {
        "architecture": plan.architecture,
        "plan": asdict(plan),
        "data": {
            "path": str(data.path),
            "fingerprint": course.mark,
            "versions": data.header.get("versions", {}),
            "plan": data.header.get("plan", {}),
        },
        "samples": {**{name: len(samples) for name, samples in splits.items()}, "rejected": dict(rejected)},
        "training": {
            "parameters": sum(p.numel() for p in course.lesson.network.parameters()),
            "steps": course.steps,
            "seconds": course.seconds,
            "validation_error": course.best_error,
            "device": _device(),
            "versions": {"torch": torch.__version__, "lightning": lightning.__version__},
        },
        "domain": {
            "largest_displacement_m": _peak(train_split.displacements),
            "largest_nodal_force_n": _peak(train_split.forces),
            "largest_net_force_n": float(np.linalg.norm(train_split.forces.sum(axis=1), axis=1).max()),
            "loaded_nodes": len(data.response.loaded),
        },
    }


def _peak(fields: Any) -> float:
    return float(np.linalg.norm(fields, axis=-1).max())
