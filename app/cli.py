"""The command line: one command a stage, and the whole chain in one."""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import click
from threadpoolctl import threadpool_limits

from softtwin.meshes.attachment import File, parse_file, parse_region, parts_of
from softtwin.meshes.io import Axes, Unit, is_segmentation, stated_axes, stated_unit
from softtwin.reference.ranks import FailedElsewhere

from .arguments import (
    BuildArguments,
    CloudArguments,
    DemoArguments,
    DrawArguments,
    EvaluateArguments,
    ExportArguments,
    FreshArguments,
    GenerateArguments,
    IdentifyArguments,
    PageArguments,
    PickArguments,
    QuickstartArguments,
    RegisterArguments,
    ReportArguments,
    StartArguments,
    TrainArguments,
    WatchArguments,
)
from .config import (
    BodySection,
    Config,
    ConfigError,
    LoadsSection,
    MaterialSection,
    RegistrationSection,
    SamplesSection,
    TrainingSection,
    default_samples,
    parse_config,
    to_toml,
)
from .flags import Commands, flags
from .register import NOTICE

# What libraries tell those who write programs with them.
_FOR_DEVELOPERS = (DeprecationWarning, PendingDeprecationWarning, FutureWarning, ImportWarning, ResourceWarning)
_PATH = click.Path(path_type=Path)
_EXISTING = click.Path(exists=True, path_type=Path)
_KNOWN_LOADS = ("known_forces", "gravity", "pressure")


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="softtwin")
def softtwin() -> None:
    """Turn the surface of a soft organ into a real-time digital twin.

    A reference (FEniCSx) solves hyperelastic equilibria, a surrogate (torch) learns them, and registration finds from
    a partial point cloud how the whole organ has moved and which forces did it.

    Start with `softtwin quickstart`. For an organ of your own: `softtwin build liver.stl --unit mm --fixed veins.ply`,
    then `softtwin register twin-run clouds/*.ply`. Research software: not a medical device.
    """


@softtwin.command()
def doctor() -> None:
    """Say what is installed: versions, BLAS, MPI, GPU, compiler, rendering."""
    from .doctor import as_text, checks

    click.echo(as_text(checks()))


@softtwin.command()
def config() -> None:
    """Write out the configuration with every default and its meaning (TOML)."""
    click.echo(to_toml(Config()))


@softtwin.command()
@click.argument("configuration", type=_EXISTING)
def mesh(configuration: Path) -> None:
    """Make the body of CONFIGURATION: read or make a surface, fill it with tetrahedra, report the quality.

    One that is there stays, where nothing that it was made from has changed. Another one is made beside a copy of it,
    body.HASH.vtu: equilibria that were solved are of the body that they were solved on.
    """
    from .inputs import is_meshed, set_aside
    from .stages.mesh import mesh_stage
    from .workspace import open_workspace

    space = open_workspace(configuration)
    if is_meshed(space):
        click.echo(f"nothing has changed: {space.body} stays as it is; remove it to have it made again")
        return
    if space.body.exists():
        set_aside(space)
    body = mesh_stage(space)
    click.echo((space.folder / "mesh_quality.txt").read_text().rstrip())
    click.echo(f"{len(body.points)} nodes, {len(body.fixed)} of them fixed; written to {space.body}")


@softtwin.command()
@click.argument("configuration", type=_EXISTING)
@flags(GenerateArguments)
def generate(
    configuration: Path, redo: tuple[int, ...], again: bool, shard: str | None, engine: str, device: str
) -> None:
    """Solve the equilibria of CONFIGURATION's data set; also under `mpirun -n N`. Goes on where it was stopped.

    Blocks that are damaged are found and made again. Another body or configuration is refused. Once all parts of an
    array of jobs have ended, `generate` without `--shard` makes what is missing, and the Jacobians.
    """
    from softtwin.reference.data.shard import Shard

    from .stages.generate import describe_data, generate_stage

    chosen = None if shard is None else Shard.parse(shard)
    if device != "cpu" and engine != "torch":
        raise ConfigError(f"generate --device {device}: expected --engine torch beside it; the reference knows no GPU.")
    data = generate_stage(configuration, redo, again, chosen, device if engine == "torch" else "")
    if data is not None and chosen is not None:
        missing = len(data.missing_blocks())
        click.echo(f"shard {chosen}: done; {missing} of {data.block_count} blocks of {data.path} are still missing")
    elif data is not None:
        click.echo(describe_data(data))
        click.echo(f"written to {data.path}")


