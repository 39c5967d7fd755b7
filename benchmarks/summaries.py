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
