"""Certificates calibrated on loads that nobody learned from, and what they are worth on others.

A product of powers of the signs, fitted to the errors, ranks predictions; split conformal prediction turns it into a
bound that a wanted share of loads keeps, in each range of size apart (normalised: Papadopoulos, Gammerman and Vovk
2008; Mondrian: Vovk, Gammerman and Shafer 2005).
"""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from softtwin.meshes.metrics import nodal_distances
from softtwin.reference.data.dataset import DataSet, Samples, Split

from .certificate import ERRORS, Certifier
from .model import Surrogate
from .signs import CalibrationError, SignReader, Signs

Floats = NDArray[np.float64]
_SHRINKAGE = 1.0  # of the fitted powers, in units of one sample of each sign's spread
_A_RANGE = 50  # calibration samples that a range of its own should have
_RANGES = 4  # of size, at most
_USUAL = 0.99  # of the calibration samples: who is farther out of balance is set aside


class CalibrationWarning(UserWarning):
    """Calibration loads that are drawn otherwise than those that were learned."""


def needed(confidence: float) -> int:
    """Calibration samples without which no bound of a confidence is finite."""
    return int(np.ceil(confidence / (1.0 - confidence) - 1e-9))


def calibrate(
    surrogate: Surrogate,
    data: DataSet,
    split: Split = "calibration",
    fitted_on: Split = "validation",
    confidence: float = 0.9,
) -> Surrogate:
    """The surrogate with a certificate in its card.

    Powers of the signs are fitted to the errors on one split, the bound is calibrated on another; neither was learned
    from. Draws of one ramp share a load, and splits share no ramp.

    Args:
        surrogate: the surrogate.
        data: equilibria of its body and material.
        split: what is calibrated on.
        fitted_on: what the powers are fitted on.
        confidence: share of loads that shall keep the bound, in (0, 1).

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
    if wrong:
        raise CalibrationError(f"calibrate.data: {data.path} is of another material than the surrogate: {wrong[0]}.")
    held, fitted = data.samples(split), data.samples(fitted_on)
    if len(held) < needed(confidence) or len(fitted) == 0:
        raise CalibrationError(
            f"calibrate.data: expected at least {needed(confidence)} accepted samples to calibrate {confidence:.0%} on "
            f"and some to fit on, got {len(held)} in the {split} and {len(fitted)} in the {fitted_on} split of "
            f"{data.path}; {_A_RANGE} and more for each range of size make the bound one to go by."
        )
    _compare_loads(surrogate, data)
    reader = SignReader(surrogate)
    shown, errors = _seen(reader, data, held)
    shown_before, errors_before = _seen(reader, data, fitted)
    powers = {error: _fitted(shown_before, errors_before[error]) for error in ERRORS}
    sizes = np.array([signs.size for signs in shown])
    edges = np.quantile(sizes, np.linspace(0.0, 1.0, max(1, min(_RANGES, len(held) // _A_RANGE)) + 1))[1:-1]
    places = np.searchsorted(edges, sizes, side="right")
    rows = np.stack([signs.row for signs in shown])
    with np.errstate(over="ignore"):  # a prediction inside out has no bound, and keeps that
        scores = {error: errors[error] / np.exp(rows @ powers[error]) for error in ERRORS}
    entry = {
        "confidence": confidence,
        "samples": len(held),
        "split": split,
        "edges": edges.tolist(),
        "in_range": np.bincount(places, minlength=len(edges) + 1).tolist(),
        "powers": {error: powers[error].tolist() for error in ERRORS},
        "quantiles": {
            error: [quantile(values[places == place], confidence) for place in range(len(edges) + 1)]
            for error, values in scores.items()
        },
        "limits": {
            name: _limit([getattr(signs, name) for signs in shown], share)
            for name, share in (("size", 1.0), ("residual", _USUAL), ("step", _USUAL))
        },
        "rank_correlation": {error: _rank(rows @ powers[error], errors[error]) for error in ERRORS},
    }
    return surrogate.with_card(certificate=entry)


def _seen(reader: SignReader, data: DataSet, samples: Samples) -> tuple[list[Signs], dict[str, Floats]]:
    """Signs of the predictions of samples, and their true errors, metres, (s,) each."""
    forces, shown, found = np.zeros_like(data.body.points), [], np.empty_like(samples.displacements)
    for i, load in enumerate(samples.forces):
        forces[data.response.loaded] = load
        state = reader.surrogate.solve(forces)
        shown.append(reader.read(forces, state))
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
        widths: median bound over median error in each range, likewise.
        in_range: samples in each range.
        rank_correlation: Spearman's, of bound and error; None where they do not vary.
        outside: samples that the certificate sets aside; they count in all of the above.
    """

    split: str
    samples: int
    confidence: float
    kept: dict[str, float]
    kept_in_range: dict[str, list[float | None]]
    widths: dict[str, list[float | None]]
    in_range: list[int]
    rank_correlation: dict[str, float | None]
    outside: int

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
        return "\n".join([*lines, f"certificate: {self.outside} of {self.samples} are set aside as outside its domain"])


