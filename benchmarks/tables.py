"""The tables of docs/results.md, printed as Markdown from the records.

    python benchmarks/tables.py [--into docs/results.md]

With `--into` each table of that page whose first heading is one of these is replaced.
"""

from __future__ import annotations

import argparse
import io
import math
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from liver import SEQUENCES
from record import recorded
from robustness import ROWS

ASKED = {
    "clean": "",
    "noise 1 mm": "0.3; 6; 0.8-1.3",
    "noise 2 mm": "0.4; 9; 0.8-1.3",
    "noise 5 mm": "0.7; 15; 0.8-1.3",
    "noise 2 mm along the view": "-",
    "noise 5 mm along the view": "-",
    "outliers": "0.1 / 0.3; -; <= 1.5",
    "pose off by 2 degrees and 3 mm": "0.5; -; <= 1.5",
    "no zone, clean": "0.6",
    "no zone, noise 1 mm": "0.8; 8; 0.8-1.5",
    "no zone, noise 2 mm": "0.9; 14; 0.8-1.5",
    "no zone, noise 5 mm": "1.2; 25; 0.8-1.5",
}


def row(*cells: object) -> None:
    print("| " + " | ".join(map(str, cells)) + " |")


def head(*cells: str) -> None:
    print()
    row(*cells)
    row(*["---"] * len(cells))


def robustness(model: str) -> None:
    """Degraded clouds: errors, calibration, time and verdicts by row and start."""
    found = recorded(f"robustness_{model}")
    head(
        model, "start", "TRE mm (95 %)", "force %", "z rms", "accepted %", "median s (longest)", "asked: TRE; force; z"
    )
    for name in ROWS:
        for start in ("cold", "warm"):
            f = found.get(name, {}).get(start)
            if f is None:
                continue
            count = found[name]["draws"]
            row(
                f"{name} ({count} draw{'s' * (count > 1)})",
                start,
                f"{f['tre_mm']:.2f} ({f['tre_p95_mm']:.2f})",
                f"{100 * f['force_error']:.1f}",
                f"{f['z_rms']:.2f}",
                f"{100 * f['accepted']:.0f}",
                f"{f['median_seconds']:.2f} ({f['longest_seconds']:.1f})",
                ASKED.get(name, "1.5 x clean"),
            )
    starts = [found[name][s] for name in found if name in ROWS for s in ("cold", "warm") if s in found[name]]
    print(f"\nfailed: {sum(f['failed'] for f in starts)}; accepted and worse than doing nothing: "
          f"{sum(f['accepted_worse_than_nothing'] for f in starts)}")  # fmt: skip
    verdicts = [f"{n['cloud']}: {n['verdict']}" for n in found.get("nonsense", [])]
    print("nonsense: " + ("; ".join(verdicts) or "not run"))


def sequences(name: str) -> None:
    """Whole sequences: frames 1-49, and the cold frame 0."""
    found = recorded(name)["sequences"]
    each = [found[s]["summary"] for s in SEQUENCES]
    head(name, *SEQUENCES)
    for label, key, scale, form in (
        ("mean TRE, mm", "mean_tre_mm", 1.0, ".3f"),
        ("worst frame's mean TRE, mm", "worst_tre_mm", 1.0, ".2f"),
        ("net force error, %", "mean_force_error", 100.0, ".1f"),
        ("median time a frame, s", "median_seconds", 1.0, ".3f"),
        ("95 % of them, s", "p95_seconds", 1.0, ".3f"),
        ("longest, s", "longest_seconds", 1.0, ".2f"),
        ("cold frame 0: TRE, mm", "cold_tre_mm", 1.0, ".3f"),
        ("- force, %", "cold_force_error", 100.0, ".1f"),
        ("- time, s", "cold_seconds", 1.0, ".2f"),
    ):
        row(label, *(format(scale * f[key], form) for f in each))
    print(f"\nmean TRE of all: {sum(f['mean_tre_mm'] for f in each) / len(each):.3f} mm")


