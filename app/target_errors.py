"""Is a twin right for an organ that was measured? Landmarks that registration never saw against where it puts them."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm import tqdm

from softtwin.meshes.attachment import RegionError, parse_file
from softtwin.meshes.clouds import CloudError
from softtwin.meshes.embedding import embed, is_carried_along
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import FileError
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.pose import Pose
from softtwin.registration.result import Registration
from softtwin.registration.uncertainty import margins_of
from softtwin.registration.verdict import Verdict

from .config import ConfigError
from .landmarks import LandmarkFiles
from .pictures import chart
from .record import NOTICE, millimetres
from .register import CloudFile, Scene, Start, find_clouds, say_coordinates
from .sequences import COLOURS
from .twin import Camera, Twin

Floats = NDArray[np.float64]
RECORD, TABLE = "evaluation.json", "landmarks.csv"
CONFIDENCES = (0.5, 0.9, 0.95)
CURVE = tuple(np.linspace(0.05, 0.95, 19).round(2).tolist())


@dataclass(frozen=True, eq=False)
class CaseErrors:
    """One cloud and the landmarks that were set in it.

    Args:
        cloud: name of the file.
        verdict: of its registration.
        reasons: why it is not accepted.
        names: of the landmarks.
        moved: how far each lies from where the pose alone puts it, (l,), metres.
        errors: how far it lies from where the registration puts it, (l,), metres; NaN without a result.
        covariances: of where it is put, with that of setting landmarks, (l, 3, 3), square metres; NaN as above.
        is_outside: not inside the organ at rest: nothing is known of it, (l,).
    """

    cloud: str
    verdict: str
    reasons: tuple[str, ...]
    names: tuple[str, ...]
    moved: Floats
    errors: Floats
    covariances: Floats
    is_outside: NDArray[np.bool_]

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Which landmarks count: inside the organ, of a registration that gave a result, (l,)."""
        return ~self.is_outside & np.isfinite(self.errors)

    def margins(self, confidence: float) -> Floats:
        """Radius of each landmark's region, (l,), metres; infinite where nothing is known of it."""
        found = np.full(len(self.errors), np.inf)
        known = np.isfinite(self.covariances).all(axis=(1, 2))
        found[known] = margins_of(self.covariances[known], confidence)
        return found


