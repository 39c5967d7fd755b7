"""What [training] asks for, as the surrogate's training takes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from softtwin.surrogate.galerkin import Galerkin
from softtwin.surrogate.physics import Physics
from softtwin.surrogate.plan import Device, TrainingPlan, chosen_device
from softtwin.surrogate.reduced import Reduced
from softtwin.surrogate.registry import ARCHITECTURES

from ..config import ConfigError, TrainingSection


def training_plan(section: TrainingSection, device: Device = "auto", processes: int = 1) -> TrainingPlan:
    """What [training] asks for.

    Args:
        section: of the configuration.
        device: where to train; it is of the machine, and not of the configuration.
        processes: that train together; likewise.

    Raises:
        ConfigError: settings that the architecture does not have, or values that it refuses; weights of physics that
            there are not.
        ValueError: a GPU is asked for and there is none; fewer GPUs than processes.
    """
    kind: Any = ARCHITECTURES[section.architecture]
    own: dict[str, Any] = {"modes": section.modes, "width": section.width} if kind is Reduced else {}
    if kind is Galerkin:
        own = {"vary": section.vary}
    physics = _built("training.physics", Physics, section.physics) if section.physics else None
    plan = TrainingPlan(
        architecture=_built("training.settings", kind, {**own, **section.settings}),
        seconds=section.seconds,
        epochs=section.epochs or None,
        seed=section.seed,
        physics=physics,
        patience=section.patience or None,
        precision=section.precision,
        device=device,
        processes=processes,
    )
    chosen_device(plan)
    return plan


def _built(entry: str, kind: Any, values: Mapping[str, Any]) -> Any:
    known = [field.name for field in fields(kind)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ConfigError(f"{entry}: expected names among {', '.join(known)}, got {', '.join(unknown)}.")
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{entry}: {error}") from error