def with_deviation(spread: dict[str, float], scale: float, form: str) -> str:
    """Mean and standard deviation over samples."""
    return f"{scale * spread['mean']:{form}} +- {scale * spread['std']:{form}}"


def least_signal_to_noise(figures: dict[str, Any]) -> float:
    """The smallest SNR of a split, decibels: that of its largest relative error, since older records hold no least."""
    return -20.0 * math.log10(figures["relative_error"]["max"])


def networks(name: str) -> None:
    """Networks: held-out errors, means +- deviations over the samples, and how sound the predictions are."""
    found = recorded(name)
    if not found:
        return
    sizes = ("u_2 m", "e mm", "largest mm", "norm / nodes um", "relative % (95 %)", "SNR dB; least")
    derivatives = ("cosine", "Jacobian %")
    sound_heads = ("residual", "inside out; indefinite", "f(0) mm")
    head(name, *sizes, *derivatives, *sound_heads, "other loads: e; largest mm", "steps; s")
    for key, f in found.items():
        own = f[f["learned_from"]]
        sound, training = own["balance"], f["training"] or {}
        other = [f[kind] for kind in ("modal", "random") if kind in f and f[kind] is not own]
        residual = sound["residual"]
        row(
            key,
            with_deviation(own["displacement_norm"], 1.0, ".2f" if own["displacement_norm"]["mean"] > 1.0 else ".3f"),
            with_deviation(own["nodal_error"], 1e3, ".3f"),
            with_deviation(own["largest_error"], 1e3, ".2f"),
            with_deviation(own["thesis_error"], 1e6, ".2f"),
            f"{100 * own['relative_error']['median']:.3f} ({100 * own['relative_error']['p95']:.2f})",
            f"{with_deviation(own['signal_to_noise'], 1.0, '.1f')}; {least_signal_to_noise(own):.1f}",
            f"{own['gradient_cosine']['mean']:.5f}",
            f"{100 * own['jacobian_error']['mean']:.1f}" if "jacobian_error" in own else "-",
            "-" if residual is None else f"{residual['median']:.2g}",
            f"{sound['inside_out']}; {sound['indefinite']} of {sound['samples']}",
            f"{1e3 * sound['at_rest']:.3f}",
            "; ".join(f"{1e3 * other[0][each]['mean']:.3f}" for each in ("nodal_error", "largest_error"))
            if other
            else "-",
            f"{training.get('steps', '-')}; {f['wall_s']:.0f}",
        )


def prediction() -> None:
    """What a prediction makes of its machine: shares of the operations and bytes a second of a large product."""
    found = recorded("prediction")
    if not found:
        return
    head(
        "prediction, ms",
        "double",
        "single",
        "with Jacobian",
        "onnxruntime: value; with Jacobian",
        "256 at once, a second",
    )
    for key, f in found["networks"].items():
        graphs = ("onnxruntime_ms", "onnxruntime_with_jacobian_ms")
        row(
            key,
            f"{f['double_ms']:.2f}",
            f"{f['single_ms']:.2f}",
            f"{f['with_jacobian_ms']:.1f}",
            "; ".join(f"{f[name]:.2f}" for name in graphs if name in f) or "-",
            f"{f['batches']['256']['samples_per_s']:,.0f}",
        )
    batches = list(next(iter(found["networks"].values()))["batches"])
    head(
        "prediction",
        "weights, MB; operations, millions a sample",
        *(f"{batch} at once: a second; % of operations; % of bytes (weights only)" for batch in batches),
    )
    for key, f in found["networks"].items():
        row(
            key,
            f"{1e-6 * f['weights_bytes']:.1f}; {1e-6 * f['operations']:.0f}",
            *(
                f"{each['samples_per_s']:,.0f}; {100 * each['share_of_operations']:.0f}; "
                f"{100 * each['share_of_bytes']:.1f}"
                for each in f["batches"].values()
            ),
        )
    peak = found["peak"]
    print(f"\npeak of {found['device']}: {1e-9 * peak['operations_per_s']:.0f} billion operations and "
          f"{1e-9 * peak['bytes_per_s']:.1f} GB a second")  # fmt: skip


