"""How wrong a prediction may be, said without knowing the truth: bounds that a calibrated share of loads keeps."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.reference.data.loading import checked_array

from .error_indicators import CalibrationError, Error, ErrorIndicators, IndicatorReader, NewtonStep
from .model import Surrogate, SurrogateState

Floats = NDArray[np.float64]
ERRORS: tuple[Error, ...] = get_args(Error)  # over the nodes


@dataclass(frozen=True)
class ErrorBound:
    """What may be said of one prediction.

    Args:
        mean: bound on the mean nodal error, metres, which `confidence` of the loads like those of the calibration keep;
            infinite where nothing can be said.
        largest: the same for the largest nodal error.
        confidence: share of loads, in (0, 1).
        indicators: what it is read from.
        reasons: why the load or the prediction is like none of the calibration, for people; empty inside.
    """

    mean: float
    largest: float
    confidence: float
    indicators: ErrorIndicators
    reasons: tuple[str, ...]

    @property
    def is_inside(self) -> bool:
        """Whether the bound may be relied upon; outside it is a number of no standing."""
        return not self.reasons


class ErrorEstimator:
    """Certificates for the predictions of a calibrated surrogate.

    Args:
        surrogate: one that `calibrate` has made.

    Raises:
        CalibrationError: it was never calibrated, or its card does not name the material.
    """

    def __init__(self, surrogate: Surrogate) -> None:
        known = surrogate.card.get("certificate")
        if not known:
            raise CalibrationError(
                "ErrorEstimator.surrogate: expected a twin that was calibrated, got one without bounds in its card; "
                "give it calibration samples (samples.calibration) and train it again."
            )
        self._known: dict[str, Any] = dict(known)
        self.reader = IndicatorReader(surrogate)

    @property
    def known(self) -> dict[str, Any]:
        """What it knows, as a card holds it."""
        return dict(self._known)

    def with_known(self, known: Mapping[str, Any]) -> ErrorEstimator:
        """The same with what another one knows of the same surrogate."""
        other = copy.copy(self)
        other._known = dict(known)
        return other

    def of(self, surrogate: Surrogate) -> ErrorEstimator:
        """The same powers and quantiles for a surrogate that was adapted; those of Newton's steps are not known."""
        other = copy.copy(self)
        other.reader = self.reader.of(surrogate)
        other._known = {name: entry for name, entry in self._known.items() if name != "newton"}
        return other

    def scaled(self, factors: Mapping[Error, float]) -> ErrorEstimator:
        """The same with bounds that are so many times as wide.

        Args:
            factors: of each kind of error.
        """
        other = copy.copy(self)
        wide = {
            error: [None if value is None else factors[error] * value for value in values]
            for error, values in self._known["quantiles"].items()
        }
        other._known = {**self._known, "quantiles": wide}
        return other

    def within(self, seen: Sequence[ErrorIndicators]) -> ErrorEstimator:
        """The same, which may be relied upon for loads like those of other predictions, too.

        Args:
            seen: what these have shown.
        """
        limits = dict(self._known["limits"])
        for name in ("size", "residual", "step"):
            shown = [getattr(each, name) for each in seen]
            limits[name] = max([limits[name], *(value for value in shown if np.isfinite(value))])
        load = limits.get("load")
        ratios = [ratio for each in seen if (ratio := typical_ratio(each, load)) is not None]
        if load is not None and max(ratios, default=0.0) > 1.0:
            limits["load"] = {**load, "limit": load["limit"] + float(np.log(max(ratios)))}
        other = copy.copy(self)
        other._known = {**self._known, "limits": limits}
        return other

    def bound_error(self, forces: ArrayLike, state: SurrogateState | None = None, newton: bool = False) -> ErrorBound:
        """How wrong the prediction for nodal forces may be.

        Forces on nodes that the surrogate never saw loaded are no part of a prediction: of a load with such forces
        nothing is bounded, and the certificate says so.

        Args:
            forces: (n, 3), newtons.
            state: what the surrogate predicts for them (those on nodes that it never saw loaded left out), if that is
                known.
            newton: read the bounds from one step of Newton's method: dearer, much tighter, and it tells whether the
                prediction is stable.

        Raises:
            ValueError: another shape, or numbers that are not finite.
            CalibrationError: such a step was never calibrated.
        """
        load = checked_array("ErrorEstimator.forces", forces, self.reader.surrogate.body.points.shape)
        if state is None:
            known = load.copy()
            known[self.reader.surrogate.unseen(load)] = 0.0
            state = self.reader.surrogate.solve(known)
        return self.read(self.reader.read(load, state, newton))

    def read(self, indicators: ErrorIndicators) -> ErrorBound:
        """What signs say.

        Raises:
            CalibrationError: a step of Newton's method is among them, and such steps were never calibrated.
        """
        known = self._known if indicators.newton is None else self._known.get("newton")
        if not known:
            raise CalibrationError(
                "ErrorEstimator.newton: expected a twin whose Newton steps were calibrated, got none in its "
                "card; calibrate it anew, with `stepped` at what is needed or more."
            )
        bounds = {error: bound(known, indicators, error) for error in ERRORS}
        reasons = tuple(self._reasons(indicators))
        return ErrorBound(**bounds, confidence=self._known["confidence"], indicators=indicators, reasons=reasons)

    def _reasons(self, indicators: ErrorIndicators) -> list[str]:
        limits, found = self._known["limits"], []
        if not np.isfinite(indicators.residual):
            found.append("the prediction turns a cell inside out or has no balance to speak of")
        if indicators.unseen:
            found.append(
                f"it acts on {indicators.unseen} nodes that carried no load in training: the prediction leaves that out"
            )
        if indicators.distance is not None and indicators.distance > 1.0:
            found.append(f"the load lies {indicators.distance:.2g} times as far out as the farthest of the training")
        elif indicators.is_inside is False:
            found.append(
                f"it moves a node {indicators.extrapolation_ratio:.2g} times as far as any load of the training"
            )
        away = typical_ratio(indicators, limits.get("load"))
        if away is not None and away > 1.0:
            found.append(f"it lies {away:.2g} times as far out as is usual among loads on the nodes that it acts on")
        if indicators.size > limits["size"]:
            found.append(f"it moves a node by {1e3 * indicators.size:.3g} mm, more than any calibrated load")
        if limits["residual"] < indicators.residual < np.inf:
            found.append(f"forces of {indicators.residual:.3g} times the load are out of balance, more than is usual")
        if limits["step"] < indicators.step < np.inf:
            found.append(f"balance is {1e3 * indicators.step:.3g} mm away, farther than is usual")
        return found if indicators.newton is None else found + _unstable(indicators.newton)


