"""What registration needs of a forward model, whoever provides it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class ForwardModel(Protocol):
    """Nodal forces to nodal displacements, with derivatives at the last state.

    The reference, every surrogate and the hybrid satisfy it; all arrays are in the body's node order.
    """

    @property
    def body(self) -> Body:
        """The body that deforms."""

    def reset(self) -> None:
        """Forget the last state: the next solve starts from rest."""

    def solve(self, forces: ArrayLike) -> Floats:
        """Displacement, (n, 3) metres, under nodal forces, (n, 3) newtons."""

    def pullback(self, cotangent: ArrayLike) -> Floats:
        """Gradient with respect to the forces, (n, 3), from the one with respect to the displacement, (n, 3)."""

    def sensitivity(self, columns: ArrayLike) -> Floats:
        """Change of the displacement, (3n, k), for small changes of the forces, (3n, k)."""


class Restricted(Protocol):
    """A forward model from the coefficients of a control to the displacement of some nodes."""

    def solve_coefficients(self, coefficients: Floats) -> Floats:
        """Displacement of the chosen nodes, (p, 3) metres, for coefficients (k,)."""

    def jacobian(self, coefficients: Floats) -> Floats:
        """Its derivative, (3p, k)."""

    def full(self, coefficients: Floats) -> Floats:
        """Displacement of all nodes, (n, 3) metres."""


class _RestrictedModel:
    """Any forward model, restricted by picking rows and multiplying with the basis."""

    def __init__(self, model: ForwardModel, nodes: Ints, basis: Floats) -> None:
        self._model = model
        self._nodes = nodes
        self._rows = (3 * nodes[:, None] + np.arange(3)).ravel()
        self._basis = basis
        self._last: Floats | None = None

    def full(self, coefficients: Floats) -> Floats:
        if self._last is None or not np.array_equal(self._last, coefficients):
            self._last = None  # a solve that fails leaves no state of these coefficients behind
            self._displacement = self._model.solve((self._basis @ coefficients).reshape(-1, 3))
            self._last = coefficients.copy()
        return self._displacement

    def solve_coefficients(self, coefficients: Floats) -> Floats:
        return self.full(coefficients)[self._nodes]

    def jacobian(self, coefficients: Floats) -> Floats:
        self.full(coefficients)
        return self._model.sensitivity(self._basis)[self._rows]


def restrict(model: Any, nodes: Ints, basis: Floats) -> Restricted:
    """A model from control coefficients to the displacement of some nodes.

    A model that has a `restricted` of its own (surrogates precompute products) is asked for it.

    Args:
        model: a forward model.
        nodes: numbers of the nodes whose displacement is wanted, (p,).
        basis: nodal forces of each coefficient, (3n, k).
    """
    if hasattr(model, "restricted"):
        return model.restricted(nodes, basis)
    return _RestrictedModel(model, nodes, basis)
