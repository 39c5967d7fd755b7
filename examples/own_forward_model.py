"""Bring your own forward model: whatever turns nodal forces into a state can register clouds.

    python examples/own_forward_model.py

A state carries its displacement and its own derivatives, `jvp` and `vjp`; nothing needs to be inherited. The model
here is a cantilever that bends in proportion to the force at its tip: a matrix of one column. Neither torch nor
FEniCSx is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.app.twin import Twin
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.shapes import beam
from softtwin.registration.pose import Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearState:
    """u = shape (shape . f) / stiffness: what a state has to offer."""

    model: Cantilever
    forces: Floats
    negative_pivots: int | None = 0  # a linear model is never unstable
    extrapolation_ratio: float | None = None  # nor has it learned anything that it could leave

    @property
    def displacement(self) -> Floats:
        """(n, 3), metres."""
        return self.model.bent(self.forces)

    def jvp(self, changes: ArrayLike) -> Floats:
        """Change of the displacement, (3n, k), for changes of the forces, (3n, k)."""
        columns = np.asarray(changes).T.reshape(-1, *self.forces.shape)
        return np.stack([self.model.bent(column).ravel() for column in columns], axis=1)

    def vjp(self, cotangent: ArrayLike) -> Floats:
        """Gradient by the forces, (n, 3): the model is its own transpose."""
        return self.model.bent(np.asarray(cotangent))


@dataclass(frozen=True, eq=False)
class Cantilever:
    """A beam that takes the deflection line of an end load, whatever loads it."""

    body: Body
    stiffness: float = 5.0  # newtons per metre at the tip
    error: float = 0.0  # metres; it is the truth here
    discrepancy: None = None

    def bent(self, forces: Floats) -> Floats:
        """Displacement, (n, 3), metres, under nodal forces, (n, 3), newtons."""
        x = self.body.points[:, 0] / self.body.points[:, 0].max()
        line = 0.5 * x**2 * (3.0 - x)
        return np.outer(line, line @ forces) / self.stiffness

    def solve(self, forces: ArrayLike, near: Any = None) -> LinearState:
        """The state under nodal forces; a start near by would help a nonlinear model."""
        return LinearState(self, np.asarray(forces, dtype=np.float64))


def main() -> float:
    """Relative error of the net force that is found."""
    bare = beam((12, 3, 3), (0.30, 0.06, 0.06), "tetrahedron")
    corners = bare.points[bare.boundary]
    seen = (corners[:, :, 2] > 0.0599).all(axis=1) | (corners[:, :, 1] > 0.0599).all(axis=1)
    body = replace(bare, surfaces={"observed": bare.boundary[seen]})
    model = Cantilever(body)

    # The truth: 0.2 N at the tip, seen by a camera with half a millimetre of noise.
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"]] = np.array([0.0, 0.05, -0.2]) / len(body.node_sets["tip"])
    truth = model.solve(forces).displacement
    cloud = partial_view(body, truth, (0.0, 1.0, 1.0), 600, 5e-4, np.random.default_rng(3), surface="observed")

    # The seam: a twin is built from any model; the registrar is the same. The pose of this camera is known exactly.
    result = Twin(model).register(cloud, zone="tip", camera=Pose.identity())
    true = forces.sum(axis=0)
    error = float(np.linalg.norm(result.net_force - true) / np.linalg.norm(true))
    print(f"{result.judgement.verdict.value}: {result.net_force.round(4)} N, true {true} N: {100 * error:.1f} % off")
    return error


if __name__ == "__main__":
    main()
