"""The discrete system of a body: its unknowns, forms and tangent. Solving and derivatives both stand on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix

from softtwin.meshes.body import Body

from ..data.loading import Loading, checked_loading
from ..data.materials import Material
from ..data.outcome import Equilibrium
from ..data.springs import Support, checked_springs
from ..fem.discretisation import Discretisation
from ..fem.forms import DiscreteLoad, Forms
from .linear import Method
from .tangent import Tangent

Floats = NDArray[np.float64]
_LOST = 1e-12  # relative force on held nodes that may be round-off


class System:
    """What enters in the body's node order leaves as unknowns, and the reverse.

    Args:
        body: the body.
        material: strain energy.
        held: axes held at each named node set.
        weights: filled part of each cell, (cells,), in (0, 1]; None for the body's own.
        quadrature: polynomial degree that the quadrature is exact for; None for the least that is safe.
        method: linear algebra.
        comm: communicator that shares the mesh.
        springs: that hold named surfaces.

    Raises:
        ValueError: as `Problem` says.
    """

    def __init__(
        self,
        body: Body,
        material: Material,
        held: Mapping[str, str],
        weights: ArrayLike | None,
        quadrature: int | None,
        method: Method,
        comm: Any,
        springs: Mapping[str, Support] | None = None,
    ) -> None:
        if material.is_mixed and body.kind.degree != 2:
            raise ValueError(
                f"Problem.body: expected quadratic cells for {type(material).__name__} (Taylor-Hood needs a "
                f"displacement one degree above the pressure), got {body.kind.name}; body.quadratic() makes them."
            )
        self.body, self.held = body, dict(held)
        self.springs = checked_springs(springs or {}, body)
        self.space = Discretisation(body, material.is_mixed, self.held, comm, self.springs)
        checked = body.fractions if weights is None else _checked_weights(weights, len(body.cells))
        self.forms = Forms(self.space, material, checked, quadrature, self.springs)
        self.tangent = Tangent(self.forms, method)

    @property
    def material(self) -> Material:
        """Strain energy, with the parameters that it has now."""
        return self.forms.material

    def close(self) -> None:
        """Free the PETSc objects."""
        self.tangent.close()
        self.forms.close()

    def load(self, load: Loading | ArrayLike) -> tuple[Loading, DiscreteLoad]:
        """A load in the body's numbers, a copy of the caller's, and as unknowns.

        Raises:
            ValueError: wrong shape, NaN or infinity, unknown names, forces on held nodes.
        """
        checked = checked_loading(load, self.body, self.held).scaled(1.0)
        if checked.forces is not None:
            self._check_lost(np.asarray(checked.forces))
        return checked, self.forms.load(checked)

    def _check_lost(self, forces: Floats) -> None:
        lost = np.where(self.space.held, forces, 0.0)
        if np.linalg.norm(lost) > _LOST * np.linalg.norm(forces):
            where = np.flatnonzero(np.abs(lost).sum(axis=1) > 0.0)
            newtons = np.linalg.norm(lost, axis=1).sum()
            raise ValueError(
                f"Problem.forces: expected no force on held nodes, got {newtons:.3g} N at {len(where)} of them "
                f"(first {where[:5]}), which would be lost; set them to zero or move them to free nodes."
            )

    def unknowns(self, state: ArrayLike | Equilibrium | None, name: str = "displacement") -> Floats:
        """A state as unknowns; rest if not given."""
        if state is None:
            return np.zeros(self.space.owned)
        if isinstance(state, Equilibrium):
            return self.space.unknowns(f"Problem.{name}", state.displacement, state.pressure)
        return self.space.unknowns(f"Problem.{name}", state)

    def point(self, state: ArrayLike | Equilibrium | None) -> tuple[Floats, DiscreteLoad]:
        """What a tangent depends on: unknowns, and following pressures.

        Raises:
            ValueError: a displacement alone where the pressure is an unknown.
        """
        none = DiscreteLoad.none(self.space)
        if isinstance(state, Equilibrium):
            pressure = {name: float(value) for name, value in state.load.pressure.items() if value != 0.0}
            return self.unknowns(state), replace(none, pressure=pressure)
        if state is not None and self.space.mixed:
            raise ValueError(
                "Problem.displacement: expected an Equilibrium, for the tangent depends on its pressure, "
                f"got {type(state).__name__}."
            )
        return self.unknowns(state), none

    def in_body_order(self, matrix: Any) -> csr_matrix:
        """A matrix of displacements by displacements, (3n, 3n)."""
        indptr, indices, data = matrix.getValuesCSR()
        index = np.empty(self.body.points.size, dtype=np.int64)
        rows = (self.body.dimension * self.space.nodes[:, None] + np.arange(self.body.dimension)).ravel()
        index[rows] = self.space.own_numbers
        return csr_matrix((data, indices, indptr), shape=matrix.getSize())[index][:, index]


def _checked_weights(weights: ArrayLike, cells: int) -> Floats:
    values = np.asarray(weights, dtype=np.float64)
    if values.shape != (cells,):
        raise ValueError(f"Problem.weights: expected one number for each of the {cells} cells, got {values.shape}.")
    if not ((values > 0.0) & (values <= 1.0)).all():
        raise ValueError(f"Problem.weights: expected numbers in (0, 1], got {values.min()} to {values.max()}.")
    return values