@softtwin.group("data")
def data_commands() -> None:
    """Look into data sets, take samples out of them, put several together."""


@data_commands.command("show")
@click.argument("source", type=_EXISTING)
def show_data(source: Path) -> None:
    """Say what is in SOURCE, a data set or a configuration: counts, reasons, distributions, origin, damage."""
    from softtwin.reference.data.summary import summary

    from .data import opened

    click.echo(summary(opened(source)))


@data_commands.command("export")
@click.argument("source", type=_EXISTING)
@click.argument("output", type=_PATH)
@flags(DrawArguments)
def export_data(source: Path, output: Path, draws: tuple[int, ...]) -> None:
    """Write draws of SOURCE into OUTPUT (VTU, PNG): those that move least, most and in the median, or --draw."""
    from softtwin.reference.data.summary import summary

    from .data import export_draws, opened

    found = opened(source)
    chosen = draws or tuple(dict.fromkeys(summary(found).extremes.values()))
    for path in export_draws(found, chosen, output):
        click.echo(f"written: {path}")


@softtwin.command()
@click.argument("source", type=_EXISTING)
@click.argument("output", type=_PATH)
@click.option(
    "--precision",
    type=click.Choice(["single", "double"]),
    default="single",
    show_default=True,
    help="Of the samples; single halves the file.",
)
@click.option("--jacobians/--no-jacobians", default=True, show_default=True, help="Take Jacobians along.")
def tensors(source: Path, output: Path, precision: Any, jacobians: bool) -> None:
    """Write SOURCE, a data set or a configuration, into one file (OUTPUT.safetensors) for a machine with a GPU.

    Training and prediction read it there with torch, NumPy, SciPy and safetensors alone.
    """
    from softtwin.reference.data.tensors import export_tensors

    from .data import opened

    path = export_tensors(opened(source), output, precision, jacobians)
    click.echo(f"written: {path} ({path.stat().st_size / 2**20:.1f} MiB)")


@data_commands.command("merge")
@click.argument("sources", nargs=-1, required=True, type=_EXISTING)
@click.argument("output", type=_PATH)
def merge_data(sources: tuple[Path, ...], output: Path) -> None:
    """Put the draws of SOURCES, of one body and material, together in OUTPUT; what was held out stays held out."""
    from softtwin.reference.data.merge import merge

    from .data import opened
    from .stages.generate import describe_data

    merged = merge([opened(source) for source in sources], output)
    click.echo(describe_data(merged))
    click.echo(f"written to {merged.path}")


@softtwin.command()
@click.argument("configuration", type=_EXISTING)
@flags(FreshArguments)
@flags(TrainArguments)
def train(configuration: Path, fresh: bool, device: Any, processes: int) -> None:
    """Train the surrogate of CONFIGURATION on its data set and write the twin. Goes on from the last checkpoint."""
    from .stages.learn import train_stage
    from .workspace import open_workspace

    space = open_workspace(configuration)
    train_stage(space, fresh, device, processes)
    click.echo(f"twin written to {space.twin}")


@softtwin.command()
@click.argument("configuration", type=_EXISTING)
def validate(configuration: Path) -> None:
    """Measure the twin's errors on the held-out samples, every definition printed."""
    from .stages.learn import validate_stage
    from .workspace import open_workspace

    click.echo(validate_stage(open_workspace(configuration)))


@softtwin.command("model-error")
@click.argument("configuration", type=_EXISTING)
def model_error(configuration: Path) -> None:
    """Solve the model-error ensemble of CONFIGURATION ([model_error]), for the margins; also under `mpirun -n N`.

    Its models have another attachment, Poisson's ratio or mesh. The command goes on where it was stopped.
    """
    from .stages.model_error import model_error_stage

    found = model_error_stage(configuration)
    if found is not None:
        click.echo(f"    {found}")


