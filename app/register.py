"""Clouds to states of a twin: choose a forward model, register frame after frame, write what was found."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import check_cloud
from softtwin.meshes.embedding import target_points
from softtwin.meshes.files import read_body, read_cloud, write_deformed
from softtwin.meshes.metrics import target_errors
from softtwin.reference.loads import loaded_nodes
from softtwin.registration.evidence import Scale
from softtwin.registration.forward import ForwardModel
from softtwin.registration.gauss_newton import GaussNewton
from softtwin.registration.registrar import Registrar, Registration, RegistrationOptions, register_sequence
from softtwin.registration.residuals import SurfaceDistance
from softtwin.registration.unknowns import Informed, informed, nodal_forces

from .config import Config, ConfigError, RegistrationSection, read_config
from .inputs import check_material, load_plan

Floats = NDArray[np.float64]
NOTICE = "Research software: not a medical device."
_FORCE_SPREAD, _NOISE_SPREAD = 2.0, 1.5  # of the logarithms: both scales are found from the cloud
_LEAST_NOISE = 1e-4  # metres; no camera is better


def open_twin(folder: Path | str) -> tuple[Body, Config]:
    """The body and the configuration of a twin.

    Raises:
        ConfigError: the folder is no twin, or its material is not the one that its surrogate has learned.
    """
    folder = Path(folder)
    missing = [name for name in ("body.vtu", "organ.toml") if not (folder / name).is_file()]
    if missing:
        raise ConfigError(f"twin: expected a twin folder with {missing} in {folder}; make one with `softtwin build`.")
    config, _ = read_config(folder / "organ.toml")
    check_material(folder, config)
    return read_body(folder / "body.vtu"), config


@contextmanager
def forward_model(name: str, folder: Path, body: Body, config: Config) -> Iterator[ForwardModel]:
    """The forward model that registers: the twin's surrogate, or the reference where FEniCSx is installed.

    Args:
        name: `surrogate` or `reference`.
        folder: the twin.
        body: its body.
        config: its configuration; gives the reference its material.
    """
    if name == "surrogate":
        from softtwin.surrogate.predictor import load  # torch is needed here alone

        yield load(folder, body)
        return
    from softtwin.reference.equilibrium import NewtonOptions, Problem
    from softtwin.reference.materials import MATERIALS
    from softtwin.reference.model import ReferenceModel  # FEniCSx is needed here alone

    material = MATERIALS[config.material.law](config.material.young_modulus, config.material.poisson_ratio)
    with Problem(body, material, NewtonOptions(tolerance=1e-5, max_iterations=15)) as problem:
        yield ReferenceModel(problem, patient=False)


def make_registrar(model: ForwardModel, config: Config, section: RegistrationSection) -> Registrar:
    """A registrar for a model, with the zone, noise and observed side of the configuration."""
    body = model.body
    if section.zone and section.zone not in body.node_sets:
        raise ConfigError(f"registration.zone: expected one of {sorted(body.node_sets)}, got {section.zone!r}.")
    nodes = body.node_sets[section.zone] if section.zone else loaded_nodes(body, load_plan(config))
    observed = SurfaceDistance(body, body.surfaces.get("observed"))
    scale = Scale(section.force_scale, _FORCE_SPREAD, least=1e-3 * section.force_scale)
    every = nodal_forces(body, nodes, scale, section.smoothness)
    forces = informed(every, model, observed, Informed(scale=3.0 * section.force_scale, most=section.directions))
    noise = Scale(section.noise, _NOISE_SPREAD, least=min(_LEAST_NOISE, section.noise))
    options = RegistrationOptions(noise, GaussNewton(max_iterations=section.max_iterations))
    return Registrar(model, observed, forces, options)


def read_clouds(paths: Sequence[Path], unit: str, body: Body) -> list[Floats]:
    """The clouds of a sequence, each checked before the first is registered.

    Raises:
        FileError, CloudError: which file cannot be used, and why.
    """
    clouds = []
    for path in paths:
        cloud = read_cloud(path, unit)  # type: ignore[arg-type]
        try:
            clouds.append(check_cloud(cloud, body))
        except ValueError as error:
            raise type(error)(f"{path}: {error}") from None
    return clouds


def register_clouds(
    registrar: Registrar,
    clouds: Sequence[Floats],
    output: Path,
    truth: Floats | None = None,
    say: Callable[[str], None] = print,
) -> list[Registration]:
    """Register a sequence and write each frame as it is found: a VTU of the deformed organ and a line of figures.

    Args:
        registrar: model, zone and options.
        clouds: one a frame, (p, 3), metres.
        output: folder to write to.
        truth: true node positions of each frame, (frames, n, 3), metres, to state errors.
        say: prints one line a frame.
    """
    output.mkdir(parents=True, exist_ok=True)
    body = registrar.model.body
    targets = target_points(body)
    results, rows = [], []
    frames = register_sequence(registrar, clouds)
    for i, result in enumerate(tqdm(frames, total=len(clouds), desc="registering", unit="frame", disable=None)):
        row = frame_figures(body, result, i, targets, None if truth is None else truth[i] - body.points)
        write_deformed(output / f"frame_{i:04d}.vtu", body, result.displacement, {"force_N": result.forces})
        rows.append(row)
        (output / "registration.json").write_text(json.dumps({"notice": NOTICE, "frames": rows}, indent=1) + "\n")
        say(describe(row))
        results.append(result)
    return results


def frame_figures(
    body: Body, result: Registration, frame: int, targets: dict[str, Any], truth: Floats | None
) -> dict[str, Any]:
    """What is known of a registered frame: movement of the inner surfaces, net force, doubt; errors with truth."""
    row: dict[str, Any] = {
        "frame": frame,
        "rms_distance_m": result.rms_distance,
        "net_force_N": result.net_force.tolist(),
        "net_force_deviation_N": result.net_force_deviation.tolist(),
        "largest_displacement_m": float(np.linalg.norm(result.displacement, axis=1).max()),
        "seconds": result.seconds,
        "iterations": len(result.trace),
        "outcome": result.outcome.name.lower(),
        "verdict": result.judgement.verdict.value,
        "reasons": list(result.judgement.reasons),
        "noise_m": result.noise,
        "force_scale_N": result.force_scale,
        "outliers": result.outliers,
        "points": result.points,
        "targets": {
            name: {"movement_m": _mean_length(points.displace(result.displacement))} for name, points in targets.items()
        },
    }
    if truth is not None:
        row["error"] = asdict(target_errors(body.points + result.displacement, body.points + truth))
        for name, points in targets.items():
            moved, true = points.displace(result.displacement), points.displace(truth)
            row["targets"][name]["error_m"] = _mean_length(moved - true)
    return row


def _mean_length(vectors: Floats) -> float:
    return float(np.linalg.norm(vectors, axis=1).mean())


def describe(row: dict[str, Any]) -> str:
    """One line for a person: distance, net force with its doubt, time, and errors where the truth is known."""
    force, doubt = np.linalg.norm(row["net_force_N"]), np.linalg.norm(row["net_force_deviation_N"])
    line = (
        f"frame {row['frame']:3d}: cloud to surface {1e3 * row['rms_distance_m']:.2f} mm, "
        f"net force {force:.3f} ± {doubt:.3f} N, {1e3 * row['seconds']:.0f} ms"
    )
    if "error" in row:
        line += f", error {1e3 * row['error']['mean']:.2f} mm"
    for name, target in row["targets"].items():
        line += f", {name} moved {1e3 * target['movement_m']:.1f} mm"
    return line
