"""Forces whose place is unknown are gathered where they act: on the linear response of a membrane of springs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from softtwin.meshes.body import Body
from softtwin.registration.options import RegistrationOptions, SparseLocalisation, options_for
from softtwin.registration.registrar import prepare
from softtwin.registration.verdict import Verdict

from .conftest import cloud_on, seen_from_above


@dataclass(frozen=True, eq=False)
class SpringState:
    displacement: np.ndarray
    inverse: np.ndarray
    negative_pivots: int | None = 0
    extrapolation_ratio: float | None = None

    def jvp(self, changes: ArrayLike) -> np.ndarray:
        moved = np.asarray(changes).reshape(len(self.inverse), -1)
        return (self.inverse @ moved).reshape(3 * len(self.inverse), -1)

    def vjp(self, cotangent: ArrayLike) -> np.ndarray:
        return self.inverse.T @ np.asarray(cotangent)


class Springs:
    """u = K^-1 f, K a sum of springs along the edges: forces act where they are, unlike in the cantilever."""

    error = 0.0
    discrepancy = None

    def __init__(self, body: Body) -> None:
        self.body = body
        n = len(body.points)
        stiffness = np.zeros((n, n))
        for cell in body.cells:
            for i in cell:
                for j in cell:
                    if i < j:
                        stiffness[[i, j], [i, j]] += 1.0
                        stiffness[[i, j], [j, i]] -= 1.0
        free = body.free
        self.inverse = np.zeros((n, n))
        self.inverse[np.ix_(free, free)] = np.linalg.inv(stiffness[np.ix_(free, free)])

    def solve(self, forces: ArrayLike, near: Any = None) -> SpringState:
        return SpringState(self.inverse @ np.asarray(forces), self.inverse)


@pytest.mark.parametrize("noise", [3e-4, 2e-3])
def test_gathering_finds_the_place_and_the_state(rng, noise: float) -> None:
    body = seen_from_above((12, 4, 4))
    model = Springs(body)
    observed = np.unique(body.surfaces["observed"])
    middle = observed[np.argmin(np.linalg.norm(body.points[observed] - [0.5, 0.2, 0.2], axis=1))]
    tool = np.setdiff1d(
        observed[np.linalg.norm(body.points[observed] - body.points[middle], axis=1) < 0.11], body.fixed
    )
    forces = np.zeros_like(body.points)
    forces[tool] = np.array([0.0, 0.3, 0.7]) / len(tool)
    truth = model.solve(forces).displacement
    cloud = cloud_on(body, truth, 500, rng, noise)
    errors, shares = [], []
    for localisation in (SparseLocalisation(rounds=0), SparseLocalisation(rounds=3)):
        made = prepare(
            model,
            body.boundary_nodes,
            body.surfaces["observed"],
            force_scale=1e-2,
            smoothness=0.08,
            options=RegistrationOptions(localisation=localisation),
        )
        result = made.register(cloud)
        # Along its own length a straight side slides freely: what is seen is what must be found.
        errors.append(np.linalg.norm((result.displacement - truth)[:, 1:], axis=1).mean())
        size = np.linalg.norm(result.forces, axis=1)
        near = np.linalg.norm(body.points - body.points[middle], axis=1) < 0.2
        shares.append(size[near].sum() / size.sum())
    assert result.outcome.is_success and not result.judgement.reasons  # of the gathered ones
    assert shares[1] > 0.85 and shares[1] > shares[0]
    assert errors[1] < 0.1 * np.linalg.norm(truth, axis=1).mean()
    assert errors[1] < errors[0] + 1e-4


def test_a_cloud_tells_the_size_of_the_forces(rng) -> None:
    """Many times what was expected, and no point is an outlier for it; in a known zone forces are not gathered."""
    body = seen_from_above((12, 4, 4))
    model = Springs(body)
    seen = np.unique(body.surfaces["observed"])
    tip = seen[body.points[seen, 0] > 0.7 * body.points[:, 0].max()]
    forces = np.zeros_like(body.points)
    forces[tip] = np.array([0.0, 0.3, 0.7]) / len(tip)
    made = prepare(
        model,
        tip,
        body.surfaces["observed"],
        force_scale=1e-3,
        options=options_for(model, has_zone=True),
    )
    truth = model.solve(forces).displacement
    for noise in (0.0, 2e-3):
        found = made.register(cloud_on(body, truth, 500, rng, noise))
        assert found.prepared.forces.patterns is made.forces.patterns
        assert found.prepared.forces.scale == made.forces.scale
        assert found.judgement.verdict is Verdict.ACCEPTED and found.outliers < 0.01
        assert np.linalg.norm(found.net_force - forces.sum(axis=0)) < 0.05 * np.linalg.norm(forces.sum(axis=0))
        assert found.force_scale > 5.0 * made.forces.scale.median
