"""Records of benchmarks: what each row is made from (commit, command, machine, day, settings), as JSON under results/.

A record is `{benchmark, date, command, commit, machine, figures, made}`. `made` says for each row the commit, command,
day, seconds, settings and processor that it is of, since rows are made at several times; the other entries are those of
the run that wrote last. Records of before the harness have no `made`: rows may hold one each, or there is only the
record's own commit, with `-dirty` where the tree had uncommitted changes, or none.
"""

from __future__ import annotations

import fcntl
import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
RUNS = Path(__file__).parent / "runs"  # what benchmarks make and use again: data sets, networks
LIVER = Path(__file__).parents[2] / "shared" / "data" / "liver"
VERSIONS = ("numpy", "scipy", "torch", "vtk", "zarr", "fenics-dolfinx", "petsc4py", "slepc4py")


class NotRecordedError(Exception):
    """What was measured is of no commit, and is not recorded; the message says why and what to do."""


# ---------------------------------------------------------------------- git


def git(*words: str) -> str | None:
    """What git says in the repository, stripped; None where it fails, or where there is no git."""
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def commit() -> str:
    """The commit that the tree is at.

    Raises:
        NotRecordedError: no git, or no commit.
    """
    found = git("rev-parse", "--short=10", "HEAD")
    if found is None:
        raise NotRecordedError("There is no commit here, and a record names one. With --dry nothing is recorded.")
    return found


def uncommitted(paths: Sequence[str] = (".",)) -> list[str]:
    """Files below some paths that differ from the commit or are not in it; records themselves do not count."""
    found = git("status", "--porcelain", "--untracked-files=all", "--", *paths, ":(exclude)benchmarks/results")
    return [line.split(maxsplit=1)[1] for line in (found or "").splitlines()]


def check_clean(paths: Sequence[str] = (".",)) -> None:
    """Refuse a tree whose figures no commit could be held to.

    Raises:
        NotRecordedError: uncommitted changes below the paths.
    """
    changed = uncommitted(paths)
    if changed:
        shown = ", ".join(changed[:5]) + (f" and {len(changed) - 5} more" if len(changed) > 5 else "")
        count = f"{len(changed)} uncommitted change{'s' * (len(changed) > 1)}"
        raise NotRecordedError(
            f"{count} ({shown}): a record names the commit that its figures are of. Commit first, or run with --dry, "
            "which records nothing."
        )


def check_unchanged(begun: str, paths: Sequence[str]) -> None:
    """Refuse what was measured while files below some paths changed, committed or not.

    Raises:
        NotRecordedError: they differ from the commit that the run began at.
    """
    check_clean(paths)
    if git("diff", "--quiet", begun, "HEAD", "--", *paths, ":(exclude)benchmarks/results") is None:
        raise NotRecordedError(f"A commit changed {', '.join(paths)} while this ran from {begun}: run it again.")


@cache
def last_change(about: tuple[str, ...]) -> str:
    """The last commit that touched some folders or files; the present one where none ever did."""
    return git("log", "-1", "--format=%H", "HEAD", "--", *about) or git("rev-parse", "HEAD") or ""


@cache
def holds(told: str, about: tuple[str, ...]) -> bool:
    """Whether a commit has the last change of some folders or files in it; an unknown one has not."""
    if not told or told.endswith("-dirty"):
        return False
    return git("merge-base", "--is-ancestor", last_change(about), told) is not None


# ---------------------------------------------------------------------- the files


def read(name: str) -> dict[str, Any]:
    """The whole record of a name; empty where there is none."""
    path = RESULTS / f"{name}.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return found


def recorded(name: str) -> dict[str, Any]:
    """Figures that were written under a name; none where nothing was."""
    found: dict[str, Any] = read(name).get("figures", {})
    return found


def made_of(record: dict[str, Any], under: str = "") -> dict[str, dict[str, Any]]:
    """What each row of a record is made from; one entry, `""`, for all rows that do not say it themselves.

    Args:
        record: the whole record.
        under: entry of the figures that holds the rows, where it is not the figures themselves.
    """
    figures = record.get("figures", {})
    rows = figures.get(under, {}) if under else figures
    rows = rows if isinstance(rows, dict) else {}
    told = {name: row["made"] for name, row in rows.items() if isinstance(row, dict) and "made" in row}
    told |= {name: made for name, made in record.get("made", {}).items() if name in rows or not name}
    silent = [name for name, row in rows.items() if name not in told and (under or isinstance(row, dict))]
    whole = {name: record[name] for name in ("commit", "date", "command") if name in record}
    if silent or not rows or not told:
        return {"": whole, **told}
    return {name: made for name, made in told.items() if name} or told


def write(name: str, figures: Any, made: dict[str, Any], command: str, begun: str) -> Path:
    """Write a record, whole or not at all; returns the file.

    Args:
        name: of the record.
        figures: of all rows.
        made: what each row is made from.
        command: that was given.
        begun: the commit that it ran at.
    """
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    told = {"benchmark": name, "date": time.strftime("%Y-%m-%d"), "command": command, "commit": begun}
    record = {**told, "machine": machine(), "figures": figures, "made": made}
    partly = path.with_suffix(".part")
    partly.write_text(as_text(record) + "\n")
    partly.replace(path)
    return path


def as_text(record: Any) -> str:
    """JSON of a record; each of a row's `cases`, of which there are thousands, on one line."""
    lines: list[str] = []

    def packed(value: Any, name: str = "") -> Any:
        if isinstance(value, dict):
            return {key: packed(each, key) for key, each in value.items()}
        if name == "cases" and isinstance(value, list):
            lines.extend(json.dumps(each, default=plain) for each in value)
            return [f"\0{number}" for number in range(len(lines) - len(value), len(lines))]
        return value

    text = json.dumps(packed(record), indent=1, default=plain)
    return re.sub(r'"\\u0000(\d+)"', lambda found: lines[int(found[1])], text)


@contextmanager
def held() -> Iterator[None]:
    """The records for this process alone, while it adds a row to one that others add rows to."""
    RESULTS.mkdir(exist_ok=True)
    folder = os.open(RESULTS, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def plain(value: Any) -> Any:
    """What JSON has no word for."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


# ---------------------------------------------------------------------- the machine


def machine() -> dict[str, Any]:
    """Processor, cores and load of this machine, and the versions that figures depend on."""
    from softtwin.app.doctor import available_cores

    return {
        "processor": processor(),
        "cores": available_cores(),
        "gpu": gpu(),
        "load_at_the_end": os.getloadavg()[0],
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in VERSIONS},
        "threads": os.environ.get("OPENBLAS_NUM_THREADS", "not set"),
    }


def processor() -> str:
    """Its name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")


def gpu() -> str:
    """Its name, or `none`."""
    try:
        import torch
    except ModuleNotFoundError:  # the reference alone
        return "none"
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "none"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
