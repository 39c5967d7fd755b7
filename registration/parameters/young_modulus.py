"""Young's modulus of a body or of a region of it, unknown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import Parameter

from .block import Estimate, check_deviation, estimate
from .input_block import InputBlock, with_parameters

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
MINIMUM_MODULUS = 10.0  # pascals: nothing softer is an organ
_STRIDE = np.log(10.0)  # largest change of the logarithm in one step


@dataclass(frozen=True, eq=False)
class YoungModulus(InputBlock):
    """Young's modulus of a body or of a region: E = 10 Pa + (E0 - 10 Pa) exp(s c) with E0 that the body has.

    Args:
        deviation: s, of the logarithm.
        cells: numbers of the region's cells; all cells if not given.
        name: of the region.
    """

    deviation: float = 0.5
    cells: Ints | None = None
    name: str = ""

    def __post_init__(self) -> None:
        check_deviation("YoungModulus", self.deviation)

    @property
    def needs(self) -> tuple[str, ...]:
        """Young's modulus."""
        return ("young_modulus",)

    @property
    def size(self) -> int:
        """1."""
        return 1

    @property
    def strides(self) -> Floats:
        """Largest change of the coefficient in one step: ten times as stiff."""
        return np.array([_STRIDE / self.deviation])

    def check(self, body: Body, parameters: Mapping[str, Parameter]) -> None:
        """See `InputBlock.check`: a modulus above the least, a region of cells of the body."""
        moduli = np.asarray(parameters["young_modulus"])
        if moduli.min() <= MINIMUM_MODULUS:
            raise ValueError(
                f"InputBlocks.parameters: expected a Young's modulus above {MINIMUM_MODULUS:g} Pa to estimate it, got "
                f"{moduli.min():g} Pa."
            )
        if self.cells is None:
            return
        if len(self.cells) == 0 or self.cells.min() < 0 or self.cells.max() >= len(body.cells):
            raise ValueError(
                f"YoungModulus.cells: expected numbers of at least one of the body's {len(body.cells)} cells, got "
                f"{len(self.cells)} of them."
            )
        if moduli.ndim == 0:
            raise ValueError(
                "InputBlocks.parameters: expected one Young's modulus for each cell where a region's is unknown, got "
                "one for all."
            )

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the body's or the region's stiffness at coefficients."""
        before = inputs.parameters["young_modulus"]
        return with_parameters(inputs, young_modulus=self._there(before, self._modulus(before, coefficients[0])))

    def _modulus(self, median: Parameter, coefficient: float) -> Parameter:
        grown = MINIMUM_MODULUS + (np.asarray(median) - MINIMUM_MODULUS) * np.exp(self.deviation * coefficient)
        return grown if grown.ndim else float(grown)

    def _there(self, elsewhere: Parameter, here: Parameter) -> Parameter:
        if self.cells is None:
            return here
        whole = np.array(elsewhere, dtype=np.float64)
        whole[self.cells] = np.asarray(here)[self.cells]
        return whole

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative by the coefficient, (cells,)."""
        whole = np.broadcast_to(inputs.parameters["young_modulus"], (len(body.cells),))
        slope = self.deviation * (whole - MINIMUM_MODULUS)
        return [Change(parameters={"young_modulus": self._there(np.zeros(len(body.cells)), slope)})]

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """Young's modulus, pascals; of several moduli, the mean of theirs."""
        name = f"Young's modulus of {self.name}" if self.name else "Young's modulus"
        at = self._grown(inputs)
        return [estimate(name, "Pa", lambda c: at(self.deviation * c), mean[0], covariance[0, 0])]

    def beside(self, found: Estimate, inputs: Inputs, grown: float, variance: float) -> Estimate:
        """A region's estimate where the body's modulus is unknown, too: both have their part in it.

        Args:
            found: its own.
            inputs: at all coefficients' medians beforehand.
            grown: logarithm by which both make the modulus grow.
            variance: of that.
        """
        both = estimate(found.name, found.unit, self._grown(inputs), grown, variance)
        return replace(found, value=both.value, interval=both.interval)

    def _grown(self, inputs: Inputs) -> Callable[[float], float]:
        """The modulus as a function of the logarithm by which it grows."""
        median = np.asarray(inputs.parameters["young_modulus"])
        chosen = median if self.cells is None or not median.ndim else median[self.cells]
        return lambda change: float(np.mean(MINIMUM_MODULUS + (chosen - MINIMUM_MODULUS) * np.exp(change)))
