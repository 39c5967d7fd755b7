"""Unknowns of what a body is made of and of how it is moved, beside the forces: stiffness, Poisson's ratio, a region.

Their coefficients have unit variance beforehand. Under nodal forces that keep their direction, and fixed supports, a
state depends on forces over stiffness alone: what then tells them apart is the prior, or a load that is known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from softtwin.meshes.body import Body
from softtwin.reference.data.inputs import Change, Inputs
from softtwin.reference.data.materials import Parameter

from .pose import Pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
MINIMUM_MODULUS = 10.0  # pascals: nothing softer is an organ
LOWEST_RATIO, HIGHEST_RATIO = 0.2, 0.5  # open ends (Odot 2023, figure 7.27)
WITHIN_90 = 1.6449  # deviations of a normal law that hold 90 %
_STRIDE = {"modulus": np.log(10.0), "ratio": 1.5, "turn": 0.3}  # largest change in one step


@dataclass(frozen=True)
class Estimate:
    """What is known of one unknown after a cloud.

    Args:
        name: of the unknown.
        unit: of the values.
        value: median.
        interval: that holds it with 90 %.
        variance_reduction: part of its variance beforehand that the cloud has taken away, 0 to 1.
        deviations: how far it lies from what was expected.
    """

    name: str
    unit: str
    value: float
    interval: tuple[float, float]
    variance_reduction: float
    deviations: float


class ParameterBlock(Protocol):
    """One unknown: coefficients of unit variance to a part of the inputs."""

    @property
    def is_force(self) -> bool:
        """Whether nodal forces are all that it changes: every forward model takes those."""

    @property
    def count(self) -> int:
        """Number of coefficients."""

    @property
    def strides(self) -> Floats:
        """Largest change of each coefficient that one step may make, (count,)."""

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with this unknown at coefficients."""

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the inputs by each coefficient, at the inputs that all unknowns lead to."""

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """What is known of it.

        Args:
            inputs: at all coefficients' medians beforehand.
            mean: coefficients found, (count,).
            covariance: of theirs, (count, count).
        """


@dataclass(frozen=True, eq=False)
class YoungModulus:
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
        check_deviation("Stiffness", self.deviation)

    @property
    def is_force(self) -> bool:
        """False."""
        return False

    @property
    def count(self) -> int:
        """1."""
        return 1

    @property
    def strides(self) -> Floats:
        """Largest change of the coefficient in one step: ten times as stiff."""
        return np.array([_STRIDE["modulus"] / self.deviation])

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the body's or the region's stiffness at coefficients."""
        before = inputs.parameters["young_modulus"]
        return _with(inputs, young_modulus=self._there(before, self._modulus(before, coefficients[0])))

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


