"""Files of every format, damaged in many ways and read: the same body, a refusal, or less and said, never in silence.

Each file of `written.py` that can be read is cut off, loses bytes, gets bytes more, has bytes changed, numbers replaced
or a part twice. Another process reads them, so that one that ends it is counted. A cut of a list of points that says
nowhere how many there are (text without a count) leaves a file that is whole in itself: these are counted apart.

    python benchmarks/damaged_files.py [--each 16] [--only STL]
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from reading import Read, read
from written import Writer, writers

SEED = 11
LESS = 1e-3  # share of a volume that counts as less
UNCOUNTED = (
    ".txt",
    ".csv",
    ".tsv",
    ".xyz",
    ".asc",
    ".pts",
    ".fcsv",
    ".obj",
)  # a line less is a file as whole as before


def mutated(content: bytes, way: str, rng: np.random.Generator) -> bytes:
    """The bytes of a file, damaged.

    Args:
        content: of the file.
        way: cut, lose, gain, change, number or twice.
        rng: chooses where.
    """
    at = int(rng.integers(len(content)))
    some = int(rng.integers(1, max(2, min(200, len(content) // 4))))
    if way == "cut":
        return content[:at]
    if way == "lose":
        return content[:at] + content[at + some :]
    if way == "gain":
        return content[:at] + rng.bytes(1 if rng.random() < 0.5 else some) + content[at:]
    if way == "change":
        changed = bytearray(content)
        for place in rng.integers(len(content), size=int(rng.integers(1, 6))):
            changed[place] = int(rng.integers(256))
        return bytes(changed)
    if way == "number":
        found = list(re.finditer(rb"(?<![\w.])-?\d+(?![\w.])", content[: 1 << 16]))
        if not found:
            return mutated(content, "change", rng)
        one = found[int(rng.integers(len(found)))]
        word = [b"0", b"-1", b"-7", b"99999999", b"2147483648", b"1e400", b"nan", b""][int(rng.integers(8))]
        return content[: one.start()] + word + content[one.end() :]
    return content[:at] + content[max(0, at - some) :]


WAYS = ("cut", "lose", "gain", "change", "number", "twice")


def summary(found: Read) -> dict[str, Any]:
    """How much a file holds, as numbers that are less where something was lost.

    Args:
        found: what was read.
    """
    held = found.content
    if "volume" in held:
        return {"cells": held["cells"], "volume": held["volume"]}
    if "labels" in held:
        return {"voxels": int((held["labels"] > 0).sum())}
    return {"points": len(held["points"])} if "points" in held else {"numbers": 16}


def is_less(now: dict[str, Any], before: dict[str, Any], way: str) -> bool:
    """Whether a file holds less than it did: fewer cells, points or voxels.

    Where bytes were changed, other numbers in as many cells are another file that is whole in itself: a coordinate or
    the label of a voxel. Only its cells and points are counted then, and the volume where bytes were lost.

    Args:
        now: summary of the damaged file.
        before: of the whole one.
        way: in which it was damaged.
    """
    kept = {"cells", "points", "numbers"} | (set() if way in ("change", "number") else {"voxels"})
    kept |= {"volume"} if way in ("cut", "lose") else set()
    return any(now.get(name, 0) < before[name] * (1 - LESS if name == "volume" else 1) for name in kept & set(before))


def child(listing: Path) -> None:
    """Read the files of a list and print what came, one line of JSON each, before the next is begun."""
    for line in listing.read_text().splitlines():
        content, path = line.split("\t")
        try:
            found = read(content, Path(path))
            now = {"refused": found.is_refused, "said": found.said[:300], "holds": summary(found)}
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            now = {"error": f"{type(error).__name__}: {error}"[:200], "at": f"{place.name} {place.lineno}"}
        print(json.dumps(now), flush=True)


def outcomes(listed: list[tuple[str, Path]], folder: Path) -> list[dict[str, Any]]:
    """What came of each file; where the process ended, that.

    Args:
        listed: content and path of each.
        folder: for the list.
    """
    found: list[dict[str, Any]] = []
    while len(found) < len(listed):
        listing = folder / "listing.txt"
        listing.write_text("\n".join(f"{content}\t{path}" for content, path in listed[len(found) :]))
        words = [sys.executable, __file__, "--child", str(listing)]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=600)
            lines, ended = done.stdout.splitlines(), f"the process ended with {done.returncode}"
        except subprocess.TimeoutExpired as error:
            lines, ended = (error.stdout or b"").decode().splitlines(), "it took more than 10 minutes"
        found += [json.loads(line) for line in lines if line.startswith("{")]
        if len(found) < len(listed):
            found.append({"crash": ended})
    return found


@cache
def by_suffix() -> dict[str, list[Writer]]:
    """The writers whose files can be read, by format."""
    found: dict[str, list[Writer]] = {}
    with tempfile.TemporaryDirectory() as name:
        for writer in writers():
            folder = Path(name) / str(len(list(Path(name).iterdir())))
            folder.mkdir()
            path = folder / f"whole{writer.suffix}"
            writer.write(path)
            if not read(writer.content, path).is_refused:
                found.setdefault(f"{writer.suffix[1:].upper()} {writer.content}", []).append(writer)
    return dict(sorted(found.items()))


def work(name: str, given: Given) -> dict[str, Any]:
    """The damaged files of one format."""
    rng = np.random.default_rng([SEED, *name.encode()])
    counts: Counter[str] = Counter()
    examples: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as text:
        root, listed, told, wholes = Path(text), list[tuple[str, Path]](), list[tuple[Writer, str]](), list[Any]()
        for number, writer in enumerate(by_suffix()[name]):
            (folder := root / f"w{number}").mkdir()
            path = folder / f"whole{writer.suffix}"
            writer.write(path)
            whole = summary(read(writer.content, path))
            beside = [other for other in folder.iterdir() if other != path]
            for k in range(given.each):
                way = WAYS[k % len(WAYS)]
                (place := folder / f"{k}").mkdir()
                for other in beside:
                    (place / other.name).write_bytes(other.read_bytes())
                victim = beside[0] if beside and k % 2 else path
                (place / path.name).write_bytes(path.read_bytes())
                (place / victim.name).write_bytes(mutated(victim.read_bytes(), way, rng))
                listed.append((writer.content, place / path.name))
                told.append((writer, way))
                wholes.append(whole)
        for (writer, way), whole, found in zip(told, wholes, outcomes(listed, root), strict=True):
            kind = _kind(writer, whole, found, way)
            counts[kind] += 1
            if kind in ("traceback", "crash", "silent"):
                examples.setdefault(kind, f"{writer.name}, {way}: {json.dumps(found)[:300]}")
    kinds = ("refused", "read", "said", "uncounted", "silent", "traceback", "crash")
    return {"files": len(listed), **{kind: counts[kind] for kind in kinds}, "examples": examples}


def _kind(writer: Writer, whole: dict[str, Any], found: dict[str, Any], way: str) -> str:
    if "crash" in found:
        return "crash"
    if "error" in found:
        return "traceback"
    if found["refused"]:
        return "refused"
    if not is_less(found["holds"], whole, way):
        return "read"
    if found["said"]:
        return "said"
    return "uncounted" if writer.suffix in UNCOUNTED and writer.content in ("cloud", "landmarks") else "silent"


BENCHMARK = Benchmark(
    name="damaged_files",
    title="Damaged files of every format, read",
    about=("meshes/io", "meshes/cells.py", "registration/pose.py"),
    work=work,
    rows=lambda given: by_suffix(),
    columns=(
        Column("files", "", "{files}"),
        Column("refused", "", "{refused}"),
        Column("as much as before", "", "{read}"),
        Column("less, said", "", "{said}"),
        Column("less, in a list without a count", "", "{uncounted}"),
        Column("less in silence", "", "{silent}"),
        Column("tracebacks", "", "{traceback}"),
        Column("process ended", "", "{crash}"),
    ),
    settings={"each": Setting(16, "damaged files of each written one")},
    seeds=(SEED,),
    small={"each": 2},
    under="formats",
)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(Path(sys.argv[2]))
    else:
        run(BENCHMARK)
