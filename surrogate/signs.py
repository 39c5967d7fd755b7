"""What a prediction shows of its error without the truth: its size, what is out of balance, how far balance may be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from softtwin.reference.data.materials import MATERIALS

from .model import Surrogate, SurrogateState
from .residual import ElasticBody

Floats = NDArray[np.float64]
_LEAST, _MOST = 1e-300, 1e300


class CalibrationError(ValueError):
    """A certificate that cannot be given: too few samples, or none of this twin."""


@dataclass(frozen=True)
class Signs:
    """What a prediction shows of its error.

    Args:
        extent: how far out the load lies: 1 at the farthest of the training; None where that was not measured.
        size: largest predicted displacement of a node, metres.
        residual: |R(u) - b| / |b| at the free nodes; infinite where a cell is inside out.
        step: mean nodal length of the linear step towards balance, metres: eta = |Q K(0)^-1 Q^T (R(u) - b)|, with Q the
            rotations of the nodes; infinite as above.
    """

    extent: float | None
    size: float
    residual: float
    step: float

    @property
    def logarithms(self) -> Floats:
        """Of size, residual and step, (3,)."""
        values = np.nan_to_num(np.array([self.size, self.residual, self.step]), nan=_MOST, posinf=_MOST)
        return np.log(np.clip(values, _LEAST, _MOST))

    @property
    def row(self) -> Floats:
        """One, and the logarithms, (4,): what fitted powers multiply."""
        return np.concatenate([[1.0], self.logarithms])


class SignReader:
    """What is out of balance in predictions for one body, and where a linear step would lead.

    The tangent at rest is factored once, when it is first wanted. No FEniCSx is needed.

    Args:
        surrogate: whose predictions are looked at; its card names the material.

    Raises:
        CalibrationError: the card does not name a material, or it is of a kind that torch does not know.
    """

    def __init__(self, surrogate: Surrogate) -> None:
        learned = surrogate.learned_material
        if learned is None or learned["material"] not in MATERIALS:
            raise CalibrationError(
                "SignReader.surrogate: expected a card that names the material of its equilibria, got "
                f"{None if learned is None else learned['material']}; without it nothing is known of balance."
            )
        material = MATERIALS[learned["material"]](learned["young_modulus"], learned["poisson_ratio"])
        self.surrogate = surrogate
        self._elastic = ElasticBody(surrogate.body, material)
        free = np.ones(surrogate.body.points.shape, dtype=bool)
        free[surrogate.body.fixed] = False
        self._free = free.ravel()

    @cached_property
    def _factor(self) -> Any:
        tangent = self._elastic.stiffness(torch.zeros(self.surrogate.body.points.shape, dtype=torch.float64)).tocsc()
        own = np.flatnonzero(self._free)
        options = {"SymmetricMode": True}
        return splu(tangent[own][:, own], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)

    def read(self, forces: Floats, state: SurrogateState) -> Signs:
        """What the prediction for nodal forces, (n, 3), newtons, shows of its error."""
        shape = forces.shape
        predicted = torch.from_numpy(np.where(self._free.reshape(shape), state.displacement, 0.0))
        gap = self._elastic.internal_forces(predicted[None])[0].numpy() - forces
        gap[~self._free.reshape(shape)] = 0.0
        size, load = float(np.linalg.norm(state.displacement, axis=1).max()), float(np.linalg.norm(forces))
        missing = float(np.linalg.norm(gap))
        if not np.isfinite(missing):
            return Signs(state.extent, size, np.inf, np.inf)
        turns = self._rotations(predicted)
        step = np.zeros(forces.size)
        step[self._free] = self._factor.solve(np.einsum("nji,nj->ni", turns, gap).ravel()[self._free])
        length = float(np.linalg.norm(step.reshape(shape), axis=1).mean())  # turning back changes no length
        residual = missing / load if load > 0.0 else (np.inf if missing > 0.0 else 0.0)
        return Signs(state.extent, size, residual, length)

    def _rotations(self, displacement: torch.Tensor) -> Floats:
        """Rotation of each node, (n, 3, 3): the polar factor of the mean deformation gradient of its cells."""
        elastic = self._elastic
        of_cells = (elastic.deformation_gradients(displacement[None])[0] * elastic.volumes[..., None, None]).sum(dim=1)
        shares = of_cells[:, None].expand(-1, elastic.cells.shape[1], -1, -1).reshape(-1, 3, 3)
        mean = torch.zeros(len(displacement), 3, 3, dtype=shares.dtype)
        left, _, right = torch.linalg.svd(mean.index_add(0, elastic.cells.reshape(-1), shares))
        signs = torch.ones(len(displacement), 3, dtype=shares.dtype)
        signs[:, 2] = torch.linalg.det(left @ right)
        return (left @ (signs[..., None] * right)).numpy()
