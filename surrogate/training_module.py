"""A training under Lightning: rounds, the clock, the learning rate, a progress bar, checkpoints."""

from __future__ import annotations

import logging
import math
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor
from tqdm import tqdm

from .checkpoint import VERSION
from .plan import TrainingPlan, chosen_device
from .precision import forbid_onednn, forbid_tf32, without_onednn, without_tf32

ROUNDS = 40  # a round ends with a look at the validation split and a checkpoint
_WARM_UP = 200  # steps over which the learning rate rises
_WARM_TENTHS = 10.0
_ADVISERS = ("lightning.pytorch", "lightning.fabric", "lightning")
_ENDLESS = 10**9  # steps of a round that the clock ends


class Diverged(RuntimeError):  # noqa: N818 - a way to end, as NotConverged is
    """Training whose validation error is no finite number any more: the message says what to try."""


def _count_steps(plan: TrainingPlan, sample_count: int) -> int | None:
    """Steps of a training by epochs, a multiple of the steps of a round; None where the clock ends it.

    Args:
        plan: how to train.
        sample_count: of the lesson, symmetric images counted.
    """
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


@dataclass(frozen=True)
class Batches:
    """Sample numbers of each step of a round, shuffled passes one after the other: a loader without workers.

    Args:
        count: number of samples, symmetric images counted.
        batch: samples a step.
        steps: steps of the round.
        seed: seed of the training.
        number: number of the round; with the seed it decides the order.
        part: which part of each step's samples, of how many parts: one for each process.
    """

    count: int
    batch: int
    steps: int
    seed: int
    number: int
    part: tuple[int, int] = (0, 1)

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[Tensor]:
        rng = np.random.default_rng([self.seed, self.number])
        waiting = np.empty(0, dtype=np.int64)
        for _ in range(self.steps):
            while len(waiting) < self.batch:
                waiting = np.concatenate([waiting, rng.permutation(self.count)])
            yield torch.from_numpy(waiting[: self.batch][self.part[0] :: self.part[1]])
            waiting = waiting[self.batch :]


