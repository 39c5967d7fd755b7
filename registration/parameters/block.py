"""A block of parameters: its prior, what it moves or explains, its derivatives, what is said of it afterwards.

A new kind of parameter is one class here: most move all nodes by a few fields (`FieldBlock`), or are inputs of the
forward model (`inputs.InputBlock`). What a block does not do it inherits.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.sparse_products import product

from ..evaluation import Evaluation, Slopes
from ..expectations import Expectations
from ..hyperparameters import Hyperparameters, LogNormalPrior
from ..surface_distance import SurfaceDistance
from ..verdict import Check, Code, checked, largest_normal, normal_level

Floats = NDArray[np.float64]
WITHIN_90 = 1.6449  # deviations of a normal law that hold 90 %


@dataclass(frozen=True)
class Estimate:
    """What is known of one parameter after a cloud.

    Args:
        name: of the parameter.
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


def estimate(name: str, unit: str, at: Callable[[float], float], mean: float, variance: float) -> Estimate:
    """What a normal law of a coefficient says of a growing function of it.

    Args:
        name: of the parameter.
        unit: of its values.
        at: from the coefficient to the value.
        mean: of the coefficient, whose variance beforehand is 1.
        variance: of it.
    """
    reach = WITHIN_90 * np.sqrt(max(variance, 0.0))
    variance_reduction = float(np.clip(1.0 - variance, 0.0, 1.0))
    return Estimate(name, unit, at(mean), (at(mean - reach), at(mean + reach)), variance_reduction, float(abs(mean)))


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


@dataclass(frozen=True, eq=False)
class BlockPosterior:
    """What is known of a block's coefficients where a solver ended.

    Args:
        evaluation: the problem there.
        mean: the block's coefficients, (c,).
        covariance: of theirs, (c, c).
        scales: hyperparameters.
        has_forces: nodal forces are unknown, too.
    """

    evaluation: Evaluation
    mean: Floats
    covariance: Floats
    scales: Hyperparameters
    has_forces: bool


class ParameterBlock:
    """Coefficients with a normal law of mean zero beforehand, and what they do.

    Attributes:
        has_own_figures: records show figures of its own in place of estimates, and its checks look at these.
    """

    has_own_figures: ClassVar[bool] = False

    @property
    def size(self) -> int:
        """Number of coefficients, c."""
        raise NotImplementedError

    @property
    def is_moving(self) -> bool:
        """Whether it moves the organ or the camera; what does not explains distances alone."""
        return True

    def hyperpriors(self, observed: SurfaceDistance) -> Mapping[int, LogNormalPrior]:
        """Hyperpriors of the scales that this block brings, by their place among the five of `Hyperparameters`.

        Another scale is a field of that and of what names them one by one: `local_model.without_shared_noise`, and
        `device.evidence`.
        """
        return {}

    def log_variances(self, eta: Floats) -> tuple[Floats | float, Mapping[int, Floats | float]]:
        """Logarithms of the coefficients' variances beforehand, (c,), and their derivatives by hyperparameters.

        Args:
            eta: logarithms of the hyperparameters, (5,).

        Returns:
            The logarithms, one for all where they are the same, and the derivatives by those that matter, by place.
        """
        return 0.0, {}

    def jacobian(self, at: Evaluation, coefficients: Floats, slopes: Slopes) -> Floats:
        """Derivative of residuals by the coefficients, (q, c).

        Args:
            at: the problem at a trial.
            coefficients: the block's coefficients there, (c,).
            slopes: how the residuals follow from what moves.
        """
        raise NotImplementedError

    def vjp(self, at: Evaluation, coefficients: Floats, slopes: Slopes, cotangent: Floats) -> Floats:
        """The same, transposed and applied to a gradient by the residuals, (q,): (c,)."""
        return cotangent @ self.jacobian(at, coefficients, slopes)

    def added(self, coefficients: Floats) -> Floats | None:
        """What it adds to the displacement of the observed nodes, (m, 3), metres; None for nothing."""
        return None

    def field(self, coefficients: Floats) -> Floats | None:
        """The same of all nodes, (n, 3)."""
        return None

    def explained(self, at: Evaluation, coefficients: Floats) -> Floats | None:
        """The part of the cloud's distances that it explains, (p,), metres; None for nothing."""
        return None

    def moved(self, at: Evaluation, change: Floats, every: int) -> Floats | None:
        """How far each so-manieth observed node moves for a change of the coefficients, first order, (., 3), metres."""
        return None

    def is_too_far(self, change: Floats) -> bool:
        """Whether a change of the coefficients is more than one step may make, however little it moves."""
        return False

    def full_columns(self, at: Evaluation, coefficients: Floats) -> Floats | None:
        """Derivative of all nodes' displacement by the coefficients, (3n, c), body's axes; None where it moves none."""
        return None

    def estimates(self, mean: Floats, covariance: Floats) -> tuple[Estimate, ...]:
        """What is known of each of its parameters, for records and reports.

        By default that of each coefficient, in deviations of what was believed of it, under the name of the class.

        Args:
            mean: coefficients found, (c,).
            covariance: of theirs, (c, c).
        """
        if self.has_own_figures:
            return ()
        name, many = type(self).__name__, self.size > 1
        return tuple(
            estimate(f"{name} {place}" if many else name, "deviations", float, float(value), float(variance))
            for place, (value, variance) in enumerate(zip(mean, np.diag(covariance), strict=True), 1)
        )

    def checks(self, found: BlockPosterior, expected: Expectations) -> Iterator[Check]:
        """What would make a result doubtful: by default, estimates far from where they were expected.

        Args:
            found: what is known of the coefficients.
            expected: what a usable result looks like.
        """
        every = self.estimates(found.mean, found.covariance)
        for known in every:
            far = f"{known.name} lies {known.deviations:.1f} deviations from where it was expected"
            yield checked(
                Code.PARAMETER,
                known.deviations,
                normal_level(expected.unlikely, len(every)),
                far,
                unit="deviations",
                law=largest_normal(known.deviations, len(every)),
                subject=known.name,
            )


