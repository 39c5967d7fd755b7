"""What to train, and how long."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, get_args

import torch

from .architecture import Architecture, TrainedArchitecture
from .physics import Physics
from .reduced import Reduced

Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["single", "mixed"]


@dataclass(frozen=True)
class TrainingPlan:
    """What to train, and how long.

    Args:
        architecture: the kind of network with its settings.
        seconds: wall time of the steps, the looks at the validation split and the checkpoints together. The clock is
            looked at before every step, so that training ends with the step that is under way when the time is over,
            on a busy machine too (with fewer steps then). Reading the data and finding the modes come before it.
        epochs: passes over all that a network learns from: the training samples and, of a reduced network, their
            symmetric images, of which one pass is as many over the samples as the body has symmetries. Given, it
            replaces `seconds`.
        batch: samples a step; None for the architecture's own.
        learning_rate: highest of the cosine; None for the architecture's own.
        samples: draws of the training split to use; None for all.
        seed: seed of weights and batches.
        physics: what is asked of predictions beside, or instead of, the data; None for the data alone.
        patience: training ends after so many of its 40 rounds without a smaller validation error; None: never early.
        precision: `single`, or `mixed`: products of matrices in bfloat16, which has three digits; it suits large
            networks on a GPU, and not one that is to be right to a thousandth.
        device: where to train; `auto` takes a GPU where torch sees one.
        processes: that share each batch, on a GPU each, or on the cores of one machine. They learn what one would, from
            whole Jacobians in the mean: each process draws directions of its own.

    Raises:
        ValueError: an argument out of its range.
    """

    architecture: Architecture = field(default_factory=Reduced)
    seconds: float = 60.0
    epochs: int | None = None
    batch: int | None = None
    learning_rate: float | None = None
    samples: int | None = None
    seed: int = 0
    physics: Physics | None = None
    patience: int | None = None
    precision: Precision = "single"
    device: Device = "auto"
    processes: int = 1

    def __post_init__(self) -> None:
        for name in ("epochs", "batch", "samples", "patience", "processes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"TrainingPlan.{name}: expected at least 1, got {value}.")
        for name in ("seconds", "learning_rate"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"TrainingPlan.{name}: expected a positive number, got {value}.")
        if self.device not in get_args(Device):
            raise ValueError(f"TrainingPlan.device: expected one of {get_args(Device)}, got {self.device!r}.")
        if self.precision not in get_args(Precision):
            raise ValueError(f"TrainingPlan.precision: expected one of {get_args(Precision)}, got {self.precision!r}.")

    @property
    def trained(self) -> TrainedArchitecture:
        """The architecture, of those that are trained step by step."""
        assert isinstance(self.architecture, TrainedArchitecture), "others are made at once, without steps"
        return self.architecture

    @property
    def rate(self) -> float:
        """Highest learning rate."""
        return self.learning_rate or self.trained.rate

    def batch_size(self, count: int) -> int:
        """Samples a step when there are so many: as many for each process."""
        each = -(-min(self.batch or self.trained.batch, count) // self.processes)
        return each * self.processes

    def entries(self) -> dict[str, Any]:
        """All settings that decide what is learned, those of the architecture among them, for cards and checkpoints."""
        kind = self.architecture
        physics = None if self.physics is None else asdict(self.physics)
        own = {**_settings(self, "architecture", "device", "processes"), "physics": physics}
        return {"architecture": kind.name, **_settings(kind), **own}


def _settings(plan: Any, *apart: str) -> dict[str, Any]:
    return {one.name: getattr(plan, one.name) for one in fields(plan) if one.name not in apart}


def chosen_device(plan: TrainingPlan) -> str:
    """Where to train.

    Raises:
        ValueError: a GPU is asked for, and torch sees none, or fewer than there are processes.
    """
    if plan.device == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            "TrainingPlan.device: expected a GPU that torch can use, found none (torch "
            f"{torch.__version__}); take 'cpu' or 'auto', or a build of torch with CUDA."
        )
    device = "cuda" if plan.device != "cpu" and torch.cuda.is_available() else "cpu"
    if device == "cuda" and plan.processes > torch.cuda.device_count():
        raise ValueError(
            f"TrainingPlan.processes: expected at most one for each of {torch.cuda.device_count()} GPUs, got "
            f"{plan.processes}; take fewer, or the device 'cpu'."
        )
    return device
