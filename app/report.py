"""The report: one HTML file with pictures and figures of whatever a twin's stages have made so far."""

from __future__ import annotations

import json
import platform
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any

import jinja2
import matplotlib
import numpy as np
import pyvista
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import Embedding, carried, outer, target_points
from softtwin.meshes.io import read_body
from softtwin.meshes.metrics import mesh_quality, nodal_errors
from softtwin.reference.data.dataset import SPLITS, DataSet
from softtwin.registration.surface_distance import SurfaceDistance

from .config import Config, to_toml
from .pictures import (
    CLOUD,
    DISPLACEMENT,
    FOUND,
    ORGAN,
    Layer,
    Picture,
    Studio,
    camera_side,
    chart,
    inner_colours,
    is_tumour,
    moved_layers,
    rendering_problem,
    sprung,
    view_of,
)
from .record import NOTICE
from .sequences import find_registrations, sequence_section
from .target_errors import evaluation_section, find_evaluations
from .workspace import Workspace, read_records

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Section = dict[str, Any]

OBSERVED, FIXED, TRUTH = "#1c6fd1", "#d9480f", "#2f9e44"
_ERROR = "YlOrRd"
_MODES = 6
_DEMOS = ("surrogate", "surrogate-without-zone", "reference")
_MODE_SIZE = 0.12  # largest displacement of a mode in its picture, relative to the body
_MOST_DRAWS = 1024  # of each split that the histograms look at
_READ_ERRORS = (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile)


class _Missing(Exception):  # noqa: N818 - not an error: a section whose stage has not run
    """An input that is not there yet, and the command that makes it."""


def report_stage(space: Workspace, registrations: Sequence[Path] = ()) -> Path:
    """Write report.html into the workspace's folder: one file that needs nothing else, in light, dark and print.

    A section whose input is not there yet, or cannot be read, says so and names the command that makes it.

    Args:
        space: the workspace.
        registrations: folders that `softtwin register` wrote, beside those that lie in the workspace's folder.

    Returns:
        The file written.
    """
    space.folder.mkdir(parents=True, exist_ok=True)
    pyvista.OFF_SCREEN = True
    studio = Studio(rendering_problem())
    sections = {name: _guarded(make, space, studio) for name, make in _SECTIONS.items()}
    folders = find_registrations(space.folder, registrations)
    sections["sequences"] = _guarded(lambda space, studio: _sequences(space, studio, folders), space, studio)
    sections["evaluations"] = _guarded(_evaluations, space, studio)
    path = space.folder / "report.html"
    path.write_text(_fill_template(space, studio, sections), encoding="utf-8")
    return path


def _sequences(space: Workspace, studio: Studio, folders: Sequence[Path]) -> Section:
    if not folders:
        raise _Missing(
            "There are no registrations of your own: softtwin register TWIN CLOUDS... makes them; "
            "softtwin report organ.toml --registrations FOLDER shows them."
        )
    body = _body(space)

    def section(folder: Path) -> Section:
        made = _guarded(lambda space, studio: sequence_section(folder, body, studio), space, studio)
        return {"name": folder.resolve().name, **made}

    return {"every": [section(folder) for folder in folders]}


def _evaluations(space: Workspace, studio: Studio) -> Section:
    folders = find_evaluations(space.folder)
    if not folders:
        raise _Missing(
            "Nothing has been held against a measured organ: softtwin evaluate TWIN --cloud CLOUD --landmarks REST "
            f"MOVED --output {space.folder.name}/evaluation compares landmarks with where registration puts them."
        )

    def section(folder: Path) -> Section:
        made = _guarded(lambda space, studio: evaluation_section(folder), space, studio)
        return {"name": folder.resolve().name, **made}

    return {"every": [section(folder) for folder in folders]}


def _guarded(make: Callable[[Workspace, Studio], Section], space: Workspace, studio: Studio) -> Section:
    try:
        return make(space, studio)
    except _Missing as missing:
        return {"missing": str(missing)}
    except _READ_ERRORS as error:
        return {"missing": without_paths(str(error), space)}


