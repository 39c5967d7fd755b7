"""Where everything of one twin lies, and how long its stages took."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .config import Config, read_config


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
def timed(space: Workspace, stage: str) -> Iterator[None]:
    """Record how long a stage took, beside its results."""
    begin = time.perf_counter()
    yield
    path = space.folder / "stages.json"
    stages = json.loads(path.read_text()) if path.exists() else {}
    stages[stage] = {"seconds": round(time.perf_counter() - begin, 2), "finished": time.strftime("%Y-%m-%d %H:%M:%S")}
    path.write_text(json.dumps(stages, indent=1) + "\n")
