"""fTetWild (Hu et al. 2020, ACM Trans. Graph. 39(4)) in a process of its own: tetrahedra from any triangles.

A process of its own, so that Ctrl-C ends it at once and a crash of its C++ is a message.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from tqdm import tqdm

from .body import Floats, Ints, Surface
from .checks import SurfaceError

_PROCESS = "softtwin.meshes.tetwild_process"


def tetrahedra(surface: Surface, edge_length: float, tolerance: float) -> tuple[Floats, Ints]:
    """Points (n, 3), metres, and positively oriented tetrahedra (m, 4) of what triangles enclose.

    Inside is where the winding number says so, whatever the triangles' gaps and overlaps. The same input gives another
    mesh each time: fTetWild takes the order in which it inserts triangles from the machine's random source.

    Args:
        surface: any triangles, metres.
        edge_length: wanted, metres.
        tolerance: how far the boundary may lie from the triangles, metres.

    Raises:
        SurfaceError: no tetrahedra came.
        ImportError: pytetwild is not installed.
    """
    if find_spec("pytetwild") is None:
        raise ImportError("pytetwild is needed to make a surface solid; install softtwin[mesh].")
    size = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    middle = surface.points.mean(axis=0)
    with tempfile.TemporaryDirectory(prefix="softtwin-") as folder:
        given, made = Path(folder) / "given.npz", Path(folder) / "made.npz"
        np.savez(
            given,
            # Its rounding is absolute: a body of size 1 about the origin.
            points=(surface.points - middle) / size,
            triangles=surface.triangles.astype(np.int32),
            edge_length=edge_length / size,
            tolerance=tolerance / size,
        )
        program = [sys.executable, "-m", _PROCESS, str(given), str(made)]
        code, errors = _run(program, folder)
        if code != 0 or not made.exists():
            raise SurfaceError(
                f"surface: fTetWild ended with code {code} and gave no solid "
                f"({' '.join(errors.split())[-200:]}); try another number of nodes or cell size, or mend the "
                "surface where it was segmented."
            )
        with np.load(made) as solid:
            points, cells = solid["points"], solid["cells"].astype(np.int64)
    return middle + size * points, cells


def _run(program: list[str], folder: str) -> tuple[int, str]:
    """Code and error output of a program that runs in a folder, with a clock on a terminal; it dies with its caller."""
    clock = tqdm(desc="making the surface solid", bar_format="{desc} {elapsed}", disable=None, leave=False)
    silent, pipe = subprocess.DEVNULL, subprocess.PIPE
    with clock, subprocess.Popen(program, text=True, cwd=folder, stdout=silent, stderr=pipe) as run:
        errors = None
        try:
            while errors is None:
                with suppress(subprocess.TimeoutExpired):
                    errors = run.communicate(timeout=1.0)[1]
                clock.refresh()
        except BaseException:
            run.kill()
            raise
    return run.returncode, errors