def _fill_template(space: Workspace, studio: Studio, sections: Mapping[str, Section]) -> str:
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters.update(
        figure=figure,
        mm=lambda metres: "–" if metres is None else figure(1e3 * metres),
        vector=_vector,
        interval=_interval,
        mm2=_square_millimetres,
        measure=_measure,
    )
    environment.globals.update(gradient=_gradient, norm=np.linalg.norm)
    environment.globals.update(displacement_colours=DISPLACEMENT, error_colours=_ERROR)
    template = environment.from_string(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))
    return template.render(
        title=PurePath(space.config.body.source).stem or "organ", notice=NOTICE, rendering=studio.problem, **sections
    )


def without_paths(text: str, space: Workspace) -> str:
    """The text with every absolute path cut down to its last name: a report may be passed on."""
    for folder in (space.folder, space.root):
        text = text.replace(f"{folder.resolve()}/", "").replace(f"{folder.absolute()}/", "")
    return re.sub(r"(?<![\w./:])/(?:[^\s/\"'<>]+/)+", "", text)


def figure(value: float) -> str:
    """A number with three significant digits, without an exponent where it is readable without."""
    if value == 0.0 or 1e-3 <= abs(value) < 1e3:
        return f"{value:.3g}"
    return f"{value:,.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.2e}"


def _vector(values: Sequence[float | None]) -> str:
    return "(" + ", ".join(map(_signed, values)) + ")"


def _measure(value: float | None, unit: str) -> str:
    """A statistic with its unit, metres as millimetres."""
    if value is None:
        return "–"
    return f"{figure(1e3 * value)} mm" if unit == "m" else f"{figure(value)} {unit}".strip()


def _square_millimetres(values: Sequence[float | None]) -> str:
    return "(" + ", ".join("–" if value is None else f"{1e6 * value:+.3g}" for value in values) + ")"


def _interval(bounds: Sequence[Sequence[float | None]]) -> Markup:
    """A line for each component: in one they would be wider than a column of figures."""
    each = zip("xyz", bounds, strict=True)
    return Markup("<br>".join(f"{axis} {_signed(low)} to {_signed(high)}" for axis, (low, high) in each))


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.3f}"


def _gradient(colours: str) -> str:
    stops = matplotlib.colormaps[colours](np.linspace(0.0, 1.0, 9))
    return f"linear-gradient(to right, {', '.join(matplotlib.colors.to_hex(stop) for stop in stops)})"


# ------------------------------------------------------------------ the organ


def _body(space: Workspace) -> Body:
    if not space.body.exists():
        raise _Missing("There is no body yet: softtwin mesh organ.toml makes it.")
    return read_body(space.body)


def organ_section(space: Workspace, studio: Studio) -> Section:
    """The body from both sides, its counts and the quality of its mesh."""
    body = _body(space)
    colours = inner_colours(body.inner)
    observed = [(OBSERVED, "observed side (mesh lines)")] if "observed" in body.surfaces else []
    inner = [(colours[name], name) for name in body.inner]
    held = [(FIXED, f"{len(body.fixed)} fixed nodes")] if len(body.fixed) else []
    held += [(FIXED, f"springs {name} (mesh lines)") for name in sprung(body)]
    front = camera_side(body)
    sides = {
        "from the camera's side": front,
        "from behind": -front + np.array([0.0, 0.0, 0.6]),
        "from above": 0.3 * front + np.array([0.0, 0.0, 1.0]),
    }
    pictures = [
        studio.picture(view_of(towards, [body.points]), organ_layers(body), words, 760)
        for words, towards in sides.items()
    ]
    return {
        "pictures": pictures,
        "legend": [(ORGAN, "surface"), *observed, *held, *inner],
        "quality": mesh_quality(body),
        "fixed": len(body.fixed),
        "extent": np.ptp(body.points, axis=0).tolist(),
        "zones": {name: len(nodes) for name, nodes in body.node_sets.items() if name != "fixed"},
        "inner": {name: (len(surface.points), abs(surface.volume)) for name, surface in body.inner.items()},
    }