def hybrid() -> None:
    """Newton's method from a network's prediction: means are over all loads, failures at the time they took."""
    found = recorded("hybrid_newton")
    if not found:
        return
    head(
        "hybrid_newton",
        "same state",
        "converged; unstable",
        "prediction picked",
        "where solved: iterations; factorisations",
        "ms: median; mean; 95 %",
    )
    for key, f in found.items():
        row(
            key,
            f"{f['same_state']} of {f['compared']}",
            f"{f['converged']} of {f['loads']}; {f['unstable']}",
            f"{100 * f['picked'] / f['loads']:.0f} %",
            f"{f['iterations']:.1f}; {f['factorisations']:.2f}",
            f"{f['median_ms']:.1f}; {f['mean_ms']:.1f}; {f['p95_ms']:.0f}",
        )


def _kept_inside(outside: dict[str, Any]) -> str:
    inside = outside.get("times_3_inside")
    return "-" if not inside or inside["kept"] is None else f"{100 * inside['kept']:.0f} % of {inside['loads']}"


def certificates() -> None:
    """Bounds on errors, by range of size from the smallest to the largest."""
    found = recorded("certificates")
    if not found:
        return
    ranges = "; by size"
    head(
        "certificates",
        f"kept, mean error, %{ranges}",
        f"width / median error{ranges}",
        "rank of bound; of eta",
        "outside %: 1 x; 3 x; of 3 x inside kept",
        "unstable",
        "ms",
    )
    for body, f in found.items():
        ms, tiers = f["ms"], {"certificate": f["held_out"], "newton": f["held_out_newton"]}
        for tier, held in tiers.items():
            unstable, outside = held["unstable"], f["outside"]
            row(
                f"{body}, {tier}: {held['samples']} loads",
                f"{100 * held['kept']['mean']:.1f}; "
                + " / ".join(f"{100 * k:.1f}" for k in held["kept_in_range"]["mean"]),
                " / ".join(f"{width:.2f}" for width in held["widths"]["mean"]),
                f"{held['rank_correlation']['mean']:.3f}; {held['step_correlation']['mean']:.3f}",
                f"{100 * outside['times_1']:.1f}; {100 * outside['times_3']:.1f}; {_kept_inside(outside)}"
                if tier == "certificate"
                else "-",
                "-" if unstable is None else f"{unstable} of {held['samples']}",
                f"{ms[tier]:.2f}",
            )
        row(
            f"{body}: prediction; distance; solve",
            *["-"] * 5,
            f"{ms['prediction']:.2f}; {ms['distance']:.3f}; {ms['solve']:.1f}",
        )


def checked_network() -> None:
    """One network: errors, Jacobian, bounds by size, and what its predictions save."""
    found = recorded("checked_network")
    if not found:
        return
    head("checked_network", "its own errors", "bounds", "same state", "iterations; factorisations", "ms: median; mean")
    for body, f in found.items():
        errors, bounds = f["errors"], f["bounds"]
        row(
            f"{body}: the network",
            f"mean {1e3 * errors['nodal_error']['mean']:.3f} mm; relative "
            f"{100 * errors['relative_error']['median']:.3f} (95 %: {100 * errors['relative_error']['p95']:.2f}) %; "
            f"cosine {errors['gradient_cosine']['mean']:.5f}; Jacobian {100 * errors['jacobian_error']['mean']:.2f} %",
            f"kept by {100 * bounds['kept']['mean']:.1f} %, by size "
            + " / ".join(f"{100 * kept:.1f}" for kept in bounds["kept_in_range"]["mean"]),
            *["-"] * 3,
        )
        for name, ways in f["solved"].items():
            for way, told in ways.items():
                row(
                    f"{body}, {name}: {way}",
                    *["-"] * 2,
                    f"{told['same_state']} of {told['loads']}",
                    f"{told['iterations']:.1f}; {told['factorisations']:.2f}",
                    f"{told['median_ms']:.1f}; {told['mean_ms']:.1f}",
                )


