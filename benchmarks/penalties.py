"""What forces cost: the Gaussian prior beside the thesis's penalties (eq. 6.5, 6.6), errors of displacement and force.

    softtwin quickstart --output FOLDER
    python benchmarks/penalties.py FOLDER [--loads 8]

States of the quickstart's organ under loads of its kind that no data set holds, solved by the reference; clouds of
1,000 points from the quickstart's camera with 0.5 mm of noise, no zone told, from rest, surrogate. `prior` is the
product's own solver and, by L-BFGS, its objective without either penalty. Frames that are refused are counted and are
in the errors all the same.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from columns import Column, verdicts
from harness import FOLDER, Benchmark, Given, Setting, run
from margins import truths_of
from numpy.typing import NDArray
from summaries import counts

from softtwin.app.quickstart import CAMERA, POINTS
from softtwin.app.twin import Twin
from softtwin.meshes.clouds import CloudError, partial_view
from softtwin.reference.data.outcome import NotConverged

Floats = NDArray[np.float64]
NOISE = 5e-4
ROWS: dict[str, dict[str, Any]] = {
    "prior": {},
    "prior, L-BFGS": {"solver": "l-bfgs"},
    **{
        f"{penalty}, alpha {alpha:g}": {"penalty": penalty, "alpha": alpha}
        for penalty in ("amplitude", "divergence")
        for alpha in (0.01, 0.1, 1.0)
    },
}


def one(twin: Twin, load: Floats, truth: Floats, seed: int) -> dict[str, Any]:
    """Errors of one registration."""
    rng = np.random.default_rng(seed)
    cloud = partial_view(twin.body, truth, CAMERA, POINTS, NOISE, rng, surface="observed")
    begun = time.perf_counter()
    try:
        result = twin.register(cloud, "")
    except (CloudError, NotConverged):
        return {"verdict": "none"}
    seconds = time.perf_counter() - begun
    off = np.linalg.norm(result.forces - load, axis=1).sum() / np.linalg.norm(load, axis=1).sum()
    net = np.linalg.norm(result.net_force - load.sum(axis=0)) / np.linalg.norm(load, axis=1).sum()
    error = 1e3 * float(np.linalg.norm(result.displacement - truth, axis=1).mean())
    return {"verdict": result.judgement.verdict.value, "error_mm": error, "forces_off": float(off),
            "net_off": float(net), "seconds": seconds}  # fmt: skip


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all frames with a result."""
    used = [row for row in rows if row["verdict"] != "none"]
    found: dict[str, Any] = {"loads": len(rows), "verdicts": counts(row["verdict"] for row in rows)}
    for name in ("error_mm", "forces_off", "net_off", "seconds"):
        values = np.array([row[name] for row in used])
        found[name] = {"mean": values.mean(), "median": np.median(values), "p95": np.quantile(values, 0.95)}
    return found


def work(row: str, given: Given) -> dict[str, Any]:
    pairs = given.once(truths_of, given.folder, given.loads)
    with Twin.open(given.folder, "surrogate", pose="fixed", **ROWS[row]) as twin:
        return summary([one(twin, *pair, seed) for seed, pair in enumerate(pairs)])


BENCHMARK = Benchmark(
    name="penalties",
    title="What forces cost: the Gaussian prior beside the thesis's penalties (eq. 6.5, 6.6)",
    about=("registration", "surrogate"),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column("accepted; doubtful; refused", "", verdicts),
        Column("mean nodal (95 %)", "mm", "{error_mm.mean:.2f} ({error_mm.p95:.2f})"),
        Column("nodal forces off, median", "", "{forces_off.median:.2f}"),
        Column("net force off, median", "", "{net_off.median:.2f}"),
        Column("median", "s", "{seconds.median:.2f}"),
    ),
    settings={"folder": FOLDER, "loads": Setting(8, "that no data set holds")},
    small={"loads": 1},
)


if __name__ == "__main__":
    run(BENCHMARK)
