"""The main job on an embedded default: a liver phantom from its shape to registered clouds and a report."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.embedding import target_points
from softtwin.meshes.io import read_body
from softtwin.registration.result import Registration

from .chain import make_twin, prepare
from .config import Config
from .export import Exporter
from .record import NOTICE, Recorder
from .report import report_stage
from .twin import Frame, Twin, forward_models
from .workspace import Workspace, timed

Floats = NDArray[np.float64]
CAMERA = np.array([-0.3, -1.0, 0.25])  # from the organ towards the camera: the phantom's front, a little from above
POINTS = 1000
NOISE = 5e-4
DEMOS = {
    "surrogate": ("surrogate", "tool"),
    "surrogate-without-zone": ("surrogate", ""),
    "reference": ("reference", "tool"),
}


def quickstart_config(small: bool) -> Config:
    """The configuration of the quickstart; `small` goes the same way with less of everything."""
    loads = {"displacement": 0.03, "patches": 2, "radius": (0.15, 0.5)}
    if small:
        samples = {"train": 24, "validation": 8, "test": 8, "calibration": 12, "smooth": 8, "block": 4}
        body = {"source": "liver-phantom", "cell_size": 0.016}
        return Config.model_validate(
            # By epochs: what tests find must not depend on how busy the machine is.
            {"folder": ".", "body": body, "loads": loads, "samples": samples, "training": {"epochs": 200, "modes": 16}}
        )
    # Over in a minute and a half. A network half as wide takes steps half as dear; its error is a little larger.
    return Config.model_validate(
        {
            "folder": ".",
            "body": {"source": "liver-phantom", "cell_size": 0.0105},
            "loads": loads,
            "samples": {"train": 192, "validation": 24, "test": 32, "calibration": 32, "smooth": 24},
            "training": {"seconds": 25.0, "width": 128},
            "model_error": {"draws": 32},
        }
    )


def run_quickstart(output: Path, small: bool, say: Callable[[str], None]) -> Path:
    """The whole chain; returns the report.

    Args:
        output: folder of everything that is made; a finished stage in it is not made again.
        small: a coarse organ and few samples.
        say: prints a line.
    """
    say(f"softtwin quickstart: a liver phantom becomes a twin in {output}. {NOTICE}")
    space = prepare(quickstart_config(small), output)
    make_twin(space, output / "organ.toml", say)
    say("registration: a partial cloud of an unseen deformation")
    demo_stage(space, say)
    say("report: pictures and figures")
    with timed(space, "report"):
        path = report_stage(space)
    say(f"open {path}")
    return path


def demo_stage(space: Workspace, say: Callable[[str], None]) -> None:
    """Deform the organ by an unseen load, look at it from one side, and register what is seen, with both models."""
    folder = space.folder / "demo"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    body = read_body(space.body)
    with timed(space, "demo"):
        _demo(space, folder, body, say)


def _demo(space: Workspace, folder: Path, body: Body, say: Callable[[str], None]) -> None:
    with forward_models("reference", space.twin, body, space.config) as (reference, _):
        forces, zone = unseen_load(body, reference, space.config.loads.displacement)
        truth = reference.solve(forces).displacement
    cloud = partial_view(body, truth, CAMERA, POINTS, NOISE, np.random.default_rng(11), surface="observed")
    np.save(folder / "cloud.npy", cloud)
    np.save(folder / "truth.npy", truth)
    for name, error in _target_errors(body, np.zeros_like(truth), truth).items():
        say(f"    before: {name} {1e3 * error:.2f} mm away from where it is")
    held = body.with_sets(tool=zone)
    for name, (model, touched) in DEMOS.items():
        with forward_models(model, space.twin, held, space.config) as (forward, fast):
            result = _registered(Twin(forward, space.config, fast=fast), touched, cloud, truth, folder / name)
        np.savez(folder / f"{name}.npz", displacement=result.displacement, forces=result.forces, true_forces=forces)
        say(f"    after, with the {name.replace('-', ' ')}: {_outcome(body, result, truth, forces)}")


def unseen_load(body: Body, model: Any, displacement: float) -> tuple[Floats, NDArray[np.int64]]:
    """A pull on a patch of the observed side that no training load equals, and the wider zone a tool is known to touch.

    Args:
        body: the phantom.
        model: the reference, which scales the load to the displacement.
        displacement: largest displacement wanted, metres.
    """
    seen = np.setdiff1d(np.unique(body.surfaces["observed"]), body.fixed)
    # The point of the seen side farthest from what holds the organ moves most freely.
    distance = np.linalg.norm(body.points[seen][:, None] - body.points[body.fixed][None], axis=2).min(axis=1)
    centre = body.points[seen[np.argmax(distance)]]
    away = np.linalg.norm(body.points[seen] - centre, axis=1)
    tool, zone = seen[away < 0.03], seen[away < 0.05]
    forces = np.zeros_like(body.points)
    forces[tool] = np.array([0.25, -0.75, 0.6]) / len(tool)
    for _ in range(4):
        reached = np.linalg.norm(model.solve(forces).displacement, axis=1).max()
        forces *= 0.8 * displacement / reached
    return forces, zone


def _target_errors(body: Body, displacement: Floats, truth: Floats) -> dict[str, float]:
    return {
        name: float(np.linalg.norm(points.displace(displacement - truth), axis=1).mean())
        for name, points in target_points(body).items()
    }


def _registered(twin: Twin, zone: str, cloud: Floats, truth: Floats, folder: Path) -> Registration:
    """The cloud registered and written as any user's is."""
    result = twin.register(cloud, zone)
    with Recorder(Exporter(twin, folder), zone, twin.body.points + truth[None]) as recorder:
        recorder.add(Frame(0, result.judgement, result, result.seconds, cloud))
    return result


def _outcome(body: Body, result: Registration, truth: Floats, forces: Floats) -> str:
    errors = ", ".join(
        f"{key} {1e3 * value:.2f} mm" for key, value in _target_errors(body, result.displacement, truth).items()
    )
    net, true = np.linalg.norm(result.net_force), np.linalg.norm(forces.sum(axis=0))
    return (
        f"{result.judgement.verdict.value}; {errors}; net force {net:.2f} N, true {true:.2f} N; {result.seconds:.2f} s"
    )