class FieldBlock(ParameterBlock):
    """One that adds a few fields to the displacement of all nodes, whatever the model.

    Args:
        modes: the field of each coefficient, (3n, c), metres.
        observed: the observed side.
        amplitude: factor of all fields.
    """

    def __init__(self, modes: Floats, observed: SurfaceDistance, amplitude: float = 1.0) -> None:
        rows = (3 * observed.nodes[:, None] + np.arange(3)).ravel()
        self.modes, self.observed_modes, self.amplitude = modes, np.ascontiguousarray(modes[rows]), amplitude

    def with_amplitude(self, amplitude: float) -> Self:
        """The same fields, times another factor."""
        other = copy.copy(self)
        other.amplitude = amplitude
        return other

    @property
    def size(self) -> int:
        """Number of fields."""
        return int(self.modes.shape[1])

    def jacobian(self, at: Evaluation, coefficients: Floats, slopes: Slopes) -> Floats:
        """See `ParameterBlock.jacobian`."""
        return self.amplitude * product(slopes.rows, self.observed_modes)

    def vjp(self, at: Evaluation, coefficients: Floats, slopes: Slopes, cotangent: Floats) -> Floats:
        """See `ParameterBlock.vjp`."""
        found: Floats = self.amplitude * ((slopes.rows.T @ cotangent) @ self.observed_modes)
        return found

    def added(self, coefficients: Floats) -> Floats:
        """See `ParameterBlock.added`."""
        return (self.observed_modes @ (self.amplitude * coefficients)).reshape(-1, 3)

    def field(self, coefficients: Floats) -> Floats:
        """See `ParameterBlock.field`."""
        return (self.modes @ (self.amplitude * coefficients)).reshape(-1, 3)

    def moved(self, at: Evaluation, change: Floats, every: int) -> Floats:
        """See `ParameterBlock.moved`."""
        found: Floats = self.observed_modes.reshape(len(self.observed_modes) // 3, 3, self.size)[::every] @ (
            self.amplitude * change
        )
        return found

    def full_columns(self, at: Evaluation, coefficients: Floats) -> Floats:
        """See `ParameterBlock.full_columns`."""
        return self.amplitude * self.modes