def beam_registration(name: str) -> None:
    """Table 6.1: the thesis's beam registered with a network."""
    found = recorded(name)
    if not found:
        return
    head(
        name,
        "cases; failed",
        "mean nodal mm",
        "largest mm",
        "net force off %, median",
        "stress off %",
        "iterations",
        "ms",
        "matched; in a wrong state %",
        "verdicts",
    )
    for way, whole in found.items():
        for kind, f in {"": whole, **whole["kinds"]}.items():
            row(
                f"{way}{', ' if kind else ''}{kind}",
                f"{f['cases']}; {len(f['failed'])}",
                f"{1e3 * f['mean_m']['mean']:.3f} +- {1e3 * f['mean_m']['deviation']:.3f}",
                f"{1e3 * f['largest_m']['mean']:.2f} ({1e3 * f['largest_m']['most']:.1f})",
                f"{100 * f['force_off']['median']:.1f}",
                "-" if f["stress_off"] is None else f"{100 * f['stress_off']:.1f}",
                f"{f['iterations']['mean']:.0f} +- {f['iterations']['deviation']:.0f}",
                f"{f['ms']['mean']:.0f} +- {f['ms']['deviation']:.0f}",
                f"{100 * f['matched']:.1f}; {100 * f['matched_in_a_wrong_state']:.1f}",
                ", ".join(f"{count} {verdict}" for verdict, count in f["verdicts"].items()) or "-",
            )


def shares(covered: dict[str, float]) -> str:
    """Per cent, in their order."""
    return " / ".join(f"{100 * share:.0f}" for share in covered.values())


def liver_engines() -> None:
    """The real liver by engine, on another mesh, with a wrong organ."""
    found = recorded("liver_engines")
    if not found:
        return
    head(
        "liver_engines",
        "frames: accepted; doubtful; refused",
        "TRE mm: s1; s2; s3 (worst)",
        "predicted",
        "force %",
        "nodes covered by 50 / 90 / 95 % margins",
        "net force",
        "median s (longest); cold",
    )
    for key, f in found.items():
        told = f["summary"]
        counts = "; ".join(str(told["verdicts"].get(name, 0)) for name in ("accepted", "doubtful", "refused"))
        tre = "; ".join(f"{value:.3f}" for value in told["tre_mm"].values())
        row(
            key,
            f"{told['frames']}: {counts}" + (f", {told['failed']} failed" if told["failed"] else ""),
            f"{tre} ({told['worst_tre_mm']:.2f})",
            f"{told['predicted_mm']:.3f}",
            f"{100 * told['force_error']:.1f}",
            shares(told["covered"]),
            shares(told["force_covered"]),
            f"{told['median_seconds']:.3f} ({told['longest_seconds']:.2f}); "
            + " / ".join(f"{seconds:.2f}" for seconds in told["cold"]["seconds"]),
        )


def foreign_patches() -> None:
    """Clouds of which a part is not where the organ is."""
    found = recorded("foreign_patches")
    if not found:
        return
    groups = ("accepted", "told by the model's error")
    head("foreign_patches", "frames; failed", "all: TRE mm (most)", *(f"{g}: TRE mm (most)" for g in groups), "held %")
    for key, f in found.items():
        cells = [
            f"{f[g]['frames']}: {f[g]['tre_mm']:.2f} ({f[g]['tre_most_mm']:.2f})" if g in f else "-" for g in groups
        ]
        held = f"{100 * f['accepted']['held']:.0f}" if "accepted" in f else "-"
        row(
            key,
            f"{f['frames']}; {f['failed']}",
            f"{f['all']['tre_mm']:.2f} ({f['all']['tre_most_mm']:.2f})",
            *cells,
            held,
        )


