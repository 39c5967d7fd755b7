"""The pages of results, made from the records: a dashboard of the most important rows, and one page a chapter.

    python benchmarks/dashboard.py          writes the tables into docs/results/*.md, between their marks

A row names its record and the way to the figure in it, so that no figure is typed by hand; what others reached and what
was asked for are typed once, here, with their source. `tests/test_results.py` holds the pages to it.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

RESULTS = Path(__file__).parent / "results"
PAGES = Path(__file__).parents[1] / "docs" / "results"
Chapter = Literal["reference", "surrogates", "registration", "organs", "live", "data"]
CHAPTERS: dict[Chapter, str] = {
    "reference": "The reference",
    "surrogates": "Surrogates",
    "registration": "Registration",
    "organs": "Real organs",
    "live": "Live",
    "data": "Data and building",
}
MOST_ROWS = {"index": 40, "chapter": 60}
Way = tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """One figure of a record beside what others reached and what was asked for.

    Args:
        chapter: whose page it stands on.
        quantity: what was measured, on what.
        record: name of its file, without `.json`.
        way: keys that lead to the figure; `*` takes the mean over a level, `>` its largest, `#` counts its entries.
        unit: in words.
        scale: that the stored number is multiplied with.
        digits: significant ones.
        peer: what the thesis or the best peer has, with the source.
        target: what was asked for, as a number in the same unit; None for nothing.
        most: whether the target is the largest good value, and not the least.
        front: whether it stands on the dashboard as well.
    """

    chapter: Chapter
    quantity: str
    record: str
    way: Way
    unit: str = ""
    scale: float = 1.0
    digits: int = 3
    peer: str = ""
    target: float | None = None
    most: bool = True
    front: bool = False

    @property
    def value(self) -> float:
        """The figure in its unit."""
        return self.scale * _at(load(self.record)["figures"], self.way)

    @property
    def is_short(self) -> bool:
        """Whether it falls short of what was asked for."""
        if self.target is None:
            return False
        return self.value > self.target if self.most else self.value < self.target


@cache
def load(name: str) -> dict[str, Any]:
    """A record."""
    found: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return found


def _at(figures: Any, way: Way) -> float:
    for number, key in enumerate(way):
        if key == "#":
            return float(len(figures))
        if key in ("*", ">"):
            rest = way[number + 1 :]
            values = figures.values() if isinstance(figures, dict) else figures
            numbers = [_at(value, rest) for value in values]
            return max(numbers) if key == ">" else sum(numbers) / len(numbers)
        figures = figures[int(key)] if isinstance(figures, list) else figures[key]
    return float(figures)


def made(row: Row) -> str:
    """Commit and day of a row's record; where rows carry their own, the row's."""
    record = load(row.record)
    told: dict[str, Any] = {"commit": record.get("commit"), "date": record.get("date", "")}
    figures = record["figures"]
    for place in (record.get("made", {}), figures if isinstance(figures, dict) else {}):
        one = place.get(row.way[0]) if isinstance(place, dict) else None
        if isinstance(one, dict):
            told |= {name: one[name] for name in told if name in one}
            own = one.get("made")
            told |= {name: own[name] for name in told if isinstance(own, dict) and name in own}
    commit = told["commit"] or "no commit"
    return f"{commit}, {told['date']}"


def shown(value: float, digits: int) -> str:
    """A number with so many significant digits, without an exponent where it needs none."""
    if value == 0.0:
        return "0"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        text = f"{value:.0f}"
    return text


def table(rows: Iterable[Row]) -> str:
    """Rows as a table in Markdown."""
    lines = ["| quantity | ours | thesis or best peer | asked | record of |", "|---|---|---|---|---|"]
    for row in rows:
        ours = f"{shown(row.value, row.digits)} {row.unit}".strip()
        asked = "" if row.target is None else f"{'at most' if row.most else 'at least'} {row.target:g}"
        short = " (**short**)" if row.is_short else ""
        lines.append(f"| {row.quantity} | {ours}{short} | {row.peer} | {asked} | {made(row)} |")
    return "\n".join(lines)


def tables() -> dict[str, str]:
    """The table of each page, by its file's stem."""
    found = {"index": table(row for row in ROWS if row.front)}
    return found | {chapter: table(row for row in ROWS if row.chapter == chapter) for chapter in CHAPTERS}


