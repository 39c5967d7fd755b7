"""Certificates calibrated on loads that nobody learned from, and what they are worth on others.

A product of powers of the signs, fitted to a high quantile of the errors, ranks predictions; split conformal prediction
turns it into a bound that a wanted share of loads keeps, in each range of size apart (normalised: Papadopoulos,
Gammerman and Vovk 2008; Mondrian: Vovk, Gammerman and Shafer 2005). Draws that share a load path count together
(hierarchical conformal prediction: Lee, Barber and Willett 2023, arXiv 2306.06342).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.dataset import DataSet, Samples, Split, stored_plans

from .error_bound import ERRORS, ErrorEstimator, range_of
from .error_indicators import CalibrationError, Error, ErrorIndicators, IndicatorReader
from .model import Surrogate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Seen = tuple[list[ErrorIndicators], dict[str, Floats]]  # signs of predictions and true errors, metres, by kind
_A_RANGE = 50  # calibration samples that a range of its own should have
_RANGES = 4  # of size, at most
_USUAL = 0.99  # of the calibration samples: who is farther out of balance is set aside


class CalibrationWarning(UserWarning):
    """Calibration loads that are drawn otherwise than those that were learned."""


def needed(confidence: float) -> int:
    """Load paths to calibrate on, without which no bound of a confidence is finite; draws of one `ramp` are one."""
    return int(np.ceil(confidence / (1.0 - confidence) - 1e-9))


def calibrate(
    surrogate: Surrogate,
    data: DataSet,
    split: Split = "calibration",
    fitted_on: Split = "validation",
    confidence: float = 0.9,
    stepped: int = 100,
) -> Surrogate:
    """The surrogate with a certificate in its card.

    Powers of the signs are fitted to the errors on one split, the bound is calibrated on another; neither was learned
    from. Draws of one ramp share a load path, count together as one, and are in one split.

    Args:
        surrogate: the surrogate.
        data: equilibria of its body and material.
        split: what is calibrated on.
        fitted_on: what the powers are fitted on.
        confidence: share of loads that shall keep the bound, in (0, 1).
        stepped: so many samples of either split are shown a step of Newton's method too, each for the factors of a
            tangent, to calibrate bounds that are read from it; none where they are too few.

    Raises:
        CalibrationError: too few samples (it says how many are needed), another body or material, or none in the card.
        DataSetError: a split is not complete.
    """
    if not 0.0 < confidence < 1.0:
        raise CalibrationError(f"calibrate.confidence: expected a number in (0, 1), got {confidence}.")
    if data.body.fingerprint != surrogate.body.fingerprint:
        raise CalibrationError(f"calibrate.data: {data.path} is of another body than the surrogate.")
    learned, plan = surrogate.learned_material or {}, data.header.get("plan", {})
    wrong = [f"{name} ({value} learned, {plan[name]} there)" for name, value in learned.items()
             if name in plan and plan[name] != value]  # fmt: skip
    if surrogate.learned_springs != data.springs:
        wrong.append(f"springs ({surrogate.learned_springs} learned, {data.springs} there)")
    if wrong:
        raise CalibrationError(
            f"calibrate.data: {data.path} is of another material or support than the surrogate: {wrong[0]}."
        )
    held, fitted = data.samples(split), data.samples(fitted_on)
    paths = data.load_paths(split, held.draws)
    if len(np.unique(paths)) < needed(confidence) or len(fitted) == 0:
        raise CalibrationError(
            f"calibrate.data: expected accepted samples of at least {needed(confidence)} load paths to calibrate a "
            f"confidence of {confidence:g} on and some to fit on, got {len(np.unique(paths))} paths in the {split} and "
            f"{len(fitted)} samples in the {fitted_on} split of {data.path}; {_A_RANGE} paths and more for each range "
            "of size make the bound one to go by."
        )
    _compare_loads(surrogate, data, split)
    reader, is_stepped = IndicatorReader(surrogate), len(np.unique(paths[:stepped])) >= needed(confidence)
    newton = stepped if is_stepped else 0
    stepping, errors = read_samples(reader, data, held, newton)
    stepping_before, errors_before = read_samples(reader, data, fitted, newton)
    shown, shown_before = _without_steps(stepping), _without_steps(stepping_before)
    entry = {
        "confidence": confidence,
        "split": split,
        **fitted_bounds((shown_before, errors_before), (shown, errors), paths, confidence),
        "limits": {
            name: _limit([getattr(indicators, name) for indicators in shown], share)
            for name, share in (("size", 1.0), ("residual", _USUAL), ("step", _USUAL))
        },
    }
    if shown[0].load is not None:
        entry["limits"]["load"] = _usual_load(shown_before, shown, confidence)
    if is_stepped:
        before, after = _first(stepping_before, errors_before, stepped), _first(stepping, errors, stepped)
        entry["newton"] = fitted_bounds(before, after, paths[:stepped], confidence)
    return surrogate.with_card(certificate=entry)


def fitted_bounds(before: Seen, seen: Seen, paths: Ints, confidence: float) -> dict[str, Any]:
    """Powers of the signs and the quantile of what is left, for each range of size.

    Args:
        before: signs and errors that the powers are fitted to.
        seen: those that the quantiles are taken of.
        paths: number of the load path of each of the latter, (s,).
        confidence: share of loads that shall keep the bound.
    """
    shown, errors = seen
    powers = {error: _fitted(before[0], before[1], error, confidence) for error in ERRORS}
    count, sizes = len(np.unique(paths)), np.array([indicators.size for indicators in shown])
    edges = np.quantile(sizes, np.linspace(0.0, 1.0, max(1, min(_RANGES, count // _A_RANGE)) + 1))[1:-1]
    places = np.searchsorted(edges, sizes, side="right")
    ranks = {error: np.stack([indicators.row(error) for indicators in shown]) @ powers[error] for error in ERRORS}
    with np.errstate(over="ignore"):
        scores = {error: errors[error] / np.exp(ranks[error]) for error in ERRORS}
    lost = ~np.array([indicators.is_finite for indicators in shown])
    members = [places == place for place in range(len(edges) + 1)]
    for values in scores.values():
        values[lost] = 0.0  # without signs the bound is infinite, which any error keeps
    return {
        "samples": len(shown),
        "load_paths": count,
        "edges": edges.tolist(),
        "in_range": [int(some.sum()) for some in members],
        "powers": {error: powers[error].tolist() for error in ERRORS},
        "quantiles": {
            error: [quantile(values[some], confidence, paths[some]) for some in members]
            for error, values in scores.items()
        },
        "rank_correlation": {error: _rank(ranks[error], errors[error]) for error in ERRORS},
    }


def _without_steps(shown: Sequence[ErrorIndicators]) -> list[ErrorIndicators]:
    return [replace(each, newton=None) for each in shown]


def _first(shown: Sequence[ErrorIndicators], errors: Mapping[str, Floats], count: int) -> Seen:
    """Of the first samples alone."""
    return list(shown[:count]), {name: values[:count] for name, values in errors.items()}


def read_samples(reader: IndicatorReader, data: DataSet, samples: Samples, newton: int = 0) -> Seen:
    """Signs of the predictions of samples, and their true errors, metres, (s,) each.

    Args:
        reader: of the surrogate's predictions.
        data: the data set.
        samples: of it.
        newton: so many of them, the first, with a step of Newton's method each.
    """
    shown, found = [], np.empty_like(samples.displacements)
    for i, forces in enumerate(data.response.spread(samples.forces)):
        state = reader.surrogate.solve(forces)
        shown.append(reader.read(forces, state, i < newton))
        found[i] = state.displacement
    distances = nodal_distances(found, samples.displacements)
    return shown, {"mean": distances.mean(axis=1), "largest": distances.max(axis=1)}


@dataclass(frozen=True)
class Coverage:
    """How a certificate does on samples that it has never seen.

    Args:
        split: name of the split.
        samples: compared.
        confidence: share that the bounds are made for.
        kept: share of the samples whose error keeps its bound, for each kind of error.
        kept_in_range: the same in each range of size; None where no sample fell.
        widths: median bound over median error in each range, likewise; None too where most have no bound.
        in_range: samples in each range.
        rank_correlation: Spearman's, of bound and error; None where they do not vary.
        step_correlation: the same of eta, the linear step towards balance (`ErrorIndicators.step`), alone.
        outside: samples that the certificate sets aside; they count in all of the above.
        newton: whether the bounds are read from steps of Newton's method.
        unstable: predictions whose tangent has negative pivots; None where no such step was made.
    """

    split: str
    samples: int
    confidence: float
    kept: dict[str, float]
    kept_in_range: dict[str, list[float | None]]
    widths: dict[str, list[float | None]]
    in_range: list[int]
    rank_correlation: dict[str, float | None]
    step_correlation: dict[str, float | None]
    outside: int
    newton: bool
    unstable: int | None

    def as_dict(self) -> dict[str, Any]:
        """The figures as plain numbers, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        lines = []
        for error in ERRORS:
            widths = " / ".join("-" if width is None else f"{width:.2g}" for width in self.widths[error])
            lines.append(
                f"certificate: {100 * self.kept[error]:.0f} % of {self.samples} {self.split} samples keep their bound "
                f"on the {error} nodal error, made for {100 * self.confidence:.0f} %; by size it is {widths} times the "
                "median error"
            )
        aside = f"certificate: {self.outside} of {self.samples} are set aside as outside its domain"
        return "\n".join([*lines, aside + ("" if self.unstable is None else f", {self.unstable} as unstable")])