def other_mesh() -> None:
    """What another mesh of the real liver can do at all."""
    found = recorded("other_mesh")
    if not found:
        return
    head("other_mesh", "moved mm", "under the true forces, mm", "at best, mm")
    for name, f in found["sequences"].items():
        row(name, *(f"{f[kind]:.2f}" for kind in ("moved_mm", "carried_mm", "at_best_mm")))


def pose_noise() -> None:
    """Noise of pose and cloud, level by level."""
    found = recorded("pose_noise")
    if not found:
        return
    errors = ("TRE mm", "mean square, 1e-6 m^2", "force %")
    head("pose_noise", "draws; failed", *errors, "z rms", "accepted %", "median s")
    for key, f in found.items():
        row(
            key,
            f"{f['draws']}; {f['failed']}",
            f"{f['tre_mm']['mean']:.2f} +- {f['tre_mm']['deviation']:.2f}",
            f"{1e6 * f['mean_square_m2']['mean']:.2f} +- {1e6 * f['mean_square_m2']['deviation']:.2f}",
            f"{100 * f['force_error']['mean']:.1f} +- {100 * f['force_error']['deviation']:.1f}",
            f"{f['z_rms']:.2f}",
            f"{100 * f['verdicts'].get('accepted', 0) / f['draws']:.0f}",
            f"{f['median_seconds']:.3f}",
        )


def calibration() -> None:
    """Doubt against truths drawn from the prior."""
    found = recorded("calibration")
    if not found:
        return
    head(
        "calibration",
        "accepted; doubtful; refused",
        "error; predicted mm; r",
        "nodes covered by 50 / 90 / 95 % margins",
        "net force",
        "z: mean; deviation",
        "ranks apart; envelope",
        "median s",
    )
    for key, f in found.items():
        row(
            key,
            "; ".join(str(f["verdicts"].get(name, 0)) for name in ("accepted", "doubtful", "refused")),
            f"{f['error_mm']:.2f}; {f['predicted_mm']:.2f}; {f['correlation']:.2f}",
            shares(f["nodes"]),
            shares(f["force"]),
            f"{', '.join(f'{z:.2f}' for z in f['z_mean'])}; {', '.join(f'{z:.2f}' for z in f['z_deviation'])}",
            f"{', '.join(f'{apart:.3f}' for apart in f['ranks_apart'])}; {f['envelope']:.3f}",
            f"{f['median_seconds']:.2f}",
        )


def penalties() -> None:
    """What forces cost: errors under each penalty."""
    found = recorded("penalties")
    if not found:
        return
    forces = ("nodal forces off, median", "net force off, median")
    head("penalties", "accepted; doubtful; refused", "mean nodal mm (95 %)", *forces, "median s")
    for label, f in found.items():
        row(
            label,
            "; ".join(str(f["verdicts"].get(name, 0)) for name in ("accepted", "doubtful", "refused")),
            f"{f['error_mm']['mean']:.2f} ({f['error_mm']['p95']:.2f})",
            f"{f['forces_off']['median']:.2f}",
            f"{f['net_off']['median']:.2f}",
            f"{f['seconds']['median']:.2f}",
        )


def margins() -> None:
    """How often margins cover the truth, and how well the predicted error tells the true one."""
    found = recorded("margins")
    if not found:
        return
    covered = "nodes covered by 50 / 90 / 95 % margins"
    head("margins", "error; predicted mm", "r; at best", covered, "tumour", "its 95 % margin mm", "median s")
    for key, f in found.items():
        told = f["summary"]
        tumour = told["structures"]["tumour"]
        row(
            key,
            f"{told['error_mm']:.2f}; {told['predicted_mm']:.2f}",
            f"{told['correlation']:.2f}; "
            + (f"{told['correlation_at_best']:.2f}" if "correlation_at_best" in told else "-"),
            " / ".join(f"{100 * share:.0f}" for share in told["nodes_covered"].values()),
            " / ".join(f"{100 * share:.0f}" for share in tumour["covered"].values()),
            f"{tumour['margin95_mm']:.2f}",
            f"{told['median_seconds']:.2f}",
        )