def evaluate_files(
    place: Path,
    clouds: Sequence[str],
    landmarks: tuple[str, str],
    output: Path,
    options: Mapping[str, Any],
    *,
    unit: Any = None,
    axes: Any = None,
    start: Start | None = None,
    deviation: float = 0.0,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Register clouds, each from rest, and compare landmarks inside the organ with where they were found.

    Args:
        place: the twin; see `find_twin`.
        clouds: files, folders or patterns.
        landmarks: file of the landmarks in the organ at rest, and of where they are in each cloud's frame (a folder
            with files named like the clouds, or a file for one cloud), each with unit and axes behind it where they
            are not those of the organ's files, or of the clouds; registration sees neither.
        output: folder to write to.
        options: entries of [registration] that replace the twin's.
        unit: of the clouds and their landmarks; that of the twin's files if not given.
        axes: of these; those of the twin's files if not given.
        start: where the camera stands; in the body's coordinates if not given.
        deviation: standard deviation of each coordinate of a landmark that was set, metres: regions are the larger.
        say: prints a line.

    Returns:
        What is written to evaluation.json.

    Raises:
        ConfigError, FileError, PoseError, TwinError: what cannot be used, and why.
    """
    scene = Scene.of(place, options, unit, axes)
    files = find_clouds(clouds, scene.outside, scene.normals)
    rest, moved = (_named(text, usual) for text, usual in zip(landmarks, (scene.inside, scene.outside), strict=True))
    known = LandmarkFiles.read(rest[0], moved[0], rest[1], moved[1], [file.path for file in files], "--landmarks")
    pairs = [(file, known.named(file.path)) for file in files]
    without = [file.path.name for file, found in pairs if found is None]
    if without:
        say(f"without landmarks, left out: {', '.join(without)}")
    for file, found in pairs:
        alone = [] if found is None else [name for name in known.body if name not in found[0]]
        if alone:
            more = f" and {len(alone) - 5} more" if len(alone) > 5 else ""
            say(f"landmarks that {file.path.name} does not show, left out: {', '.join(alone[:5])}{more}")
    head = {
        "notice": NOTICE,
        "twin": place.resolve().name,
        "model": options.get("model", scene.home.config.registration.model),
        "localisation_error_m": deviation,
        "without_landmarks": without,
    }
    cases: list[CaseErrors] = []
    evaluation = head
    with scene.opened(start or Start(), say) as (twin, camera):
        say_coordinates(twin, say)
        for file, found in tqdm(pairs, desc="registering", unit="cloud", disable=None):
            if found is not None:
                cases.append(case_errors(twin, file, camera, found, deviation))
                say(describe_case(cases[-1]))
                evaluation = {**head, **summary(cases)}
                _write(output, evaluation, cases)  # cloud by cloud: who stops keeps what was found
    say(describe(evaluation))
    return evaluation


def _write(output: Path, evaluation: Mapping[str, Any], cases: Sequence[CaseErrors]) -> None:
    output.mkdir(parents=True, exist_ok=True)
    (output / RECORD).write_text(json.dumps(evaluation, indent=1, allow_nan=False) + "\n")
    _write_table(output / TABLE, cases)


def _named(text: str, usual: Coordinates) -> tuple[Path, Coordinates]:
    """The file or folder that a text names, and the coordinates in it."""
    try:
        file = parse_file(text)
    except RegionError as error:
        raise ConfigError(f"--landmarks: {error}") from None
    if not file.path.exists():
        raise ConfigError(f"--landmarks: expected a file or a folder, found nothing in {file.path}.")
    return file.path, Coordinates(file.unit or usual.unit, file.axes or usual.axes)


def case_errors(
    twin: Twin,
    file: CloudFile,
    camera: Camera,
    landmarks: tuple[Sequence[str], Floats, Floats],
    deviation: float = 0.0,
) -> CaseErrors:
    """Register one cloud from rest and compare landmarks with where that puts them.

    Args:
        twin: the twin.
        file: the cloud.
        camera: where the camera stands.
        landmarks: their names, where they are in the organ at rest and in the cloud's frame, (l, 3) each, metres.
        deviation: as for `evaluate_files`.

    Raises:
        ConfigError: no landmark lies inside the organ.
    """
    names, rest, moved = landmarks
    carried = embed(twin.body, rest)
    is_outside = is_carried_along(twin.body, carried)
    if is_outside.all():
        raise ConfigError(
            f"--landmarks: expected places inside the organ at rest, got {len(rest)} outside of it, the nearest "
            f"{millimetres(float(carried.outside.min()), 1)} away; are unit, axes and frame those of the organ's files?"
        )
    unknown = np.full(len(rest), np.nan)
    try:
        result = twin.register(file.read(), camera=camera)
    except (CloudError, FileError, NotConverged) as error:
        pose = camera if isinstance(camera, Pose) else Pose.identity()
        before = np.linalg.norm(pose.apply(rest) - moved, axis=1)
        nothing = np.full((len(rest), 3, 3), np.nan)
        reason = str(error).removeprefix(f"{file.path}: ")
        return CaseErrors(
            file.path.name, Verdict.REFUSED.value, (reason,), tuple(names), before, unknown, nothing, is_outside
        )
    found = result.pose.apply(rest + carried.displace(result.displacement))
    return CaseErrors(
        file.path.name,
        result.judgement.verdict.value,
        tuple(result.judgement.reasons),
        tuple(names),
        np.linalg.norm(result.pose.apply(rest) - moved, axis=1),
        np.linalg.norm(found - moved, axis=1),
        _covariances(result, carried, deviation),
        is_outside,
    )


def _covariances(result: Registration, carried: Any, deviation: float) -> Floats:
    return np.asarray(result.camera_uncertainty.covariances(carried) + deviation**2 * np.eye(3))


def summary(cases: Sequence[CaseErrors]) -> dict[str, Any]:
    """Errors of each case and of all together, those that were accepted apart."""
    accepted = [case for case in cases if case.verdict == Verdict.ACCEPTED.value]
    return {
        "verdicts": dict(Counter(case.verdict for case in cases)),
        "confidences": list(CONFIDENCES),
        "all": _together(cases),
        "accepted": _together(accepted),
        "cases": [
            {
                "cloud": case.cloud,
                "verdict": case.verdict,
                "reasons": list(case.reasons),
                **{
                    "landmarks_counted" if name == "landmarks" else name: value
                    for name, value in _together([case]).items()
                },
                "landmarks": _landmarks(case),
            }
            for case in cases
        ],
    }


def _together(cases: Sequence[CaseErrors]) -> dict[str, Any]:
    """Figures of the landmarks that count of some cases."""
    every = [(case.cloud, case.names[place], case, place) for case in cases for place in np.flatnonzero(case.is_known)]
    outside = int(sum(case.is_outside.sum() for case in cases))
    lost = int(sum((~case.is_outside & ~np.isfinite(case.errors)).sum() for case in cases))
    counted = {"landmarks": len(every), "outside": outside, "without_result": lost}
    if not every:
        return counted
    errors, moved = (np.concatenate([getattr(case, of)[case.is_known] for case in cases]) for of in ("errors", "moved"))
    regions = {
        level: np.concatenate([case.margins(level)[case.is_known] for case in cases])
        for level in (*CONFIDENCES, *CURVE)
    }
    covariances = np.concatenate([case.covariances[case.is_known] for case in cases])
    worst = int(errors.argmax())
    expected = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    return {
        **counted,
        "error_m": _spread(errors),
        "without_deformation_m": _spread(moved),
        "expected_error_m": float(np.sqrt(np.mean(expected**2))) if np.isfinite(expected).all() else None,
        "worst": {"cloud": every[worst][0], "name": every[worst][1], "error_m": float(errors[worst])},
        "within": {str(level): float(np.mean(errors <= regions[level])) for level in CONFIDENCES},
        "curve": [[level, float(np.mean(errors <= regions[level]))] for level in CURVE],
        "slope_of_error_by_movement": _slope(moved, errors),
    }


def _spread(values: Floats) -> dict[str, float]:
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "rms": float(np.sqrt(np.mean(values**2))),
        "p95": float(np.quantile(values, 0.95)),
        "max": float(values.max()),
    }


def _slope(moved: Floats, errors: Floats) -> float | None:
    """Of the line through the origin: 1 where nothing is explained of how far landmarks have moved."""
    square = float(moved @ moved)
    return float(moved @ errors) / square if square > 0.0 else None


def _landmarks(case: CaseErrors) -> list[dict[str, Any]]:
    regions = {level: case.margins(level) for level in CONFIDENCES}
    found = []
    for place, name in enumerate(case.names):
        row: dict[str, Any] = {"name": name, "without_deformation_m": float(case.moved[place])}
        if case.is_outside[place]:
            row["is_outside"] = True
        if np.isfinite(case.errors[place]):
            row["error_m"] = float(case.errors[place])
            if np.isfinite(regions[CONFIDENCES[0]][place]):
                row["margins_m"] = {str(level): float(margins[place]) for level, margins in regions.items()}
        found.append(row)
    return found


def _write_table(path: Path, cases: Sequence[CaseErrors]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        levels = [f"margin{100 * level:.0f}_m" for level in CONFIDENCES]
        writer.writerow(["cloud", "verdict", "landmark", "is_outside", "without_deformation_m", "error_m", *levels])
        for case in cases:
            margins = np.stack([case.margins(level) for level in CONFIDENCES], axis=1)
            for place, name in enumerate(case.names):
                known = np.isfinite(case.errors[place])
                row = [case.errors[place], *margins[place]] if known else [""] * (1 + len(levels))
                writer.writerow([case.cloud, case.verdict, name, case.is_outside[place], case.moved[place], *row])


def describe_case(case: CaseErrors) -> str:
    """A line for a person."""
    known = case.is_known
    line = f"{case.cloud}: {case.verdict}"
    if known.any():
        line += (
            f", {known.sum()} landmarks {millimetres(float(case.errors[known].mean()), 2)} off on average "
            f"({millimetres(float(case.moved[known].mean()), 2)} without deformation)"
        )
    return line + (f"; {case.reasons[0]}" if case.reasons else "")


def describe(evaluation: Mapping[str, Any]) -> str:
    """All cases in a few lines."""
    counts = ", ".join(f"{count} {verdict}" for verdict, count in evaluation["verdicts"].items())
    total = sum(evaluation["verdicts"].values())
    lines = [f"{total} cloud{'s' if total > 1 else ''}: {counts}"]
    for words, of in (("all", "all"), ("accepted", "accepted")):
        figures = evaluation[of]
        if "error_m" not in figures or (of == "accepted" and len(evaluation["verdicts"]) < 2):
            continue
        error, before, worst = figures["error_m"], figures["without_deformation_m"], figures["worst"]
        shares = ", ".join(
            f"{100 * share:.0f} % in {100 * float(level):.0f} %" for level, share in figures["within"].items()
        )
        lines.append(
            f"{words}: {figures['landmarks']} landmarks, error {millimetres(error['mean'], 2)} mean, "
            f"{millimetres(error['p95'], 2)} at 95 %, worst {worst['name']} of {worst['cloud']} "
            f"({millimetres(worst['error_m'], 2)}); {millimetres(before['mean'], 2)} without deformation; "
            f"within regions: {shares}"
        )
    if evaluation["all"]["outside"]:
        lines.append(f"{evaluation['all']['outside']} landmarks outside the organ at rest are not counted")
    if evaluation["all"]["without_result"]:
        lines.append(
            f"{evaluation['all']['without_result']} landmarks have no result: their clouds were refused unregistered"
        )
    return "\n".join(lines)


# ---------------------------------------------------------------------- drawn


def find_evaluations(folder: Path) -> list[Path]:
    """Folders of evaluations below a workspace's."""
    return [record.parent for depth in ("*", "*/*") for record in sorted(folder.glob(f"{depth}/{RECORD}"))]