def placed(page: str, text: str) -> str:
    """A page with the text between its marks."""
    marks = r"(<!-- made by benchmarks/dashboard.py -->\n).*?(\n<!-- end -->)"
    if not re.search(marks, page, flags=re.DOTALL):
        raise ValueError("the page has no marks `<!-- made by benchmarks/dashboard.py -->` and `<!-- end -->`")
    return re.sub(marks, lambda found: found[1] + text + found[2], page, flags=re.DOTALL)


def _mean_over(*keys: str) -> Way:
    return ("sequences", "*", "summary", *keys)


ROWS: tuple[Row, ...] = (
    # The reference
    Row(
        "reference",
        "hard loads on the thesis's beam that are solved, of 1,000",
        "beam_hard",
        ("softtwin", "converged"),
        digits=4,
        peer="full steps: 20 % (Odot 2023, 7.2.1), 22 of 100 in the same run",
        target=1000,
        most=False,
        front=True,
    ),
    Row(
        "reference",
        "hard loads on the thesis's beam, median time",
        "beam_hard",
        ("softtwin", "median_ms"),
        "ms",
        front=True,
        peer="full steps in load steps: 159 ms (same run)",
    ),
    Row("reference", "the same, 95 % of times", "beam_hard", ("softtwin", "p95_ms"), "ms"),
    Row(
        "reference",
        "the same by the energy search from rest, median time",
        "beam_hard",
        ("energy search from rest", "median_ms"),
        "ms",
    ),
    Row(
        "reference",
        "the same in load steps with full steps, median time",
        "beam_hard",
        ("full steps in load steps", "median_ms"),
        "ms",
    ),
    Row(
        "reference",
        "beam bent by 0.3 m, median time",
        "beam_solve",
        ("median_ms",),
        "ms",
        peer="25 ms (SOFA), 500 ms (DiffEn): Odot 2023, ch. 7",
        target=40,
    ),
    Row(
        "reference",
        "beam, Neo-Hookean, against felupe: largest difference",
        "peers",
        ("beam, neo-hookean", "felupe", "largest_difference_m"),
        "m",
        digits=2,
    ),
    Row(
        "reference",
        "beam, Neo-Hookean, one equilibrium",
        "peers",
        ("beam, neo-hookean", "softtwin_s"),
        "s",
        peer="felupe 0.24 s, scikit-fem 0.40 s, torch-fem 0.53 s (same run)",
        front=True,
    ),
    Row(
        "reference",
        "liver, Neo-Hookean, one equilibrium",
        "peers",
        ("liver, neo-hookean", "softtwin_s"),
        "s",
        peer="felupe 6.8 s, scikit-fem 8.8 s, torch-fem 7.6 s (same run, eight load steps each)",
        front=True,
    ),
    Row(
        "reference",
        "a million unknowns, one solve on two ranks",
        "growth",
        ("cases", "multigrid, 2 ranks, 1e+06", "solve_s"),
        "s",
    ),
    Row(
        "reference",
        "a million unknowns, memory",
        "growth",
        ("cases", "multigrid, 1 rank, 1e+06", "peak_GiB"),
        "GiB",
        target=20,
        front=True,
    ),
    Row(
        "reference", "100,000 unknowns by MUMPS, one rank", "growth", ("cases", "mumps, 1 rank, 100000", "solve_s"), "s"
    ),
    Row(
        "reference",
        "100,000 unknowns by multigrid, one rank",
        "growth",
        ("cases", "multigrid, 1 rank, 100000", "solve_s"),
        "s",
    ),
    Row(
        "reference",
        "tangent of the liver: assembled",
        "assembly",
        ("liver", "summed_ms"),
        "ms",
        peer="DOLFINx's own assembly 44 ms (same run)",
    ),
    Row(
        "reference",
        "tangent of the beam of table 5.1: factored",
        "assembly",
        ("large beam", "factored_ms"),
        "ms",
        peer="MUMPS 196 ms (same run)",
    ),
    Row(
        "reference",
        "inverse problem, stiffness: found to 1e-8, of 100",
        "inverse",
        ("stiffness", "within_1e-8"),
        digits=4,
        target=100,
        most=False,
    ),
    Row(
        "reference",
        "inverse problem, Poisson's ratio: found to 1e-5, of 100",
        "inverse",
        ("ratio", "within_1e-5"),
        digits=4,
        target=100,
        most=False,
    ),
    Row(
        "reference",
        "inverse problem, both together: found to 1e-5, of 100",
        "inverse",
        ("both", "within_1e-5"),
        digits=4,
        target=100,
        most=False,
        front=True,
    ),
    Row(
        "reference",
        "differentiable equilibria: draws compared with a minimiser's",
        "inverse_exactness",
        ("exactness", "loads"),
        digits=4,
    ),
    Row(
        "reference",
        "inverse problem, forces on the thesis's beam: searches that fail or find no state, of 100",
        "inverse",
        ("force", "failed", "#"),
        target=0,
    ),
    *(
        Row(
            "reference",
            f"inverse problem, forces looked for {words}: accepted in spite of it, of 99",
            "inverse",
            ("force", "wrong support", name, "verdicts", "accepted"),
            peer="'has a lot of impact' (Odot 2023, 7.2.2)",
            target=0,
            front=name == "opposite",
        )
        for name, words in (("opposite", "on the opposite side"), ("tip", "at the tip alone"))
    ),
    # Surrogates
    Row(
        "surrogates",
        "thesis's beam, reduced network, mean of norm / nodes (Table 4.1's measure)",
        "beam_surrogate",
        ("reduced", "thesis_error", "mean"),
        "um",
        1e6,
        peer="169 um (Odot 2023, Table 4.1)",
        front=True,
    ),
    Row(
        "surrogates",
        "the same, the thesis's perceptron trained here",
        "beam_surrogate",
        ("mlp", "thesis_error", "mean"),
        "um",
        1e6,
        peer="169 um (Odot 2023, Table 4.1)",
    ),
    Row(
        "surrogates",
        "the same, mean nodal error of the reduced network",
        "beam_surrogate",
        ("reduced", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "the same, mean nodal error of the perceptron",
        "beam_surrogate",
        ("mlp", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "8,192 samples, 200 s, reduced network with whole Jacobians: mean nodal error",
        "networks",
        ("4.2: reduced, whole Jacobians, seed 0", "modal", "nodal_error", "mean"),
        "mm",
        1e3,
        front=True,
    ),
    Row(
        "surrogates",
        "the same without Jacobians",
        "networks",
        ("4.2: reduced, seed 0", "modal", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "the same, perceptron",
        "networks",
        ("4.2: mlp, seed 0", "modal", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "the same, U-Mesh with 16 channels (starved: the thesis has 128)",
        "networks",
        ("4.2: umesh, 16 channels, seed 0", "modal", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "the same, transolver",
        "networks",
        ("4.2: transolver, seed 0", "modal", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "the same, linear map between POD coordinates",
        "networks",
        ("4.2: POD of 64 modes, linear map", "modal", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "perceptron, 20,480 samples, 200 s (starved): mean of norm / nodes",
        "networks",
        ("4.1: mlp, modal forces, 20480 samples", "modal", "thesis_error", "mean"),
        "um",
        1e6,
        peer="169 um (Odot 2023, Table 4.1)",
    ),
    Row(
        "surrogates",
        "perceptron on random forces, 20,480 samples, 200 s (starved): mean of norm / nodes",
        "networks",
        ("4.1: mlp, random forces, 20480 samples", "random", "thesis_error", "mean"),
        "um",
        1e6,
        peer="220 um (Odot 2023, Table 4.1)",
    ),
    Row(
        "surrogates",
        "real liver on a grid, reduced network with Jacobians: mean nodal error",
        "networks_bodies",
        ("4.3: liver, reduced, 192 modes, whole Jacobians", "liver", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "the same, perceptron of width 1500",
        "networks_bodies",
        ("4.3: liver, mlp, width 1500", "liver", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "propeller, reduced network: mean nodal error",
        "networks_bodies",
        ("5.1: propeller, reduced", "propeller", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "propeller, perceptron: mean nodal error",
        "networks_bodies",
        ("5.1: propeller, mlp, width 1500", "propeller", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "surrogates",
        "error bounds made for 90 %: kept on 10,000 held-out loads (mean error)",
        "certificates",
        ("modal", "held_out", "kept", "mean"),
        "%",
        100,
        front=True,
        peer="split conformal prediction: 90 %",
    ),
    Row(
        "surrogates",
        "the same for the largest nodal error",
        "certificates",
        ("modal", "held_out", "kept", "largest"),
        "%",
        100,
    ),
    Row(
        "surrogates",
        "a load three times beyond the training range is set aside",
        "certificates",
        ("modal", "outside", "times_3"),
        "%",
        100,
    ),
    Row(
        "surrogates",
        "prediction on one CPU thread, reduced, single precision",
        "prediction",
        ("networks", "reduced", "single_ms"),
        "ms",
        front=True,
        peer="0.26 to 0.4 ms on a GPU for its perceptron (Odot 2023)",
        target=0.5,
    ),
    Row(
        "surrogates",
        "the same with the Jacobian in 64 directions",
        "prediction",
        ("networks", "reduced", "with_jacobian_ms"),
        "ms",
    ),
    Row("surrogates", "prediction on one CPU thread, perceptron", "prediction", ("networks", "mlp", "single_ms"), "ms"),
    Row(
        "surrogates",
        "NVIDIA H100: prediction of the reduced network, host to host",
        "gpu/h100",
        ("reduced", "prediction", "single", "solve", "median_ms"),
        "ms",
        front=True,
    ),
    Row(
        "surrogates",
        "NVIDIA H100: the same with the Jacobian in 64 directions",
        "gpu/h100",
        ("reduced", "prediction", "single", "linearised_64", "median_ms"),
        "ms",
    ),
    Row(
        "surrogates",
        "NVIDIA H100: 256 loads at once",
        "gpu/h100",
        ("reduced", "prediction", "single", "solve_many_256", "median_ms"),
        "ms",
    ),
    Row(
        "surrogates",
        "NVIDIA H100: off from the processor's double precision, of the largest displacement",
        "gpu/h100",
        ("reduced", "prediction", "single", "off_from_double_on_processor"),
        digits=2,
    ),
    Row(
        "surrogates",
        "NVIDIA H100: perceptron, 100 epochs of 2,048 samples (starved: 20,480)",
        "gpu/h100",
        ("mlp", "training", "seconds"),
        "s",
    ),
    Row(
        "surrogates",
        "NVIDIA H100: U-Mesh with 128 channels, training steps (bfloat16)",
        "gpu/h100",
        ("umesh_128_mixed", "training", "steps_per_s"),
        "a second",
    ),
    Row(
        "surrogates",
        "NVIDIA H100: elastic forces of 1,000 states at once, double precision",
        "gpu/h100",
        ("elastic_forces", "states_per_s"),
        "states a second",
    ),
    Row(
        "surrogates",
        "Newton from the prediction, loads up to twice the range: same state, of 500",
        "checked_network",
        ("modal", "solved", "up to twice", "from the network", "same_state"),
        digits=4,
    ),
    Row(
        "surrogates",
        "Newton from the prediction, loads in the range: iterations",
        "checked_network",
        ("modal", "solved", "in range", "from the network", "iterations"),
        peer="from rest 6.9 (same run); thesis 5.0 on another body and network (Odot 2023, Table 5.3)",
    ),
    Row(
        "surrogates",
        "Newton from the prediction, 12,000 unknowns, loads up to twice the range: mean time",
        "hybrid_newton",
        ("large, up to twice", "ours", "mean_ms"),
        "ms",
        digits=4,
        peer="8,000 ms from rest (same run)",
        target=8000,
        front=True,
    ),
    Row(
        "surrogates",
        "the thesis's algorithm 5 as printed, 304 hexahedra, loads in the range: solved of 500",
        "hybrid_newton",
        ("small, in range", "algorithm 5 as printed", "converged"),
        peer="99 % of 100 on another body and network (Odot 2023, Table 5.3)",
    ),
    Row(
        "surrogates",
        "the same: iterations",
        "hybrid_newton",
        ("small, in range", "algorithm 5 as printed", "iterations"),
        peer="5.0 on another body and network (Odot 2023, Table 5.3)",
    ),
    Row(
        "surrogates",
        "error bounds under loads of all sizes: rank correlation of bound and error",
        "certificates",
        ("ranges", "held_out", "rank_correlation", "mean"),
        target=0.95,
        most=False,
        front=True,
    ),
    Row(
        "surrogates",
        "the same: width over the median error, largest quarter of the loads",
        "certificates",
        ("ranges", "held_out", "widths", "mean", "3"),
        target=2,
    ),
    Row(
        "surrogates",
        "error bounds on the real liver: rank correlation of the indicator and the error",
        "certificates",
        ("liver-tetrahedra", "held_out", "step_correlation", "mean"),
        target=0.95,
        most=False,
    ),
    # Registration
    Row(
        "registration",
        "thesis's beam, 10,000 unseen cases: mean error where forces act is known",
        "beam_registration",
        ("where forces act is known", "mean_m", "mean"),
        "mm",
        1e3,
        peer="0.060 mm (Odot 2023, Table 6.1)",
        target=0.05,
        front=True,
    ),
    Row(
        "registration",
        "the same, largest nodal error in the mean",
        "beam_registration",
        ("where forces act is known", "largest_m", "mean"),
        "mm",
        1e3,
        target=0.3,
    ),
    Row(
        "registration",
        "the same, forces anywhere: mean error",
        "beam_registration",
        ("forces anywhere", "mean_m", "mean"),
        "mm",
        1e3,
        peer="0.060 mm (Odot 2023, Table 6.1)",
        target=0.05,
    ),
    *(
        Row(
            "registration",
            f"real liver, simulated, {words}: target error, surrogate",
            "robustness_surrogate",
            (name, "cold", "tre_mm"),
            "mm",
            target=target,
            front=name in ("noise 2 mm", "outliers"),
        )
        for name, words, target in (
            ("clean", "clean cloud", None),
            ("noise 1 mm", "noise 1 mm", 0.3),
            ("noise 2 mm", "noise 2 mm", 0.4),
            ("noise 5 mm", "noise 5 mm", 0.7),
            ("outliers", "outliers", 0.3),
            ("half of the points", "half of the points", None),
            ("quarter of the points", "a quarter of the points", None),
            ("half of the side", "half of the side", None),
            ("pose off by 2 degrees and 3 mm", "pose off by 2 degrees and 3 mm", 0.5),
            ("no zone, noise 2 mm", "no zone, noise 2 mm", 0.9),
        )
    ),
    *(
        Row(
            "registration",
            f"the same, {name}: target error, reference",
            "robustness_reference",
            (name, "cold", "tre_mm"),
            "mm",
        )
        for name in ("clean", "noise 1 mm", "noise 2 mm", "noise 5 mm")
    ),
    Row(
        "registration",
        "real liver, truths drawn from the prior: mean error",
        "calibration",
        ("liver", "error_mm"),
        "mm",
    ),
    Row("registration", "the same: error that was predicted", "calibration", ("liver", "predicted_mm"), "mm"),
    Row(
        "registration",
        "real liver, truths drawn from the prior: nodes inside their 90 % margin",
        "calibration",
        ("liver", "nodes", "0.9"),
        "%",
        100,
        front=True,
        peer="90 %",
    ),
    Row(
        "registration",
        "real liver, truths drawn from the prior: net force inside its 90 % region",
        "calibration",
        ("liver", "force", "0.9"),
        "%",
        100,
        target=88,
        most=False,
        front=True,
        peer="90 %",
    ),
    Row(
        "registration",
        "real liver, truths drawn from the prior: correlation of predicted and true error",
        "calibration",
        ("liver", "correlation"),
        target=0.9,
        most=False,
        front=True,
    ),
    Row(
        "registration",
        "any camera: nodes inside their 90 % margin",
        "calibration",
        ("liver, any camera", "nodes", "0.9"),
        "%",
        100,
    ),
    Row(
        "registration",
        "rigid start from half of the side: within 15 mm",
        "alignment",
        ("rows", "liver 50%", "found_within_15_mm"),
        "%",
        100,
    ),
    Row(
        "registration",
        "rigid start from a quarter of the side: within 15 mm",
        "alignment",
        ("rows", "liver 25%", "within_15_mm"),
        "%",
        100,
        target=90,
        most=False,
        front=True,
    ),
    Row(
        "registration",
        "the same: found wrong by more than 50 mm without a word",
        "alignment",
        ("rows", "liver 25%", "found_beyond_50_mm"),
        "%",
        100,
        target=0,
    ),
    *(
        Row(
            "registration",
            f"wrong model, {name}, without the model-error ensemble: nodes inside their 90 % margin",
            "misspecified",
            (f"surrogate: {name}", "nodes", "0.9"),
            "%",
            100,
        )
        for name in ("as it is", "modulus 50 % off", "held up to 10 mm elsewhere", "meshed anew")
    ),
    Row(
        "registration",
        "foreign patch, 30 % raised by 10 mm: target error of accepted frames",
        "foreign_patches",
        ("surrogate: raised, 30 % by 10 mm", "accepted", "tre_mm"),
        "mm",
    ),
    Row(
        "registration",
        "sampled posterior (pCN) against Laplace, the first of ten frames: net force apart, of its deviation",
        "pcn",
        ("frame 0, about laplace, 20000 states", "net force", "apart"),
    ),
    Row(
        "registration",
        "pose noise 1 mm, pose unknown: target error, surrogate",
        "pose_noise",
        ("surrogate, pose unknown, s 0.001", "tre_mm", "mean"),
        "mm",
    ),
    *(
        Row(
            "registration",
            f"thesis's beam, forces act {words}: {quantity}",
            "beam_registration",
            (name, *way),
            unit,
            peer=peer,
            target=target,
            front=name == "where forces act is known",
        )
        for name, words in (("where forces act is known", "where it is known"), ("forces anywhere", "anywhere"))
        for quantity, way, unit, peer, target in (
            ("mean iterations", ("iterations", "mean"), "", "27 (Odot 2023, Table 6.1)", 8),
            ("mean time", ("ms", "mean"), "ms", "48 ms on a GPU (Odot 2023, Table 6.1)", 15),
        )
    ),
    *(
        Row(
            "registration",
            f"{words}: net force inside its 90 % region",
            "calibration",
            (name, "force", "0.9"),
            "%",
            100,
            peer="90 %",
            target=88,
            most=False,
        )
        for name, words in (
            ("beam", "thesis's beam, truths drawn from the prior"),
            ("beam, any camera", "thesis's beam, any camera"),
            ("liver, any camera", "real liver, any camera"),
        )
    ),
    *(
        Row(
            "registration",
            f"real liver, simulated, {name}: target error, reference (asked: 1.5 times the clean one)",
            "robustness_reference",
            (name, "cold", "tre_mm"),
            "mm",
            target=0.0372,
        )
        for name in ("quarter of the points", "half of the side")
    ),
    Row(
        "registration",
        "no zone, noise 1 mm, warm, reference: z of the net force",
        "robustness_reference",
        ("no zone, noise 1 mm", "warm", "z_rms"),
        target=0.8,
        most=False,
    ),
    *(
        Row(
            "registration",
            f"wrong model, {name}, with the model-error ensemble: nodes inside their 90 % margin",
            "misspecified_doubt",
            (f"surrogate: {name}", "nodes", "0.9"),
            "%",
            100,
            target=85,
            most=False,
        )
        for name in ("as it is", "modulus 50 % off", "held up to 10 mm elsewhere", "meshed anew")
    ),
    Row(
        "registration",
        "camera 3 mm and 1 degree elsewhere, pose taken as exact: nodes inside their 90 % margin",
        "misspecified_doubt",
        ("surrogate: seen from 3 mm and 1 degree elsewhere", "nodes", "0.9"),
        "%",
        100,
        target=85,
        most=False,
    ),
    Row(
        "registration",
        "the same camera, pose to 2 mm and 1 degree: nodes inside their 90 % margin",
        "misspecified_doubt",
        ("surrogate, pose to 2 mm: seen from 3 mm and 1 degree elsewhere", "nodes", "0.9"),
        "%",
        100,
        target=85,
        most=False,
    ),
    Row(
        "registration",
        "phantom, 200 loads, noise 0.5 mm: nodes inside their 90 % margin, surrogate",
        "margins",
        ("surrogate, noise 0.5 mm", "summary", "nodes_covered", "0.9"),
        "%",
        100,
        peer="90 %",
    ),
    Row(
        "registration",
        "the same: correlation of predicted and true error",
        "margins",
        ("surrogate, noise 0.5 mm", "summary", "correlation"),
        peer="0.81 were each posterior right (same run)",
        target=0.9,
        most=False,
    ),
    # Real organs
    Row(
        "organs",
        "real liver, whole sequences, surrogate: mean target error",
        "registration_surrogate",
        _mean_over("mean_tre_mm"),
        "mm",
        peer="0.5 to 3.5 mm (Odot 2023, ch. 6)",
        target=0.15,
        front=True,
    ),
    Row(
        "organs",
        "the same: worst frame of the three sequences",
        "registration_surrogate",
        ("sequences", ">", "summary", "worst_tre_mm"),
        "mm",
    ),
    Row("organs", "the same: net force off", "registration_surrogate", _mean_over("mean_force_error"), "%", 100),
    Row(
        "organs",
        "real liver, whole sequences, surrogate: median time of a frame",
        "registration_surrogate",
        _mean_over("median_seconds"),
        "ms",
        1e3,
        target=16,
        front=True,
    ),
    Row(
        "organs",
        "real liver, whole sequences, reference: mean target error",
        "liver_engines",
        ("reference", "summary", "mean_tre_mm"),
        "mm",
        target=0.01,
        front=True,
    ),
    Row(
        "organs",
        "real liver, whole sequences, hybrid: mean target error",
        "liver_engines",
        ("hybrid", "summary", "mean_tre_mm"),
        "mm",
        target=0.02,
    ),
    Row(
        "organs",
        "the same, reference told that points are good to 0.01 mm",
        "liver_engines",
        ("reference, told that points are good to 0.01 mm", "summary", "mean_tre_mm"),
        "mm",
    ),
    Row(
        "organs",
        "another mesh of the liver, reference: mean target error",
        "liver_engines",
        ("remeshed, reference", "summary", "mean_tre_mm"),
        "mm",
        target=0.45,
        front=True,
    ),
    Row(
        "organs",
        "modulus 30 % too large, reference",
        "liver_engines",
        ("wrong: E 30 % too large, reference", "summary", "mean_tre_mm"),
        "mm",
    ),
    Row(
        "organs",
        "ratio 0.45 for 0.49, reference",
        "liver_engines",
        ("wrong: nu 0.45 for 0.49, reference", "summary", "mean_tre_mm"),
        "mm",
    ),
    Row(
        "organs", "linear law, reference", "liver_engines", ("wrong: linear, reference", "summary", "mean_tre_mm"), "mm"
    ),
    Row(
        "organs",
        "stored states of the liver's ground truth: largest error of sequence s1, frame 25",
        "liver_truth",
        ("s1", "largest_error_m", "s1 25"),
        "m",
        digits=2,
    ),
    Row(
        "organs",
        "real liver, surrogate beside reference and hybrid in one record: mean target error",
        "liver_engines",
        ("surrogate", "summary", "mean_tre_mm"),
        "mm",
        peer="0.5 to 3.5 mm (Odot 2023, ch. 6)",
        target=0.15,
    ),
    *(
        Row(
            "organs",
            f"real liver, {name}, the same record: net force off",
            "liver_engines",
            (name, "summary", "force_error"),
            "%",
            100,
            peer="10.04 % (Odot 2023, ch. 6)",
            target=target,
        )
        for name, target in (("reference", 0.5), ("surrogate", 4))
    ),
    *(
        Row(
            "organs",
            f"real liver, {name}, the same record: median time of a frame",
            "liver_engines",
            (name, "summary", "median_seconds"),
            "s",
            target=target,
        )
        for name, target in (("reference", 0.5), ("hybrid", 0.4), ("surrogate", 0.016))
    ),
    Row(
        "organs",
        "real liver, surrogate, the same record: net forces inside their 90 % region",
        "liver_engines",
        ("surrogate", "summary", "force_covered", "0.9"),
        "%",
        100,
        peer="90 %",
    ),
    Row(
        "organs",
        "another mesh of the liver, reference with the model-error ensemble: mean target error",
        "liver_engines",
        ("remeshed, reference, doubt", "summary", "mean_tre_mm"),
        "mm",
        target=0.45,
    ),
    Row(
        "organs",
        "the same: nodes inside their 90 % margin",
        "liver_engines",
        ("remeshed, reference, doubt", "summary", "covered", "0.9"),
        "%",
        100,
        peer="8 % without the ensemble (same record)",
    ),
    Row(
        "organs",
        "another mesh of the liver, every node known: least mean error that any forces reach",
        "other_mesh",
        ("sequences", "*", "at_best_mm"),
        "mm",
    ),
    *(
        Row(
            "organs",
            f"{words}, with the model-error ensemble: nodes inside their 90 % margin",
            "liver_engines",
            (f"wrong: {name}, reference, doubt", "summary", "covered", "0.9"),
            "%",
            100,
            target=target,
            most=False,
        )
        for name, words, target in (
            ("E 30 % too large", "modulus 30 % too large", 85),
            ("nu 0.45 for 0.49", "ratio 0.45 for 0.49", 85),
            ("linear", "linear law (asked: not accepted; all 33 frames are doubtful)", None),
        )
    ),
    # Live
    Row(
        "live",
        "a stream of ten minutes at 60 clouds a second: age of an answer, median",
        "stream",
        ("age_ms", "p50"),
        "ms",
        front=True,
    ),
    Row("live", "the same, 95 %", "stream", ("age_ms", "p95"), "ms", target=120),
    Row("live", "the same, 99.9 %", "stream", ("age_ms", "p999"), "ms"),
    Row(
        "live",
        "the same stream: answers within the budget of 100 ms and 10 ms more",
        "stream",
        ("within_budget_and_10_ms",),
        "%",
        100,
        digits=4,
        target=99.9,
        most=False,
    ),
    Row("live", "the same: mean error", "stream", ("error_mm", "mean"), "mm"),
    Row("live", "live page: pull to answer, median", "live_page", ("pull_to_answer_ms", "median"), "ms", front=True),
    Row("live", "live page: pull to answer, 95 %", "live_page", ("pull_to_answer_ms", "p95"), "ms", target=100),
    Row("live", "live page: updates", "live_page", ("updates_a_second",), "a second", target=30, most=False),
    Row("live", "live page: time to the page", "live_page", ("seconds_to_page",), "s"),
    Row("live", "live page: time to the first vertices", "live_page", ("seconds_to_first_update",), "s", target=15),
    Row(
        "live",
        "OpenIGTLink, a registered cloud and its answer, median",
        "openigtlink",
        ("registered", "round_ms", "p50"),
        "ms",
        front=True,
    ),
    Row("live", "OpenIGTLink, network alone, median", "openigtlink", ("network, POINT", "round_ms", "p50"), "ms"),
    # Data and building
    Row(
        "data",
        "equilibria of the liver on two ranks (tetrahedra)",
        "throughput",
        ("tetrahedra, 2 ranks", "draws_a_second"),
        "a second",
        front=True,
    ),
    Row("data", "the same on one rank", "throughput", ("tetrahedra, 1 rank", "draws_a_second"), "a second"),
    Row(
        "data",
        "the same on a grid of hexahedra, two ranks",
        "throughput",
        ("grid, 2 ranks", "draws_a_second"),
        "a second",
        target=2.8,
        most=False,
    ),
    Row(
        "data",
        "20,480 equilibria of the liver, two ranks",
        "throughput",
        ("tetrahedra, 2 ranks", "hours_for_20480"),
        "h",
        peer="19.7 h on a grid of hexahedra (Odot 2023)",
    ),
    Row(
        "data",
        "a twin from a surface file (2,000 nodes, 256 samples): all stages",
        "build_time",
        ("seconds",),
        "s",
        digits=4,
        target=300,
        front=True,
    ),
    Row(
        "data",
        "the same: mean nodal error of its network",
        "build_time",
        ("held_out", "nodal_error", "mean"),
        "mm",
        1e3,
    ),
    Row(
        "data",
        "strange surfaces made solid: mean distance to the surface",
        "surfaces",
        ("surfaces", "*", "mean_distance_m"),
        "mm",
        1e3,
        front=True,
    ),
    Row("data", "the same: mean time", "surfaces", ("surfaces", "*", "seconds"), "s"),
    Row(
        "data",
        "segmentation to surface, 1 mm voxels, phantom: mean distance",
        "segmentations",
        ("surfaces", "phantom, 1 x 1 x 1", "mean_mm"),
        "mm",
        front=True,
    ),
    Row("data", "the same, 0.7 x 0.7 x 5 mm", "segmentations", ("surfaces", "phantom, 0.7 x 0.7 x 5", "mean_mm"), "mm"),
    Row(
        "data",
        "the same, real liver, 1 mm",
        "segmentations",
        ("surfaces", "sofa-liver.vtk, 1 x 1 x 1", "mean_mm"),
        "mm",
    ),
    Row(
        "data",
        "draws chosen in active rounds, 1,024: 95 % of nodal errors",
        "active_rounds",
        ("modal: active, 1024 draws", "nodal_error_m", "p95"),
        "mm",
        1e3,
        peer="0.250 mm with 4,096 random draws (same record)",
        target=0.25,
    ),
    Row(
        "data",
        "random draws, 1,024: 95 % of nodal errors",
        "active_rounds",
        ("modal: random, 1024 draws", "nodal_error_m", "p95"),
        "mm",
        1e3,
    ),
    Row(
        "data",
        "loads of all sizes, 2,048 draws in active rounds: 95 % of nodal errors",
        "active_rounds",
        ("ranges: active, 2048 draws", "nodal_error_m", "p95"),
        "mm",
        1e3,
        peer="1.97 mm with 4,096 random draws (same record)",
        target=1.97,
        front=True,
    ),
)


def main() -> int:
    """Writes the tables into their pages; 1 where a page is not there or has no marks."""
    for stem, text in tables().items():
        path = PAGES / f"{stem}.md"
        path.write_text(placed(path.read_text(), text))
        print(f"written: {path.relative_to(PAGES.parents[1])}, {text.count(chr(10)) - 1} rows")
    return 0


if __name__ == "__main__":
    sys.exit(main())