def organ_layers(body: Body) -> list[Layer]:
    """The translucent surface, the mesh of the observed side, the inner surfaces and the fixed nodes."""
    colours = inner_colours(body.inner)
    outside = outer(body).rest
    layers = [Layer(outside.points, outside.triangles, ORGAN, 0.4)]
    if "observed" in body.surfaces:
        layers.append(Layer(outside.points, body.surfaces["observed"], OBSERVED, 0.35, style="wireframe"))
    layers += [Layer(surface.points, surface.triangles, colours[name]) for name, surface in body.inner.items()]
    layers += [Layer(outside.points, each, FIXED, 0.5, style="wireframe") for each in sprung(body).values()]
    return [*layers, Layer(body.points[body.fixed], colour=FIXED, ball=0.011)] if len(body.fixed) else layers


# ------------------------------------------------------------------ modes and data


def _data(space: Workspace) -> DataSet:
    if not (space.data / "zarr.json").exists():
        raise _Missing("There is no data set yet: softtwin generate organ.toml makes it.")
    return DataSet(space.data)


def modes_section(space: Workspace, studio: Studio) -> Section:
    """The softest eigenmodes, coloured by their displacement."""
    data = _data(space)
    body, shapes = data.body, data.shapes[:_MODES]
    size = _MODE_SIZE * body.size
    fields = [size * shape / np.linalg.norm(shape, axis=1).max() for shape in shapes]
    view = view_of(camera_side(body), [body.points, *(body.points + field for field in fields)])
    pictures = []
    for i, field in enumerate(fields):
        layers = _coloured(body, field, size, None)
        words = f"mode {i + 1}: {figure(float(data.eigenvalues[i]))} N/m"
        pictures.append(studio.picture(view, layers, words, 480))
    return {"pictures": pictures, "count": len(data.shapes), "size": size}


def data_section(space: Workspace, studio: Studio) -> Section:
    """Accepted and rejected draws, how far they move, what they cost."""
    data = _data(space)
    missing = data.missing_blocks()
    if missing:
        raise _Missing(
            f"{data.block_count - len(missing)} of {data.block_count} blocks are finished: "
            "softtwin generate organ.toml goes on."
        )
    rejected = data.rejected().reasons
    drawn = dict(data.header["samples"])
    splits = [split for split in SPLITS if drawn.get(split) and split != "active"]  # these are among the training's
    peaks: dict[str, Floats] = {split: _peaks(data.samples(split, _MOST_DRAWS).displacements) for split in splits}
    iterations: dict[str, Ints] = {split: _iterations(data, split) for split in splits}
    return {
        "drawn": drawn,
        "accepted": sum(drawn.values()) - len(rejected),
        "rejected": {reason: rejected.count(reason) for reason in sorted(set(rejected))},
        "chart": chart(lambda sheet: _draw_data(sheet, peaks, iterations), "histograms of displacement and iterations"),
        "looked_at": sum(map(len, peaks.values())),
        "loaded": len(data.response.loaded),
        "versions": data.header.get("versions", {}),
    }


def _peaks(displacements: Floats) -> Floats:
    return np.linalg.norm(displacements, axis=2).max(axis=1)


def _iterations(data: DataSet, split: Any) -> Ints:
    figures = data.figures(split)
    return figures["iterations"][figures["reason"] == 0][:_MOST_DRAWS]


_SPLIT_COLOURS = ("#4c78a8", "#72b7b2", "#f2a65a", "#b79ad6", "#8c8c8c", "#d67195")


def _draw_data(sheet: Figure, peaks: Mapping[str, Floats], iterations: Mapping[str, Ints]) -> None:
    left, right = sheet.subplots(1, 2)
    colours = [_SPLIT_COLOURS[place % len(_SPLIT_COLOURS)] for place in range(len(peaks))]
    left.hist([1e3 * peaks[split] for split in peaks], bins=24, stacked=True, color=colours, label=list(peaks))
    left.set(xlabel="largest nodal displacement (mm)", ylabel="samples")
    left.legend(frameon=False)
    every = np.concatenate(list(iterations.values()))
    bins = np.arange(every.min(initial=0), every.max(initial=1) + 2) - 0.5
    right.hist(list(iterations.values()), bins=bins, stacked=True, color=colours)
    right.set(xlabel="Newton iterations of a sample", ylabel="samples")
    right.xaxis.get_major_locator().set_params(integer=True)


