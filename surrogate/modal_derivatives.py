"""Linear modes of typical loads and their modal derivatives: the displacements that a body's equilibria are made of."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from .residual import ElasticBody

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_AT_ONCE = 2**18  # points of the quadrature, times pairs of modes, that are looked at together
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
        own = elastic.stiffness(torch.from_numpy(np.array(state)))[self._free][:, self._free].tocsc()
        self._factor = splu(own, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def inverse(self, columns: Floats) -> Floats:
        """Changes of the displacement, (3n, k), metres, for changes of nodal forces, (3n, k), newtons; held ones stay."""
        found = np.zeros_like(columns)
        found[self._free] = self._factor.solve(np.ascontiguousarray(columns[self._free]))
        return found


def second_derivative(elastic: ElasticBody, first: Floats, second: Floats) -> Floats:
    """Second derivative of the internal forces at rest along pairs of fields, (m, 3n) each, metres: (m, 3n), newtons.

    Args:
        elastic: the body, in double precision.
        first: of each pair.
        second: likewise.
    """
    size = max(1, _AT_ONCE // elastic.volumes.numel())
    parts = range(0, len(first), size)
    return np.concatenate([_along(elastic, first[i : i + size], second[i : i + size]) for i in parts])


def _along(elastic: ElasticBody, first: Floats, second: Floats) -> Floats:
    shape = (len(first), elastic.nodes, 3)
    one, other = (torch.from_numpy(np.ascontiguousarray(fields).reshape(shape)) for fields in (first, second))

    def forces(displacement: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = torch.func.grad(lambda at: elastic.energy(at).sum())(displacement)
        return found

    def slope(displacement: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = torch.func.jvp(forces, (displacement,), (one,))[1]
        return found

    with torch.no_grad():
        found = torch.func.jvp(slope, (torch.zeros_like(one),), (other,))[1]
    return np.asarray(found.reshape(len(first), -1).numpy())


def leading_modes(fields: Floats, most: int) -> Floats:
    """Orthonormal proper orthogonal modes of fields, (m, 3n): (3n, r) with r at most `most`, the largest first."""
    values, vectors = np.linalg.eigh(fields @ fields.T)
    order = np.argsort(values)[::-1][:most]
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
    first, second = np.triu_indices(modes.shape[1])
    pulled = second_derivative(tangent.elastic, modes.T[first], modes.T[second])
    halves = np.where(first == second, 0.5, 1.0)
    return -halves[:, None] * tangent.inverse(pulled.T).T


def without(fields: Floats, modes: Floats) -> Floats:
    """What fields, (m, 3n), have outside of orthonormal modes, (3n, r)."""
    return fields - (fields @ modes) @ modes.T
