"""Several unknown inputs of the forward model together: stiffness, Poisson's ratio, motions, contacts.

Their coefficients have unit variance beforehand. Under nodal forces that keep their direction, and fixed supports, a
state depends on forces over stiffness alone: what then tells them apart is the prior, or a load that is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import Parameter

from ..evaluation import Evaluation, Slopes
from ..expectations import Expectations
from ..forward import ParametrisedState
from ..verdict import Check, Code, Verdict
from .block import BlockPosterior, Estimate, ParameterBlock
from .identifiability import uninformed
from .input_block import InputBlock
from .young_modulus import MINIMUM_MODULUS, YoungModulus

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class InputBlocks(ParameterBlock):
    """Several unknowns beside the forces.

    Args:
        body: the body.
        parameters: of its material, by name: what is expected of them beforehand.
        blocks: each once.

    Raises:
        ValueError: a parameter that the material does not have, a region of no cells, a ratio out of its map, a set of
            nodes that the body does not have, stiffness of a region where the material has one for all cells.
    """

    body: Body
    parameters: Mapping[str, Parameter]
    blocks: tuple[InputBlock, ...]

    def __post_init__(self) -> None:
        for block in self.blocks:
            missing = [name for name in block.needs if name not in self.parameters]
            if missing:
                raise ValueError(
                    f"InputBlocks.blocks: expected inputs of a material with {sorted(self.parameters)}, got "
                    f"{type(block).__name__}, which needs {', '.join(missing)}."
                )
            block.check(self.body, self.parameters)
        labels = [block.label for block in self.blocks]
        twice = sorted({label for label in labels if labels.count(label) > 1})
        if twice:
            raise ValueError(f"InputBlocks.blocks: expected each input once, got {', '.join(twice)} several times.")

    @property
    def size(self) -> int:
        """Number of coefficients of all."""
        return sum(block.size for block in self.blocks)

    @property
    def expected(self) -> Inputs:
        """The inputs before any cloud, unknowns left out."""
        wanted = {"young_modulus", "poisson_ratio"} & self.parameters.keys()
        return Inputs({name: self.parameters[name] for name in sorted(wanted)})

    @property
    def moved_nodes(self) -> Ints:
        """Numbers of the nodes whose displacement is prescribed, sorted."""
        nodes = [block.moved_nodes(self.body) for block in self.blocks]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *nodes]))

    def _parts(self, coefficients: Floats) -> list[tuple[InputBlock, Floats]]:
        ends = np.cumsum([unknown.size for unknown in self.blocks])
        return list(zip(self.blocks, np.split(coefficients, ends[:-1]), strict=True))

    def inputs(self, coefficients: Floats) -> Inputs:
        """The inputs at coefficients, (c,)."""
        inputs = self.expected
        for unknown, part in self._parts(coefficients):
            inputs = unknown.taken(inputs, part, self.body)
        return inputs

    def changes(self, coefficients: Floats) -> list[Change]:
        """Derivative of the inputs by each coefficient."""
        inputs, found = self.inputs(coefficients), []
        for unknown, part in self._parts(coefficients):
            found += unknown.changes(inputs, part, self.body)
        return found

    @property
    def modulus(self) -> tuple[int, float] | None:
        """Place and deviation of the coefficient of the whole body's Young's modulus; None where that is no unknown."""
        begin = 0
        for unknown in self.blocks:
            if isinstance(unknown, YoungModulus) and unknown.cells is None:
                return begin, unknown.deviation
            begin += unknown.size
        return None

    def stiffness_scaling(self, coefficients: Floats) -> tuple[float, Floats]:
        """Factor by which forces grow with the whole body's Young's modulus, and its derivative, (c,).

        Forces are expected of a size for a stiffness: a body twice as stiff is pulled at twice as hard. Were they
        expected in newtons, the most probable body would be too soft, since a softer one needs less of them.

        Args:
            coefficients: (c,).
        """
        slopes, modulus = np.zeros(self.size), self.modulus
        if modulus is None:
            return 1.0, slopes
        place, deviation = modulus
        minimum = MINIMUM_MODULUS / float(np.mean(self.parameters["young_modulus"]))
        grown = (1.0 - minimum) * float(np.exp(deviation * coefficients[place]))
        slopes[place] = deviation * grown
        return minimum + grown, slopes

    @property
    def has_regions(self) -> bool:
        """Whether the stiffness of a part of the body is an unknown of its own."""
        return any(isinstance(unknown, YoungModulus) and unknown.cells is not None for unknown in self.blocks)

    def shares(self, direction: Floats) -> Floats:
        """How far each unknown's own value goes along a direction of the coefficients, in its deviations beforehand.

        They are the direction itself, but for a region beside the whole body: its modulus grows with both.

        Args:
            direction: (c,).
        """
        found, begin, modulus = direction.copy(), 0, self.modulus
        for unknown in self.blocks:
            if isinstance(unknown, YoungModulus) and modulus is not None and unknown.cells is not None:
                both = np.array([unknown.deviation, modulus[1]])
                found[begin] = both @ direction[[begin, modulus[0]]] / np.linalg.norm(both)
            begin += unknown.size
        return found

    @property
    def has_forces_alone(self) -> bool:
        """Whether every forward model takes them."""
        return all(unknown.is_force for unknown in self.blocks)

    def forces(self, coefficients: Floats) -> Floats:
        """Nodal forces among the inputs, (n, 3), newtons."""
        found = self.inputs(coefficients).forces
        return np.zeros_like(self.body.points) if found is None else found

    def net_forces(self, coefficients: Floats) -> Floats:
        """Derivative of their net force by each coefficient, (3, c)."""
        columns = [change.forces for change in self.changes(coefficients)]
        nets = [np.zeros(3) if column is None else np.asarray(column).sum(axis=0) for column in columns]
        return np.stack(nets, axis=1)

    def is_too_far(self, change: Floats) -> bool:
        """Whether a change of the coefficients is more than one step may make."""
        strides = np.concatenate([unknown.strides for unknown in self.blocks])
        return bool((np.abs(change) > strides).any())

    def estimates(self, mean: Floats, covariance: Floats) -> tuple[Estimate, ...]:
        """What is known of each unknown.

        Args:
            mean: coefficients found, (c,).
            covariance: of theirs, (c, c).
        """
        found, begin, modulus = list[Estimate](), 0, self.modulus
        for unknown, part in self._parts(mean):
            own = slice(begin, begin + unknown.size)
            each = unknown.estimates(self.expected, part, covariance[own, own])
            if isinstance(unknown, YoungModulus) and modulus is not None and unknown.cells is not None:
                along = np.zeros(self.size)
                along[begin], along[modulus[0]] = unknown.deviation, modulus[1]
                law = float(along @ mean), float(along @ covariance @ along)
                each = [unknown.beside(each[0], self.expected, *law)]
            found += each
            begin = own.stop
        return tuple(found)

    def jacobian(self, at: Evaluation, coefficients: Floats, slopes: Slopes) -> Floats:
        """See `ParameterBlock.jacobian`."""
        return cast(ParametrisedState, at.state).rows_by_parameters(slopes.rows)

    def moved(self, at: Evaluation, change: Floats, every: int) -> Floats:
        """See `ParameterBlock.moved`."""
        found: Floats = self.full_columns(at, change).reshape(-1, 3, self.size)[at.observed.nodes[::every]] @ change
        return found

    def full_columns(self, at: Evaluation, coefficients: Floats) -> Floats:
        """See `ParameterBlock.full_columns`."""
        return cast(ParametrisedState, at.state).by_parameters()

    def checks(self, found: BlockPosterior, expected: Expectations) -> Iterator[Check]:
        """Unknowns far from where they were expected, and those that the cloud says nothing of.

        With unknown forces the latter is no fault: the prior of the stiffness is what the newtons are worth. Nor is it
        one of a contact, which only its place along the surface tells.
        """
        yield from super().checks(found, expected)
        if not found.has_forces and not self.has_forces_alone:
            yield from self._identifiability(found, expected)

    def _identifiability(self, found: BlockPosterior, expected: Expectations) -> Iterator[Check]:
        """Unknowns, and combinations of them, of which the cloud has left most of what was believed beforehand."""
        covariance = found.covariance
        names = [known.name for known in self.estimates(found.mean, covariance)]
        if self.has_regions:
            names = [f"{name} of the rest" if name == "Young's modulus" else name for name in names]
        alone, combined = uninformed(self.shares, names, covariance, expected.minimum_variance_reduction)
        kept = float(np.linalg.eigvalsh(covariance)[-1]) if np.isfinite(covariance).all() else np.inf
        level = 1.0 - expected.minimum_variance_reduction
        given = "what is given is what was expected beforehand"
        same = "other values that differ so would explain it as well"
        reasons = [(name, given) for name in alone] + [(name, same) for name in combined]
        if not reasons:
            yield Check(Code.IDENTIFIABILITY, Verdict.ACCEPTED, kept, level, "of the variance beforehand")
        for name, why in reasons:
            reason = f"the cloud does not tell {name} under this load: {why}"
            unit = "of the variance beforehand"
            yield Check(Code.IDENTIFIABILITY, Verdict.DOUBTFUL, kept, level, unit, subject=name, reason=reason)
