"""Makes app/twins/phantom, the small twin that `softtwin demo` shows, by the product's own chain; needs FEniCSx.

python ci/make_phantom.py            makes it anew (about two minutes on one core)
python ci/make_phantom.py --check    makes it in a temporary folder and says how far that is from the one that is there

Beside the twin lies truth.npz: equilibria of the reference under a load that goes around and that no training load
equals, which the page's simulated camera looks at.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

from softtwin.app.chain import make_twin, prepare
from softtwin.app.config import Config, to_toml
from softtwin.app.quickstart import unseen_load
from softtwin.app.stages.learn import calibrated
from softtwin.app.twin import find_twin, forward_models
from softtwin.app.workspace import Workspace
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.closest import polydata
from softtwin.meshes.io import read_body, write_body
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.calibration import coverage
from softtwin.surrogate.discrepancy import with_discrepancy
from softtwin.surrogate.evaluate import evaluate
from softtwin.surrogate.low_rank import compressed
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import load, save

PHANTOM = Path(__file__).resolve().parent.parent / "app" / "twins" / "phantom"
FILES = ("body.vtu", "organ.toml", "surrogate.json", "surrogate.safetensors", "truth.npz")
RANK, LOAD_MODES, ERROR_MODES = 12, 12, 4  # what fits into half a megabyte
STATES, TRUE_MODES = 24, 8  # equilibria once around, and the modes that they are kept in
VERTICES = 350  # of each inner surface
TOLERANCE = 1e-3  # relative: training sums its gradients in another order with other versions of torch
CONFIG = {
    "folder": ".",
    "body": {"source": "liver-phantom", "cell_size": 0.016},
    "loads": {"displacement": 0.03, "patches": 2, "radius": (0.15, 0.5)},
    "samples": {"train": 256, "validation": 16, "test": 32, "calibration": 40, "block": 8, "ranks": 1},
    "training": {"epochs": 2000, "modes": 16, "width": 48},
    "doubt": {"draws": 0},
}


def config() -> Config:
    """The configuration that the twin is made with."""
    return Config.model_validate(CONFIG)


def make(folder: Path, work: Path) -> None:
    """Make the twin.

    Args:
        folder: where its four files go.
        work: where everything is made.
    """
    space = prepare(config(), work)
    make_twin(space, work / "organ.toml", print)
    data = DataSet(space.data)
    small = measured(compressed(load(space.twin, read_body(space.body)), RANK, LOAD_MODES), data)
    folder.mkdir(parents=True, exist_ok=True)
    save(small, folder, single=True)
    write_body(folder / "body.vtu", light(read_body(space.body)))
    (folder / "organ.toml").write_text(to_toml(config()))
    np.savez(folder / "truth.npz", **around(space))


def around(space: Workspace) -> dict[str, Any]:
    """Equilibria of the reference once around: displacements as modes (3n, m) times coefficients (s, m), metres.

    Two patches of the seen side are pulled and pushed, the second twice as often as the first; at the start both are
    let go. Net forces, (s, 3), newtons, go with them.
    """
    body = read_body(space.body)
    with forward_models("reference", space.twin, body, space.config) as (reference, _):
        pull, _ = unseen_load(body, reference, space.config.loads.displacement)
        push = _push(body, reference)
        angles = 2.0 * np.pi * np.arange(STATES) / STATES
        loads = [0.5 * (1 - np.cos(a)) * pull + 0.5 * (1 - np.cos(2 * a)) * push for a in angles]
        moved = np.array([reference.solve(load_).displacement.ravel() for load_ in loads])
    left, sizes, right = np.linalg.svd(moved, full_matrices=False)
    coefficients, modes = (left * sizes)[:, :TRUE_MODES], right[:TRUE_MODES].T
    off = np.abs(coefficients @ modes.T - moved).max()
    print(f"truth: {STATES} equilibria, up to {1e3 * np.abs(moved).max():.1f} mm, kept to {1e3 * off:.3f} mm")
    net = np.array([load_.sum(axis=0) for load_ in loads])
    return {name: array.astype(np.float32) for name, array in
            {"modes": modes, "coefficients": coefficients, "net_forces": net}.items()}  # fmt: skip


def _push(body: Body, reference: Any) -> Any:
    """A push backwards on the lobe at the other end of the seen side, that moves a node by 12 mm."""
    seen = np.setdiff1d(np.unique(body.surfaces["observed"]), body.fixed)
    place = body.points[seen]
    centre = place[np.argmin(place[:, 0])]
    patch = seen[np.linalg.norm(place - centre, axis=1) < 0.035]
    forces = np.zeros_like(body.points)
    forces[patch] = np.array([0.2, 0.6, 0.3]) / len(patch)
    for _ in range(4):
        forces *= 0.012 / np.linalg.norm(reference.solve(forces).displacement, axis=1).max()
    return forces


def measured(surrogate: Surrogate, data: DataSet) -> Surrogate:
    """The surrogate with patterns of error, a certificate and held-out errors of its own; no machine is named."""
    known = calibrated(with_discrepancy(surrogate, data, ERROR_MODES), data)
    card: dict[str, Any] = dict(known.card)
    card["held_out"] = _without_time(evaluate(known, data).as_dict())
    card["certificate"] = {**card["certificate"], "held_out": coverage(known, data).as_dict()}
    card["data"] = {name: entry for name, entry in card["data"].items() if name != "path"}
    card["training"] = _without_time(card["training"])
    return known.with_card(**card)


def _without_time(entries: dict[str, Any]) -> dict[str, Any]:
    return {name: entry for name, entry in entries.items() if "seconds" not in name and "time" not in name}


def light(body: Body) -> Body:
    """The body with coarser inner surfaces, which is what a page draws thirty times a second."""
    return replace(body, inner={name: thinner(surface) for name, surface in body.inner.items()})


def thinner(surface: Surface) -> Surface:
    """The surface with about `VERTICES` vertices (Garland and Heckbert 1997, as VTK has it)."""
    chosen = vtkQuadricDecimation()
    chosen.SetInputData(polydata(surface))
    chosen.SetTargetReduction(max(0.0, 1.0 - VERTICES / len(surface.points)))
    chosen.Update()
    found = chosen.GetOutput()
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64)
    return Surface(points, vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64))


def distance(one: Path, other: Path) -> float:
    """Largest difference of two twins' predictions under the same loads, relative to the largest displacement.

    Raises:
        SystemExit: their bodies differ.
    """
    homes = [find_twin(folder) for folder in (one, other)]
    bodies = [home.body for home in homes]
    if bodies[0].fingerprint != bodies[1].fingerprint:
        sys.exit("error: the bodies differ; make the twin anew")
    pair = [load(home.folder, home.body) for home in homes]
    forces = np.zeros((4, *bodies[0].points.shape))
    loaded = pair[0].encoder_decoder.loaded
    modes = pair[0].encoder_decoder.load_modes
    assert modes is not None
    forces[:, loaded] = modes[:, :4].T.reshape(4, -1, 3)
    moved = np.array([[twin.solve(load_).displacement for load_ in forces] for twin in pair])
    return float(np.abs(moved[0] - moved[1]).max() / np.abs(moved[0]).max())


def main(check: bool, kept: str = "") -> int:
    """Makes or checks; 1 where the check fails."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(kept or name)
        folder = work / "phantom" if check else PHANTOM
        if not check:
            shutil.rmtree(PHANTOM, ignore_errors=True)
        make(folder, work / "work")
        if check:
            found = distance(PHANTOM, folder)
            print(f"phantom: predictions differ by {found:.1e} of the largest displacement, {TOLERANCE:.0e} allowed")
            return int(found > TOLERANCE)
    for file in FILES:
        print(f"{(PHANTOM / file).stat().st_size:8d} bytes  {file}")
    errors = json.loads((PHANTOM / "surrogate.json").read_text())["held_out"]
    print(f"mean nodal error {1e3 * errors['nodal_error']['mean']:.2f} mm")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing that is there")
    sys.exit(main(parser.parse_args().check, os.environ.get("PHANTOM_WORK", "")))
