"""The meshed body of a configuration, written with its quality."""

from __future__ import annotations

from softtwin.meshes.body import Body
from softtwin.meshes.io import write_body
from softtwin.meshes.metrics import mesh_quality

from ..inputs import mesh_inputs
from ..organ import make_organ
from ..workspace import Workspace, timed, write_whole


def mesh_stage(space: Workspace) -> Body:
    """Make the body and write it, with the quality of its mesh and what was done to its surface.

    Raises:
        FileError, SurfaceError, BodyError, ConfigError: what is wrong with the input.
    """
    space.folder.mkdir(parents=True, exist_ok=True)
    with timed(space, "mesh", mesh_inputs(space)):
        organ = make_organ(space.config.body, space.root, space.config.springs.where)
        write_body(space.body, organ.body)
        lines = [str(mesh_quality(organ.body)), *organ.notes]
        write_whole(space.folder / "mesh_quality.txt", "\n".join(lines) + "\n")
    return organ.body
