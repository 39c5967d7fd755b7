"""Section of the report about registrations of the user's own: verdicts, figures and pictures of their frames."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from matplotlib.figure import Figure
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import carried, outer
from softtwin.meshes.export import Coordinates

from .pictures import CLOUD, ORGAN, Layer, Picture, Studio, camera_side, chart, inner_colours, view_of
from .record import RECORD, describe_estimate

Floats = NDArray[np.float64]
Section = dict[str, Any]
_LISTED = 40  # rows of the table: the first, the last, and those that were not accepted
_CHECKED = 5  # frames whose checks are shown: the first, and those that were not accepted
_WORST = ("accepted", "doubtful", "refused")
COLOURS = {"accepted": "#2f9e44", "doubtful": "#e8a33d", "refused": "#d9480f"}


def find_registrations(folder: Path, further: Iterable[Path] = ()) -> list[Path]:
    """Folders of registrations below a workspace's, and those that are named; each once.

    Args:
        folder: of the workspace.
        further: folders that hold a record, wherever they are.

    Raises:
        ValueError: a named folder holds no record.
    """
    named = list(further)
    for path in named:
        if not (path / RECORD).is_file():
            raise ValueError(f"--registrations: expected a folder with {RECORD}, found none in {path}.")
    own = [record.parent for depth in ("*", "*/*") for record in sorted(folder.glob(f"{depth}/{RECORD}"))]
    own = [path for path in own if folder / "demo" not in (path, path.parent)]
    return list({path.resolve(): path for path in (*own, *named)}.values())


def sequence_section(folder: Path, body: Body, studio: Studio) -> Section:
    """Frames with their verdicts, how many bear each, and pictures of the first, the worst and the last.

    Args:
        folder: that `softtwin register` wrote.
        body: the body that was registered.
        studio: draws.

    Raises:
        ValueError: the record is damaged, or of another body.
    """
    record = _read_record(folder, body)
    rows = [{"targets": {}, **row} for row in record["frames"]]
    options, place = record["options"], Coordinates(**record["files_in"])
    shown = _listed(rows)
    return {
        "coordinates": _coordinates(record),
        "notes": record.get("notes", []),
        "model": options["model"],
        "zone": options["zone"],
        "known": options.get("forces") == "known",
        "frames": len(rows),
        "counts": record["counts"],
        "colours": COLOURS,
        "rows": shown,
        "unlisted": len(rows) - len(shown),
        "checked": [
            row
            for row in (shown[:1] + [row for row in shown[1:] if row["verdict"] != "accepted"])[:_CHECKED]
            if row.get("checks")
        ],
        "targets": list(body.inner),
        "model_error": _model_error(record.get("model_error", record.get("doubt", {}))),
        "drafted": any("draft" in row for row in rows),
        "has_free_pose": any("camera_margin95_m" in target for row in rows for target in row["targets"].values()),
        "estimates": lambda row: [describe_estimate(estimate) for estimate in row.get("estimates", ())],
        "together": [describe_estimate(estimate) for estimate in record.get("together", ())],
        "bounded": next((row["network"]["confidence"] for row in rows if "network" in row), None),
        "pictures": _pictures(folder, body, place, rows, studio),
        "legend": [(ORGAN, "organ"), *((inner_colours(body.inner)[name], name) for name in body.inner)],
        "cloud": (CLOUD, "cloud"),
        "chart": chart(lambda sheet: _draw(sheet, rows), "net force, noise and verdict of each frame")
        if len(rows) > 1
        else None,
    }


def _coordinates(record: Mapping[str, Any]) -> str:
    """Unit and axes of everything that a record holds, in words."""
    files = record["files_in"]
    figures, pose = record.get("figures_in", files), record.get("pose_in", files)  # older records have but one
    return (
        f"Files: {files['unit']}, {files['axes'].upper()}. Forces: newtons, {figures['axes'].upper()}. Lengths: "
        f"metres in registration.json, millimetres here. Pose: metres, {pose['axes'].upper()}, as the clouds."
    )


def _model_error(asked: Mapping[str, Any]) -> str:
    """What the model-error ensemble behind the margins perturbs, in words; none where there is no ensemble."""
    words = []
    if asked.get("attachment"):
        words.append(f"an attachment that lies elsewhere by some {1e3 * asked['attachment']:.1f} mm along each axis")
    if asked.get("poisson_ratio"):
        minimum, maximum = asked["poisson_ratio"]
        words.append(f"a Poisson's ratio of {minimum:g} to {maximum:g}")
    if asked.get("meshes"):
        words.append(f"{asked['meshes']} other meshes of its surface")
    return " and ".join(words)


def _read_record(folder: Path, body: Body) -> dict[str, Any]:
    try:
        record = json.loads((folder / RECORD).read_text())
        known = record["body"], record["frames"], record["options"], record["files_in"], record["counts"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder.name}: expected a record of softtwin register ({error}); register again.") from None
    if known[0] != body.fingerprint:
        raise ValueError(f"{folder.name}: this registration is of another body.")
    if not record["frames"]:
        raise ValueError(f"{folder.name}: no frame has been registered yet.")
    return dict(record)


def _listed(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    if len(rows) <= _LISTED:
        return list(rows)
    worse = [row for row in rows if row["verdict"] != "accepted"]
    chosen = {row["frame"]: row for row in (rows[0], *worse[: _LISTED - 2], rows[-1])}
    for row in rows:
        if len(chosen) >= _LISTED:
            break
        chosen.setdefault(row["frame"], row)
    return [chosen[frame] for frame in sorted(chosen)]


def _pictures(
    folder: Path, body: Body, place: Coordinates, rows: Sequence[Mapping[str, Any]], studio: Studio
) -> list[tuple[Picture, Mapping[str, Any]]]:
    """The first, the worst and the last frame that were written as VTU, in their order."""
    drawn = [row for row in rows if _file(row, "frame", "vtu") and (folder / _file(row, "frame", "vtu")).is_file()]
    if not drawn:
        return []
    worst = max(drawn, key=lambda row: (_WORST.index(row["verdict"]), row["noise_m"] or np.inf))
    names = {worst["frame"]: "worst", drawn[-1]["frame"]: "last", drawn[0]["frame"]: "first"}
    if len(drawn) == 1:
        names = {drawn[0]["frame"]: "only"}
    chosen = [row for row in drawn if row["frame"] in names]
    states = [_displacement(folder / _file(row, "frame", "vtu"), body, place) for row in chosen]
    clouds = [_cloud(folder, row, place) for row in chosen]
    seen = [body.points, *(body.points + state for state in states)]
    view = view_of(camera_side(body), seen)
    return [
        (
            studio.picture(view, _layers(body, state, cloud), f"{names[row['frame']]} frame ({row['frame']})", 520),
            row,
        )
        for row, state, cloud in zip(chosen, states, clouds, strict=True)
    ]


def _file(row: Mapping[str, Any], name: str, suffix: str) -> str:
    wanted = f"{name}_{row['frame']:04d}.{suffix}"
    return wanted if wanted in row["files"] else ""


def _displacement(path: Path, body: Body, place: Coordinates) -> Floats:
    found = np.asarray(pyvista.read(path).point_data["displacement"], dtype=np.float64)
    if found.shape != body.points.shape:
        raise ValueError(f"{path.name}: expected {len(body.points)} nodes, got {len(found)}; register again.")
    return place.metres(found)


def _cloud(folder: Path, row: Mapping[str, Any], place: Coordinates) -> Floats | None:
    name = _file(row, "cloud", "vtp")
    if not name or not (folder / name).is_file():
        return None
    return place.metres(pyvista.read(folder / name).points)


def _layers(body: Body, state: Floats, cloud: Floats | None) -> list[Layer]:
    colours = inner_colours(body.inner)
    rest, moved = outer(body).rest, outer(body).moved(state)
    layers = [
        Layer(moved.points, moved.triangles, ORGAN, 0.35),
        Layer(rest.points, rest.triangles, "#8a929c", style="outline"),
    ]
    layers += [
        Layer(surface.points, surface.triangles, colours[name]) for name, surface in carried(body, state).items()
    ]
    return layers if cloud is None else [*layers, Layer(cloud, colour=CLOUD, ball=0.007)]


def _draw(sheet: Figure, rows: Sequence[Mapping[str, Any]]) -> None:
    left, right = sheet.subplots(1, 2)
    found = [row for row in rows if "net_force_N" in row]
    frames = [row["frame"] for row in found]
    force = [float(np.linalg.norm(row["net_force_N"])) for row in found]
    deviations = [float(np.linalg.norm(row["net_force_deviation_N"])) for row in found]
    left.errorbar(frames, force, deviations, fmt="none", ecolor="#8a929c", elinewidth=1)
    for axes, values in ((left, force), (right, [1e3 * (row["noise_m"] or np.nan) for row in found])):
        axes.scatter(frames, values, s=20, c=[COLOURS[row["verdict"]] for row in found], zorder=3)
        for row in rows:
            if "net_force_N" not in row:
                axes.axvline(row["frame"], color=COLOURS["refused"], linewidth=1, linestyle=":")
        axes.set_ylim(bottom=0.0)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.grid(alpha=0.25)
    left.set(xlabel="frame", ylabel="net force (N)")
    right.set(xlabel="frame", ylabel="noise found (mm)")