def coverage(
    surrogate: Surrogate, data: DataSet, split: Split = "test", limit: int | None = None, newton: bool = False
) -> Coverage:
    """How the certificate of a surrogate does on a split, by default the held-out test split.

    Args:
        surrogate: a calibrated one.
        data: equilibria of its body.
        split: of them.
        limit: take the first so many draws only.
        newton: judge the bounds that are read from steps of Newton's method.

    Raises:
        CalibrationError: there is no certificate, or none of such steps.
        DataSetError: the split is not complete.
    """
    estimator = ErrorEstimator(surrogate)
    samples = data.samples(split, limit)
    shown, errors = read_samples(estimator.reader, data, samples, len(samples) if newton else 0)
    given = [estimator.read(indicators) for indicators in shown]
    bounds = {error: np.array([getattr(each, error) for each in given]) for error in ERRORS}
    eta = np.array([indicators.step for indicators in shown])
    known = surrogate.card["certificate"]["newton"] if newton else surrogate.card["certificate"]
    places = np.array([range_of(known, indicators) for indicators in shown])
    members = [places == place for place in range(len(known["edges"]) + 1)]
    kept = {error: errors[error] <= bounds[error] for error in ERRORS}
    return Coverage(
        split=split,
        samples=len(given),
        confidence=surrogate.card["certificate"]["confidence"],
        kept={error: float(kept[error].mean()) for error in ERRORS},
        kept_in_range={error: [_mean(kept[error][some]) for some in members] for error in ERRORS},
        widths={error: [_ratio(bounds[error][some], errors[error][some]) for some in members] for error in ERRORS},
        in_range=[int(some.sum()) for some in members],
        rank_correlation={error: _rank(bounds[error], errors[error]) for error in ERRORS},
        step_correlation={error: _rank(eta, errors[error]) for error in ERRORS},
        outside=sum(not each.is_inside for each in given),
        newton=newton,
        unstable=sum(bool(each.newton and each.newton.negative_pivots) for each in shown) if newton else None,
    )


