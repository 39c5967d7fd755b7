"""The parameters of a problem: blocks one after the other, and where the coefficients of each are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from .block import ParameterBlock
from .correlated_noise import CorrelatedNoise
from .discrepancy import ModelError
from .inputs import InputBlocks
from .nodal_forces import NodalForces
from .pose import PosePrior

Floats = NDArray[np.float64]
_Kind = TypeVar("_Kind", bound=ParameterBlock)


@dataclass(frozen=True, eq=False)
class ParameterStack:
    """Blocks of parameters, the nodal forces among them; those that explain distances alone come last.

    Args:
        blocks: the parameters.
    """

    blocks: tuple[ParameterBlock, ...]

    @cached_property
    def parts(self) -> tuple[tuple[ParameterBlock, slice], ...]:
        """Each block, and where its coefficients are."""
        ends = np.cumsum([0, *(block.size for block in self.blocks)]).tolist()
        return tuple(zip(self.blocks, map(slice, ends[:-1], ends[1:]), strict=True))

    @cached_property
    def size(self) -> int:
        """Number of coefficients, k."""
        return self.parts[-1][1].stop

    @cached_property
    def moving(self) -> slice:
        """Where the coefficients of the blocks are that move the organ or the camera."""
        return slice(0, max(part.stop for block, part in self.parts if block.is_moving))

    def block(self, kind: type[_Kind]) -> _Kind | None:
        """The block of a kind; None where there is none."""
        return next((block for block in self.blocks if isinstance(block, kind)), None)

    def part(self, kind: type[ParameterBlock]) -> slice:
        """Where its coefficients are; nowhere for a kind that there is none of."""
        return next((part for block, part in self.parts if isinstance(block, kind)), slice(0, 0))

    @cached_property
    def forces(self) -> NodalForces:
        """The nodal forces."""
        found = self.block(NodalForces)
        assert found is not None
        return found

    @cached_property
    def force_part(self) -> slice:
        """Where their coefficients are."""
        return self.part(NodalForces)

    @cached_property
    def pose_part(self) -> slice:
        """Where the coefficients of the pose are."""
        return self.part(PosePrior)

    @cached_property
    def input_part(self) -> slice:
        """Where those of the model's unknown inputs are."""
        return self.part(InputBlocks)

    @cached_property
    def pose(self) -> PosePrior | None:
        """The pose; None where the cloud is in the body's coordinates."""
        return self.block(PosePrior)

    @cached_property
    def inputs(self) -> InputBlocks | None:
        """Unknown inputs of the model beside the forces; None for none."""
        return self.block(InputBlocks)

    @cached_property
    def error(self) -> ModelError | None:
        """What the model may get wrong; None where it is not known in patterns."""
        return self.block(ModelError)

    @cached_property
    def shared(self) -> CorrelatedNoise | None:
        """Noise that neighbouring points share; None where each point errs by itself."""
        return self.block(CorrelatedNoise)

    def with_shared(self, shared: CorrelatedNoise | None) -> Self:
        """The same with other noise that neighbours share, or without: its coefficients come last."""
        others = tuple(block for block in self.blocks if not isinstance(block, CorrelatedNoise))
        return replace(self, blocks=others if shared is None else (*others, shared))

    @cached_property
    def unshared(self) -> Self:
        """The same without noise that neighbours share: its coefficients are the first of these."""
        return self if self.shared is None else self.with_shared(None)

    def sized(self, coefficients: Floats) -> Floats:
        """Coefficients of the same with or without shared noise for this one, (k,): those of that noise come last."""
        if len(coefficients) == self.size:
            return coefficients
        found = np.zeros(self.size)
        found[: len(coefficients)] = coefficients[: self.size]
        return found

    def carried(self, coefficients: Floats, before: ParameterStack) -> Floats:
        """Coefficients of another problem for a start of this one, (k,); what it did not have is zero.

        Args:
            coefficients: of the other problem.
            before: that problem.
        """
        start, left = np.zeros(self.size), list(before.parts)
        for block, part in self.parts:
            same = next((each for each in left if type(each[0]) is type(block) and each[0].size == block.size), None)
            if same is not None:
                start[part] = coefficients[same[1]]
                left.remove(same)
        return start

    def prior_variances(self, eta: Floats) -> tuple[Floats, Floats]:
        """Logarithms of the coefficients' variances beforehand, (k,), and their derivatives by eta, (5, k)."""
        logs, slopes = np.zeros(self.size), np.zeros((len(eta), self.size))
        for block, part in self.parts:
            logs[part], derivatives = block.log_variances(eta)
            for place, derivative in derivatives.items():
                slopes[place, part] = derivative
        return logs, slopes
