"""Unknown forces with the reduced model between them and the observed side: what can be multiplied beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .forward import ForwardModel, ReducedModel, reduce_model
from .parameters.inputs import InputBlocks
from .parameters.nodal_forces import LikelihoodInformed, NodalForces, likelihood_informed
from .surface_distance import SurfaceDistance
from .uncertainty import unseen_response

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """Forces and the reduced model between them and the observed side.

    Args:
        forces: the unknown forces.
        model: from their coefficients to the observed nodes.
        whole: the forward model that this is the reduced one of.
    """

    forces: NodalForces
    model: ReducedModel
    whole: ForwardModel

    @classmethod
    def of(
        cls,
        model: ForwardModel,
        observed: SurfaceDistance,
        forces: NodalForces,
        inputs: InputBlocks | None = None,
    ) -> Prepared:
        """What can be multiplied before a cloud comes."""
        return cls(forces, reduce_model(model, observed.nodes, forces.basis, inputs), model)

    def informed(self, observed: SurfaceDistance, rule: LikelihoodInformed) -> Prepared:
        """The directions that a cloud can tell: see `likelihood_informed`."""
        kept = likelihood_informed(self.model, observed, rule, self.forces.scale.median)
        return Prepared(self.forces.combined(kept), self.model.combined(kept), self.whole)

    def leading(self, count: int) -> Prepared:
        """The first directions alone."""
        some = np.eye(self.forces.size)[:, :count]
        return Prepared(self.forces.leading(count), self.model.combined(some), self.whole)

    @cached_property
    def unseen(self) -> Floats:
        """Displacements by the directions of force that were left out, for unit scale, (3n, r)."""
        return unseen_response(self.model, self.forces)
