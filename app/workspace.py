"""Where everything of one twin lies, and the record of its stages: what each one read, and how long it took."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtwin.reference.data import lock

from .config import Config, ConfigError, read_config

RECORDS = "stages.json"
_PATIENCE_S = 2.0


@dataclass(frozen=True)
class Workspace:
    """Where everything of one twin lies.

    Args:
        config: the configuration.
        root: folder that relative paths of the configuration start from.
    """

    config: Config
    root: Path

    @property
    def folder(self) -> Path:
        """Everything that the stages make."""
        return self.root / self.config.folder

    @property
    def body(self) -> Path:
        """The meshed body."""
        return self.folder / "body.vtu"

    @property
    def data(self) -> Path:
        """The data set."""
        return self.folder / "data.zarr"

    @property
    def training(self) -> Path:
        """Checkpoints."""
        return self.folder / "training"

    @property
    def twin(self) -> Path:
        """The finished twin."""
        return self.folder / "twin"


def open_workspace(path: Path | str) -> Workspace:
    """The workspace of a configuration file.

    Raises:
        ConfigError: see `read_config`.
    """
    config, root = read_config(path)
    return Workspace(config, root)


@contextmanager
def timed(space: Workspace, stage: str, read: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Record a stage beside its results: what it read and how long it took.

    The record goes before the stage begins: one that is cut short leaves none, and results without one answer for
    nothing.

    Args:
        space: the workspace.
        stage: its name.
        read: what it reads, as from `softtwin.app.inputs`; hashed before the stage begins.
    """
    records = read_records(space.folder)
    if records.pop(stage, None) is not None:
        _write_records(space.folder, records)
    begin = time.perf_counter()
    yield
    record_stage(space, stage, time.perf_counter() - begin, read)


@contextmanager
def locked(space: Workspace, stage: str) -> Iterator[None]:
    """Keep others from the same stage in the same folder; the system lets go of the lock when the process ends.

    Args:
        space: the workspace.
        stage: its name.

    Raises:
        ConfigError: another process is at it.
    """
    refusal = f"{space.folder}: another `{stage}` is at work here; wait for it, end it, or choose another folder."
    with lock.locked(space.folder / f".{stage}.lock", ConfigError(refusal), _PATIENCE_S):
        yield


def record_stage(space: Workspace, stage: str, seconds: float, read: Mapping[str, Any] | None = None) -> None:
    """Write the record of a stage that has succeeded.

    Args:
        space: the workspace.
        stage: its name.
        seconds: how long it took.
        read: what it read.
    """
    entry = {"seconds": round(seconds, 2), "finished": time.strftime("%Y-%m-%d %H:%M:%S"), "read": dict(read or {})}
    _write_records(space.folder, {**read_records(space.folder), stage: entry})


def read_records(folder: Path) -> dict[str, dict[str, Any]]:
    """The records of the stages of a folder; one that is damaged counts as none.

    Returns:
        Name of the stage: `seconds`, `finished` and `read`, a mapping from what was read to its value or hash.
    """
    try:
        found = json.loads((folder / RECORDS).read_text())
    except (OSError, ValueError):
        return {}
    entries = found.items() if isinstance(found, dict) else ()
    return dict(_renamed(name, entry) for name, entry in entries if _is_record(entry))


def _renamed(name: str, entry: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """A stage and its record under today's words: what is unchanged need not be made again."""
    if name != "doubt":
        return name, entry
    read = {re.sub(r"^doubt\.", "model_error.", what): value for what, value in entry.get("read", {}).items()}
    return "model_error", {**entry, "read": read}


def write_whole(path: Path, content: str) -> None:
    """Write a text whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(content)
    os.replace(partial, path)


def _is_record(entry: Any) -> bool:
    if not isinstance(entry, dict) or not isinstance(entry.get("read", {}), dict):
        return False
    return isinstance(entry.get("seconds"), int | float)


def _write_records(folder: Path, records: Mapping[str, Any]) -> None:
    write_whole(folder / RECORDS, json.dumps(records, indent=1) + "\n")
