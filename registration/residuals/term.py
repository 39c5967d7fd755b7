"""A residual term: measurements beside the distances of a cloud, over their standard deviations.

A new kind of measurement is one class: its residuals, and how they follow from what moves (`Slopes`). Derivatives by
all parameters and their adjoint follow from that.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from ..evaluation import Evaluation, Slopes
from ..loss import Loss
from ..policy import POLICY
from ..surface_distance import Correspondence
from ..verdict import Check, Code, checked

Floats = NDArray[np.float64]


class ResidualTerm:
    """Residuals over their standard deviations: standard normal where model and measurements are right."""

    @property
    def name(self) -> str:
        """What was measured, as records and reports say it."""
        return type(self).__name__

    @property
    def loss(self) -> Loss | None:
        """What a residual costs; None for what a distance of the cloud does."""
        return None

    def values(self, at: Evaluation, held: Correspondence | None = None) -> Floats:
        """The residuals, (r,).

        Args:
            at: the problem at a trial.
            held: a match of the cloud that stays as it is where two trials are compared; the trial's if not given.
        """
        raise NotImplementedError

    def slopes(self, at: Evaluation, held: Correspondence | None = None) -> Slopes:
        """How they follow from the observed nodes and from the measured places, r of them."""
        raise NotImplementedError

    def checks(self, at: Evaluation) -> Iterator[Check]:
        """What would make a result doubtful: by default, squares that are larger than chi-square has them.

        Args:
            at: the problem where a solver ended.
        """
        values = self.values(at)
        if not len(values):
            return
        square, count = float(values @ values), len(values)
        law = f"chi-square, {count} degrees of freedom", float(chdtrc(count, square))
        rms = np.sqrt(square / count)
        off = f"{self.name}: residuals are {rms:.1f} times their standard deviation"
        yield checked(
            Code.RESIDUAL_TERM, square, float(chdtri(count, POLICY.unlikely_score)), off, law=law, subject=self.name
        )
