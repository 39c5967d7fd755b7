"""Normals measured with a cloud: how far the surface leans from them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..evaluation import Evaluation, Slopes
from ..policy import POLICY
from ..surface_distance import Correspondence
from ..verdict import Check, Code, checked
from .term import ResidualTerm

Floats = NDArray[np.float64]
# Radians, of a measured normal across itself: cameras' are off by some 10 degrees, and flat triangles by some more.
NORMAL_DEVIATION = float(np.deg2rad(10.0))


class Normals(ResidualTerm):
    """How far the surface leans towards two directions across each measured normal, over its deviation, (2p,).

    A normal counts up to its sign. A surface that is turned by an angle leans by its sine.

    Args:
        tangent_basis: two unit vectors across each point's normal, in the cloud's axes, (p, 2, 3); zeros where none was
            measured.
        deviation: standard deviation of a normal across itself, radians.
    """

    def __init__(self, tangent_basis: Floats, deviation: float = NORMAL_DEVIATION) -> None:
        self.tangent_basis, self.deviation = tangent_basis, deviation

    def _across(self, at: Evaluation) -> Floats:
        """In the body's coordinates."""
        return self.tangent_basis if at.pose is None else self.tangent_basis @ at.pose.rotation

    def values(self, at: Evaluation, held: Correspondence | None = None) -> Floats:
        """See `ResidualTerm.values`; where closest points go on to the next triangle they jump."""
        facing = at.observed.facing(held or at.match, at.positions)
        return np.einsum("pqi,pi->pq", self._across(at), facing).ravel() / self.deviation

    def slopes(self, at: Evaluation, held: Correspondence | None = None) -> Slopes:
        """See `ResidualTerm.slopes`; exact for triangles that are held."""
        match, along = held or at.match, self._across(at) / self.deviation
        facing = np.repeat(at.observed.facing(match, at.positions), 2, axis=0)
        rows = at.observed.facing_rows(match, at.positions, along)
        return Slopes(rows, along.reshape(-1, 3), facing, are_directions=True)

    def checks(self, at: Evaluation) -> Iterator[Check]:
        """Normals that are none of this surface's: of another frame, say, or columns of something else."""
        known = np.abs(self.tangent_basis).max(axis=(1, 2)) > 0.0
        if not known.any():
            return
        leaning = np.linalg.norm(self.values(at).reshape(-1, 2)[known], axis=1) * self.deviation
        median = float(np.rad2deg(np.arcsin(np.minimum(np.median(leaning), 1.0))))
        expected = float(np.rad2deg(np.sqrt(2.0 * np.log(2.0)) * self.deviation))  # Rayleigh's law
        lean = (
            f"the cloud's normals do not match: half of them lean by more than {median:.0f} degrees from the surface "
            f"found, where {expected:.0f} were expected"
        )
        yield checked(Code.NORMALS, median, POLICY.deviations * expected, lean, unit="degrees")