class TrainingModule(lightning.LightningModule):
    """A lesson under Lightning: one epoch is a round; the best weights on the validation split are kept.

    A round is a part of the steps, or of the time by the clock; it holds at least one step.

    Args:
        objective: network, data and loss.
        plan: how to train.
        mark: fingerprint of the data.
        clock: seconds since whenever.
    """

    def __init__(
        self, objective: Any, plan: TrainingPlan, mark: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__()
        self.objective = objective
        self.plan, self.mark, self.clock = plan, mark, clock
        self.steps = _count_steps(plan, objective.sample_count)
        self.rounds = ROUNDS if self.steps is None else min(ROUNDS, self.steps)
        self.best: dict[str, Tensor] = {}
        self.best_error = math.inf
        self.stale = 0  # rounds since then
        self._loss, self._count = torch.zeros(()), 0  # of the round
        self.seconds = 0.0
        self.steps_made = 0

    def __setstate__(self, state: Any) -> None:
        """Only a process that was started to help takes a course from another: no advice of Lightning's there."""
        super().__setstate__(state)
        _hush()
        if self.plan.precision == "single":
            forbid_tf32()
        elif chosen_device(self.plan) == "cpu":
            forbid_onednn()

    @property
    def share(self) -> float:
        """Part of the epochs or seconds that were used, as far as the clock was looked at."""
        return self.seconds / self.plan.seconds if self.steps is None else self.steps_made / self.steps

    def configure_optimizers(self) -> Any:
        """The architecture's."""
        return self.plan.trained.optimizer(self.objective.network, self.plan.rate)

    def train_dataloader(self) -> Batches:
        """Sample numbers of the steps of the current round."""
        count = self.objective.sample_count
        steps = _ENDLESS if self.steps is None else self.steps // self.rounds
        part = (self.global_rank, self.trainer.world_size)
        return Batches(count, self.plan.batch_size(count), steps, self.plan.seed, self.current_epoch, part)

    def on_train_start(self) -> None:
        """Start the clock, where an interrupted training left it."""
        self._origin = self.clock() - self.seconds

    def on_train_epoch_start(self) -> None:
        """Find where the round ends: at the next part of the time; batches end the others."""
        self._round_end = (
            math.inf if self.steps is not None else (math.floor(self.rounds * self.share) + 1) / self.rounds
        )

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
        loss: Tensor = self.objective.loss(batch)
        self._loss, self._count = self._loss.to(loss.device) + loss.detach(), self._count + 1
        return loss

    def on_train_epoch_end(self) -> None:
        """Look at the validation split and keep the weights if they are the best so far."""
        error = self.objective.error()
        self._look()
        if not math.isfinite(error):
            raise Diverged(
                f"train: the validation error is {error} after {self.steps_made} steps at learning rate "
                f"{self.plan.rate}; lower TrainingPlan.learning_rate."
            )
        self._log(error)
        self.stale += 1
        if error < self.best_error:
            self.best_error, self.stale = error, 0
            self.best = {name: value.detach().clone() for name, value in self.objective.network.state_dict().items()}
        if self.share >= 1.0 or self.stale == self.plan.patience:
            self.trainer.should_stop = True

    def _log(self, error: float) -> None:
        """One line of the round, where training has a folder."""
        rate = self.trainer.optimizers[0].param_groups[0]["lr"]
        loss = float(self._loss) / max(self._count, 1)
        line = {"seconds": self.seconds, "loss": loss, "validation_error": error, "learning_rate": rate}
        for logger in self.loggers:
            logger.log_metrics(line, step=self.steps_made)
            logger.save()
        self._loss, self._count = torch.zeros(()), 0

    def _look(self) -> None:
        """Of several processes the first has the clock, so that all end a round at the same step."""
        seconds = torch.tensor(self.clock() - self._origin, dtype=torch.float64, device=self.device)
        if self.trainer.world_size > 1:
            torch.distributed.broadcast(seconds, src=0)
        self.seconds = float(seconds)
        self.steps_made = self.trainer.global_step

    def teardown(self, stage: str) -> None:
        """Processes part before they end: gloo's threads abort one that ends while they wait for another."""
        if self.trainer.world_size > 1 and torch.distributed.is_initialized():
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what Lightning does not know of."""
        checkpoint["course"] = {
            "version": VERSION,
            "plan": self.plan.entries(),
            "data": self.mark,
            "steps_made": self.steps_made,
            "best": self.best,
            "best_error": self.best_error,
            "seconds": self.seconds,
            "stale": self.stale,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take it back; weights of a training begun under an earlier name are read, too."""
        weights = checkpoint["state_dict"]
        checkpoint["state_dict"] = {re.sub(r"^lesson\.", "objective.", name): value for name, value in weights.items()}
        self.take_back(checkpoint["course"])

    def take_back(self, training_module: dict[str, Any]) -> None:
        """Go on from what `on_save_checkpoint` added."""
        for name in ("best", "best_error", "seconds", "steps_made"):
            setattr(self, name, training_module[name])
        self.stale = training_module.get("stale", 0)


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


def fit(training_module: TrainingModule, path: Path, resume: bool, log: bool = False) -> None:
    """Train to the end of the plan; every round leaves a checkpoint. In single precision a GPU multiplies without TF32.

    Args:
        training_module: what to train.
        path: of the checkpoint.
        resume: go on from it.
        log: leave a line for each round beside it, as CSV and for TensorBoard, in a folder of its own for each run.
    """
    device, is_single = chosen_device(training_module.plan), training_module.plan.precision == "single"
    kernels = without_onednn(device == "cpu" and not is_single)
    with _quiet(), _interruptible(), without_tf32(is_single), kernels:
        keeper = ModelCheckpoint(
            dirpath=path.parent,
            filename=path.stem,
            save_on_train_epoch_end=True,
            enable_version_counter=False,
        )
        several = training_module.plan.processes > 1
        trainer = lightning.Trainer(
            accelerator="gpu" if device == "cuda" else "cpu",
            devices=training_module.plan.processes,
            strategy=_together(device) if several else "auto",
            precision="bf16-mixed" if training_module.plan.precision == "mixed" else "32-true",
            use_distributed_sampler=False,
            plugins=LightningEnvironment(),  # else it looks for MPI and starts it
            max_epochs=training_module.rounds,
            reload_dataloaders_every_n_epochs=1,
            callbacks=[keeper, _Progress()],
            logger=_logs(path.parent) if log else False,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=path.parent,
        )
        trainer.fit(training_module, ckpt_path=path if resume else None)
    if several:  # what the others did is in the checkpoint alone
        training_module.take_back(torch.load(path, map_location="cpu", weights_only=True)["course"])


def _together(device: str) -> DDPStrategy:
    backend = "nccl" if device == "cuda" else "gloo"  # the buffers are data, alike everywhere and never written
    return DDPStrategy(start_method="spawn", process_group_backend=backend, broadcast_buffers=False)


def _logs(folder: Path) -> list[Logger]:
    table = CSVLogger(folder, name="logs")
    return [table, TensorBoardLogger(folder, name="logs", version=f"version_{table.version}")]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Lightning's advice: its hints on hardware, loaders and folders are no concern of the user here."""
    loggers = [logging.getLogger(name) for name in _ADVISERS]
    levels = [logger.level for logger in loggers]
    try:
        with warnings.catch_warnings():
            _hush()
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _hush() -> None:
    for name in _ADVISERS:
        logging.getLogger(name).setLevel(logging.ERROR)
    # Its successor would send all buffers, which are the data, at the start; older torch does not know it.
    warnings.filterwarnings("ignore", message=".*broadcast_buffers.*is deprecated")
    warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
    warnings.filterwarnings("ignore", message=".*LeafSpec.* is deprecated", category=FutureWarning)
    warnings.filterwarnings("ignore", category=UserWarning, module=r"lightning\.")
    warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"lightning\.")


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
