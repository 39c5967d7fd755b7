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
from collections.abc import Callable, Iterator
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
_WARM_TENTHS = 10.0
_ENDLESS = 10**9  # steps of a round that the clock ends
_RATES = {"reduced": 3e-3, "mlp": 1e-3}
_BATCHES = {"reduced": 128, "mlp": 50}


class CheckpointError(ValueError):
    """A checkpoint that training cannot go on from: truncated, or of another plan or data set."""


class Diverged(RuntimeError):  # noqa: N818 - a way to end, as NotConverged is
    """Training whose validation error is no finite number any more: the message says what to try."""


@dataclass(frozen=True)
class TrainingPlan:
    """What to train, and how long.

    Args:
        architecture: `reduced`, or `mlp` for the thesis's perceptron.
        modes: POD modes of the reduced network at most.
        width: width of its blocks.
        depth: number of its blocks.
        seconds: wall time of the steps, the looks at the validation split and the checkpoints together. The clock is
            looked at before every step, so that training ends with the step that is under way when the time is over,
            on a busy machine too (with fewer steps then). Reading the data and finding the modes come before it.
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
        folder: for the checkpoint; None for none that outlasts the call.
        clock: seconds since whenever; `plan.seconds` is measured with it.

    Raises:
        CheckpointError: the folder's checkpoint is truncated, or of another plan or data set.
        DataSetError: the training or validation split is not complete.
        Diverged: the validation error is no finite number any more.
        ValueError: a split holds no accepted sample, or numbers that are not finite.
    """
    splits = {"train": data.samples("train", plan.samples), "validation": data.samples("validation")}
    for name, samples in splits.items():
        _check_split(data, name, samples)
    mark = fingerprint(data, splits)
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(folder or temporary) / CHECKPOINT
        resumed = _read_checkpoint(path, plan, mark) if path.exists() else None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(plan.seed)
            lesson = _build_lesson(data, plan, splits).to(_device())
        course = Course(lesson, plan, mark, clock)
        if resumed:
            course.take_back(resumed)
        if course.share < 1.0:
            _fit(course, path, resumed is not None)
    lesson.network.load_state_dict(course.best)
    return _surrogate(lesson, data, _card(data, plan, splits, course))


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


def _count_steps(plan: TrainingPlan, sample_count: int) -> int | None:
    """Steps of a training by epochs, a multiple of the steps of a round; None where the clock ends it."""
    if plan.epochs is None:
        return None
    wanted = math.ceil(plan.epochs * sample_count / plan.batch_size(sample_count))
    rounds = min(ROUNDS, wanted)
    return math.ceil(wanted / rounds) * rounds


def rate_factor(step: int, share: float) -> float:
    """Part of the highest learning rate: a warm-up, then a cosine down to zero at the end of the budget.

    Args:
        step: steps that were made.
        share: part of the epochs or seconds that were used, 0 to 1.
    """
    warm = max((step + 1) / _WARM_UP, _WARM_TENTHS * share)  # 200 steps, or a tenth of a training that is shorter
    return min(1.0, warm) * 0.5 * (1.0 + math.cos(math.pi * min(1.0, share)))


def _optimizer(lesson: Lesson, plan: TrainingPlan) -> torch.optim.Optimizer:
    kind = torch.optim.Adam if plan.architecture == "mlp" else torch.optim.AdamW
    return kind(lesson.network.parameters(), lr=plan.rate, fused=True)


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
        waiting = np.empty(0, dtype=np.int64)
        for _ in range(self.steps):
            while len(waiting) < self.batch:
                waiting = np.concatenate([waiting, rng.permutation(self.count)])
            yield torch.from_numpy(waiting[: self.batch])
            waiting = waiting[self.batch :]


# ------------------------------------------------------------------ Lightning


