"""What several benchmarks say of many cases, in the same words: verdicts, times, memory, predicted errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np


def counts(words: Iterable[str]) -> dict[str, int]:
    """How often each word came, in their order; an empty one is none."""
    found = list(words)
    return {word: found.count(word) for word in sorted(set(found)) if word}


def median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median wall time of a call, seconds."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


def relative_errors(predictions: Iterable[tuple[Callable[[], Any], Any]]) -> dict[str, float]:
    """|u - u*| / |u*| of predictions, per cent: median and 95 %, their number, and how long one takes, ms.

    Args:
        predictions: what gives a state, and its true displacement, (n, 3), metres.
    """
    missed, seconds = [], []
    for predict, truth in predictions:
        begin = time.perf_counter()
        state = predict()
        seconds.append(time.perf_counter() - begin)
        missed.append(100.0 * float(np.linalg.norm(state.displacement - truth) / np.linalg.norm(truth)))
    found = {"median": float(np.median(missed)), "p95": float(np.percentile(missed, 95)), "count": len(missed)}
    return {**found, "ms": 1e3 * float(np.median(seconds))}


def resident_mib(process: int | str = "self") -> float:
    """Memory that a process holds, MiB."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def covered(errors: Any, known: Any, shares: Iterable[float], points: Any = None) -> dict[str, float]:
    """Share of errors that lie within the margin of each confidence; metres, of the nodes if no points are given."""
    return {str(share): float((errors <= known.margin(points, share) + 1e-12).mean()) for share in shares}


def predicted_mm(uncertainty: Any) -> float:
    """Mean error of the nodes that a posterior expects, mm: the mean length of a normal error in space."""
    return 1e3 * float(np.sqrt(8.0 / (3.0 * np.pi)) * uncertainty.deviation.mean())
