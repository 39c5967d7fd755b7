"""What `softtwin data` does: say what is in a data set, take samples out of it, put several together."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.io import write_deformed
from softtwin.reference.data.dataset import DataSet, DataSetError
from softtwin.reference.data.schema import Reason

from .workspace import open_workspace

Floats = NDArray[np.float64]


def opened(source: Path) -> DataSet:
    """The data set in a folder, or of a configuration."""
    return DataSet(open_workspace(source).data if source.suffix == ".toml" else source)


def export_draws(data: DataSet, draws: Sequence[int], folder: Path) -> list[Path]:
    """Accepted draws as deformed bodies with forces and displacements: a VTU file each, and a picture where one can be.

    Args:
        data: the data set.
        draws: their numbers.
        folder: made if it is not there; files of the same names are replaced.

    Raises:
        DataSetError: a number that is not there, or of a draw that was not solved or not accepted.
    """
    size, missing = data.header["block"], set(data.missing_blocks())
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for draw in draws:
        if not 0 <= draw < data.block_count * size or draw // size in missing:
            raise DataSetError(f"data.draws: expected a finished draw of {data.path}, got {draw}.")
        row = data.rows(range(draw, draw + 1))
        reason = Reason(row["reason"][0])
        if reason is not Reason.ACCEPTED:
            raise DataSetError(f"data.draws: expected a draw that was accepted, got {draw}: {reason.words}.")
        forces = data.response.spread(row["forces"][0])
        path = folder / f"draw-{draw:06d}.vtu"
        write_deformed(path, data.body, row["displacements"][0], {"force": forces})
        written += [path, *_pictured(data.body, row["displacements"][0], path.with_suffix(".png"))]
    return written


def _pictured(body: Body, displacement: Floats, path: Path) -> list[Path]:
    try:
        from .pictures import Studio, camera_side, moved_layers, rendering_problem, view_of
    except ModuleNotFoundError:  # pyvista is of the extra `app`
        return []
    if rendering_problem():
        return []
    limit = float(np.linalg.norm(displacement, axis=1).max())
    view = view_of(camera_side(body), [body.points, body.points + displacement])
    picture = Studio("").picture(view, moved_layers(body, displacement, limit), f"up to {1e3 * limit:.3g} mm")
    path.write_bytes(base64.b64decode(picture.address.split(",", 1)[1]))
    return [path]
