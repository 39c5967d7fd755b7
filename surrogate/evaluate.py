"""Held-out errors of a surrogate against the reference: every definition is printed beside its figures."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.embedding import outer_nodes
from softtwin.meshes.metrics import nodal_distances, relative_error, thesis_error
from softtwin.reference.data.dataset import DataSet, Samples, Split, probe_cotangents
from softtwin.reference.data.schema import Reason

from .model import Surrogate

Floats = NDArray[np.float64]
Adjoint = Callable[[Floats, Floats], Floats]
Inverse = Callable[[Floats, Floats], Floats]

_LEAST = 1e-300  # of a relative error, so that decibels stay numbers


@dataclass(frozen=True)
class Spread:
    """Statistics over the samples of a split."""

    mean: float
    std: float
    p5: float
    median: float
    p95: float
    max: float


def spread(values: Floats) -> Spread:
    """Mean, standard deviation, 5th, 50th and 95th percentile and maximum of values, (s,)."""
    p5, median, p95 = (float(q) for q in np.percentile(values, (5, 50, 95)))
    return Spread(float(values.mean()), float(values.std()), p5, median, p95, float(values.max()))


# What is measured of each sample, in the order of the table: name, symbol, definition, unit.
DEFINITIONS = (
    ("nodal_error", "e", "mean over the nodes of |u_i - u*_i|", "m"),
    ("largest_error", "e_max", "largest over the nodes of |u_i - u*_i|", "m"),
    ("thesis_error", "e_thesis", "|u - u*|_2 / number of nodes", "m"),
    ("relative_error", "rel", "|u - u*|_2 / |u*|_2", "1"),
    ("signal_to_noise", "SNR", "20 log10(|u*|_2 / |u - u*|_2)", "dB"),
    ("displacement_norm", "u_2", "|u*|_2 over all nodal components", "m"),
    ("gradient_cosine", "cos", "cosine of J^T g with the reference's K(u*)^-1 g at the loaded nodes, g stored", "1"),
)


@dataclass(frozen=True)
class Evaluation:
    """Errors of a surrogate on one split, each as the spread over its accepted samples (`DEFINITIONS`).

    Args:
        split: name of the split.
        samples: accepted samples compared.
        rejected: draws of the split that were kept apart, by reason; they are in no average.
        nodal_error: metres.
        largest_error: metres.
        thesis_error: metres.
        relative_error: dimensionless.
        signal_to_noise: decibels (Odot 2023, Tables 5.1 and 5.2, names an SNR and does not define it).
        displacement_norm: metres.
        gradient_cosine: dimensionless; None where the data hold no gradients.
        prediction_ms: median wall time of `solve` for one sample, milliseconds, in double precision on the CPU.
        threads: limit of BLAS threads that the time was taken under.
    """

    split: str
    samples: int
    rejected: Mapping[str, int]
    nodal_error: Spread
    largest_error: Spread
    thesis_error: Spread
    relative_error: Spread
    signal_to_noise: Spread
    displacement_norm: Spread
    gradient_cosine: Spread | None
    prediction_ms: float
    threads: str

    def as_dict(self) -> dict[str, Any]:
        """The figures as plain numbers, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        return table({"surrogate": self})


def evaluate(surrogate: Surrogate, data: DataSet, split: Split = "test", limit: int | None = None) -> Evaluation:
    """Errors of a surrogate on a split of a data set, by default on the held-out test split.

    Args:
        surrogate: what to judge.
        data: the data set, of the same body and, where both say which, of the same material.
        split: `train`, `validation` or `test`.
        limit: take the first so many draws only.

    Raises:
        ValueError: another body or material, or no accepted sample.
        DataSetError: the split is not complete.
    """
    if data.body.fingerprint != surrogate.body.fingerprint:
        raise ValueError(f"evaluate.data: {data.path} is of another body than the surrogate.")
    _check_material(surrogate, data)
    samples = data.samples(split, limit)
    if len(samples) == 0:
        raise ValueError(f"evaluate.split: expected accepted samples in the {split} split of {data.path}, got none.")
    found, cosines, times = _predict(surrogate, data, samples)
    distances = nodal_distances(found, samples.displacements)
    relative = relative_error(found, samples.displacements)
    reasons = data.figures(split)["reason"][:limit]
    return Evaluation(
        split=split,
        samples=len(samples),
        rejected=dict(Counter(Reason(reason).words for reason in reasons if reason)),
        nodal_error=spread(distances.mean(axis=1)),
        largest_error=spread(distances.max(axis=1)),
        thesis_error=spread(thesis_error(found, samples.displacements)),
        relative_error=spread(relative),
        signal_to_noise=spread(-20.0 * np.log10(np.clip(relative, _LEAST, 1.0 / _LEAST))),
        displacement_norm=spread(np.linalg.norm(samples.displacements, axis=(1, 2))),
        gradient_cosine=spread(cosines) if data.has_gradients else None,
        prediction_ms=1e3 * float(np.median(times)),
        threads=os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or "not limited",
    )


def _check_material(surrogate: Surrogate, data: DataSet) -> None:
    learned, plan = surrogate.learned_material or {}, data.header.get("plan", {})
    differing = [name for name in learned if name in plan and plan[name] != learned[name]]
    if differing:
        here, there = (", ".join(f"{name} {values[name]}" for name in differing) for values in (plan, learned))
        raise ValueError(
            f"evaluate.data: expected the material that the surrogate has learned ({there}), got {here} in {data.path}."
        )
    if surrogate.learned_springs != data.springs:
        raise ValueError(
            f"evaluate.data: expected the springs that the surrogate has learned ({surrogate.learned_springs}), "
            f"got {data.springs} in {data.path}."
        )