class Course(lightning.LightningModule):
    """A lesson under Lightning: one epoch is a round; the best weights on the validation split are kept.

    A round is a part of the steps, or of the time by the clock; it holds at least one step.

    Args:
        lesson: network, data and loss.
        plan: how to train.
        mark: fingerprint of the data.
        clock: seconds since whenever.
    """

    def __init__(
        self, lesson: Lesson, plan: TrainingPlan, mark: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__()
        self.lesson = lesson
        self.plan, self.mark, self.clock = plan, mark, clock
        self.steps = _count_steps(plan, lesson.sample_count)
        self.rounds = ROUNDS if self.steps is None else min(ROUNDS, self.steps)
        self.best: dict[str, Tensor] = {}
        self.best_error = math.inf
        self.seconds = 0.0
        self.steps_made = 0

    @property
    def share(self) -> float:
        """Part of the epochs or seconds that were used, as far as the clock was looked at."""
        return self.seconds / self.plan.seconds if self.steps is None else self.steps_made / self.steps

    def configure_optimizers(self) -> Any:
        """AdamW (Adam for the perceptron); its rate is set before every step."""
        return _optimizer(self.lesson, self.plan)

    def train_dataloader(self) -> Batches:
        """Sample numbers of the steps of the current round."""
        count = self.lesson.sample_count
        steps = _ENDLESS if self.steps is None else self.steps // self.rounds
        return Batches(count, self.plan.batch_size(count), steps, self.plan.seed, self.current_epoch)

    def on_train_start(self) -> None:
        """Start the clock, where an interrupted training left it."""
        self._origin = self.clock() - self.seconds

    def on_train_epoch_start(self) -> None:
        """Find where the round ends: at the next part of the time; batches end the others."""
        self._round_end = math.inf if self.steps is not None else (math.floor(ROUNDS * self.share) + 1) / ROUNDS

    def on_train_batch_start(self, batch: Tensor, batch_idx: int) -> int | None:
        """Look at the clock: -1 ends the round, else the step gets its learning rate."""
        self._look()
        over = self.share >= 1.0 and self.steps_made > 0
        if over or (batch_idx > 0 and self.share >= self._round_end):
            return -1
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = self.plan.rate * rate_factor(self.steps_made, self.share)
        return None

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        """Loss of one batch."""
        return self.lesson.loss(batch)

    def on_train_epoch_end(self) -> None:
        """Look at the validation split and keep the weights if they are the best so far."""
        error = self.lesson.error()
        self._look()
        if not math.isfinite(error):
            raise Diverged(
                f"train: the validation error is {error} after {self.steps_made} steps at learning rate "
                f"{self.plan.rate}; lower TrainingPlan.learning_rate."
            )
        if error < self.best_error:
            self.best_error = error
            self.best = {name: value.detach().clone() for name, value in self.lesson.network.state_dict().items()}
        if self.share >= 1.0:
            self.trainer.should_stop = True

    def _look(self) -> None:
        self.seconds = self.clock() - self._origin
        self.steps_made = self.trainer.global_step

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what Lightning does not know of."""
        checkpoint["course"] = {
            "plan": asdict(self.plan),
            "data": self.mark,
            "steps_made": self.steps_made,
            "best": self.best,
            "best_error": self.best_error,
            "seconds": self.seconds,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take it back."""
        self.take_back(checkpoint["course"])

    def take_back(self, course: dict[str, Any]) -> None:
        """Go on from what `on_save_checkpoint` added."""
        for name in ("best", "best_error", "seconds", "steps_made"):
            setattr(self, name, course[name])


class _Progress(Callback):
    """One bar over the steps or the seconds: time left, validation error; quiet when not a terminal."""

    def on_train_start(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        by_clock = pl_module.steps is None
        layout = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s{postfix}" if by_clock else None
        total = pl_module.plan.seconds if by_clock else pl_module.steps
        self._bar = tqdm(total=total, desc="training", unit="step", bar_format=layout, disable=None)

    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module: Any, *_: Any) -> None:
        used = trainer.global_step if pl_module.steps is not None else min(pl_module.seconds, self._bar.total or 0.0)
        self._bar.update(used - self._bar.n)

    def on_train_epoch_start(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        if pl_module.best:
            said = f", step {trainer.global_step}, validation {pl_module.best_error:.3g}"
            self._bar.set_postfix_str(said, refresh=False)

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
        if "steps_made" not in course:
            raise KeyError("steps_made")
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
            "the plan it was made with to go on, or train from the start (`softtwin train --fresh`)."
        )
    if course["data"] != mark:
        raise CheckpointError(
            f"train.folder: {path} belongs to another data set; choose another folder, or train "
            "from the start (`softtwin train --fresh`)."
        )
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
            "identity": data.identity,
            "versions": data.header.get("versions", {}),
            "plan": data.header.get("plan", {}),
        },
        "samples": {**{name: len(samples) for name, samples in splits.items()}, "rejected": dict(rejected)},
        "training": {
            "parameters": sum(p.numel() for p in course.lesson.network.parameters()),
            "steps": course.steps_made,
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