@dataclass(frozen=True)
class PoissonRatio:
    """Poisson's ratio through the logistic map onto ]0.2, 0.5[ (Odot 2023, figure 7.27), normal before it.

    Args:
        deviation: before the map.
    """

    deviation: float = 1.0

    def __post_init__(self) -> None:
        check_deviation("PoissonRatio", self.deviation)

    @property
    def is_force(self) -> bool:
        """False."""
        return False

    @property
    def count(self) -> int:
        """1."""
        return 1

    @property
    def strides(self) -> Floats:
        """Largest change of the coefficient in one step."""
        return np.array([_STRIDE["ratio"] / self.deviation])

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the ratio at coefficients."""
        return _with(inputs, poisson_ratio=self._ratio(inputs.parameters["poisson_ratio"], coefficients[0]))

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


@dataclass(frozen=True)
class PrescribedMotion:
    """A node set that is moved as a rigid whole: what grips it, a support that has shifted.

    Args:
        name: of the node set; the model's problem holds all its axes.
        rotation_deviation: standard deviation of the turn about each axis, radians.
        translation_deviation: of the shift along each axis, metres.
    """

    name: str
    rotation_deviation: float = 0.2
    translation_deviation: float = 0.01

    def __post_init__(self) -> None:
        check_deviation("PrescribedMotion.rotation_deviation", self.rotation_deviation)
        check_deviation("PrescribedMotion.translation_deviation", self.translation_deviation)

    @property
    def is_force(self) -> bool:
        """False."""
        return False

    @property
    def count(self) -> int:
        """6: turn and shift."""
        return 6

    @property
    def strides(self) -> Floats:
        """Largest changes of the coefficients in one step; shifts are held by how far nodes may move."""
        return np.repeat([_STRIDE["turn"] / self.rotation_deviation, np.inf], 3)

    def _twist(self, coefficients: Floats) -> Floats:
        return np.repeat([self.rotation_deviation, self.translation_deviation], 3) * coefficients

    def _places(self, body: Body) -> tuple[Floats, Floats]:
        places = body.points[body.node_sets[self.name]]
        return places, places.mean(axis=0)

    def taken(self, inputs: Inputs, coefficients: Floats, body: Body) -> Inputs:
        """The inputs with the region where coefficients put it."""
        places, centre = self._places(body)
        moved = Pose.identity().moved(self._twist(coefficients), centre).apply(places) - places
        return replace(inputs, displacement={**inputs.displacement, self.name: moved})

    def changes(self, inputs: Inputs, coefficients: Floats, body: Body) -> list[Change]:
        """Derivative of the prescribed displacements by each coefficient, (n, 3)."""
        places, centre = self._places(body)
        columns = Pose.identity().moved_jacobian(places, self._twist(coefficients), centre)
        found = []
        for column in (columns * np.repeat([self.rotation_deviation, self.translation_deviation], 3)).T:
            whole = np.zeros_like(body.points)
            whole[body.node_sets[self.name]] = column.reshape(-1, 3)
            found.append(Change(displacement=whole))
        return found

    def estimates(self, inputs: Inputs, mean: Floats, covariance: Floats) -> list[Estimate]:
        """Turn, radians, and shift, metres, about and along each axis."""
        found = []
        for place, (kind, axis) in enumerate((kind, axis) for kind in ("turn", "shift") for axis in "xyz"):
            scale, unit = (self.rotation_deviation, "rad") if kind == "turn" else (self.translation_deviation, "m")

            def at(c: float, scale: float = scale) -> float:
                return scale * c

            name = f"{kind} of {self.name} {'about' if kind == 'turn' else 'along'} {axis}"
            found.append(estimate(name, unit, at, mean[place], covariance[place, place]))
        return found


@dataclass(frozen=True, eq=False)
class ParameterBlocks:
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
    blocks: tuple[ParameterBlock, ...]
    count: int = field(init=False)

    def __post_init__(self) -> None:
        for unknown in self.blocks:
            self._check(unknown)
        names = [_name(unknown) for unknown in self.blocks]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(
                f"ParameterBlocks.blocks: expected each unknown once, got {', '.join(twice)} several times."
            )
        object.__setattr__(self, "count", sum(unknown.count for unknown in self.blocks))

    def _check(self, unknown: ParameterBlock) -> None:
        for kind, name in ((YoungModulus, "young_modulus"), (PoissonRatio, "poisson_ratio")):
            if isinstance(unknown, kind) and name not in self.parameters:
                raise ValueError(
                    f"ParameterBlocks.blocks: expected unknowns of a material with {sorted(self.parameters)}, got "
                    f"{kind.__name__}, which needs {name}."
                )
        if isinstance(unknown, YoungModulus):
            self._check_stiffness(unknown)
        if isinstance(unknown, PoissonRatio):
            ratios = np.asarray(self.parameters["poisson_ratio"])
            if not ((ratios > LOWEST_RATIO) & (ratios < HIGHEST_RATIO)).all():
                raise ValueError(
                    f"ParameterBlocks.parameters: expected Poisson's ratio in ]{LOWEST_RATIO}, {HIGHEST_RATIO}[ where "
                    f"it is unknown, got {ratios.min():g} to {ratios.max():g}."
                )
        if isinstance(unknown, PrescribedMotion) and unknown.name not in self.body.node_sets:
            raise ValueError(
                f"PrescribedMotion.name: expected a node set among {sorted(self.body.node_sets)}, got {unknown.name!r}."
            )

    def _check_stiffness(self, unknown: YoungModulus) -> None:
        moduli = np.asarray(self.parameters["young_modulus"])
        if moduli.min() <= MINIMUM_MODULUS:
            raise ValueError(
                f"ParameterBlocks.parameters: expected a Young's modulus above {MINIMUM_MODULUS:g} Pa to estimate it, "
                f"got {moduli.min():g} Pa."
            )
        if unknown.cells is None:
            return
        if len(unknown.cells) == 0 or unknown.cells.min() < 0 or unknown.cells.max() >= len(self.body.cells):
            raise ValueError(
                f"YoungModulus.cells: expected numbers of at least one of the body's {len(self.body.cells)} cells, "
                f"got {len(unknown.cells)} of them."
            )
        if moduli.ndim == 0:
            raise ValueError(
                "ParameterBlocks.parameters: expected one Young's modulus for each cell where a region's is unknown, "
                "got one for all."
            )

    @property
    def expected(self) -> Inputs:
        """The inputs before any cloud, unknowns left out."""
        wanted = {"young_modulus", "poisson_ratio"} & self.parameters.keys()
        return Inputs({name: self.parameters[name] for name in sorted(wanted)})

    @property
    def moved(self) -> Ints:
        """Numbers of the nodes whose displacement is prescribed, sorted."""
        names = [unknown.name for unknown in self.blocks if isinstance(unknown, PrescribedMotion)]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(self.body.node_sets[name] for name in names)]))

    def _parts(self, coefficients: Floats) -> list[tuple[ParameterBlock, Floats]]:
        ends = np.cumsum([unknown.count for unknown in self.blocks])
        return list(zip(self.blocks, np.split(coefficients, ends[:-1]), strict=True))

    def inputs(self, coefficients: Floats) -> Inputs:
        """The inputs at coefficients, (count,)."""
        inputs = self.expected
        for unknown, part in self._parts(coefficients):
            inputs = unknown.taken(inputs, part, self.body)
        return inputs

    def changes(self, coefficients: Floats) -> list[Change]:
        """Derivative of the inputs by each coefficient, count of them."""
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
            begin += unknown.count
        return None

    def stiffness_scaling(self, coefficients: Floats) -> tuple[float, Floats]:
        """Factor by which forces grow with the whole body's Young's modulus, and its derivative, (count,).

        Forces are expected of a size for a stiffness: a body twice as stiff is pulled at twice as hard. Were they
        expected in newtons, the most probable body would be too soft, since a softer one needs less of them.

        Args:
            coefficients: (count,).
        """
        slopes, modulus = np.zeros(self.count), self.modulus
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
            direction: (count,).
        """
        found, begin, modulus = direction.copy(), 0, self.modulus
        for unknown in self.blocks:
            if isinstance(unknown, YoungModulus) and modulus is not None and unknown.cells is not None:
                both = np.array([unknown.deviation, modulus[1]])
                found[begin] = both @ direction[[begin, modulus[0]]] / np.linalg.norm(both)
            begin += unknown.count
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
        """Derivative of their net force by each coefficient, (3, count)."""
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
            mean: coefficients found, (count,).
            covariance: of theirs, (count, count).
        """
        found, begin, modulus = list[Estimate](), 0, self.modulus
        for unknown, part in self._parts(mean):
            own = slice(begin, begin + unknown.count)
            each = unknown.estimates(self.expected, part, covariance[own, own])
            if isinstance(unknown, YoungModulus) and modulus is not None and unknown.cells is not None:
                along = np.zeros(self.count)
                along[begin], along[modulus[0]] = unknown.deviation, modulus[1]
                law = float(along @ mean), float(along @ covariance @ along)
                each = [unknown.beside(each[0], self.expected, *law)]
            found += each
            begin = own.stop
        return tuple(found)


def _with(inputs: Inputs, **parameters: Parameter) -> Inputs:
    return replace(inputs, parameters={**inputs.parameters, **parameters})


def _name(unknown: ParameterBlock) -> str:
    return f"{type(unknown).__name__} {getattr(unknown, 'name', '')}".strip()


def check_deviation(name: str, value: float) -> None:
    """Refuse a prior without width, or without end.

    Raises:
        ValueError: the value is not positive and finite.
    """
    if not 0.0 < value < np.inf:
        raise ValueError(
            f"{name}: expected a positive deviation, got {value}; without a prior, forces and stiffness cannot be told "
            "apart."
        )


def estimate(name: str, unit: str, at: Callable[[float], float], mean: float, variance: float) -> Estimate:
    """What a normal law of a coefficient says of a growing function of it.

    Args:
        name: of the unknown.
        unit: of its values.
        at: from the coefficient to the value.
        mean: of the coefficient, whose variance beforehand is 1.
        variance: of it.
    """
    reach = WITHIN_90 * np.sqrt(max(variance, 0.0))
    variance_reduction = float(np.clip(1.0 - variance, 0.0, 1.0))
    return Estimate(name, unit, at(mean), (at(mean - reach), at(mean + reach)), variance_reduction, float(abs(mean)))
