"""What is in a data set: counts, reasons, distributions, origin."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .dataset import SPLITS, DataSet, stored_plan
from .jacobians import missing_jacobians, stored_modes
from .schema import Reason

Floats = NDArray[np.float64]
_PERCENTILES = (0, 5, 50, 95, 100)


@dataclass(frozen=True)
class Summary:
    """A data set in figures.

    Args:
        identity: SHA-256 of header and checksums: another one, other samples.
        origin: seed, material, loads and versions it was made with.
        blocks: how many there are when complete.
        missing: of them, never finished.
        damaged: of them, not as they were written.
        draws: finished ones of each split, by the reason that each was kept or kept apart for.
        spread: of accepted draws of all splits: smallest, 5th, 50th and 95th percentile and largest, by what it is of.
        extremes: numbers of the accepted draws that move the least, in the median, and the most.
        jacobians: modes that Jacobians are by, and training blocks that lack them; None where there are none.
    """

    identity: str
    origin: dict[str, Any]
    blocks: int
    missing: int
    damaged: dict[int, str]
    draws: dict[str, dict[str, int]]
    spread: dict[str, list[float]]
    extremes: dict[str, int]
    jacobians: tuple[int, int] | None

    def __str__(self) -> str:
        counts = [
            f"{split:12} " + (", ".join(f"{count} {reason}" for reason, count in reasons.items()) or "nothing finished")
            for split, reasons in self.draws.items()
        ]
        rows = [f"{name:32} " + " ".join(f"{value:10.4g}" for value in row) for name, row in self.spread.items()]
        head = f"{'accepted draws':32} " + " ".join(f"{words:>10}" for words in _HEAD) if rows else ""
        made = "; ".join(f"{name} {entry}" for name, entry in self.origin.items())
        blocks = f"{self.blocks - self.missing} of {self.blocks} blocks finished, {len(self.damaged)} damaged"
        known = self.jacobians
        more = "" if known is None else f"; Jacobians by {known[0]} modes, missing in {known[1]} blocks"
        ends = ", ".join(f"{words} is draw {number}" for words, number in self.extremes.items())
        lines = [blocks + more, *(f"block {n} {words}" for n, words in self.damaged.items()), *counts, head, *rows]
        return "\n".join(line for line in [*lines, ends, made, f"identity {self.identity}"] if line)


_HEAD = ("least", "5 %", "median", "95 %", "most")


def summary(data: DataSet) -> Summary:
    """A data set in figures, finished or not; reads all of it."""
    damaged = data.damaged_blocks()
    size, whole = data.header["block"], np.ones(data.block_count, dtype=bool)
    whole[[*data.missing_blocks(), *damaged]] = False
    draws: dict[str, dict[str, int]] = {}
    numbers: list[int] = []
    measured: dict[str, list[float]] = {name: [] for name in (_PEAK, _FORCE, _ITERATIONS, _RESIDUAL)}
    for split in SPLITS:
        every, reasons = data.split_draws(split), Counter[str]()
        for begin in range(every.start, every.stop, size):
            if not whole[begin // size]:
                continue
            rows = data.rows(range(begin, min(begin + size, every.stop)))
            reasons.update(Reason(reason).words for reason in rows["reason"])
            kept = rows["reason"] == Reason.ACCEPTED
            numbers += (begin + np.flatnonzero(kept)).tolist()
            loads = np.linalg.norm(rows["forces"][kept].sum(axis=1), axis=1)
            measured[_PEAK] += (1e3 * np.linalg.norm(rows["displacements"][kept], axis=2).max(axis=1)).tolist()
            measured[_FORCE] += loads.tolist()
            measured[_ITERATIONS] += rows["iterations"][kept].astype(float).tolist()
            measured[_RESIDUAL] += rows["residual"][kept].tolist()
        if every:
            draws[split] = dict(sorted(reasons.items()))
    order = np.argsort(measured[_PEAK], kind="stable")
    places = {"least moved": 0, "median": len(order) // 2, "most moved": -1} if len(order) else {}
    modes = stored_modes(data)
    return Summary(
        identity=data.identity,
        origin=_origin(data),
        blocks=data.block_count,
        missing=len(data.missing_blocks()),
        damaged=damaged,
        draws=draws,
        spread={name: np.percentile(row, _PERCENTILES).tolist() for name, row in measured.items() if row},
        extremes={words: numbers[order[place]] for words, place in places.items()},
        jacobians=None if modes is None else (modes.shape[1], len(missing_jacobians(data))),
    )


_PEAK, _FORCE = "largest nodal displacement, mm", "net force, N"
_ITERATIONS, _RESIDUAL = "Newton iterations", "residual, N"


def _origin(data: DataSet) -> dict[str, Any]:
    plan = stored_plan(data.header)
    named: dict[str, Any] = {
        name: plan[name] for name in ("seed", "material", "young_modulus", "poisson_ratio", "loads") if name in plan
    }
    merged = data.header.get("merged")
    more = {} if merged is None else {"merged from": [entry["identity"][:12] for entry in merged]}
    solved = {"engines": data.engines} if data.engines else {}
    return {**named, **more, "versions": data.header.get("versions", {}), **solved}
