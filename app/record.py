"""The record of a registered sequence: figures of every frame in one JSON file that is whole whenever it is there."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.metrics import target_errors
from softtwin.registration.parameters.block import WITHIN_90
from softtwin.registration.pose import Pose
from softtwin.registration.result import Registration
from softtwin.registration.verdict import Verdict

from .config import axes_unknown
from .export import SERIES, Exporter
from .twin import Frame, Twin

Floats = NDArray[np.float64]
NOTICE = "Research software: not a medical device."
RECORD = "registration.json"
_ASKEW = 0.01  # chance of a pose as far from the one said, if that were right: with less, it is seen to be off
_TOLD = 0.5  # of the variance beforehand: less is called not told
_EVERY, _SHARE = 1.0, 0.05  # at least so many seconds between two writings, and at most this share of the time on them


class Recorder:
    """Writes the frames of a sequence as they come; a record of an earlier sequence and its files are removed first.

    Use it in a `with` statement: at its end, Ctrl-C included, the record holds every frame that was added.

    Args:
        exporter: twin, folder and formats of the files of each frame.
        zone: that may carry force, for the record.
        truth: true node positions of each frame, (frames, n, 3), metres, to state errors.
    """

    def __init__(self, exporter: Exporter, zone: str | None = None, truth: Floats | None = None) -> None:
        self.exporter, self.truth = exporter, truth
        self.rows: list[dict[str, Any]] = []
        self.header = _header(exporter.twin, zone)
        self._due = -math.inf
        exporter.folder.mkdir(parents=True, exist_ok=True)
        remove_record(exporter.folder)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *error: object) -> None:
        self.write()
        if error[0] not in (None, KeyboardInterrupt):  # what went wrong is to be said, not what would go wrong next
            return
        bundles = self.exporter.write_bundles((row["frame"], row["files"]) for row in self._usable())
        if bundles:
            self.header["bundles"] = bundles
            self.write()

    def add(self, frame: Frame, cloud: str = "", **more: Any) -> dict[str, Any]:
        """Write a frame's files and enter its figures, which are returned.

        Args:
            frame: the frame.
            cloud: name of the cloud's file.
            **more: further figures of it.
        """
        row = self.figures(frame, cloud, **more)
        self.enter(row, frame)
        return row

    def figures(self, frame: Frame, cloud: str = "", **more: Any) -> dict[str, Any]:
        """What is known of a frame, without a file of it; arguments as for `add`."""
        row: dict[str, Any] = {"frame": frame.number, "cloud": cloud, "verdict": frame.judgement.verdict.value}
        if frame.missing:
            row["points_missing"] = frame.missing
        row |= {"reasons": list(frame.judgement.reasons), "seconds": frame.seconds, "files": [], **more}
        if frame.judgement.checks:
            row["checks"] = [check.figures() for check in frame.judgement.checks]
        if frame.landmarks:
            row["landmarks"] = frame.landmarks
        if frame.registration is not None:
            truth = None if self.truth is None else self.truth[frame.number]
            row |= frame_figures(self.exporter.twin, frame.registration, truth)
        return row

    def enter(self, row: dict[str, Any], frame: Frame) -> None:
        """Write a frame's files and enter its figures.

        Args:
            row: what `figures` gave; the names of the files are set in it.
            frame: the frame.
        """
        if frame.registration is not None:
            row["files"] = self.exporter.write(frame.number, frame.registration, frame.cloud)
        self.rows.append(row)
        if time.monotonic() > self._due:
            self.write()

    def write(self) -> None:
        """Write the record, and the time series of the frames not refused, each whole or not at all."""
        begin = time.monotonic()
        series = self.exporter.write_series((row["frame"], row["files"]) for row in self._usable())
        content = {**self.header, "counts": counts(self.rows), "series": series, "frames": self.rows}
        path = self.exporter.folder / RECORD
        partial = path.with_name(f".{RECORD}.partial")
        partial.write_text(json.dumps(finite(content), indent=1, allow_nan=False) + "\n")
        os.replace(partial, path)
        now = time.monotonic()
        self._due = now + max(_EVERY, (now - begin) / _SHARE)

    def _usable(self) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["verdict"] != Verdict.REFUSED.value]


def _header(twin: Twin, zone: str | None) -> dict[str, Any]:
    place, own, section = twin.written_in, twin.coordinates, twin.config.registration
    options = section.model_dump() | ({} if zone is None else {"zone": zone})
    return {
        "notice": NOTICE,
        "format": 4,
        "body": twin.body.fingerprint,
        "files_in": {"unit": place.unit, "axes": place.axes},
        "figures_in": {"unit": "m", "axes": place.axes},
        "pose_in": {"unit": "m", "axes": own.axes},
        "source_in": {"unit": own.unit, "axes": own.axes},
        "notes": notes_on(twin),
        "options": options,
        **({"model_error": dict(twin.model_error)} if twin.model_error else {}),
    }


def notes_on(twin: Twin) -> list[str]:
    """What a person should know of the coordinates of what is written, in sentences.

    Args:
        twin: the twin.
    """
    notes = []
    if axes_unknown(twin.config.body):
        notes.append("The organ's files say no axes: they were taken as LPS.")
    if twin.written_in.unit != "mm":
        notes.append(f"Files are in {twin.written_in.unit}, which 3D Slicer would read as mm; nrrd, mrk.json, mrb: mm.")
    return notes


def frame_figures(twin: Twin, result: Registration, truth: Floats | None) -> dict[str, Any]:
    """What is known of a registered frame: SI units, on the axes of what is written; the pose on those of the clouds.

    Args:
        twin: the twin.
        result: what was found.
        truth: true node positions, (n, 3), metres, on the inner axes; None where they are not known.
    """
    place = twin.written_in
    turned = place.directions(np.eye(3))
    net, deviation = place.directions(result.net_force), result.net_force_deviation
    row: dict[str, Any] = {
        "outcome": result.outcome.name.lower(),
        "rms_distance_m": result.rms_distance,
        "noise_m": result.noise,
        "net_force_N": net.tolist(),
        "net_force_deviation_N": deviation.tolist(),
        "net_force_90_N": np.stack([net - WITHIN_90 * deviation, net + WITHIN_90 * deviation], axis=1).tolist(),
        "net_force_covariance_N2": (turned @ result.net_force_covariance @ turned).tolist(),
        "force_scale_N": result.force_scale,
        "largest_displacement_m": float(np.linalg.norm(result.displacement, axis=1).max()),
        "discrepancy_scale": result.discrepancy_scale,
        "largest_correction_m": float(np.linalg.norm(result.correction, axis=1).max()),
        "pose": twin.coordinates.motion(result.pose.matrix).tolist(),
        "points": result.points,
        "points_left_out": result.left_out,
        "outliers": result.outliers,
        "informed": result.informed,
        "iterations": len(result.trace),
        "evaluations": result.evaluations,
        "solve_seconds": result.seconds,
    }
    correction = pose_correction_of(result)
    if correction is not None:
        row["pose_correction"] = correction
    if result.shared_noise is not None:
        row["shared_noise"] = dict(zip(("size_m", "length_m"), result.shared_noise, strict=True))
    if result.estimates:
        row["estimates"] = [asdict(estimate) for estimate in result.estimates]
    if deviation.any():  # there are unknown forces
        ratio, deviation = _over_modulus(twin, result)
        row["net_force_over_modulus_m2"] = place.directions(ratio).tolist()
        row["net_force_over_modulus_deviation_m2"] = deviation.tolist()
    if result.draft is not None:  # where the two models of the hybrid engine disagree, and by how much
        apart = np.linalg.norm(result.displacement - result.draft.displacement, axis=1)
        row["draft"] = {
            "verdict": result.draft.judgement.verdict.value,
            "mean_distance_m": float(apart.mean()),
            "largest_distance_m": float(apart.max()),
            "node_of_largest": int(apart.argmax()),
            "net_force_N": place.directions(result.draft.net_force).tolist(),
            "solve_seconds": result.draft.seconds,
        }
    bound = twin.bounded(result)
    if bound is not None:
        row["network"] = {
            "mean_error_bound_m": bound.mean,
            "largest_error_bound_m": bound.largest,
            "confidence": bound.confidence,
            "is_inside": bound.is_inside,
            "reasons": list(bound.reasons),
        }
    moved = {name: points.displace(result.displacement) for name, points in twin.embeddings.items()}
    known = result.uncertainty
    row["margins_in"] = result.frame
    row["deviation_m"] = {"mean": float(known.deviation.mean()), "largest": float(known.deviation.max())}
    row["targets"] = {name: {"movement_m": _mean_length(vectors)} for name, vectors in moved.items()}
    for name, target in row["targets"].items():
        target["margin95_m"] = twin.margin_inside(name, known.margin(twin.embeddings[name]))
        if result.has_free_pose:
            margins = result.camera_uncertainty.margin(twin.embeddings[name])
            target["camera_margin95_m"] = twin.margin_inside(name, margins)
        if twin.outside[name].any():
            target["outside_share"] = float(twin.outside[name].mean())
    if truth is not None:
        rest = twin.body.points
        row["error"] = asdict(target_errors(rest + result.displacement, truth))
        for name, points in twin.embeddings.items():
            row["targets"][name]["error_m"] = _mean_length(moved[name] - points.displace(truth - rest))
    return row


def pose_correction_of(result: Registration) -> dict[str, Any] | None:
    """What a pose that was said to be known is off by, SI units; None for one that is exact, or unknown altogether."""
    pose = result.problem.pose
    if pose is None or not pose.is_said:
        return None
    return {
        "rotation_rad": result.pose_correction.angle_to(Pose.identity()),
        "translation_m": float(np.linalg.norm(result.pose_correction.apply(pose.centre) - pose.centre)),
        "chance": result.chance_of_pose,
        "is_seen": result.chance_of_pose < _ASKEW,
    }


def _over_modulus(twin: Twin, result: Registration) -> tuple[Floats, Floats]:
    """Net force over Young's modulus, (3,), square metres, and its deviation: by the configuration's where it is known.

    How well that modulus is known adds to the uncertainty of the newtons, and is no part of this.
    """
    if result.force_over_modulus is not None:
        return result.force_over_modulus
    material, net = twin.config.material, result.net_force
    variances = np.diag(result.net_force_covariance) - (material.young_modulus_deviation * net) ** 2
    return net / material.young_modulus, np.sqrt(np.maximum(variances, 0.0)) / material.young_modulus


def _mean_length(vectors: Floats) -> float:
    return float(np.linalg.norm(vectors, axis=1).mean())


def counts(rows: list[dict[str, Any]]) -> dict[str, int]:
    """How many frames bear each verdict."""
    return {verdict.value: sum(row["verdict"] == verdict.value for row in rows) for verdict in Verdict}


def finite(value: Any) -> Any:
    """The value with `null` in place of numbers that JSON has no word for."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe(row: Mapping[str, Any]) -> str:
    """One line for a person: the verdict with its first reason, distance, net force, errors if known."""
    line = f"frame {row['frame']:3d}: {row['verdict']}"
    if row["reasons"]:
        line += f" ({row['reasons'][0]})"
    if "net_force_N" not in row:
        return line
    force, deviation = np.linalg.norm(row["net_force_N"]), np.linalg.norm(row["net_force_deviation_N"])
    line += f", cloud to surface {millimetres(row['rms_distance_m'])}"
    line += f" without {row['points_left_out']} of {row['points']} points" if row.get("points_left_out") else ""
    line += f", {row['points_missing']} rows without a measurement passed over" if "points_missing" in row else ""
    if "shared_noise" in row:
        size, length = (row["shared_noise"][name] for name in ("size_m", "length_m"))
        line += f", of which neighbours within {millimetres(length, 0)} share noise of {millimetres(size)}"
    if row.get("pose_correction", {}).get("is_seen"):
        shift, turn = (
            millimetres(row["pose_correction"]["translation_m"]),
            np.rad2deg(row["pose_correction"]["rotation_rad"]),
        )
        line += f", pose {shift} and {turn:.1f} degrees from where it was said"
    line += f", {row['landmarks']} landmarks" if "landmarks" in row else ""
    line += (
        f", net force {force:.3f} ± {deviation:.3f} N" if force > 0.0 or deviation > 0.0 else ""
    )  # none where all forces are known
    line += f", {row['informed']:.0f} directions seen" if math.isfinite(row.get("informed", math.nan)) else ""
    line += "".join(f", {describe_estimate(estimate)}" for estimate in row.get("estimates", ()))
    line += f", {1e3 * row['seconds']:.0f} ms"
    if "age_s" in row:
        line += f", {1e3 * row['age_s']:.0f} ms old{' (late)' if row['is_late'] else ''}"
        line += f", {row['dropped']} dropped" if row["dropped"] else ""
    if "error" in row:
        line += f", error {millimetres(row['error']['mean'])}"
    for name, target in row["targets"].items():
        line += f", {name} moved {millimetres(target['movement_m'], 1)} ± {millimetres(target['margin95_m'], 1)}"
        seen = target.get("camera_margin95_m")
        line += "" if seen is None else f" (± {millimetres(seen, 1)} in the camera's coordinates)"
        share = target.get("outside_share")
        line += "" if share is None else f" where it is inside the organ ({100 * share:.0f} % is not, and not known)"
        line += f" ({millimetres(target['error_m'])} off)" if "error_m" in target else ""
    return line


