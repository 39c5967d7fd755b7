"""How near to the truth another mesh of the real liver can come at all, whatever a cloud says.

    python benchmarks/other_mesh.py [--frames 5 15 25]

The truth of s1, s2 and s3 was computed on mesh-default. On mesh-remeshed, `carried` is the state under the true nodal
forces, carried by the other mesh's cells, and `at best` the one under forces at the zone's nodes that bring the truth's
nodes nearest to where they are: all 3,046 of them are told, not the seen side alone. No registration with forces in the
zone can do better on that mesh. Errors are mean nodal distances in mm, over the truth's nodes as everywhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, liver, sequence
from numpy.typing import NDArray
from scipy.sparse import csr_array, kron

from softtwin.meshes.embedding import embed
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.solve.problem import Problem

Floats = NDArray[np.float64]
_TOLD = 1e-5  # metres to which a node's place is told: little beside what is looked for
_FREE = 1.0  # newtons that a nodal force may well have: hundreds of times the true ones, so that nothing holds it back
_STEPS, _SETTLED = 40, 1e-3  # Gauss-Newton steps at most; relative fall of the objective that ends them
_FIRST, _LEAST = 4e-3, 1e-5  # metres that a node may move in the first step; with less, none is tried


class OtherMesh:
    """The truth's nodes on mesh-remeshed.

    Args:
        model: forward model on that mesh.
    """

    def __init__(self, model: ReferenceModel) -> None:
        self.model, self.truth = model, liver()
        self.carrier = embed(model.body, self.truth.points)
        self.rows = csr_array(kron(self.carrier.matrix, np.eye(3), format="csr"))

    def carried(self, forces: Floats) -> Floats:
        """Nodal forces of mesh-default, (n, 3), newtons, that do the same work on the other mesh."""
        return self.carrier.matrix.T @ forces

    def error(self, displacement: Floats, wanted: Floats) -> float:
        """Mean distance of the truth's nodes, metres."""
        missed = self.carrier.displace(displacement) - wanted
        return float(np.linalg.norm(missed, axis=1).mean())

    def best(self, wanted: Floats, zone: NDArray[np.int64]) -> tuple[float, int]:
        """Least error with forces at the zone's nodes, metres, and the Gauss-Newton steps from rest that it took.

        Args:
            wanted: displacement of the truth's nodes, (3046, 3), metres.
            zone: nodes that may carry force.
        """
        entries = (3 * zone[:, None] + np.arange(3)).ravel()
        basis = np.zeros((self.model.body.points.size, len(entries)))
        basis[entries, np.arange(len(entries))] = 1.0
        forces, limit = np.zeros(len(entries)), _FIRST
        state = self.model.solve(np.zeros_like(self.model.body.points))
        value, steps = self._objective(state.displacement, wanted, forces), 0
        while steps < _STEPS and limit > _LEAST:
            steps += 1
            slopes = self.rows @ state.jvp(basis)
            missed = (self.carrier.displace(state.displacement) - wanted).ravel()
            values, vectors = np.linalg.eigh(slopes.T @ slopes + np.eye(len(forces)) * (_TOLD / _FREE) ** 2)
            pulled = vectors.T @ (slopes.T @ missed + forces * (_TOLD / _FREE) ** 2)
            while limit > _LEAST:
                change = _damped(slopes, values, vectors, pulled, limit)
                try:
                    tried = self.model.solve((basis @ (forces + change)).reshape(-1, 3), state)
                    after = self._objective(tried.displacement, wanted, forces + change)
                except NotConverged:
                    after = np.inf
                if after < value:
                    break
                limit /= 3.0
            else:
                break
            fallen, value, limit = 1.0 - after / value, after, 2.0 * limit
            state, forces = tried, forces + change
            if fallen < _SETTLED:
                break
        return self.error(state.displacement, wanted), steps

    def _objective(self, displacement: Floats, wanted: Floats, forces: Floats) -> float:
        missed = (self.carrier.displace(displacement) - wanted) / _TOLD
        return float((missed**2).sum() + (forces**2).sum() / _FREE**2)


def _damped(slopes: Floats, values: Floats, vectors: Floats, pulled: Floats, limit: float) -> Floats:
    """The step, damped until no coordinate of the truth's nodes moves farther than a limit by first order."""
    damping = 0.0
    while True:
        change: Floats = -vectors @ (pulled / (values + damping))
        if np.abs(slopes @ change).max() <= limit:
            return change
        damping = max(2.0 * damping, 1e-9 * values[-1])


def frame_of(mesh: OtherMesh, name: str, frame: int) -> dict[str, Any]:
    """One frame."""
    data = sequence(name, "remeshed")
    wanted = data.positions[frame] - mesh.truth.points
    state = mesh.model.solve(mesh.carried(data.nodal_forces(frame)))
    least, steps = mesh.best(wanted, data.zone)
    return {
        "sequence": name,
        "frame": frame,
        "moved_mm": 1e3 * float(np.linalg.norm(wanted, axis=1).mean()),
        "carried_mm": 1e3 * mesh.error(state.displacement, wanted),
        "at_best_mm": 1e3 * least,
        "steps": steps,
    }


def work(row: str, given: Given) -> dict[str, Any]:
    """Means over the frames of a sequence, and each."""
    problem = given.opened(Problem, given.once(liver, "remeshed"), given.once(NeoHookean, YOUNG_MODULUS, POISSON_RATIO))
    mesh = OtherMesh(ReferenceModel(problem, patient=False))
    rows = [frame_of(mesh, row, frame) for frame in given.frames]
    kinds = ("moved_mm", "carried_mm", "at_best_mm")
    return {**{kind: float(np.mean([each[kind] for each in rows])) for kind in kinds}, "rows": rows}


BENCHMARK = Benchmark(
    name="other_mesh",
    title="How near to the truth another mesh of the real liver can come at all",
    about=("reference",),
    work=work,
    rows=SEQUENCES,
    columns=(
        Column("moved", "mm", "{moved_mm:.2f}"),
        Column("under the true forces", "mm", "{carried_mm:.2f}"),
        Column("at best", "mm", "{at_best_mm:.2f}"),
    ),
    settings={"frames": Setting((5, 15, 25), "of each sequence")},
    small={"frames": (5,)},
    under="sequences",
)


if __name__ == "__main__":
    run(BENCHMARK)