def bound(known: Mapping[str, Any], indicators: ErrorIndicators, error: Error) -> float:
    """Bound on an error, metres; infinite where nothing can be said.

    Args:
        known: edges of the ranges of size, powers and quantiles, as `calibration.fitted_bounds` finds them.
        indicators: of a prediction.
        error: whose.
    """
    factor = known["quantiles"][error][range_of(known, indicators)]
    if factor is None or not indicators.is_finite:
        return float(np.inf)
    return float(factor * np.exp(indicators.row(error) @ known["powers"][error]))


def range_of(known: Mapping[str, Any], indicators: ErrorIndicators) -> int:
    """Number of the range of size that a prediction falls in, as `bound` has it."""
    return int(np.searchsorted(known["edges"], indicators.size, side="right"))


def typical_ratio(indicators: ErrorIndicators, known: Mapping[str, Any] | None) -> float | None:
    """How far out a load lies among those on its nodes, over what is usual for so many; None where that is not known.

    Args:
        indicators: of a prediction.
        known: powers of the number of components, and the limit of what they leave, as `calibrate` found them.
    """
    if indicators.load is None or known is None or indicators.load[1] == 0:
        return None
    distance, count = indicators.load
    usual = np.polyval(known["powers"], np.log(count)) + known["limit"]
    return float(distance / np.exp(usual))


def _unstable(step: NewtonStep) -> list[str]:
    if not np.isfinite(step.mean):
        return ["Newton's method finds no step from the prediction"]
    if step.negative_pivots == 0:
        return []
    count = "an unknown number of" if step.negative_pivots is None else step.negative_pivots
    return [f"the predicted state is unstable: its tangent has {count} negative pivots"]