@softtwin.command()
@click.argument("twin", type=_EXISTING)
@flags(EvaluateArguments, required=("cloud", "landmarks"))
@flags(CloudArguments)
@flags(StartArguments, without=("landmarks",))
@flags(RegistrationSection, without=("forces", "budget"), unset=True)
def evaluate(
    twin: Path,
    cloud: tuple[str, ...],
    landmarks: tuple[str, str],
    localisation_error: float,
    output: Path,
    unit: Unit | None,
    frame: Axes | None,
    start: Path | None,
    align: str | None,
    **chosen: Any,
) -> None:
    """Hold TWIN against a measured organ: register clouds, and compare landmarks inside with where that puts them.

    Every cloud is registered from rest and alone; the landmarks pull nothing. Written to the folder: evaluation.json
    and landmarks.csv, with the error of each landmark, how far it is off without the deformation, and its regions of
    50, 90 and 95 %; `softtwin report` draws them. Landmarks outside the organ at rest are not counted.
    """
    from .register import Start
    from .target_errors import evaluate_files

    if start is not None and align is not None:
        raise ConfigError("--start, --align: expected one of them, got both.")
    evaluate_files(
        twin, cloud, landmarks, output, _given(chosen), unit=unit, axes=frame,
        start=Start(start, align=align is not None), deviation=localisation_error, say=click.echo,
    )  # fmt: skip
    click.echo(f"written to {output}\n{NOTICE}")


@softtwin.command()
@click.argument("twin", type=_EXISTING)
@flags(ExportArguments)
def export(twin: Path, output: Path | None, directions: int) -> None:
    """Write the surrogate of TWIN as graphs for other programs (ONNX and torch.export): displacement and Jacobian."""
    from softtwin.meshes.io import read_body
    from softtwin.surrogate.export import export as write_graphs
    from softtwin.surrogate.twin import load

    folder = write_graphs(load(twin, read_body(twin / "body.vtu")), output or twin / "onnx", directions)
    click.echo(f"graphs written to {folder}")


@softtwin.command()
@click.argument("twin", type=_EXISTING)
@click.argument("clouds", nargs=-1, required=True)
@flags(CloudArguments)
@flags(StartArguments)
@flags(RegistrationSection, without=("forces", "budget"), unset=True)
@flags(WatchArguments)
@flags(RegisterArguments)
def register(
    twin: Path,
    clouds: tuple[str, ...],
    unit: Unit | None,
    frame: Axes | None,
    start: Path | None,
    landmarks: tuple[Path, Path] | None,
    align: str | None,
    frame_landmarks: tuple[Path, Path] | None,
    formats: tuple[str, ...],
    truth: Path | None,
    budget: float | None,
    watch: bool,
    idle: float | None,
    learn: bool,
    keep: bool,
    strict: bool,
    output: Path,
    **chosen: Any,
) -> None:
    """Register CLOUDS to TWIN: one file a frame, in order; a folder; or a pattern in quotes.

    Every frame has a verdict: accepted, doubtful or refused, with reasons. Written to the folder: registration.json,
    and for each frame the organ with displacement and force (VTU) and the moved surface of each structure, in
    millimetres and LPS (--output-unit, --output-frame); frames.pvd opens all of it in ParaView, frames.mrb (with
    --format seq.mrb) in 3D Slicer. Clouds are read in the unit and on the axes of the organ's files (--unit, --frame).

    A peer of OpenIGTLink gets each answer back: a POLYDATA for every structure, the TRANSFORM pose, the STRING figures.

    TWIN is a twin's folder; with --model reference a folder with a body and its configuration is enough. What is not
    given is as in the twin's organ.toml; the defaults below are those of a new one.
    """
    from .address import SCHEME, parse_source
    from .export import FORMATS
    from .register import Start, register_files

    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise ConfigError(f"--format: expected {', '.join(FORMATS)}, got {', '.join(unknown)}.")
    if sum(given is not None for given in (start, landmarks or None, align)) > 1:
        raise ConfigError("--start, --landmarks, --align: expected one of them, got several.")
    options = _given(chosen)
    begin = Start(start, landmarks or None, align is not None, frame_landmarks or None)
    beside = {"--idle": idle is not None, "--learn": learn, "--keep": keep}
    if not watch and (alone := [name for name, is_given in beside.items() if is_given]):
        raise ConfigError(f"{alone[0]}: expected --watch beside it.")
    if not watch and any(name.startswith(f"{SCHEME}://") for name in clouds):
        raise ConfigError(f"CLOUDS: expected --watch beside a place of OpenIGTLink, got {clouds[0]} without it.")
    if watch:
        from .live import watch_source

        if len(clouds) != 1 or truth is not None:
            raise ConfigError("--watch: expected one folder or igtl://... and no --truth.")
        verdicts = watch_source(
            twin, parse_source(clouds[0]), output, options, unit=unit, axes=frame, start=begin, formats=formats,
            budget=budget, idle=idle, learn=learn, keep=keep, say=click.echo,
        )  # fmt: skip
    else:
        try:
            verdicts = register_files(
                twin, clouds, output, options, unit=unit, axes=frame, start=begin, truth=truth, formats=formats,
                budget=budget, say=click.echo,
            )  # fmt: skip
        except KeyboardInterrupt:
            _end(f"\ninterrupted: {output} has the frames so far; the same command begins with the first again.", 130)
    said = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items() if count)
    click.echo(f"{said or 'no frame'}; written to {output}\n{NOTICE}")
    if strict and verdicts["doubtful"] + verdicts["refused"]:
        sys.exit(3)


