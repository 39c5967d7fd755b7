"""Poisson's ratio of a body, unknown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import Parameter

from .block import Estimate, check_deviation, estimate
from .input_block import InputBlock, with_parameters

Floats = NDArray[np.float64]
LOWEST_RATIO, HIGHEST_RATIO = 0.2, 0.5  # open ends (Odot 2023, figure 7.27)
_STRIDE = 1.5  # largest change before the map in one step


@dataclass(frozen=True)
class PoissonRatio(InputBlock):
    """Poisson's ratio through the logistic map onto ]0.2, 0.5[ (Odot 2023, figure 7.27), normal before it.

    Args:
        deviation: before the map.
    """

    deviation: float = 1.0

    def __post_init__(self) -> None:
        check_deviation("PoissonRatio", self.deviation)

    @property
    def needs(self) -> tuple[str, ...]:
        """Poisson's ratio."""
        return ("poisson_ratio",)

    @property
    def size(self) -> int:
        """1."""
        return 1

    @property
    def strides(self) -> Floats:
        """Largest change of the coefficient in one step."""
        return np.array([_STRIDE / self.deviation])

    def check(self, body: Body, parameters: Mapping[str, Parameter]) -> None:
        """See `InputBlock.check`: a ratio within the map."""
        ratios = np.asarray(parameters["poisson_ratio"])
        if not ((ratios > LOWEST_RATIO) & (ratios < HIGHEST_RATIO)).all():
            raise ValueError(
                f"InputBlocks.parameters: expected Poisson's ratio in ]{LOWEST_RATIO}, {HIGHEST_RATIO}[ where it is "
                f"unknown, got {ratios.min():g} to {ratios.max():g}."
            )

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the ratio at coefficients."""
        return with_parameters(inputs, poisson_ratio=self._ratio(inputs.parameters["poisson_ratio"], coefficients[0]))

    def _ratio(self, median: Parameter, coefficient: float) -> Parameter:
        width = HIGHEST_RATIO - LOWEST_RATIO
        before = logit((np.asarray(median) - LOWEST_RATIO) / width)
        found = LOWEST_RATIO + width * expit(before + self.deviation * coefficient)
        found = np.minimum(found, np.nextafter(HIGHEST_RATIO, 0.0))  # far out, the map ends at 0.5 itself
        return found if found.ndim else float(found)

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative by the coefficient, (cells,)."""
        ratio = np.broadcast_to(inputs.parameters["poisson_ratio"], (len(body.cells),))
        slope = (ratio - LOWEST_RATIO) * (HIGHEST_RATIO - ratio) / (HIGHEST_RATIO - LOWEST_RATIO)
        return [Change(parameters={"poisson_ratio": self.deviation * slope})]

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """Poisson's ratio."""
        median = float(np.mean(inputs.parameters["poisson_ratio"]))

        def at(coefficient: float) -> float:
            return float(self._ratio(median, coefficient))

        return [estimate("Poisson's ratio", "", at, mean[0], covariance[0, 0])]
