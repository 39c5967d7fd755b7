"""The stages of a twin, each from the configuration and what the stage before left in the folder."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtwin.meshes.body import Body, BodyError
from softtwin.meshes.embedding import embed
from softtwin.meshes.files import FileError, read_body, read_cloud, read_mesh, read_surface, write_body
from softtwin.meshes.metrics import edge_lengths, mesh_quality
from softtwin.meshes.shapes import beam, liver_phantom, propeller
from softtwin.meshes.solidify import repair, solidify
from softtwin.reference.dataset import DataSet
from softtwin.reference.loads import LoadPlan

from .config import BodySection, Config, ConfigError, read_config

Ints = NDArray[np.int64]
_JOB_VARIABLES = ("PMIX_", "ORTE_", "OMPI_MCA_orte", "OMPI_MCA_ess", "OMPI_COMM_", "OMPI_UNIVERSE", "OMPI_APP_CTX")
SHAPES: dict[str, Callable[..., Body]] = {"liver-phantom": liver_phantom, "propeller": propeller, "beam": beam}


@dataclass(frozen=True)
class Workspace:
    """Where everything of one twin lies.

    Args:
        config: the configuration.
        root: folder that relative paths of the configuration start from.
    """

    config: Config
    root: Path

    @property
    def folder(self) -> Path:
        """Everything that the stages make."""
        return self.root / self.config.folder

    @property
    def body(self) -> Path:
        """The meshed body."""
        return self.folder / "body.vtu"

    @property
    def data(self) -> Path:
        """The data set."""
        return self.folder / "data.zarr"

    @property
    def training(self) -> Path:
        """Checkpoints."""
        return self.folder / "training"

    @property
    def twin(self) -> Path:
        """The finished twin."""
        return self.folder / "twin"


def open_workspace(path: Path | str) -> Workspace:
    """The workspace of a configuration file.

    Raises:
        ConfigError: see `read_config`.
    """
    config, root = read_config(path)
    return Workspace(config, root)


@contextmanager
def timed(space: Workspace, stage: str) -> Iterator[None]:
    """Record how long a stage took, beside its results."""
    begin = time.perf_counter()
    yield
    path = space.folder / "stages.json"
    stages = json.loads(path.read_text()) if path.exists() else {}
    stages[stage] = {"seconds": round(time.perf_counter() - begin, 2), "finished": time.strftime("%Y-%m-%d %H:%M:%S")}
    path.write_text(json.dumps(stages, indent=1) + "\n")


# ------------------------------------------------------------------ mesh


def mesh_stage(space: Workspace) -> Body:
    """Make the body and write it.

    Raises:
        FileError, SurfaceError, BodyError, ConfigError: what is wrong with the input.
    """
    space.folder.mkdir(parents=True, exist_ok=True)
    with timed(space, "mesh"):
        body = make_body(space.config.body, space.root)
        write_body(space.body, body)
        (space.folder / "mesh_quality.txt").write_text(str(mesh_quality(body)) + "\n")
    return body


def make_body(section: BodySection, root: Path) -> Body:
    """The body that a configuration describes.

    Args:
        section: the configuration's [body].
        root: folder that relative paths start from.
    """
    if section.source in SHAPES:
        body = SHAPES[section.source](**({"cell_size": section.cell_size} if _takes_size(section) else {}))
        return _with_zones(body, section, root)
    points, cells = _solid(section, root)
    if not section.fixed:
        raise BodyError(
            "body.fixed: expected what holds the organ, got nothing; without it the organ has no equilibrium. Give "
            "--fixed FILE (points or triangles near the attachment, or .npy/.txt with node numbers)."
        )
    bare = Body(points, cells, {"fixed": np.arange(len(points) - 1)})
    fixed = _nodes_from(bare, "body.fixed", root / section.fixed, section)
    body = Body(points, cells, {"fixed": _attached(bare, fixed)})
    return _with_zones(body, section, root)


def _takes_size(section: BodySection) -> bool:
    return section.cell_size > 0.0 and section.source != "beam"


def _solid(section: BodySection, root: Path) -> tuple[NDArray[np.float64], Ints]:
    found = read_mesh(root / section.source, section.unit)
    if isinstance(found, tuple):
        return found
    surface = repair(found) if section.repair else found
    if section.cell_size > 0.0:
        return solidify(surface, cell_size=section.cell_size)
    return solidify(surface, node_count=section.nodes)


def _attached(bare: Body, nodes: Ints) -> Ints:
    """The given nodes that belong to a boundary triangle given whole: an attachment is a surface, not a lone node."""
    whole = bare.boundary[np.isin(bare.boundary, nodes).all(axis=1)]
    if len(whole) == 0:
        raise BodyError(
            f"body.fixed: expected fixed nodes that cover part of the surface, got {len(nodes)} nodes that span no "
            "whole boundary triangle; enlarge fixed_distance or give more of the attachment."
        )
    return np.unique(whole)


def _nodes_from(body: Body, name: str, path: Path, section: BodySection) -> Ints:
    """Node numbers from a file of numbers, or the boundary nodes near the points of a file."""
    numbers = _read_numbers(path)
    if numbers is not None:
        if numbers.size and (numbers.min() < 0 or numbers.max() >= len(body.points)):
            raise BodyError(
                f"{name}: expected node numbers in 0..{len(body.points) - 1}, "
                f"got {numbers.min()}..{numbers.max()} in {path}."
            )
        return np.unique(numbers)
    near = section.fixed_distance or float(np.median(edge_lengths(body.points, body.cells)))
    distances, _ = cKDTree(read_cloud(path, section.unit)).query(body.points[body.boundary_nodes])
    nodes = body.boundary_nodes[distances <= near]
    if len(nodes) == 0:
        raise BodyError(
            f"{name}: no boundary node lies within {1e3 * near:.1f} mm of the points in {path} "
            f"(the nearest is {1e3 * distances.min():.1f} mm away). Same unit and axes? Else raise fixed_distance."
        )
    return nodes


def _read_numbers(path: Path) -> Ints | None:
    """Node numbers if the file holds whole numbers in one column, else None."""
    if not path.is_file():
        raise FileError(f"{path}: expected a file, found none.")
    try:
        values = (
            np.load(path) if path.suffix == ".npy" else np.loadtxt(path, ndmin=1) if path.suffix == ".txt" else None
        )
    except ValueError:
        return None
    if values is None or values.ndim != 1 or not np.array_equal(values, np.round(values)):
        return None
    return values.astype(np.int64)


def _with_zones(body: Body, section: BodySection, root: Path) -> Body:
    zones = {
        name: _nodes_from(body, f"body.zones.{name}", root / file, section) for name, file in section.zones.items()
    }
    body = body.with_sets(**zones)
    inner = {name: read_surface(root / file, section.unit) for name, file in section.inner.items()}
    body = body.with_inner(**inner)
    if not section.observed:
        return body
    return Body(
        body.points,
        body.cells,
        body.node_sets,
        {**body.surfaces, "observed": _observed(body, root / section.observed, section)},
        body.inner,
    )


def _observed(body: Body, path: Path, section: BodySection) -> Ints:
    if path.suffix == ".npy":
        return np.load(path)
    near = section.fixed_distance or float(np.median(edge_lengths(body.points, body.cells)))
    distances, _ = cKDTree(read_surface(path, section.unit).points).query(body.points[body.boundary].mean(axis=1))
    if not (distances <= near).any():
        raise ConfigError(f"body.observed: no boundary triangle lies within {1e3 * near:.1f} mm of {path}.")
    return body.boundary[distances <= near]


# ------------------------------------------------------------------ generate


def load_plan(config: Config) -> LoadPlan:
    """How loads are drawn, from the configuration."""
    loads = config.loads
    return LoadPlan(
        kind=loads.kind,
        modes=loads.modes,
        zones=loads.zones,
        patches=loads.patches,
        radius=loads.radius,
        displacement=loads.displacement,
        amplitude=loads.amplitude or None,
    )


def generate_stage(space: Workspace, redo: tuple[int, ...] = ()) -> DataSet | None:
    """Solve the equilibria of the data set; collective where mpirun started it. Returns None on ranks other than 0.

    Raises:
        ConfigError: there is no body yet.
        DataSetError: the folder holds a data set of another configuration.
    """
    from softtwin.reference.dataset import drop_block  # FEniCSx is needed by this stage alone
    from softtwin.reference.equilibrium import NewtonOptions
    from softtwin.reference.fenicsx import MPI
    from softtwin.reference.generate import Plan, generate

    if not space.body.exists():
        raise ConfigError(f"generate: expected the body in {space.body}, found none; run `softtwin mesh` first.")
    samples, material = space.config.samples, space.config.material
    plan = Plan(
        material=material.law,
        young_modulus=material.young_modulus,
        poisson_ratio=material.poisson_ratio,
        loads=load_plan(space.config),
        samples={"train": samples.train, "validation": samples.validation, "test": samples.test},
        block=samples.block,
        path=samples.path,
        seed=samples.seed,
        newton=NewtonOptions(**space.config.solver.model_dump()),
    )
    if MPI.COMM_WORLD.rank == 0:
        for block in redo:
            drop_block(space.data, block)
    with timed(space, "generate") if MPI.COMM_WORLD.rank == 0 else nullcontext():
        return generate(space.data, read_body(space.body), plan)


def generate_in_parallel(config_path: Path, ranks: int) -> None:
    """Run the generate stage under mpirun, or here where there is one core or no mpirun.

    Raises:
        RuntimeError: the stage failed; its own message stands above.
    """
    ranks = ranks or os.cpu_count() or 1
    if ranks == 1 or shutil.which("mpirun") is None:
        generate_stage(open_workspace(config_path))
        return
    # A caller that runs MPI itself hands down the names of its own job, which mpirun would take for its.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_JOB_VARIABLES)}
    environment["OPENBLAS_NUM_THREADS"] = "1"
    if sys.stderr.isatty():
        environment["SOFTTWIN_PROGRESS"] = "1"
    if os.geteuid() == 0:
        environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    program = [sys.executable, "-m", "softtwin.app.cli", "generate", str(config_path)]
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), *program]
    done = subprocess.run(command, env=environment, check=False)
    if done.returncode != 0:
        raise RuntimeError(
            f"generate: mpirun ended with code {done.returncode}; its message stands above. What was solved is kept: "
            f"run `softtwin generate {config_path}` again to go on."
        )


# ------------------------------------------------------------------ target points of the inner surfaces


def target_points(body: Body) -> dict[str, Any]:
    """Embeddings of the vertices of the inner surfaces, by name: what target errors are measured at."""
    return {name: embed(body, surface.points) for name, surface in body.inner.items()}
