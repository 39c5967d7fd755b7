"""Linear modes of typical loads and their modal derivatives: the displacements that a body's equilibria are made of."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from .residual import ElasticBody

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_STEP = 1e-4  # of a central difference: largest displacement, relative to the body's length
_NOTHING = 1e-10  # of the largest eigenvalue: directions that rounding has made


class FactoredTangent:
    """The stiffness of a body in one state, factored: from forces to small displacements.

    Args:
        elastic: the body, in double precision.
        displacement: of the state, (n, 3), metres; at rest if not given.

    Raises:
        RuntimeError: the stiffness is singular.
    """

    def __init__(self, elastic: ElasticBody, displacement: Floats | None = None) -> None:
        self.elastic = elastic
        self._free: Ints = np.flatnonzero(np.repeat(elastic.free[:, 0].numpy() > 0.0, 3))
        state = np.zeros((elastic.nodes, 3)) if displacement is None else displacement
        own = elastic.free_stiffness(torch.from_numpy(np.array(state)))
        self._factor = splu(own, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def inverse(self, columns: Floats) -> Floats:
        """Changes of the displacement, (3n, k), metres, for changes of nodal forces, (3n, k), newtons."""
        found = np.zeros_like(columns)
        found[self._free] = self._factor.solve(np.ascontiguousarray(columns[self._free]))
        return found


def stiffness_changes(elastic: ElasticBody, mode: Floats, fields: Floats) -> Floats:
    """Second derivative of the internal forces at rest along a mode, (3n,), and each of fields, (3n, k): (3n, k).

    By a central difference of the stiffness, whose relative error is about 1e-6.

    Args:
        elastic: the body, in double precision.
        mode: direction in which the body begins to move.
        fields: the other direction of each pair.
    """
    length = float(elastic.volumes.sum()) ** (1.0 / 3.0)
    step = _STEP * length / max(float(np.abs(mode).max()), 1e-300)
    away = torch.from_numpy(step * mode.reshape(1, -1, 3))
    change = (elastic.cell_stiffnesses(away) - elastic.cell_stiffnesses(-away))[0]
    nodal = torch.from_numpy(fields.reshape(elastic.nodes, 3, -1))[elastic.cells].flatten(1, 2)
    shares = (change @ nodal).reshape(-1, 3, fields.shape[1])
    found = torch.zeros(elastic.nodes, 3, fields.shape[1], dtype=torch.float64)
    return found.index_add(0, elastic.cells.reshape(-1), shares).reshape(fields.shape).numpy() / (2.0 * step)


def leading_modes(fields: Floats, maximum: int) -> Floats:
    """Orthonormal proper orthogonal modes of fields, (m, 3n): (3n, r) with r at most `maximum`, the largest first."""
    values, vectors = np.linalg.eigh(fields @ fields.T)
    order = np.argsort(values)[::-1][:maximum]
    order = order[values[order] > _NOTHING * max(float(values.max(initial=0.0)), 1e-300)]
    return np.linalg.qr(fields.T @ (vectors[:, order] / np.sqrt(values[order])))[0]


def modal_derivatives(tangent: FactoredTangent, modes: Floats) -> Floats:
    """How each mode changes as the body moves along another, -K^-1 f''[a, b]: (k (k + 1) / 2, 3n), metres.

    Those of a mode along itself count half, as they do in the expansion of an equilibrium to second order. Source:
    Idelsohn and Cardona 1985; Barbic and James 2005, whose simplified ones (K alone, no inertia) these are.

    Args:
        tangent: of the body at rest.
        modes: displacements, (3n, k), metres, as large as they occur.
    """
    count = modes.shape[1]
    pulled = []
    for first in range(count):
        changes = stiffness_changes(tangent.elastic, modes[:, first], modes[:, first:])
        changes[:, 0] *= 0.5
        pulled.append(changes)
    return -tangent.inverse(np.hstack(pulled)).T


def without(fields: Floats, modes: Floats) -> Floats:
    """What fields, (m, 3n), have outside of orthonormal modes, (3n, r)."""
    return fields - (fields @ modes) @ modes.T
