"""A bar that lies on springs alone: from its configuration to registrations by all engines."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.chain import build_twin
from softtwin.app.config import Config, ConfigError, parse_config, read_config, to_toml
from softtwin.app.inputs import mesh_inputs
from softtwin.app.report import report_stage
from softtwin.app.stages.learn import train_stage
from softtwin.app.stages.mesh import mesh_stage
from softtwin.app.twin import Twin
from softtwin.app.workspace import Workspace
from softtwin.meshes.body import Body, BodyError
from softtwin.meshes.clouds import partial_view
from softtwin.meshes.io import write_body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.inputs import Inputs
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.data.springs import Ligament, Springs
from softtwin.reference.solve.problem import Problem
from softtwin.surrogate.model import Surrogate

pytestmark = pytest.mark.fenicsx
BED = Springs(normal=6e4, tangential=2e4)
ENTRIES: dict[str, Any] = {
    "folder": ".",
    "body": {"source": "bar.vtu", "zones": {"tool": "box:0.3,-1,-1:1,1,1"}},
    "springs": {
        "where": {"bed": "halfspace:0,0,1e-6:0,0,-1"},
        "normal": {"bed": BED.normal},
        "tangential": {"bed": BED.tangential},
    },
    "loads": {"modes": 4, "displacement": 0.03},
    "samples": {"train": 48, "validation": 4, "test": 8, "block": 4, "ranks": 1},
    "training": {"modes": 16, "width": 32, "seconds": 5.0},
}


def config(**sections: Any) -> Config:
    return Config.model_validate({**ENTRIES, **sections})


def bar() -> Body:
    made = beam((6, 2, 2), (0.4, 0.1, 0.1), "tetrahedron")
    low = made.points - made.points.min(axis=0)
    return Body(low, made.cells, {})


def workspace(folder: Path, **sections: Any) -> Workspace:
    write_body(folder / "bar.vtu", bar())
    return Workspace(config(**sections), folder)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("springs")
    workspace(folder)
    build_twin(config(), folder, lambda _: None)
    return folder


def test_the_configuration_keeps_them(tmp_path: Path) -> None:
    (tmp_path / "organ.toml").write_text(to_toml(config()))
    found, _ = read_config(tmp_path / "organ.toml")
    assert found.supports == {"bed": BED}


def test_ligaments_are_read_on_the_axes_of_the_files() -> None:
    given = {**ENTRIES["springs"], "ligaments": {"cord": "1,-2,3cm to 1,-2,30cm"}, "stiffness": {"cord": 40.0}}
    assert config(springs=given).supports["cord"] == Ligament((0.01, -0.02, 0.03), (0.01, -0.02, 0.3), 40.0)
    ras = config(springs=given, body={**ENTRIES["body"], "frame": "ras"}).supports["cord"]
    assert ras == Ligament((-0.01, 0.02, 0.03), (-0.01, 0.02, 0.3), 40.0)


def test_a_twin_knows_its_ligament(built: Path, tmp_path: Path) -> None:
    """The reference and torch, from one configuration."""
    (tmp_path / "body.vtu").write_bytes((built / "body.vtu").read_bytes())
    given = {**ENTRIES["springs"], "ligaments": {"cord": "0.4,0.05,0.1 to 0.4,0.05,0.3"}, "stiffness": {"cord": 60.0}}
    (tmp_path / "organ.toml").write_text(to_toml(config(springs=given)))
    found = []
    for model in ("reference", "torch"):
        with Twin.open(tmp_path, model) as twin:
            forces = np.zeros_like(twin.body.points)
            forces[twin.body.node_sets["tool"], 2] = -0.05
            found.append(twin.predict(forces).displacement)
    with Twin.open(built / "twin", "reference") as twin:
        without = twin.predict(forces).displacement
    np.testing.assert_allclose(found[0], found[1], atol=1e-5 * np.abs(found[0]).max())
    assert np.abs(found[0] - without).max() > 0.05 * np.abs(without).max()


def test_data_and_twin_are_of_a_body_on_springs(built: Path) -> None:
    data = DataSet(built / "data.zarr")
    assert data.springs == {"bed": BED}
    samples = data.samples("test")
    forces = np.zeros_like(data.body.points)
    forces[data.response.loaded] = samples.forces[0]
    with Problem(data.body, data.material, springs={"bed": BED}) as problem:
        state = problem.solve(forces).displacement
    np.testing.assert_allclose(samples.displacements[0], state, atol=1e-6 * np.abs(state).max())
    with Twin.open(built / "twin") as twin:
        missed = np.linalg.norm(twin.predict(forces).displacement - state, axis=1).mean()
        rest = twin.predict(np.zeros_like(forces)).displacement
    assert missed < 0.1 * np.linalg.norm(state, axis=1).mean()
    assert not rest.any()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_the_report_shows_what_holds_it(built: Path) -> None:
    """Without a fixed node there is nothing to look away from."""
    page = report_stage(Workspace(config(), built), ()).read_text()
    assert "springs bed (mesh lines)" in page
    assert "0 fixed nodes" not in page


def test_all_engines_register_it(built: Path) -> None:
    with Twin.open(built / "twin", "reference") as twin:
        body = twin.body
        forces = np.zeros_like(body.points)
        tool = body.node_sets["tool"]
        forces[tool] = np.array([0.1, 0.3, 0.6]) / len(tool)
        truth = twin.predict(forces).displacement
    assert np.linalg.norm(truth, axis=1).max() > 5e-3
    cloud = partial_view(body, truth, (0.2, -1.0, 0.4), 600, 3e-4, np.random.default_rng(0))
    errors = {}
    for model in ("surrogate", "hybrid", "reference", "torch"):
        with Twin.open(built / "twin", model, zone="tool") as twin:
            found = twin.register(cloud)
        errors[model] = np.linalg.norm(found.displacement - truth, axis=1).mean()
    assert max(errors.values()) < 6e-4, errors
    assert abs(errors["reference"] - errors["torch"]) < 1e-6
    assert abs(errors["reference"] - errors["hybrid"]) < 1e-5


def on_other_springs(built: Path, factor: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Known forces, the state under them on springs so many times as stiff, and a cloud of it."""
    with Twin.open(built / "twin", "reference") as twin:
        body, tool = twin.body, twin.body.node_sets["tool"]
    forces = np.zeros_like(body.points)
    forces[tool] = np.array([0.5, 0.2, 1.5]) / len(tool)
    true = {"bed": Springs(factor * BED.normal, factor * BED.tangential)}
    with Problem(body, NeoHookean(5000.0, 0.45), springs=true) as problem:
        truth = problem.solve(forces).displacement
    return forces, truth, partial_view(body, truth, (0.2, -1.0, 0.4), 600, 3e-4, np.random.default_rng(seed))


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_stiffness_is_found_where_forces_are_known(built: Path, tmp_path: Path, factor: float) -> None:
    forces, truth, cloud = on_other_springs(built, factor, 0)
    np.save(tmp_path / "forces.npy", forces)
    known = {"forces": "known", "known_forces": str(tmp_path / "forces.npy"), "parameters": ["springs@bed=1"]}
    with Twin.open(built / "twin", "reference", **known) as twin:
        found = twin.register(cloud)
    (stiffness,) = found.estimates
    assert stiffness.name == "stiffness of the springs bed"
    low, high = stiffness.interval
    assert low / 1.05 < factor < 1.05 * high
    assert high / low < 1.5
    assert np.linalg.norm(found.displacement - truth, axis=1).mean() < 2e-4


