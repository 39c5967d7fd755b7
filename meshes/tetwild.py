"""fTetWild (Hu et al. 2020, ACM Trans. Graph. 39(4)) in a process of its own: tetrahedra from any triangles.

A process of its own, so that Ctrl-C ends it at once and a crash of its C++ is a message.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from .body import Floats, Ints, Surface
from .checks import SurfaceError

_STOP_ENERGY = 10.0  # below 8 it halves cells without end; what 10 leaves bad, smoothing.improved mends


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
        program = [sys.executable, "-m", __name__, str(given), str(made)]
        ended = subprocess.run(program, capture_output=True, text=True, cwd=folder)  # it leaves a file where it runs
        if ended.returncode != 0 or not made.exists():
            raise SurfaceError(
                f"surface: fTetWild ended with code {ended.returncode} and gave no solid "
                f"({' '.join(ended.stderr.split())[-200:]}); try another number of nodes or cell size, or mend the "
                "surface where it was segmented."
            )
        with np.load(made) as solid:
            points, cells = solid["points"], solid["cells"].astype(np.int64)
    return middle + size * points, cells


def _main(given: str, made: str) -> None:
    from pytetwild.pytetwild import tetrahedralize  # of the extra `mesh`

    with np.load(given) as surface:
        points, cells = tetrahedralize(
            surface["points"],
            surface["triangles"],
            edge_length_abs=float(surface["edge_length"]),
            epsilon=float(surface["tolerance"]),
            stop_energy=_STOP_ENERGY,
            num_threads=1,  # more gain nothing: smoothing and collapsing are serial
            vtk_ordering=True,
        )
    corners = points[cells]
    volumes = np.einsum(
        "mi,mi->m",
        corners[:, 1] - corners[:, 0],
        np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 0]),
    )
    cells[volumes < 0] = cells[volumes < 0][:, [0, 2, 1, 3]]
    np.savez(made, points=points, cells=cells[volumes != 0])


if __name__ == "__main__":
    _main(*sys.argv[1:])