def _rank(bounds: Floats, errors: Floats) -> float | None:
    if np.ptp(np.nan_to_num(bounds)) == 0.0 or np.ptp(errors) == 0.0:
        return None
    from scipy.stats import spearmanr  # half a second, which only who calibrates waits for

    return float(spearmanr(bounds, errors).statistic)


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if len(values) else None


def _ratio(bounds: Floats, errors: Floats) -> float | None:
    if not len(errors) or not np.isfinite(np.median(bounds)) or np.median(errors) == 0.0:
        return None
    return float(np.median(bounds) / np.median(errors))


def _compare_loads(surrogate: Surrogate, data: DataSet, split: Split) -> None:
    """Say where the loads to calibrate on are drawn otherwise than those that were learned, or nobody knows."""
    learned, drawn = _ways(stored_plans(surrogate.card.get("data", {}))), _ways(stored_plans(data.header, split))
    unknown = "its loads" if None in drawn else "the loads that were learned" if None in learned else ""
    if unknown:
        told = f"nothing is known of how {unknown} were drawn"
    elif all(way in learned for way in drawn) and all(way in drawn for way in learned):
        return
    else:
        pairs = [(one or {}, other or {}) for one in drawn for other in learned]
        names = dict.fromkeys(name for one, other in pairs for name in one | other if one.get(name) != other.get(name))
        told = f"its loads are drawn otherwise than those that were learned (in {', '.join(names)})"
    warnings.warn(
        f"calibrate.data: {told}; the bound holds for loads like these alone.", CalibrationWarning, stacklevel=3
    )


