"""A small git repository with a folder for records, in place of this one, for tests that record something."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest


class Repository:
    """A repository whose records the harness writes and judges.

    Args:
        root: its folder.
        monkeypatch: puts this one's place in the harness.
    """

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        import record

        self.root, self.results = root, root / "benchmarks" / "results"
        self.results.mkdir(parents=True)
        monkeypatch.setattr(record, "ROOT", root)
        monkeypatch.setattr(record, "RESULTS", self.results)
        self._caches = (record.last_change, record.holds)
        self.git("init", "-q")
        self.commit("first", **{"notes.txt": "a repository"})

    def git(self, *words: str) -> str:
        """What git says."""
        who = ("-c", "user.name=a tester", "-c", "user.email=tester@example.org")
        done = subprocess.run(["git", "-C", str(self.root), *who, *words], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    def write(self, name: str, text: str) -> None:
        """A file that no commit has."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def commit(self, message: str, **files: str) -> str:
        """Commit everything, these files among it; returns the commit."""
        for name, text in files.items():
            self.write(name, text)
        self.git("add", "--all")
        self.git("commit", "-q", "--allow-empty", "-m", message)
        for each in self._caches:  # the harness asks git once a run
            each.cache_clear()
        return self.git("rev-parse", "--short=10", "HEAD")
