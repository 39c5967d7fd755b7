"""The real liver of the shared data: bodies, sequences and truth, read where they lie."""

from __future__ import annotations

from dataclasses import dataclass

import meshio
import numpy as np
from numpy.typing import NDArray
from record import LIVER

from softtwin.meshes.body import Body

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SEQUENCES = ("s1", "s2", "s3")
YOUNG_MODULUS, POISSON_RATIO = 4500.0, 0.49


@dataclass(frozen=True, eq=False)
class Sequence:
    """One sequence: clouds, true positions of mesh-default, true net forces, the tool's nodes and the allowed zone."""

    name: str
    clouds: list[Floats]
    positions: Floats
    net_forces: Floats
    tool: Ints
    zone: Ints

    def nodal_forces(self, frame: int, share: float = 1.0) -> Floats:
        """A share of the true forces of a frame, spread evenly over the tool's nodes, (n, 3), newtons."""
        forces = np.zeros_like(self.positions[0])
        forces[self.tool] = share * self.net_forces[frame] / len(self.tool)
        return forces


def liver(mesh: str = "default", attachment: str = "facets") -> Body:
    """The liver as a body with the observed side as surface `observed` and zones `s1`, `s2`, `s3`.

    Args:
        mesh: `default` or `remeshed`.
        attachment: `facets` fixes the listed nodes that belong to a boundary triangle whose nodes are all listed;
            `listed` fixes every listed node. They differ by node 756 of mesh-default, which the stored truth moves.
    """
    folder = LIVER / f"mesh-{mesh}"
    grid = meshio.read(folder / "liver.msh")
    listed = np.load(folder / "dirichlet-vertices.npy")
    zones = {s: np.load(LIVER / "sequences" / "neohookean" / s / f"forces-vertices-{mesh}.npy") for s in SEQUENCES}
    body = Body(
        points=grid.points,
        cells=grid.cells_dict["tetra"],
        node_sets={"fixed": listed, **zones},
        surfaces={"observed": _outward(grid.points, np.load(folder / "matching-triangles.npy"), mesh)},
    )
    if attachment == "listed":
        return body
    whole = body.boundary[np.isin(body.boundary, listed).all(axis=1)]
    return body.with_sets(fixed=np.unique(whole))


def _outward(points: Floats, triangles: Ints, mesh: str) -> Ints:
    return triangles[:, ::-1] if mesh == "default" else triangles


def sequence(name: str, mesh: str = "default") -> Sequence:
    """One of the sequences s1, s2, s3; the zone in the numbering of the mesh, the truth in mesh-default's."""
    folder = LIVER / "sequences" / "neohookean" / name
    return Sequence(
        name=name,
        clouds=[np.loadtxt(folder / "pointclouds" / f"pc{i:02d}.txt") for i in range(50)],
        positions=np.load(folder / "positions-default.npy"),
        net_forces=np.load(folder / "true-forces.npy"),
        tool=np.loadtxt(folder / "tool-vertices-default.txt", dtype=np.int64),
        zone=np.load(folder / f"forces-vertices-{mesh}.npy"),
    )