def _ways(plans: list[dict[str, Any]]) -> list[dict[str, Any] | None]:
    """How each plan says that loads are drawn; None where it does not."""
    return [{**plan["loads"], "ramp": plan.get("ramp", 1)} if plan.get("loads") else None for plan in plans]


def _fitted(shown: list[ErrorIndicators], found: dict[str, Floats], error: Error, confidence: float) -> Floats:
    """Intercept and powers of the signs whose product such a share of errors stays below: quantile regression.

    Least squares would follow the few predictions that are far from any equilibrium, whose steps mean little: bounds by
    a Newton step were a quarter wider (beam under modal loads).
    """
    errors, rows = found[error], np.stack([indicators.row(error) for indicators in shown])
    usable = np.array([indicators.is_finite for indicators in shown]) & (errors > 0.0)
    if not usable.any():
        return np.eye(rows.shape[1])[-1]
    return _quantile_regression(rows[usable, 1:], np.log(errors[usable]), confidence)


def _quantile_regression(rows: Floats, values: Floats, share: float) -> Floats:
    """Intercept and slopes, (k + 1,), of the plane over rows, (s, k), that such a share of values, (s,), lies below.

    Source: Koenker and Bassett 1978; as a linear programme.
    """
    centre, spread = rows.mean(axis=0), rows.std(axis=0) + 1e-12
    scaled = np.column_stack([np.ones(len(rows)), (rows - centre) / spread])
    count, width = scaled.shape
    solved = linprog(
        np.concatenate([np.zeros(width), np.full(count, share), np.full(count, 1.0 - share)]),
        A_eq=np.hstack([scaled, np.eye(count), -np.eye(count)]),
        b_eq=values,
        bounds=[(None, None)] * width + [(0.0, None)] * (2 * count),
    )
    slopes = solved.x[1:width] / spread
    return np.concatenate([[solved.x[0] - slopes @ centre], slopes])


def _usual_load(before: list[ErrorIndicators], seen: list[ErrorIndicators], confidence: float) -> dict[str, Any]:
    """How far out loads lie among those on their nodes, by the number of components that they act on.

    Args:
        before: signs that the dependence on the number is fitted to; where these are few it is left out.
        seen: those that the limit is taken of.
        confidence: quantile that is fitted.

    Returns:
        `powers` of the logarithm of the number, the highest first, and `limit` of what they leave of the distance's.
    """

    def told(indicators: list[ErrorIndicators]) -> tuple[Floats, Floats]:
        given = np.array([each.load for each in indicators if each.load is not None and each.load[1]], dtype=np.float64)
        distances, counts = given.reshape(-1, 2).T
        return np.log(np.maximum(distances, 1e-300)), np.log(np.maximum(counts, 1.0))

    distances, counts = told(before)
    fitted = np.zeros(1)
    if len(distances) >= _A_RANGE and np.ptp(counts) > 0.0:
        fitted = _quantile_regression(counts[:, None] ** [1, 2], distances, confidence)
    powers = fitted[::-1]
    distances, counts = told(seen)
    left = distances - np.polyval(powers, counts)
    return {"powers": powers.tolist(), "limit": _limit(left.tolist(), _USUAL) if len(left) else 0.0}


def quantile(scores: Floats, confidence: float, paths: Ints | None = None) -> float | None:
    """The score that at least such a share of further ones keeps on average; None where there are too few to say.

    None, too, where that score would be infinite.

    Args:
        scores: (s,).
        confidence: the share.
        paths: number of the load path of each, (s,): each path has the same weight; None where each is a path of its
            own.
    """
    groups = np.arange(len(scores)) if paths is None else paths
    _, place, counts = np.unique(groups, return_inverse=True, return_counts=True)
    order = np.argsort(scores, kind="stable")
    reached = np.cumsum(1.0 / counts[place[order]]) if len(order) else np.zeros(0)
    kept = np.flatnonzero(reached >= (len(counts) + 1) * confidence - 1e-9)
    found = float(scores[order[kept[0]]]) if len(kept) else np.inf
    return found if np.isfinite(found) else None


def _limit(values: list[float], share: float) -> float:
    """What at least so large a share of further values stays below on average; those not finite lie above all."""
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    kept = quantile(ordered, share)
    found = float(ordered[-1]) if kept is None else kept
    finite = ordered[np.isfinite(ordered)]
    return found if np.isfinite(found) else float(finite[-1]) if len(finite) else 0.0
