"""What `tetwild.tetrahedra` starts: fTetWild, and as little beside it as its process can begin with."""

from __future__ import annotations

import sys

import numpy as np

STOP_ENERGY = 10.0  # below 8 it halves cells without end; what 10 leaves bad, smoothing.improved mends


def main(given: str, made: str) -> None:
    """Tetrahedra of a file's triangles, into another file.

    Args:
        given: an .npz file of `points`, `triangles`, `edge_length`, `tolerance`.
        made: the .npz file of `points`, `cells`.
    """
    from pytetwild.pytetwild import tetrahedralize  # of the extra `mesh`

    with np.load(given) as surface:
        points, cells = tetrahedralize(
            surface["points"],
            surface["triangles"],
            edge_length_abs=float(surface["edge_length"]),
            epsilon=float(surface["tolerance"]),
            stop_energy=STOP_ENERGY,
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
    main(*sys.argv[1:])