def evaluation_section(folder: Path) -> dict[str, Any]:
    """What the report shows of an evaluation: figures, its worst landmarks, a chart.

    Args:
        folder: that `softtwin evaluate` wrote.

    Raises:
        ValueError: the record is damaged.
    """
    try:
        evaluation = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        cases = [case for case in evaluation["cases"] if "error_m" in case]
        picture = chart(
            lambda sheet: draw(sheet, evaluation), "share of landmarks in their regions; errors over movements"
        )
        return {
            **evaluation,
            "chart": picture if cases else None,
            "colours": COLOURS,
            "lines": describe(evaluation).splitlines(),
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{folder.name}/{RECORD}: damaged ({error!r}); run `softtwin evaluate` again.") from None


def draw(sheet: Figure, evaluation: Mapping[str, Any]) -> None:
    """How well regions hold, and errors over how far landmarks have moved.

    Args:
        sheet: an empty figure.
        evaluation: what `evaluate_files` returns.
    """
    left, right = sheet.subplots(1, 2, gridspec_kw={"width_ratios": (1.0, 1.6)})
    left.plot([0, 1], [0, 1], color="#8a929c", linewidth=1.0, linestyle=":")
    for of, colour in (("all", "#1c6fd1"), ("accepted", "#2f9e44")):
        curve = evaluation[of].get("curve")
        if curve:
            left.plot(*np.transpose(curve), color=colour, label=of)
    left.set(xlabel="confidence of a region", ylabel="landmarks inside", xlim=(0, 1), ylim=(0, 1))
    left.legend(frameon=False)
    largest = 0.0
    for case in evaluation["cases"]:
        rows = [row for row in case["landmarks"] if "error_m" in row and not row.get("is_outside")]
        pairs = 1e3 * np.array([(row["without_deformation_m"], row["error_m"]) for row in rows]).reshape(-1, 2)
        right.plot(*pairs.T, ".", markersize=3, color=COLOURS[case["verdict"]])
        largest = max(largest, float(pairs.max(initial=0.0)))
    right.plot([0, largest], [0, largest], color="#8a929c", linewidth=1.0, linestyle=":")
    right.set(xlabel="from where the pose alone puts it, mm", ylabel="from where it was found, mm")
