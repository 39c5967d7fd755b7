"""Parts of a data set for jobs that know nothing of each other, an array of a cluster's scheduler for instance."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .dataset import DataSetError
from .lock import locked


@dataclass(frozen=True)
class Shard:
    """Every so-manieth block of a data set.

    Args:
        number: of the shard, from 0.
        count: of all shards.
    """

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 0 <= self.number < self.count:
            raise DataSetError(f"Shard.number: expected 0..{self.count - 1} of {self.count} shards, got {self.number}.")

    @classmethod
    def parse(cls, text: str) -> Shard:
        """A shard from words like `3/16`: the fourth of sixteen.

        Raises:
            DataSetError: other words, or a number that is not there.
        """
        found = re.fullmatch(r"(\d+)/(\d+)", text.strip())
        if found is None:
            raise DataSetError(f"shard: expected NUMBER/COUNT like 3/16, counted from 0, got {text!r}.")
        return cls(int(found[1]), int(found[2]))

    def has(self, block: int) -> bool:
        """Whether a block is one of it."""
        return block % self.count == self.number

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


@contextmanager
def at_work_on(path: Path, shard: Shard) -> Iterator[None]:
    """Keep others from the same shard of a data set.

    Raises:
        DataSetError: somebody else is at work on it.
    """
    refusal = f"generate.shard: another `generate` is at work on shard {shard} in {path}; wait for it, or end it."
    with locked(_lock(path, f"{shard.number}-of-{shard.count}"), DataSetError(refusal), 0.0):
        yield


def refuse_shards_at_work(path: Path) -> None:
    """Refuse to write a whole data set while others write parts of it.

    Raises:
        DataSetError: somebody does.
    """
    for file in sorted(path.parent.glob(_lock(path, "*").name)):
        words = file.name.rsplit("part-", 1)[1].removesuffix(".lock").replace("-of-", "/")
        refusal = f"generate.path: shard {words} of {path} is being made; wait for it, or end it."
        with locked(file, DataSetError(refusal), 0.0):
            pass


def _lock(path: Path, words: str) -> Path:
    return path.with_name(f".{path.name}.part-{words}.lock")