# ------------------------------------------------------------------ the surrogate


def surrogate_section(space: Workspace, studio: Studio) -> Section:
    """Held-out errors, and the median and the worst sample of those kept."""
    table, arrays = space.folder / "validation.json", space.folder / "validation.npz"
    if not table.exists() or not arrays.exists():
        first = "" if space.twin.exists() else "softtwin train organ.toml, then "
        raise _Missing(f"There are no held-out errors yet: {first}softtwin validate organ.toml.")
    body = _body(space)
    found = _arrays(arrays)
    names = ("displacements_true", "displacements_predicted")
    true, predicted = (_fields(body, f"validation.npz: {name}", found[name]) for name in names)
    errors, sizes = found["errors_mean_m"], found["sizes_m"]
    kept = np.linalg.norm(predicted - true, axis=2).mean(axis=1)
    order = np.argsort(kept)
    chosen = {"median": order[(len(order) - 1) // 2], "worst": order[-1]}
    return {
        "table": without_paths(str(json.loads(table.read_text()).get("table", "")), space),
        "mean": float(errors.mean()),
        "largest_mean": float(errors.max()),
        "size": float(sizes.mean()),
        "count": len(errors),
        "rows": [_prediction(studio, body, name, true[i], predicted[i]) for name, i in chosen.items()],
        "chart": chart(lambda sheet: _draw_errors(sheet, sizes, errors), "error of each held-out sample over its size"),
    }


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    # Opened here: of a damaged file numpy would leave its own open.
    with path.open("rb") as file, np.load(file) as found:
        return dict(found)


def _fields(body: Body, name: str, values: Floats) -> Floats:
    if values.ndim != 3 or values.shape[1:] != body.points.shape or not len(values):
        raise ValueError(f"{name}: expected shape (samples, {len(body.points)}, 3), got {values.shape}; make it again.")
    return values


def _prediction(studio: Studio, body: Body, name: str, true: Floats, predicted: Floats) -> Section:
    errors = np.linalg.norm(predicted - true, axis=1)
    limit = float(np.linalg.norm(true, axis=1).max())
    view = view_of(camera_side(body), [body.points, body.points + true, body.points + predicted])
    columns = {"true": (true, None), "predicted": (predicted, None), "error": (predicted, errors)}
    pictures = [
        studio.picture(view, _coloured(body, field, limit, error), f"{name} sample, {words}", 480)
        for words, (field, error) in columns.items()
    ]
    figures = {"limit": limit, "error_limit": float(errors.max()), "error": float(errors.mean())}
    return {"name": name, "pictures": pictures, **figures}


def _coloured(body: Body, field: Floats, limit: float, errors: Floats | None) -> list[Layer]:
    """The deformed body coloured by its displacement, or by the errors if given, and its outline at rest."""
    coloured, rest = moved_layers(body, field, limit)
    if errors is None:
        return [coloured, rest]
    values = outer(body).carried(errors)
    return [replace(coloured, values=values, limit=float(errors.max()), colours=_ERROR), rest]


def _draw_errors(sheet: Figure, sizes: Floats, errors: Floats) -> None:
    axes = sheet.subplots()
    axes.scatter(1e3 * sizes, 1e3 * errors, s=18, color=_SPLIT_COLOURS[0], alpha=0.8, linewidths=0)
    axes.set(xlabel="largest true displacement of the sample (mm)", ylabel="mean nodal error (mm)")
    if errors.min() > 0 and errors.max() > 30 * errors.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
    else:
        axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.25)


# ------------------------------------------------------------------ the registration


@dataclass(frozen=True, eq=False)
class _State:
    """Where the organ is taken to be: before registration, or as a model found it.

    Args:
        name: `before`, or of a registration of the demo.
        displacement: (n, 3), metres.
        forces: (n, 3), newtons; none before registration.
        row: what registration.json says of it.
    """

    name: str
    displacement: Floats
    forces: Floats | None
    row: Mapping[str, Any]


def registration_section(space: Workspace, studio: Studio) -> Section:
    """The demo: where the cloud, the organ and its tumour are before and after, with either model."""
    folder = space.folder / "demo"
    if not (folder / "cloud.npy").exists() or not (folder / "truth.npy").exists():
        raise _Missing(
            "There is no registration demo: softtwin quickstart makes one; "
            "softtwin register TWIN CLOUDS... registers clouds of your own."
        )
    body = _body(space)
    cloud = np.load(folder / "cloud.npy")
    truth = _fields(body, "truth.npy", np.load(folder / "truth.npy")[None])[0]
    made = [name for name in _DEMOS if (folder / f"{name}.npz").exists()]
    found = [_read_state(folder, name, body) for name in made]
    states = [_State("before", np.zeros_like(truth), None, {}), *found]
    targets = target_points(body)
    shown = [name for name in targets if is_tumour(name)] or list(targets)
    rows = [_figures(body, state, truth, cloud, targets) for state in states]
    return {
        "points": len(cloud),
        "largest": float(np.linalg.norm(truth, axis=1).max()),
        "rows": rows,
        "targets": list(targets),
        "shown": shown,
        "force": _true_force(folder, found),
        "pictures": _wide_pictures(studio, body, states, truth, cloud, shown),
        "closeups": _closeups(studio, body, states, truth, shown),
        "across": _compared(found, targets),
        "legend": [(ORGAN, "organ"), (FOUND, ", ".join(shown)), (CLOUD, "cloud"), (TRUTH, "truth (outline, mesh)")],
    }


def _read_state(folder: Path, name: str, body: Body) -> _State:
    arrays = _arrays(folder / f"{name}.npz")
    displacement = _fields(body, f"{name}.npz: displacement", arrays["displacement"][None])[0]
    record = folder / name / "registration.json"
    row = json.loads(record.read_text())["frames"][0] if record.exists() else {}
    return _State(name, displacement, arrays["forces"], row)


def _true_force(folder: Path, found: Sequence[_State]) -> Floats | None:
    if not found:
        return None
    forces = _arrays(folder / f"{found[0].name}.npz").get("true_forces")
    return None if forces is None else np.asarray(forces.sum(axis=0))


def _figures(body: Body, state: _State, truth: Floats, cloud: Floats, targets: Mapping[str, Embedding]) -> Section:
    force = None if state.forces is None else state.forces.sum(axis=0)
    return {
        "name": state.name.replace("-", " "),
        "nodes": nodal_errors(state.displacement, truth),
        "targets": _apart(targets, state.displacement, truth),
        "distance": _cloud_distance(body, state.displacement, cloud),
        "force": force,
        "deviation": state.row.get("net_force_deviation_N"),
        "interval": state.row.get("net_force_90_N"),
        "over_modulus": state.row.get("net_force_over_modulus_m2"),
        "informed": state.row.get("informed"),
        "seconds": state.row.get("seconds"),
        "iterations": state.row.get("iterations"),
        "outcome": str(state.row.get("outcome", "")).replace("_", " "),
        "verdict": state.row.get("verdict", ""),
        "reasons": state.row.get("reasons", []),
        "checks": state.row.get("checks", []),
    }


def _apart(targets: Mapping[str, Embedding], first: Floats, second: Floats) -> dict[str, float]:
    """Mean distance of each target's points between two displacements, metres."""
    return {name: nodal_errors(to.displace(first), to.displace(second)).mean for name, to in targets.items()}


def _cloud_distance(body: Body, displacement: Floats, cloud: Floats) -> float:
    """Root mean square distance of the cloud to the observed side, metres."""
    observed = SurfaceDistance(body, body.surfaces.get("observed"))
    return observed.match(displacement[observed.nodes], cloud).rms


def _wide_pictures(
    studio: Studio, body: Body, states: Sequence[_State], truth: Floats, cloud: Floats, shown: Sequence[str]
) -> list[Picture]:
    view = view_of(camera_side(body), [body.points, body.points + truth, cloud])
    true, outside = carried(body, truth), outer(body)
    true_outside, pictures = outside.moved(truth), []
    for state in states:
        moved, organ = carried(body, state.displacement), outside.moved(state.displacement)
        layers = [
            Layer(organ.points, organ.triangles, ORGAN, 0.35),
            *(Layer(moved[name].points, moved[name].triangles, FOUND) for name in shown),
            *(Layer(true[name].points, true[name].triangles, TRUTH, style="wireframe") for name in shown),
            Layer(true_outside.points, true_outside.triangles, TRUTH, style="outline"),
            Layer(cloud, colour=CLOUD, ball=0.009),
        ]
        pictures.append(studio.picture(view, layers, _state_words(state), 600))
    return pictures


def _closeups(
    studio: Studio, body: Body, states: Sequence[_State], truth: Floats, shown: Sequence[str]
) -> list[Picture]:
    if not shown:
        return []
    true = carried(body, truth)
    moved = [carried(body, state.displacement) for state in states]
    view = view_of(camera_side(body), [surfaces[name].points for surfaces in (true, *moved) for name in shown], 1.15)
    return [
        studio.picture(
            view,
            [
                *(Layer(surfaces[name].points, surfaces[name].triangles, FOUND, 0.8) for name in shown),
                *(Layer(true[name].points, true[name].triangles, TRUTH, style="wireframe") for name in shown),
            ],
            f"{', '.join(shown)} {_state_words(state)}",
            460,
        )
        for state, surfaces in zip(states, moved, strict=True)
    ]


def _state_words(state: _State) -> str:
    return "before" if state.name == "before" else f"after, with the {state.name.replace('-', ' ')}"


def _compared(found: Sequence[_State], targets: Mapping[str, Embedding]) -> Section | None:
    """How far the two models' registrations lie apart, None unless both are there."""
    named = {state.name: state for state in found}
    if not {"surrogate", "reference"} <= set(named):
        return None
    first, second = named["surrogate"], named["reference"]
    return {
        "nodes": nodal_errors(first.displacement, second.displacement),
        "targets": _apart(targets, first.displacement, second.displacement),
        "force": float(np.linalg.norm((first.forces - second.forces).sum(axis=0))),  # type: ignore[operator]
    }


# ------------------------------------------------------------------ the record


def record_section(space: Workspace, studio: Studio) -> Section:
    """What it takes to make the same again: configuration, versions, times, the twin's card."""
    stages, card = read_records(space.folder), space.twin / "surrogate.json"
    return {
        "stages": stages,
        "total": sum(stage["seconds"] for stage in stages.values()),
        "longest": max((stage["seconds"] for stage in stages.values()), default=0.0) or 1.0,
        "toml": to_toml(public_config(space.config)),
        "card": without_paths(card.read_text(), space) if card.exists() else "",
        "seeds": {"data": space.config.samples.seed, "training": space.config.training.seed},
        "versions": _versions(),
    }


def public_config(config: Config) -> Config:
    """The configuration with files named without their folders where these are absolute."""
    return Config.model_validate(_named(config.model_dump()))


def _named(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _named(entry) for key, entry in value.items()}
    return PurePath(value).name if isinstance(value, str) and PurePath(value).is_absolute() else value


def _versions() -> dict[str, str]:
    packages = ("softtwin", "numpy", "scipy", "torch", "vtk", "pyvista", "matplotlib")
    found = {dist: _version(dist) for dist in packages}
    return {"python": platform.python_version(), **{name: version for name, version in found.items() if version}}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


_SECTIONS: Mapping[str, Callable[[Workspace, Studio], Section]] = {
    "organ": organ_section,
    "modes": modes_section,
    "data": data_section,
    "surrogate": surrogate_section,
    "registration": registration_section,
    "record": record_section,
}