@softtwin.command()
@click.argument("twin", type=_EXISTING)
@click.argument("clouds", nargs=-1, required=True)
@flags(CloudArguments, ("unit",))
@flags(StartArguments, ("start", "landmarks"))
@flags(
    RegistrationSection,
    ("parameters", *_KNOWN_LOADS, "noise", "noise_known", "points"),
    unset=True,
    required=("parameters",),
)
@flags(IdentifyArguments)
def identify(
    twin: Path,
    clouds: tuple[str, ...],
    unit: Unit | None,
    start: Path | None,
    landmarks: tuple[Path, Path] | None,
    output: Path,
    **chosen: Any,
) -> None:
    """Find what TWIN is made of from CLOUDS under known loads: stiffness, Poisson's ratio, where a region has gone.

    Each cloud is a state under the same loads, or of the same parameters; what all of them say together stands at the
    end, with the interval that holds it with 90 %. A parameter that they do not inform is called so. Ends with code 3
    where no cloud could be used. Where forces are unknown as well, use `softtwin register --parameter`.
    """
    from .identify import identify_files
    from .register import Start

    if start is not None and landmarks:
        raise ConfigError("--start, --landmarks: expected one of them, got both.")
    options = _given(chosen) | {"model": "reference", "forces": "known"}
    begin = Start(start, landmarks or None)
    used = identify_files(twin, clouds, output, options, unit=unit, start=begin, say=click.echo)
    click.echo(f"written to {output}\n{NOTICE}")
    if not used:
        sys.exit(3)


def _given(chosen: dict[str, Any]) -> dict[str, Any]:
    """Options that were given, as entries of [registration]."""
    found = {name: value for name, value in chosen.items() if value is not None and value != ()}
    return {name: str(value) if isinstance(value, Path) else value for name, value in found.items()}


@softtwin.command()
@click.argument("configuration", type=_EXISTING)
@flags(ReportArguments)
def report(configuration: Path, registrations: tuple[Path, ...]) -> None:
    """Write the HTML report of what CONFIGURATION's stages have made so far, and of registrations.

    CONFIGURATION is a file or the folder that holds organ.toml. Registrations below that folder are found by
    themselves.
    """
    from .report import report_stage
    from .workspace import open_workspace

    file = configuration / "organ.toml" if configuration.is_dir() else configuration
    click.echo(f"report written to {report_stage(open_workspace(file), registrations)}")


