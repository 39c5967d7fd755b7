"""What a prediction shows of its error without the truth: its size, what is out of balance, how far balance may be."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from softtwin.reference.data.materials import MATERIALS

from .domain import load_distance
from .model import Surrogate, SurrogateState
from .residual import ElasticBody

Floats = NDArray[np.float64]
Error = Literal["mean", "largest"]
_LEAST, _MOST = 1e-300, 1e300
_SOLVED = 1e-6  # of the right-hand side: what a step without pivoting may leave


class CalibrationError(ValueError):
    """A certificate that cannot be given: too few samples, or none of this twin."""


@dataclass(frozen=True)
class NewtonStep:
    """One step of Newton's method from a prediction, with the inertia of the tangent there.

    Args:
        mean: its mean nodal length, metres: near a stable equilibrium the error, but for what is quadratic in it;
            infinite where there is no step because a cell is inside out or the tangent is singular.
        largest: its largest nodal length, metres; likewise.
        negative_pivots: of the tangent at the prediction: 0 where that is stable; None where they cannot be told.
    """

    mean: float
    largest: float
    negative_pivots: int | None


_NO_STEP = NewtonStep(np.inf, np.inf, None)


@dataclass(frozen=True)
class ErrorIndicators:
    """What a prediction shows of its error.

    Args:
        distance: how far out the load lies in the network's own coordinates: 1 at the farthest of the training; None
            where that was not measured.
        extrapolation_ratio: likewise, and how far it moves the body (`SurrogateState.extrapolation_ratio`).
        is_inside: whether it lies among the loads that were learned, as that says; None likewise.
        unseen: nodes that it acts on though none did in training: the prediction leaves these forces out.
        load: how far out it lies among the training loads on the nodes that it acts on, and the number of components of
            force there; None likewise (`load_distance`).
        size: largest predicted displacement of a node, metres.
        residual: |R(u) - b| / |b| at the free nodes; infinite where a cell is inside out.
        step: mean nodal length of the linear step towards balance, metres: eta = |Q K(0)^-1 Q^T (R(u) - b)|, with Q the
            rotations of the nodes; infinite as above.
        newton: a step of Newton's method; None where none was asked for.
    """

    distance: float | None
    extrapolation_ratio: float | None
    is_inside: bool | None
    unseen: int
    load: tuple[float, int] | None
    size: float
    residual: float
    step: float
    newton: NewtonStep | None = None

    @property
    def is_finite(self) -> bool:
        """Whether anything can be read from them."""
        is_known = self.unseen == 0 and np.isfinite(self.residual)
        return bool(is_known and (self.newton is None or np.isfinite(self.newton.mean)))

    def row(self, error: Error) -> Floats:
        """One, and the logarithms of size, residual, step and Newton's step if there is one: fitted powers multiply it.

        Args:
            error: what they are wanted for, the mean or the largest nodal error.
        """
        values = [1.0, self.size, self.residual, self.step]
        if self.newton is not None:
            values.append(getattr(self.newton, error))
        found = np.nan_to_num(np.array(values), nan=_MOST, posinf=_MOST)
        found[1:] = np.log(np.clip(found[1:], _LEAST, _MOST))
        return found


def elastic_of(surrogate: Surrogate) -> ElasticBody:
    """The body of a surrogate with the material and the springs that it has learned.

    Raises:
        CalibrationError: its card does not name a material, or one that torch does not know.
    """
    learned = surrogate.learned_material
    if learned is None or learned["material"] not in MATERIALS:
        raise CalibrationError(
            "elastic_of.surrogate: expected a card that names the material of its equilibria, got "
            f"{None if learned is None else learned['material']}; without it nothing is known of balance."
        )
    material = MATERIALS[learned["material"]](learned["young_modulus"], learned["poisson_ratio"])
    return ElasticBody(surrogate.body, material, springs=surrogate.learned_springs)


class IndicatorReader:
    """What is out of balance in predictions for one body, and where a linear step would lead.

    The tangent at rest is factored once, when it is first wanted. No FEniCSx is needed.

    Args:
        surrogate: whose predictions are looked at; its card names the material.

    Raises:
        CalibrationError: the card does not name a material, or it is of a kind that torch does not know.
    """

    def __init__(self, surrogate: Surrogate) -> None:
        self.surrogate = surrogate
        self._elastic = elastic_of(surrogate)
        free = np.ones(surrogate.body.points.shape, dtype=bool)
        free[surrogate.body.fixed] = False
        self._free = free.ravel()

    def of(self, surrogate: Surrogate) -> IndicatorReader:
        """The same of another surrogate of the same body and material: nothing is factored again."""
        other = copy.copy(self)
        other.surrogate = surrogate
        return other

    @cached_property
    def _factor(self) -> Any:
        return self._factored(torch.zeros(self.surrogate.body.points.shape, dtype=torch.float64))[0]

    def _factored(self, displacement: torch.Tensor) -> tuple[Any, csc_matrix]:
        """Factors of the tangent at a displacement, (n, 3), and the tangent of the free unknowns.

        The diagonal is the pivot, so that the signs of U are those of D in L D L^T.
        """
        tangent = self._elastic.free_stiffness(displacement)
        options = {"SymmetricMode": True}
        return splu(tangent, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options), tangent

    def read(self, forces: Floats, state: SurrogateState, newton: bool = False) -> ErrorIndicators:
        """What the prediction for nodal forces, (n, 3), newtons, shows of its error.

        Args:
            forces: (n, 3), newtons.
            state: the prediction for them, without those on nodes that the surrogate never saw loaded.
            newton: make a step of Newton's method too, for which the tangent at the prediction is factored.
        """
        is_free = self._free.reshape(forces.shape)
        predicted = torch.from_numpy(np.where(is_free, state.displacement, 0.0))
        gap = np.where(is_free, self._elastic.internal_forces(predicted[None])[0].numpy() - forces, 0.0)
        # Forces at fixed nodes move nothing: they count neither as out of balance nor as load.
        load, missing = float(np.linalg.norm(forces[is_free.all(axis=1)])), float(np.linalg.norm(gap))
        seen = ErrorIndicators(
            distance=state.distance,
            extrapolation_ratio=state.extrapolation_ratio,
            is_inside=state.is_inside,
            unseen=len(self.surrogate.unseen(forces)),
            load=load_distance(self.surrogate, forces),
            size=float(np.linalg.norm(state.displacement, axis=1).max()),
            residual=np.inf,
            step=np.inf,
            newton=_NO_STEP if newton else None,
        )
        if not np.isfinite(missing):
            return seen
        turned = np.einsum("nji,nj->ni", self._rotations(predicted), gap)
        step = self._lengths(self._factor.solve(turned.ravel()[self._free])).mean()  # turning back changes no length
        residual = missing / load if load > 0.0 else (np.inf if missing > 0.0 else 0.0)
        newtons = self._newton_step(predicted, gap) if newton else None
        return replace(seen, residual=residual, step=float(step), newton=newtons)

    def _newton_step(self, displacement: torch.Tensor, gap: Floats) -> NewtonStep:
        try:
            factor, tangent = self._factored(displacement)
        except RuntimeError:  # exactly singular
            return _NO_STEP
        wanted = gap.ravel()[self._free]
        step = factor.solve(wanted)
        if not np.linalg.norm(tangent @ step - wanted) <= _SOLVED * np.linalg.norm(wanted):
            return _NO_STEP
        is_symmetric = np.array_equal(factor.perm_r, factor.perm_c)
        pivots = int((factor.U.diagonal() < 0.0).sum()) if is_symmetric else None
        lengths = self._lengths(step)
        return NewtonStep(float(lengths.mean()), float(lengths.max()), pivots)

    def _lengths(self, step: Floats) -> Floats:
        """Nodal lengths, (n,), metres, of a field at the free unknowns."""
        whole = np.zeros(len(self._free))
        whole[self._free] = step
        return np.linalg.norm(whole.reshape(-1, 3), axis=1)

    def _rotations(self, displacement: torch.Tensor) -> Floats:
        """Rotation of each node, (n, 3, 3): the polar factor of the mean deformation gradient of its cells."""
        elastic = self._elastic
        of_cells = (elastic.deformation_gradients(displacement[None])[0] * elastic.volumes[..., None, None]).sum(dim=1)
        shares = of_cells[:, None].expand(-1, elastic.cells.shape[1], -1, -1).reshape(-1, 3, 3)
        mean = torch.zeros(len(displacement), 3, 3, dtype=shares.dtype)
        left, _, right = torch.linalg.svd(mean.index_add(0, elastic.cells.reshape(-1), shares))
        indicators = torch.ones(len(displacement), 3, dtype=shares.dtype)
        indicators[:, 2] = torch.linalg.det(left @ right)
        return (left @ (indicators[..., None] * right)).numpy()
