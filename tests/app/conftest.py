"""The command line as a function, and a twin that needs neither torch nor FEniCSx."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from own_forward_model import Cantilever

from softtwin.app.cli import main
from softtwin.app.config import Config, to_toml
from softtwin.app.twin import Twin
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.io import write_body
from softtwin.meshes.shapes import beam


def run(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> str:
    """Output and errors of a command that ends with the code."""
    try:
        main([str(argument) for argument in arguments])
        ended = 0
    except SystemExit as stop:
        ended = int(stop.code or 0)
    captured = capsys.readouterr()
    assert ended == code, captured.out + captured.err
    return captured.out + captured.err


@pytest.fixture(scope="session")
def seen_body() -> Body:
    """A beam that a camera sees from above, from the side and at its end, with a tumour in it."""
    bare = beam((10, 3, 3), (0.30, 0.06, 0.06), "tetrahedron")
    corners = bare.points[bare.boundary]
    seen = (corners > [0.2999, 0.0599, 0.0599]).all(axis=1).any(axis=1)
    vertices = np.array([[0.20, 0.02, 0.02], [0.24, 0.02, 0.02], [0.22, 0.04, 0.02], [0.22, 0.03, 0.04]])
    tumour = Surface(vertices, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    return replace(bare, surfaces={"observed": bare.boundary[seen]}, inner={"tumour": tumour})


def pulled(body: Body, force: tuple[float, float, float]) -> np.ndarray:
    """A net force spread evenly over the tip, (n, 3), newtons."""
    forces = np.zeros_like(body.points)
    forces[body.node_sets["tip"]] = np.array(force) / len(body.node_sets["tip"])
    return forces


def seen_cloud(twin: Twin, forces: np.ndarray, noise: float = 5e-4, seed: int = 0) -> np.ndarray:
    """What a camera sees of the twin's body under forces, (400, 3), metres."""
    rng = np.random.default_rng(seed)
    return partial_view(twin.body, twin.predict(forces).displacement, (1.0, 1.0, 1.0), 400, noise, rng, "observed")


@pytest.fixture(scope="session")
def plain_twin(seen_body: Body) -> Twin:
    """A twin with a linear model."""
    return Twin(Cantilever(seen_body), Config.model_validate({"registration": {"zone": "tip"}}))


@pytest.fixture
def mesh_folder(tmp_path: Path, seen_body: Body) -> Path:
    """A folder that the reference can register: body and configuration, no network."""
    folder = tmp_path / "twin"
    folder.mkdir()
    write_body(folder / "body.vtu", seen_body)
    (folder / "organ.toml").write_text(to_toml(Config()))
    return folder
