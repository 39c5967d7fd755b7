"""Registration of the real liver with the reference: s1, s2, s3, frames 0-49, against the computed truth.

    python benchmarks/registration_reference.py [--mesh default|remeshed] [--attachment facets|listed]

On mesh-remeshed the truth's nodes (of mesh-default) are carried by the other mesh's cells, the nearest one where a node
lies outside it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Given, Setting, run
from liver import POISSON_RATIO, SEQUENCES, YOUNG_MODULUS, Sequence, liver, sequence

from softtwin.meshes.embedding import embed
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.derivatives.model import ReferenceModel
from softtwin.reference.solve.problem import NewtonOptions, Problem
from softtwin.registration.forward import ForwardModel
from softtwin.registration.options import RegistrationOptions, expected_force, options_for
from softtwin.registration.registrar import prepare, register_sequence


def registered(
    data: Sequence, model: ForwardModel, frames: int, options: RegistrationOptions, smoothness: float
) -> list[dict[str, float]]:
    """Errors at the truth's nodes, forces and times of every frame of a sequence, with any forward model."""
    body = model.body
    rest = liver("default").points
    carrier = embed(body, rest)
    registrar = prepare(
        model,
        data.zone,
        body.surfaces["observed"],
        force_scale=expected_force(body, YOUNG_MODULUS),
        smoothness=smoothness,
        options=options,
    )
    rows = []
    for i, result in enumerate(register_sequence(registrar, data.clouds[:frames])):
        errors = 1e3 * np.linalg.norm(rest + carrier.displace(result.displacement) - data.positions[i], axis=1)
        true = data.net_forces[i]
        difference = float(np.linalg.norm(result.net_force - true))
        size = float(np.linalg.norm(true))
        row = {
            "frame": i,
            "tre_mm": errors.mean(),
            "tre_p95_mm": np.quantile(errors, 0.95),
            "tre_max_mm": errors.max(),
            "force_error_N": difference,
            "force_error": difference / size if size > 0.0 else None,  # no share of nothing
            "force_deviation_N": float(np.linalg.norm(result.net_force_deviation)),
            "rms_distance_mm": 1e3 * result.rms_distance,
            "seconds": result.seconds,
            "iterations": len(result.trace),
            "verdict": result.judgement.verdict.value,
            "negative_pivots": result.state.negative_pivots,
        }
        rows.append(row)
        figures = f"TRE {errors.mean():.4f} mm (max {errors.max():.3f}), net force off by {1e3 * difference:.1f} mN"
        print(f"{data.name} {i:2d}: {figures}, {result.seconds:.2f} s, {len(result.trace)} iterations", flush=True)
    return rows


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    """Means over frames 1 and later; the first starts cold and is given apart."""
    warm = rows[1:]
    return {
        **{
            f"mean_{key}": float(np.mean([r[key] for r in warm if r[key] is not None]))
            for key in ("tre_mm", "tre_p95_mm", "tre_max_mm", "force_error", "force_error_N")
        },
        "accepted": float(np.mean([r["verdict"] == "accepted" for r in rows])),
        "worst_tre_mm": max(r["tre_mm"] for r in warm),
        "median_seconds": float(np.median([r["seconds"] for r in warm])),
        "longest_seconds": max(r["seconds"] for r in warm),
        "cold_seconds": rows[0]["seconds"],
        "p95_seconds": float(np.quantile([r["seconds"] for r in warm], 0.95)),
        "cold_tre_mm": rows[0]["tre_mm"],
        "cold_force_error": rows[0]["force_error"],
    }


LOOSE, MATERIAL = NewtonOptions(tolerance=1e-5, max_iterations=15), NeoHookean(YOUNG_MODULUS, POISSON_RATIO)
COLUMNS = (
    Column("mean TRE", "mm", "{mean_tre_mm:.3f}"),
    Column("worst frame's", "mm", "{worst_tre_mm:.2f}"),
    Column("net force off", "%", "{mean_force_error*100:.1f}"),
    Column("median; 95 %; longest", "s", "{median_seconds:.3f}; {p95_seconds:.3f}; {longest_seconds:.2f}"),
    Column("cold frame 0: TRE", "mm", "{cold_tre_mm:.3f}"),
    Column("- force", "%", "{cold_force_error*100:.1f}"),
    Column("- time", "s", "{cold_seconds:.2f}"),
)


def with_summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """A sequence's frames and what they come to."""
    return {"summary": summary(rows), "frames": rows}


def lines(rows: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for each sequence."""
    return ((name, found["summary"]) for name, found in rows.items())


def work(row: str, given: Given) -> dict[str, Any]:
    problem = given.opened(Problem, given.once(liver, given.mesh, given.attachment), MATERIAL, LOOSE)
    model = ReferenceModel(problem, patient=False)
    options = options_for(model, has_zone=True)
    return with_summary(registered(sequence(row, given.mesh), model, given.frames, options, given.smoothness))


BENCHMARK = Benchmark(
    name="registration_reference_{mesh}_{attachment}",
    title="Registration of the real liver's sequences with the reference, against the computed truth",
    about=("registration", "reference"),
    work=work,
    rows=SEQUENCES,
    columns=COLUMNS,
    settings={
        "frames": Setting(50, "of each sequence"),
        "smoothness": Setting(0.02, "correlation length of the forces, metres"),
        "mesh": Setting("default", choices=("default", "remeshed")),
        "attachment": Setting("facets", choices=("facets", "listed")),
    },
    small={"frames": 2},
    under="sequences",
    lines=lines,
    finish=lambda figures, given: {name: getattr(given, name) for name in ("smoothness", "mesh", "attachment")},
)


if __name__ == "__main__":
    run(BENCHMARK)