def coverage(surrogate: Surrogate, data: DataSet, split: Split = "test") -> Coverage:
    """How the certificate of a surrogate does on a split, by default the held-out test split.

    Args:
        surrogate: a calibrated one.
        data: equilibria of its body.
        split: of them.

    Raises:
        CalibrationError: there is no certificate.
        DataSetError: the split is not complete.
    """
    certifier = Certifier(surrogate)
    shown, errors = _seen(certifier.reader, data, data.samples(split))
    given = [certifier.read(signs) for signs in shown]
    bounds = {error: np.array([getattr(each, error) for each in given]) for error in ERRORS}
    edges = surrogate.card["certificate"]["edges"]
    places = np.searchsorted(edges, [each.signs.size for each in given], side="right")
    members = [places == place for place in range(len(edges) + 1)]
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
        outside=sum(not each.is_inside for each in given),
    )


def _rank(bounds: Floats, errors: Floats) -> float | None:
    if np.ptp(np.nan_to_num(bounds)) == 0.0 or np.ptp(errors) == 0.0:
        return None
    return float(spearmanr(bounds, errors).statistic)


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if len(values) else None


def _ratio(bounds: Floats, errors: Floats) -> float | None:
    return float(np.median(bounds) / np.median(errors)) if len(errors) else None


def _compare_loads(surrogate: Surrogate, data: DataSet) -> None:
    learned = surrogate.card.get("data", {}).get("plan", {}).get("loads")
    drawn = data.header.get("plan", {}).get("loads")
    if learned is not None and drawn is not None and learned != drawn:
        differing = [name for name in drawn if learned.get(name) != drawn[name]]
        warnings.warn(
            f"calibrate.data: its loads are drawn otherwise than those that were learned (in {', '.join(differing)}); "
            "the bound holds for loads like these alone.",
            CalibrationWarning,
            stacklevel=3,
        )


def _fitted(shown: list[Signs], errors: Floats) -> Floats:
    """Intercept and powers of the signs, (4,), that errors go with: least squares of logarithms, shrunk a little."""
    usable = np.array([np.isfinite(signs.residual) for signs in shown]) & (errors > 0.0)
    if not usable.any():
        return np.array([0.0, 0.0, 0.0, 1.0])
    rows = np.stack([signs.logarithms for signs in shown])[usable]
    wanted = np.log(errors[usable])
    centre, spread = rows.mean(axis=0), rows.std(axis=0) + 1e-12
    scaled = (rows - centre) / spread
    powers = np.linalg.solve(scaled.T @ scaled + _SHRINKAGE * np.eye(3), scaled.T @ (wanted - wanted.mean())) / spread
    return np.concatenate([[wanted.mean() - powers @ centre], powers])


def quantile(scores: Floats, confidence: float) -> float | None:
    """The score that at least such a share of further ones keeps on average; None where there are too few to say."""
    place = int(np.ceil((len(scores) + 1) * confidence - 1e-9)) - 1
    return float(np.sort(scores)[place]) if place < len(scores) else None


def _limit(values: list[float], share: float) -> float:
    """What at least so large a share of further values stays below on average; those not finite lie above all."""
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    kept = quantile(ordered, share)
    found = float(ordered[-1]) if kept is None else kept
    finite = ordered[np.isfinite(ordered)]
    return found if np.isfinite(found) else float(finite[-1]) if len(finite) else 0.0
