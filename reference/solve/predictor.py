"""What says where an equilibrium is likely to be, so that Newton's method starts there (hybrid Newton)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

from ..data.materials import MATERIALS, Material
from .problem import Problem
from .start import Proposal

Floats = NDArray[np.float64]
_PATIENCE, _LONGEST_PAUSE = 8, 64  # solves
_PARAMETERS = ("young_modulus", "poisson_ratio")


class Predictor(Protocol):
    """What says where an equilibrium is likely to be, as far as a search starts there: a surrogate."""

    @property
    def body(self) -> Body:
        """The body that it knows."""

    @property
    def learned_material(self) -> Mapping[str, Any] | None:
        """`material`, `young_modulus`, `poisson_ratio` that it has learned; None where that is not known."""

    def propose(self, forces: ArrayLike, linear: Floats | None = None) -> Floats:
        """The displacement, (n, 3), metres, that is thought to balance nodal forces, (n, 3), newtons.

        Args:
            forces: nodal forces.
            linear: the linear response to them, (n, 3), metres, where that is known.
        """


class Adviser:
    """A predictor that is asked ever more seldom while it is of no use, so that a poor one costs next to nothing.

    After eight solves in a row that went on from elsewhere it is left out of the next, then of the next two, four and
    so on up to 64, and asked once between; the first solve that goes on from what it says makes it asked every time
    again.

    Args:
        predictor: it.
    """

    def __init__(self, predictor: Predictor) -> None:
        self.predictor = predictor
        self._losses, self._pause = 0, 0

    def proposal(self, forces: Floats) -> Proposal | None:
        """What to offer to a solve of nodal forces, (n, 3), newtons; None where it is left out."""
        if self._pause > 0:
            self._pause -= 1
            return None
        return proposal_for(forces, self.predictor)

    def learn(self, was_of_use: bool) -> None:
        """Say whether the solve that something was offered to went on from it."""
        self._losses = 0 if was_of_use else self._losses + 1
        if self._losses >= _PATIENCE:
            self._pause = int(min(2 ** (self._losses - _PATIENCE), _LONGEST_PAUSE))


def check_predictor(predictor: Predictor, problem: Problem) -> None:
    """Refuse what has learned other equilibria.

    Raises:
        ValueError: a predictor of another body or material.
    """
    if predictor.body.fingerprint != problem.body.fingerprint:
        raise ValueError(
            f"predictor: expected a network of this body (fingerprint {problem.body.fingerprint[:12]}...), got one of "
            f"another ({predictor.body.fingerprint[:12]}...)."
        )
    if not knows_material(predictor, problem.material):
        learned = predictor.learned_material or {}
        theirs = {name: learned[name] for name in _PARAMETERS}
        raise ValueError(
            f"predictor: expected a network of {problem.material!r}, got one that has learned {learned['material']} "
            f"with {theirs}; its proposals would lie elsewhere."
        )


def knows_material(predictor: Predictor, material: Material) -> bool:
    """Whether a predictor has learned equilibria of a material, as far as it says what it has learned."""
    learned = predictor.learned_material
    if learned is None:
        return True
    law = MATERIALS.get(learned["material"])
    same = law is not None and isinstance(material, law)
    return same and not any(np.any(getattr(material, name, None) != learned[name]) for name in _PARAMETERS)


def proposal_for(forces: Floats, predictor: Predictor) -> Proposal:
    """What a predictor says of nodal forces, (n, 3), newtons, as a solve asks for it.

    It says nothing of forces where it has never seen any, and nothing that one could not start from.
    """

    def proposed(linear: Floats) -> Floats | None:
        try:
            found = predictor.propose(forces, linear)
        except ValueError:
            return None
        return found if np.isfinite(found).all() else None

    return proposed