def test_engines_agree_on_it_where_forces_are_unknown(built: Path) -> None:
    """Forces and springs trade places, and the prior decides: exact engines say the same, the state is right."""
    _, truth, cloud = on_other_springs(built, 0.5, 0)
    values = {}
    for model in ("reference", "torch", "hybrid"):
        with Twin.open(built / "twin", model, zone="tool", parameters=["springs@bed=1"]) as twin:
            found = twin.register(cloud)
        assert np.linalg.norm(found.displacement - truth, axis=1).mean() < 6e-4
        values[model] = found.estimates[0].value
        low, high = found.estimates[0].interval
    assert values["torch"] == pytest.approx(values["reference"], rel=1e-3)
    assert low < values["reference"] < high  # hybrid's, whose noise and force scale are those of the network's search


@pytest.fixture(scope="module")
def galerkin(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same equilibria, of which the Galerkin model makes a twin that knows a range of stiffness."""
    folder = tmp_path_factory.mktemp("galerkin") / "out"
    shutil.copytree(built, folder)
    training = {"architecture": "galerkin", "vary": {"springs@bed": (0.3, 3.0)}}
    train_stage(Workspace(config(training=training), folder), fresh=True)
    (folder / "organ.toml").write_text(to_toml(config(training=training)))
    (folder / "twin" / "organ.toml").write_text(to_toml(config(training=training)))
    return folder


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_surrogate_may_know_their_stiffness_as_an_input(galerkin: Path, factor: float) -> None:
    """States and registrations are those of torch, and far from those of the stiffness that is expected."""
    forces, truth, cloud = on_other_springs(galerkin, factor, 0)
    with Twin.open(galerkin / "twin") as twin:
        assert isinstance(twin.network, Surrogate)
        ways = [twin.network.solve(forces, inputs=Inputs(springs={"bed": each})) for each in (factor, 1.0, 4.0)]
        assert ways[0].extrapolation_ratio <= ways[2].extrapolation_ratio and ways[2].extrapolation_ratio > 1.0
    missed = [np.linalg.norm(way.displacement - truth) / np.linalg.norm(truth) for way in ways[:2]]
    assert missed[0] < 0.1 * missed[1] and missed[1] > 0.3
    values = {}
    for model in ("surrogate", "torch"):
        with Twin.open(galerkin / "twin", model, zone="tool", parameters=["springs@bed=1"]) as twin:
            found = twin.register(cloud)
        assert np.linalg.norm(found.displacement - truth, axis=1).mean() < 6e-4
        values[model] = found.estimates[0]
    assert values["surrogate"].name == "stiffness of the springs bed"
    low, high = values["torch"].interval
    assert low < values["surrogate"].value < high


def test_a_stiffness_that_a_surrogate_does_not_know_is_said(built: Path) -> None:
    with pytest.raises(ConfigError, match="expected reference or hybrid or torch with springs@bed"):
        Twin.open(built / "twin", "surrogate", parameters=["springs@bed"])
    training = {"architecture": "galerkin", "vary": {"springs@roof": (0.5, 2.0)}}
    with pytest.raises(ValueError, match=r"training.vary: expected springs@ one of \['bed'\], got 'springs@roof'"):
        config(training=training)


def test_springs_that_are_not_there_cannot_be_found(built: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected springs@ one of \['bed'\], got 'roof'"):
        Twin.open(built / "twin", "reference", parameters=["springs@roof"])


def test_another_stiffness_is_another_twin(built: Path) -> None:
    card = built / "twin" / "organ.toml"
    before = card.read_text()
    try:
        card.write_text(before.replace("bed = 60000.0", "bed = 50000.0"))
        assert card.read_text() != before
        with pytest.raises(ConfigError, match=r"organ\.toml was changed after the twin was made: springs"):
            Twin.open(built / "twin")
    finally:
        card.write_text(before)


def test_where_they_are_is_an_input_of_the_mesh(tmp_path: Path) -> None:
    space = workspace(tmp_path)
    body = mesh_stage(space)
    heights = body.points[body.surfaces["bed"]][..., 2]
    assert len(heights) > 0 and heights.max() < 1e-6
    assert not len(body.fixed)
    other = workspace(tmp_path, springs={**ENTRIES["springs"], "where": {"bed": "halfspace:0,0,0.02:0,0,-1"}})
    assert mesh_inputs(space) != mesh_inputs(other)
    assert mesh_inputs(Workspace(Config(), tmp_path)).keys() == mesh_inputs(Workspace(Config(), tmp_path)).keys()


@pytest.mark.parametrize(
    ("springs", "said"),
    [
        ({"where": {"bed": "x"}, "normal": {"bd": 1.0}}, r"springs\.normal: expected names of springs\.where"),
        ({"where": {"bed": "x"}}, "expected a stiffness above 0"),
        ({"where": {"bed": "x"}, "normal": {"bed": -1.0}}, r"Springs\.normal: expected a stiffness of 0"),
        ({"ligaments": {"cord": "0,0,0 to 0,0,1"}}, r"springs\.stiffness: expected one for the ligament 'cord'"),
        ({"ligaments": {"cord": "0,0,0"}, "stiffness": {"cord": 1.0}}, "expected X,Y,Z to X,Y,Z, got '0,0,0'"),
        ({"ligaments": {"cord": "0,0 to 0,0,1"}, "stiffness": {"cord": 1.0}}, "cord|0,0"),
        ({"slack": {"cord": 1.0}}, r"springs\.slack: expected names of springs\.ligaments"),
        ({"where": {"observed": "x"}, "normal": {"observed": 1.0}}, "a name of its own, got 'observed'"),
    ],
)
def test_what_does_not_belong_together_is_said(springs: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse_config({"springs": springs})


def test_a_place_without_surface_is_said(tmp_path: Path) -> None:
    away = {**ENTRIES["springs"], "where": {"bed": "ball:5,5,5:0.01"}}
    with pytest.raises((BodyError, ValueError), match=r"bed|ball"):
        mesh_stage(workspace(tmp_path, springs=away))
    grid = {**ENTRIES["body"], "grid": 0.02}
    with pytest.raises(ConfigError, match="expected none on a grid"):
        mesh_stage(workspace(tmp_path, body=grid))


def test_nothing_that_holds_is_said(tmp_path: Path) -> None:
    with pytest.raises(BodyError, match=r"body\.fixed: expected what holds the organ"):
        mesh_stage(workspace(tmp_path, springs={}))
    with Problem(bar(), NeoHookean(3000.0, 0.4), held={}, springs={"boundary": BED}) as problem:
        assert problem.solve(np.zeros_like(problem.body.points)).is_stable