def _predict(surrogate: Surrogate, data: DataSet, samples: Samples) -> tuple[Floats, Floats, Floats]:
    """Displacements (s, n, 3), cosines of the gradients (s,) and times (s,) of all samples, one by one."""
    found, cosines, times = np.empty_like(samples.displacements), np.empty(len(samples)), np.empty(len(samples))
    forces = np.zeros_like(data.body.points)
    loaded = data.response.loaded
    for i in range(len(samples)):
        forces[loaded] = samples.forces[i]
        began = time.perf_counter()
        state = surrogate.solve(forces)
        times[i] = time.perf_counter() - began
        found[i] = state.displacement
        cotangent = probe_cotangents(data.body, data.shapes, samples.probes[i : i + 1])[0]
        cosines[i] = cosine(state.vjp(cotangent)[loaded], samples.adjoints[i])
    return found, cosines, times


def cosine(a: Floats, b: Floats) -> float:
    """Cosine of the angle between two arrays of one shape; 0 if one of them is zero."""
    sizes = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.vdot(a, b)) / sizes if sizes > 0.0 else 0.0


def registration_cosines(surrogate: Surrogate, data: DataSet, samples: Samples, adjoint: Adjoint) -> Floats:
    """Cosines, (s,), of the gradient with the reference's for what registration asks: g = u - u' for another sample u'.

    The cotangent is the misfit to the next sample at the boundary nodes; gradients are compared at the loaded nodes.

    Args:
        surrogate: what to judge.
        data: the data set, for its body and loaded nodes.
        samples: at least two samples.
        adjoint: gives K(u)^-1 g, (n, 3), for u and g, (n, 3) each; the reference knows it.

    Raises:
        ValueError: fewer than two samples.
    """
    if len(samples) < 2:
        raise ValueError(f"registration_cosines.samples: expected at least 2, got {len(samples)}.")
    loaded, boundary = data.response.loaded, outer_nodes(data.body)
    forces, cotangent = np.zeros_like(data.body.points), np.zeros_like(data.body.points)
    cosines = np.empty(len(samples))
    for i, (here, there) in enumerate(zip(samples.displacements, np.roll(samples.displacements, -1, 0), strict=True)):
        forces[loaded] = samples.forces[i]
        cotangent[boundary] = (here - there)[boundary]
        cosines[i] = cosine(surrogate.solve(forces).vjp(cotangent)[loaded], adjoint(here, cotangent)[loaded])
    return cosines


def jacobian_errors(
    surrogate: Surrogate, data: DataSet, samples: Samples, inverse: Inverse, probes: int | None = None
) -> Floats:
    """Relative errors |J - J*|_F / |J*|_F of the derivative by all loaded forces, (s,); J* = K(u*)^-1 at those columns.

    The currency of derivative-informed operators (O'Leary-Roseberry et al. 2022, arXiv 2206.10745).

    Args:
        surrogate: what to judge.
        data: the data set, for its body and loaded nodes.
        samples: where to compare.
        inverse: gives K(u)^-1 c, (3n, k), for columns c, (3n, k), and u, (n, 3); the reference knows it.
        probes: estimate both norms with so many random loads of signs +-1 (Hutchinson 1990) instead of all columns,
            which would be gigabytes on a body of ten thousand unknowns; None for all.
    """
    loaded = data.response.loaded
    entries = (3 * loaded[:, None] + np.arange(3)).ravel()
    columns = np.zeros((data.body.points.size, probes or len(entries)))
    if probes is None:
        columns[entries, np.arange(len(entries))] = 1.0
    else:
        columns[entries] = np.random.default_rng(0).choice([-1.0, 1.0], (len(entries), probes))
    forces, errors = np.zeros_like(data.body.points), np.empty(len(samples))
    for i, (load, displacement) in enumerate(zip(samples.forces, samples.displacements, strict=True)):
        forces[loaded] = load
        truth = inverse(columns, displacement)
        errors[i] = np.linalg.norm(surrogate.solve(forces).jvp(columns) - truth) / np.linalg.norm(truth)
    return errors


def table(evaluations: Mapping[str, Evaluation]) -> str:
    """A text table of one or more evaluations, with its definitions and the draws that are in no average.

    Args:
        evaluations: by the name to print.
    """
    width = max(len(name) for name in (*evaluations, "surrogate"))
    head = f"{'surrogate':{width}}  {'':8} {'mean':>10} {'std':>10} {'5 %':>10} {'median':>10} {'95 %':>10} {'max':>10}"
    lines = [head]
    for name, evaluation in evaluations.items():
        for field, symbol, _, unit in DEFINITIONS:
            if getattr(evaluation, field) is None:
                continue
            values = asdict(getattr(evaluation, field)).values()
            figures = " ".join(f"{value:10.6f}" if field == "gradient_cosine" else f"{value:10.3e}" for value in values)
            lines.append(f"{name:{width}}  {symbol:8} {figures}  {'' if unit == '1' else unit}".rstrip())
        lines.append(
            f"{name:{width}}  {evaluation.prediction_ms:.3g} ms a prediction (double precision, BLAS threads: "
            f"{evaluation.threads}); {_counts(evaluation)}"
        )
    return "\n".join([*lines, "", *(f"{symbol}: {text}" for _, symbol, text, _ in DEFINITIONS)])


def _counts(evaluation: Evaluation) -> str:
    kept_apart = sum(evaluation.rejected.values())
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(evaluation.rejected.items()))
    return (
        f"{evaluation.samples} accepted {evaluation.split} samples averaged, {kept_apart} draws rejected"
        f"{f' ({reasons})' if reasons else ''}"
    )
