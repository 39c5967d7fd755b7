"""VTK's files of other programs, read by VTK in a process of its own: a damaged file ends that one, and is an error.

VTK's readers trust what a file says of itself, and a few changed bytes can end their process:
benchmarks/damaged_files.py has such files. The process is begun with the first file and serves all that come after it.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import resource
import select
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy

from ...body import Floats, Ints
from ..common import FileError
from .vtk import content, read_vtk

_MEMORY, _MEMORY_OF_FILE = 4 << 30, 60  # bytes that reading may take: so many, and so many times the file
_TIME, _TIME_OF_BYTE = 60.0, 2e-6  # seconds: the same
_WORDS = ("SPACE", "UNIT")


@dataclass(frozen=True, eq=False)
class Foreign:
    """What a VTK file holds.

    Args:
        points: (p, 3), in its own numbers.
        cells: point numbers by kind of cell.
        normals: of the points, (p, 3); None where it has none.
        words: what it states about itself in its field data, by name.
    """

    points: Floats
    cells: Mapping[str, Ints]
    normals: Floats | None
    words: Mapping[str, str]


def read_apart(path: Path) -> Foreign:
    """The content of a VTK, VTU or VTP file.

    Args:
        path: the file.

    Raises:
        FileError: cut off, damaged, or another kind of data set.
    """
    return _SERVICE.read(path)


class _Service:
    """The process, one for each process that asks."""

    def __init__(self) -> None:
        self._lock, self._owner = threading.Lock(), 0
        self._process: subprocess.Popen[bytes] | None = None

    def read(self, path: Path) -> Foreign:
        with self._lock, tempfile.TemporaryDirectory(prefix="softtwin-") as folder:
            made = Path(folder) / "made.npz"
            answer = self._asked({"path": str(path.resolve()), "made": str(made)}, path)
            if "error" in answer:
                raise FileError(answer["error"].replace(str(path.resolve()), str(path)))
            with np.load(made) as found:
                cells = {name[6:]: found[name] for name in found.files if name.startswith("cells:")}
                normals = found["normals"] if "normals" in found.files else None
                return Foreign(found["points"], cells, normals, answer["words"])

    def _asked(self, question: dict[str, str], path: Path) -> dict[str, Any]:
        process = self._running()
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(question).encode() + b"\n")
            process.stdin.flush()
            limit = _TIME + _TIME_OF_BYTE * path.stat().st_size
            ready, _, _ = select.select([process.stdout], [], [], limit)
            line = process.stdout.readline() if ready else b""
        except OSError:
            line, ready = b"", [process.stdout]
        except BaseException:  # Ctrl-C: the answer to this question must not be taken for that to the next
            self.end()
            raise
        if line:
            return dict(json.loads(line))
        self.end()
        how = "ended the process that read it" if ready else f"was not read within {limit:.0f} s"
        raise FileError(
            f"{path}: could not be read as {path.suffix[1:]}; the file may be truncated or damaged (it {how})."
        )

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
            if self._owner == os.getpid():
                self.end()
            self._owner = os.getpid()
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in a terminal is for the one who asks
            )
        return self._process

    def end(self) -> None:
        """End the process, if there is one."""
        process, self._process = self._process, None
        if process is None or self._owner != os.getpid():
            return
        process.kill()
        process.communicate()


_SERVICE = _Service()
atexit.register(_SERVICE.end)


def _check_counts(path: Path, data: Any) -> None:
    """Refuse a legacy file of which fewer cells came than it names: its reader says nothing of them."""
    if path.suffix.lower() != ".vtk" or not data.IsA("vtkUnstructuredGrid"):
        return
    text, came = path.read_bytes(), data.GetNumberOfCells()
    version = re.match(rb"# vtk DataFile Version (\d+)", text)
    more = 1 if version and int(version.group(1)) >= 5 else 0  # ends of lists: one more than lists
    for word, beyond in ((rb"CELLS", more), (rb"CELL_TYPES", 0)):
        for found in re.findall(rb"^%s[ \t]+(\d+)" % word, text, re.MULTILINE):
            if int(found) != came + beyond:
                raise FileError(
                    f"{path}: it names {int(found) - beyond} cells, and {came} can be read; the file may be damaged."
                )


def _answered(path: Path, made: Path) -> dict[str, Any]:
    """What a file holds, written beside; its words in the answer."""
    data = read_vtk(path)
    points, cells = content(path, data)
    _check_counts(path, data)
    arrays = {"points": points, **{f"cells:{name}": block for name, block in cells.items()}}
    there = data.GetPointData()
    names = [there.GetArrayName(i) for i in range(there.GetNumberOfArrays())]
    named = [name for name in names if name and name.lower() == "normals"]
    normals = there.GetNormals() or (there.GetArray(named[0]) if named else None)
    if normals is not None:
        arrays["normals"] = np.asarray(vtk_to_numpy(normals), dtype=np.float64)
    words = {}
    for name in _WORDS:
        array = data.GetFieldData().GetAbstractArray(name)
        if array and array.IsA("vtkStringArray") and array.GetNumberOfValues():
            words[name] = str(array.GetValue(0))
    np.savez(made, **arrays)
    return {"words": words}


def _serve() -> None:
    for line in sys.stdin:
        question = json.loads(line)
        path = Path(question["path"])
        try:
            room = _MEMORY + _MEMORY_OF_FILE * path.stat().st_size
            resource.setrlimit(resource.RLIMIT_AS, (room, resource.RLIM_INFINITY))
            answer = _answered(path, Path(question["made"]))
        except FileError as error:
            answer = {"error": str(error)}
        except Exception as error:
            said = " ".join(f"{type(error).__name__} {error}".split())[:200]
            answer = {"error": f"{path}: could not be read; the file may be truncated or damaged ({said})."}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    _serve()