def active_rounds() -> None:
    """Draws that active rounds choose against random ones."""
    found = recorded("active_rounds")
    if not found:
        return
    head("active_rounds", "mean; 95 %; 99 % mm", "relative %, median (95 %)")
    for key, f in found.items():
        nodal, relative = f["nodal_error_m"], f["relative_error"]
        row(
            key,
            "; ".join(f"{1e3 * nodal[name]:.3f}" for name in ("mean", "p95", "p99")),
            f"{100 * relative['median']:.3f} ({100 * relative['p95']:.2f})",
        )


def throughput() -> None:
    """Equilibria a second by ranks."""
    found = recorded("throughput")
    if not found:
        return
    head("throughput", "draws a second", "efficiency", "20,480 at that rate, h", "before the first draw, s", "rejected")
    for key, f in found.items():
        body, _, words = key.rpartition(", ")
        ranks = int(words.split()[0])
        alone = found[f"{body}, 1 rank"]["draws_a_second"]
        row(
            f"{key}, {f['draws']:,} draws",
            f"{f['draws_a_second']:.2f}",
            f"{f['draws_a_second'] / alone / ranks:.2f}",
            f"{f['hours_for_20480']:.2f}",
            f"{f['prepare_s']:.0f}",
            sum(f["rejected"].values()),
        )


_CONTROLS = {
    "stiffness": ("modulus_off", "within_1e-8"),
    "ratio": ("ratio_off", "within_1e-5"),
    "both": ("modulus_off", "within_1e-5"),
}


def inverse() -> None:
    """The thesis's section 7.2: what is off at the end, in the mean and at most."""
    found = recorded("inverse")
    if not found:
        return
    head(
        "inverse", "loads", "as asked", "mean nodal m (largest)", "norm / nodes m", "control off, relative", "s a load"
    )
    if "exactness" in found:
        f = found["exactness"]
        away, share = f["distance"], f["share_within_1e-9"]
        nodal, norm = away["mean"], away["norm_over_nodes"]["mean"]
        spent = f["seconds_a_load"]["layer"]
        row(
            "exactness",
            f["loads"],
            f"{100 * share:.0f} % of nodes' largest",
            f"{nodal['mean']:.1e} ({nodal['largest']:.1e})",
            f"{norm:.1e}",
            "-",
            f"{spent:.2f}",
        )
    for name, (off, kept) in _CONTROLS.items():
        f = found.get(name)
        if f is not None:
            each = f["found"]
            row(
                name,
                f["loads"],
                f[kept],
                f"{each['mean']['mean']:.1e} ({each['mean']['largest']:.1e})",
                f"{each['norm_over_nodes']['mean']:.1e}",
                f"{each[off]['mean']:.1e} ({each[off]['largest']:.1e})",
                f"{f['seconds']:.2f}",
            )
    if "force" in found:
        f = found["force"]
        for start, each in f["starts"].items():
            row(
                f"force from {start}",
                f["loads"] // 2,
                f"all but {len(f['failed'])} of {f['loads']}",
                f"{each['mean']['mean']:.1e} ({each['mean']['largest']:.1e})",
                f"{each['norm_over_nodes']['mean']:.1e}",
                f"{each['force_off']['mean']:.1e} ({each['force_off']['largest']:.1e})",
                f"{f['seconds']:.2f}",
            )


def misspecified(name: str) -> None:
    """Doubt where the organ is not what the twin takes it for."""
    found = recorded(name)
    if not found:
        return
    covered = "nodes covered by 50 / 90 / 95 % margins"
    head(name, "accepted; refused of", "error; predicted mm", covered, "inner", "force", "z rms", "median s")
    for key, f in found.items():
        if "error_mm" in f:
            row(
                key,
                f"{100 * f['accepted']:.0f} %; {f['refused']} of {f['truths']}",
                f"{f['error_mm']:.2f}; {f['predicted_mm']:.2f}",
                *(" / ".join(f"{100 * s:.0f}" for s in f[part].values()) for part in ("nodes", "structures", "force")),
                f"{f['z_rms']:.2f}",
                f"{f['median_seconds']:.2f}",
            )