@softtwin.command()
@click.argument("surface_or_mesh", type=_PATH)
@flags(
    BodySection,
    (
        "unit",
        "frame",
        "fixed",
        "observed",
        "zones",
        "inner",
        "nodes",
        "organ",
        "join",
        "component",
        "cavities",
        "fixed_distance",
        "cell_size",
        "grid",
    ),
    unset=("unit", "frame", "cavities"),
)
@flags(MaterialSection, ("young_modulus", "poisson_ratio", "law"))
@flags(SamplesSection, ("train", "jacobians", "load_path", "ranks"), unset=("train",))
@flags(LoadsSection, ("displacement",))
@flags(TrainingSection, ("architecture", "seconds"))
@flags(TrainArguments)
@flags(BuildArguments)
def build(
    surface_or_mesh: Path, zones: tuple[str, ...], inner: tuple[str, ...], output: Path, again: bool, **given: Any
) -> None:
    """Build a twin from SURFACE_OR_MESH (STL PLY OBJ VTK VTU VTP MSH), or a segmentation (NII NRRD, or a folder).

    Mesh, equilibria, surrogate, held-out errors. A surface may have holes, crumbs, overlaps, any winding: it is made
    solid, and what was done to it is said. Labels of a segmentation become smooth closed surfaces.

    Writes OUTPUT/organ.toml with all settings; run again after an interruption, it goes on where it stopped. With
    other options or changed files it makes again what depends on them; only equilibria that were solved are never
    thrown away unasked.

    \b
    WHERE is a file, or words. Lengths without a unit are in --unit.
      veins.ply                  near its points; node numbers (n,) in .npy or .txt;
                                 for --observed a surface, or (t, 3) in .npy
      near:hepatic_vein:5mm      near the --inner surface of that name
      touching:vena_cava:5mm     where another label of the segmentation touches the organ
      ball:10,-20,35mm:15mm      centre and radius
      box:0,0,0:40,30,20mm       two corners
      halfspace:0,0,12mm:0,0,-1  a point, and the side that the normal points to
      seen-from:0,-400,100mm     what a camera at that place sees

    A FILE in another unit or on other axes has them behind its name: veins.ply:mm, tumour.stl:cm:ras.
    """  # noqa: D301  (click's mark for lines that are kept)
    from .chain import build_twin

    source, unit, frame = _source(str(surface_or_mesh), given["unit"], given["frame"])
    body = {
        "source": source,
        "organ": given["organ"],
        "fixed": " + ".join(map(_resolved, given["fixed"])),
        "observed": " + ".join(map(_resolved, given["observed"])),
        "zones": _named("--zone", zones),
        "inner": _labelled(inner) if is_segmentation(parse_file(source).path) else _named("--inner", inner),
        "unit": unit,
        "frame": frame,
        "join": " + ".join(given["join"]),
        "cavities": given["cavities"] or "",
        **{name: given[name] for name in ("nodes", "cell_size", "grid", "fixed_distance", "component")},
    }
    train = given["train"] or default_samples(given["architecture"])
    entries = {
        "folder": ".",
        "body": body,
        "material": {name: given[name] for name in ("law", "young_modulus", "poisson_ratio")},
        "loads": {"displacement": given["displacement"], "zones": sorted(body["zones"])},
        "samples": {
            "train": train,
            "validation": max(8, train // 8),
            "test": max(8, train // 4),
            "calibration": max(12, train // 4),
            "smooth": max(8, train // 8),
            "ranks": given["ranks"],
            "load_path": given["load_path"],
            "jacobians": given["jacobians"],
        },
        "training": {name: given[name] for name in ("architecture", "seconds")},
    }
    build_twin(parse_config(entries, "command line"), output, click.echo, again, given["device"], given["processes"])


def _named(flag: str, pairs: tuple[str, ...]) -> dict[str, str]:
    named = {}
    for pair in pairs:
        name, equals, where = pair.partition("=")
        if not (name and equals and where):
            raise ConfigError(f"{flag}: expected NAME={'FILE' if flag == '--inner' else 'WHERE'}, got {pair!r}.")
        named[name] = _resolved(where)
    return named


def _labelled(inner: tuple[str, ...]) -> dict[str, str]:
    """Inner structures of a segmentation: NAME, NAME=LABEL or NAME=FILE."""
    named = {}
    for pair in inner:
        name, equals, where = pair.partition("=")
        if not name or (equals and not where):
            raise ConfigError(f"--inner: expected NAME, NAME=LABEL or NAME=FILE, got {pair!r}.")
        named[name] = _resolved(where) if equals and parse_file(where).path.is_file() else where or name
    return named


def _source(source: str, unit: Unit | None, frame: Axes | None) -> tuple[str, Unit, Axes | str]:
    """The source as the configuration holds it, and the unit and axes of files that say none."""
    if is_segmentation(parse_file(source).path):
        from .scan import framed

        return framed(source, unit, frame)
    stated = _stated_unit(source)
    file = parse_file(_with_axes(_resolved(source)))
    if unit and stated and unit != stated and file.unit is None:
        file = replace(file, unit=unit)  # what the user says wins, and the configuration holds that it was said
    return str(file), file.unit or unit or stated or "m", frame or ""


def _with_axes(source: str) -> str:
    """The source with the axes that it states about itself, so that the configuration holds it."""
    file = parse_file(source)
    return str(file if file.axes else replace(file, axes=stated_axes(file.path)))


def _stated_unit(source: str) -> Unit | None:
    """The unit that a source states about itself; None for one that is yet to be looked for."""
    path = parse_file(source).path
    return stated_unit(path) if path.is_file() else None


def _resolved(where: str) -> str:
    """The words as they are; a file with its whole path."""
    parts = [(part, parse_region(part)) for part in parts_of(where)]
    return " + ".join(str(replace(r, path=r.path.resolve())) if isinstance(r, File) else part for part, r in parts)


@softtwin.command()
@flags(QuickstartArguments)
def quickstart(output: Path, small: bool) -> None:
    """Run the whole chain on a liver phantom: mesh, modes, equilibria, surrogate, registration, report (minutes)."""
    from .quickstart import run_quickstart

    run_quickstart(output, small, click.echo)


@softtwin.command()
@flags(PageArguments)
@flags(DemoArguments)
def demo(port: int | None, browser: bool, record: Path | None, seconds: float) -> None:
    """Show a live page on this machine: a liver phantom before a simulated camera; pull at it with the mouse.

    The twin comes with the package; nothing is made and nothing is downloaded.
    """
    from .page.demo import run_demo

    run_demo(port, browser, record, seconds, click.echo)


@softtwin.command()
@click.argument("twin", type=_EXISTING)
@click.argument("source")
@flags(CloudArguments)
@flags(StartArguments)
@flags(RegistrationSection, ("model", "zone"), unset=True)
@flags(WatchArguments, ("idle", "learn", "keep"))
@flags(PageArguments)
def live(
    twin: Path,
    source: str,
    unit: Unit | None,
    frame: Axes | None,
    start: Path | None,
    landmarks: tuple[Path, Path] | None,
    align: str | None,
    idle: float | None,
    learn: bool,
    keep: bool,
    port: int | None,
    browser: bool,
    **chosen: Any,
) -> None:
    """Show a live page on this machine: TWIN follows the clouds of SOURCE.

    SOURCE is a folder that is written to, or a place of OpenIGTLink (igtl://HOST:PORT, igtl://:PORT to listen; mm and
    RAS if not given). Nothing is written or sent back; `softtwin register --watch` does that.
    """
    from .address import parse_source
    from .page.stream import run_live
    from .register import Start

    if sum(given is not None for given in (start, landmarks or None, align)) > 1:
        raise ConfigError("--start, --landmarks, --align: expected one of them, got several.")
    begin = Start(start, landmarks or None, align is not None)
    run_live(
        twin, parse_source(source), _given(chosen), unit=unit, axes=frame, start=begin, idle=idle, learn=learn,
        keep=keep, port=port, browser=browser, say=click.echo,
    )  # fmt: skip


@softtwin.command()
@click.argument("organ", type=_PATH)
@flags(PickArguments)
@flags(PageArguments)
def pick(organ: Path, unit: Unit, frame: str | None, inner: tuple[str, ...], port: int | None, browser: bool) -> None:
    """Show a page on which one clicks what holds ORGAN, and get the words for --fixed.

    ORGAN is a surface or a mesh, or a configuration (organ.toml), which the words can be written into.
    """
    from .config import read_config
    from .page.pick import run_pick

    if organ.suffix == ".toml":
        known, root = read_config(organ)
        run_pick(known.body, root, organ, port, browser, click.echo)
        return
    body = {"source": _with_axes(_resolved(str(organ))), "unit": unit, "frame": frame or ""}
    section = parse_config({"body": {**body, "inner": _named("--inner", inner)}}, "command line").body
    run_pick(section, Path(), None, port, browser, click.echo)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; errors of the input are one message and exit code 2, not a traceback."""
    # Ranks are the parallelism: on meshes of an organ's size several BLAS threads in one process only wait for another.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Threads that spin while they wait made training 14 times slower on two cores that others used as well.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        with warnings.catch_warnings(), threadpool_limits(int(os.environ["OPENBLAS_NUM_THREADS"]), "blas"):
            warnings.showwarning = _shown_once()
            softtwin.main(args=arguments, standalone_mode=False)
    except click.ClickException as error:
        if _speaks():
            error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        _end("\ninterrupted: what was finished is kept; the same command goes on from there.", 130)
    except FailedElsewhere:
        sys.exit(2)  # whoever failed has said why
    except (ImportError, MemoryError, OSError, RuntimeError, ValueError) as error:
        message = _message(error)
        if message is None:
            raise
        _end(f"error: {message}", 2)


def _end(message: str, code: int) -> NoReturn:
    if _speaks():
        click.echo(message, err=True)
    sys.exit(code)


def _speaks() -> bool:
    """Whether this process is no rank of a job, or the first: what all ranks find is said once."""
    names = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK")
    return next((os.environ[name] for name in names if name in os.environ), "0") == "0"


def _message(error: Exception) -> str | None:
    """What to tell the user of an error; None for one that is a defect of this program."""
    if isinstance(error, ModuleNotFoundError):
        return f"{error}. {_where_from(error.name or '')}"
    if isinstance(error, MemoryError):
        return "there is not enough memory for this; a coarser mesh or fewer samples need less."
    if isinstance(error, OSError):
        return _system_message(error)
    return str(error) if _is_ours(error) else None


def _system_message(error: OSError) -> str | None:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "the disk is full. What was written whole is kept; make room and run the same command again."
    if error.filename is None:
        return str(error) if _is_ours(error) else None
    if error.errno in (errno.EEXIST, errno.ENOTDIR):
        return f"{error.filename}: expected a folder, found a file; choose another place to write to."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{error.filename}: {error.strerror}; choose a place that you may read and write."
    return f"{error.filename}: {error.strerror}."


def _is_ours(error: Exception) -> bool:
    """Errors whose message is written for the user: raised, with their type or as they are, by this project."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and str(trace.tb_frame.f_globals.get("__name__", "")).startswith("softtwin.")


def _where_from(module: str) -> str:
    if module.split(".")[0] in ("dolfinx", "petsc4py", "slepc4py", "ufl", "mpi4py", "basix", "ffcx"):
        return "This stage needs FEniCSx: apt-get install python3-dolfinx-real python3-slepc4py-real."
    return "Install what is missing: pip install 'softtwin[torch,mesh,app]'; `softtwin doctor` lists everything."


def _shown_once() -> Callable[..., None]:
    """Warnings as lines, each text once: several stages read one file."""
    said = set[str]()

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = " ".join(str(message).split())
        if not issubclass(category, _FOR_DEVELOPERS) and text not in said:
            said.add(text)
            click.echo(f"warning: {text}", err=True)

    return show


if __name__ == "__main__":
    main()
