"""How far predictions are from balance: what a comparison of displacements does not show.

An operator of small error may turn cells inside out or sit where the tangent is indefinite (arXiv 2606.21828).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softtwin.reference.data.dataset import DataSet, Samples, Split

from .evaluate import Spread, spread
from .model import Surrogate
from .residual import ElasticBody

Floats = NDArray[np.float64]
_AT_ONCE = 64  # samples


@dataclass(frozen=True)
class Balance:
    """Physical soundness of the predictions of one split.

    Args:
        samples: predictions looked at.
        inside_out: how many have det F <= 0 at a point of the quadrature.
        indefinite: how many of the others have a tangent with negative pivots; None where nobody counted them.
        residual: |R(u) - b| / |b| at the free nodes, of those that are not inside out; None where all are.
        energy_gap: (P(u) - P(u*)) / |P(u*)| of the potential energy P of the same, u* the reference's equilibrium.
        at_rest: mean nodal displacement that is predicted under no load, metres: |f(0)|.
        at_fixed_nodes: largest displacement of a fixed node that is predicted, metres.
    """

    samples: int
    inside_out: int
    indefinite: int | None
    residual: Spread | None
    energy_gap: Spread | None
    at_rest: float
    at_fixed_nodes: float

    def as_dict(self) -> dict[str, Any]:
        """The figures as plain numbers, for JSON."""
        return asdict(self)


def balance(
    surrogate: Surrogate,
    data: DataSet,
    split: Split = "test",
    limit: int | None = None,
    negative_pivots: Callable[[Floats], int | None] | None = None,
) -> Balance:
    """How far a surrogate's predictions are from balance, in double precision.

    Args:
        surrogate: what to judge.
        data: the data set, of the same body; its header names the material.
        split: `train`, `validation` or `test`.
        limit: take the first so many draws only.
        negative_pivots: of the tangent at a displacement, (n, 3); the reference knows them (`Problem.negative_pivots`).

    Raises:
        ValueError: another body, or no accepted sample.
        DataSetError: the split is not complete, or the data do not say their material.
    """
    if data.body.fingerprint != surrogate.body.fingerprint:
        raise ValueError(f"balance.data: {data.path} is of another body than the surrogate.")
    samples = data.samples(split, limit)
    if len(samples) == 0:
        raise ValueError(f"balance.split: expected accepted samples in the {split} split of {data.path}, got none.")
    forces, found = predictions(surrogate, data, samples)
    body = data.body
    held = np.linalg.norm(found[:, body.fixed], axis=2)
    inside_out, residuals, gaps = _measured(
        ElasticBody(body, data.material, springs=data.springs), forces, found, samples.displacements
    )
    sound = np.flatnonzero(~inside_out)
    pivots = None if negative_pivots is None else [negative_pivots(_kept(found[i], body.fixed)) for i in sound]
    at_rest = surrogate.solve(np.zeros_like(body.points)).displacement
    return Balance(
        samples=len(samples),
        inside_out=int(inside_out.sum()),
        indefinite=None if pivots is None else sum(bool(count) for count in pivots),
        residual=spread(residuals[sound]) if len(sound) else None,
        energy_gap=spread(gaps[sound]) if len(sound) else None,
        at_rest=float(np.linalg.norm(at_rest, axis=1).mean()),
        at_fixed_nodes=float(held.max()) if held.size else 0.0,
    )


def predictions(surrogate: Surrogate, data: DataSet, samples: Samples) -> tuple[Floats, Floats]:
    """Nodal forces and predicted displacements of samples, (s, n, 3) each."""
    forces = data.response.spread(samples.forces)
    return forces, np.stack([surrogate.solve(one).displacement for one in forces])


def _kept(displacement: Floats, fixed: NDArray[np.int64]) -> Floats:
    kept = displacement.copy()
    kept[fixed] = 0.0
    return kept


@torch.no_grad()
def _measured(
    body: ElasticBody, forces: Floats, found: Floats, truth: Floats
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Which are inside out, relative residuals and relative gaps of the energy, (s,) each; fixed nodes stay fixed.

    Args:
        body: energy and forces.
        forces: nodal forces, (s, n, 3).
        found: predictions, (s, n, 3).
        truth: equilibria, (s, n, 3).
    """
    parts: list[list[Floats]] = [[], [], []]
    for begin in range(0, len(found), _AT_ONCE):
        b, u, right = (torch.from_numpy(a[begin : begin + _AT_ONCE]) for a in (forces, found, truth))
        u = u * body.free
        lowest = body.potential(right, b)
        parts[0].append((body.jacobians(u).amin(dim=(1, 2)) <= 0.0).numpy())
        parts[1].append(body.residual(u, b).numpy())
        parts[2].append(((body.potential(u, b) - lowest) / lowest.abs()).numpy())
    turned, residuals, gaps = (np.concatenate(part) for part in parts)
    return turned.astype(bool), residuals, gaps