def segmentations() -> None:
    """Surfaces made of voxels: volume, and distances to the true surface."""
    found = recorded("segmentations")
    if not found:
        return
    head("voxels, mm", "volume", "mean mm", "95 %", "largest", "s")
    for label, f in found["surfaces"].items():
        row(
            label,
            f"{100 * f['volume_off']:+.2f} %",
            *(f"{f[name]:.2f}" for name in ("mean_mm", "p95_mm", "largest_mm")),
            f"{f['seconds']:.1f}",
        )


def live_page() -> None:
    """The page in a browser: updates, pulls, five of them, memory."""
    f = recorded("live_page")
    if not f:
        return
    head("live page", "reached", "asked")
    row("page served; first vertices there, s", f"{f['seconds_to_page']:.1f}; {f['seconds_to_first_update']:.1f}", 15)
    row("vertex updates a second that the browser receives", f"{f['updates_a_second']:.1f}", 30)
    pull = f["pull_to_answer_ms"]
    row(f"pull to answer, {f['pulls']} pulls, ms", f"{pull['median']:.0f} (95 %: {pull['p95']:.0f})", "95 %: 100")
    five = f["five_browsers_updates_a_second"]
    row("five browsers, updates a second each", f"{min(five):.1f} to {max(five):.1f}", "at once")
    memory = f["memory_mib"]
    row(
        f"resident memory over {memory['seconds']:.0f} s: first, middle, last, MiB",
        "; ".join(f"{memory[name]:.0f}" for name in ("first", "middle", "last")),
        "flat",
    )
    row("cores used with no browser", f"{f['cores_used_with_no_browser']:.2f}", "-")


def openigtlink() -> None:
    """Round trips over a socket with a second process."""
    found = recorded("openigtlink")
    if not found:
        return
    head("OpenIGTLink", "points in", "vertices out", "kB in; out", "Hz", "round ms (95 %)")
    for label, f in found.items():
        row(
            label,
            f["points_in"],
            f["surface_vertices"] + f["inner_vertices"],
            f"{f['bytes_in'] / 1e3:.0f}; {f['bytes_out'] / 1e3:.0f}",
            f"{f['rate_hz']:.1f}",
            f"{f['round_ms']['p50']:.1f} ({f['round_ms']['p95']:.1f})",
        )


def print_all() -> None:
    """All tables, with a line on what stands in none."""
    for model in ("surrogate", "reference"):
        robustness(model)
    sequences("registration_reference_default_facets")
    sequences("registration_surrogate")
    networks("networks")
    networks("networks_samples")
    networks("networks_physics")
    networks("networks_bodies")
    prediction()
    hybrid()
    certificates()
    checked_network()
    beam_registration("beam_registration")
    beam_registration("beam_registration_tried")
    liver_engines()
    foreign_patches()
    other_mesh()
    pose_noise()
    calibration()
    penalties()
    margins()
    active_rounds()
    throughput()
    inverse()
    misspecified("misspecified")
    misspecified("misspecified_doubt")
    segmentations()
    live_page()
    openigtlink()


def tables_of(text: str) -> dict[str, list[str]]:
    """The lines of each table of a page, by its first heading."""
    found: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            lines.append(line)
        elif lines:
            found[lines[0].split("|")[1].strip()] = lines
            lines = []
    return found


def replaced(page: str, printed: str) -> str:
    """A page with each of its tables that are printed, too, as it is printed."""
    wanted = tables_of(printed)
    for heading, lines in tables_of(page).items():
        if heading in wanted:
            page = page.replace("\n".join(lines), "\n".join(wanted[heading]))
    return page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, help="a page whose tables are brought up to date")
    page = parser.parse_args().into
    with redirect_stdout(io.StringIO()) as printed:
        print_all()
    if page is None:
        print(printed.getvalue(), end="")
    else:
        page.write_text(replaced(page.read_text(), printed.getvalue()))


if __name__ == "__main__":
    main()