def describe_estimate(estimate: Mapping[str, Any]) -> str:
    """An unknown beside the forces for a person, with the interval that holds it with 90 %, and what the cloud told."""
    low, high = estimate["interval"]
    value, unit = estimate["value"], estimate["unit"]
    if unit == "m":
        value, low, high, unit = 1e3 * value, 1e3 * low, 1e3 * high, "mm"
    text = f"{estimate['name']} {_plain(value)}{' ' + unit if unit else ''} ({_plain(low)} to {_plain(high)})"
    return text if estimate["variance_reduction"] > _TOLD else f"{text}, not told by the cloud"


def _plain(value: float) -> str:
    """Four digits, and no power of ten where a person would write none."""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e8 else f"{value:.4g}"


def millimetres(metres: float, digits: int = 2) -> str:
    """A length for a person; `unknown` where there is none."""
    return f"{1e3 * metres:.{digits}f} mm" if math.isfinite(metres) else "unknown"


def remove_record(folder: Path) -> None:
    """Remove the record of an earlier sequence and the files that it lists, and nothing else."""
    path = folder / RECORD
    if not path.is_file():
        return
    try:
        record = json.loads(path.read_text())
        files = [name for row in record["frames"] for name in row.get("files", [])] + record.get("bundles", [])
    except (ValueError, KeyError, TypeError, AttributeError):
        files = []  # damaged, or written by something else: whatever lies there stays
    for name in (*files, SERIES, RECORD):
        if isinstance(name, str) and Path(name).name == name:
            (folder / name).unlink(missing_ok=True)
