"""An organ that hangs in its scan: lying still it stays, turned over it goes where the body without stress goes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.app.config import ConfigError, parse_config
from softtwin.app.scenario import Scenario
from softtwin.app.twin import Twin
from softtwin.meshes.body import Body
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import write_body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Problem
from softtwin.reference.unloaded import moved_body
from softtwin.registration.verdict import Verdict

pytestmark = pytest.mark.fenicsx
GRAVITY, DENSITY, MODULUS, RATIO = 9.81, 1060.0, 2e5, 0.45
PRONE = np.array([0.0, 0.0, -GRAVITY])
TURNED = {"scan_gravity": tuple(PRONE), "gravity": tuple(-2.0 * PRONE)}


@pytest.fixture(scope="module")
def free() -> Body:
    """The body without stress, which nobody has seen."""
    return beam((10, 3, 3), (0.3, 0.08, 0.08), "tetrahedron")


@pytest.fixture(scope="module")
def problem(free: Body) -> Problem:
    return Problem(free, NeoHookean(MODULUS, RATIO))


@pytest.fixture(scope="module")
def scanned(problem: Problem, free: Body) -> Body:
    return moved_body(free, problem.solve(Loading(body_force=DENSITY * PRONE)).displacement)


@pytest.fixture(scope="module")
def folder(scanned: Body, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("scan")
    write_body(place / "body.vtu", scanned)
    (place / "organ.toml").write_text(f"[material]\nyoung_modulus = {MODULUS}\npoisson_ratio = {RATIO}\n")
    return place


def test_without_a_change_nothing_moves(folder: Path) -> None:
    with Twin.open(folder, model="reference", scan_gravity=tuple(PRONE)) as twin:
        state = twin.predict(np.zeros_like(twin.body.points))
    np.testing.assert_allclose(state.displacement, 0.0, atol=1e-6)


def test_turned_over_it_goes_where_the_true_one_goes(problem: Problem, scanned: Body, folder: Path) -> None:
    free = problem.body
    forces = np.zeros_like(free.points)
    forces[free.node_sets["tip"], 1] = 0.05
    load = Loading(forces, body_force=-DENSITY * PRONE)
    wanted = free.points + problem.solve(load).displacement - scanned.points
    size = np.linalg.norm(wanted, axis=1).max()
    assert size > 0.02
    with Twin.open(folder, model="reference", **TURNED) as twin:
        state = twin.predict(forces)
        np.testing.assert_allclose(state.displacement, wanted, atol=1e-3 * size)
        change = np.zeros_like(forces)
        change[free.node_sets["tip"], 2] = 1e-3
        ahead, behind = (twin.model.solve(forces + sign * change, state).displacement for sign in (1.0, -1.0))
        pushed = state.jvp(change.reshape(-1, 1))[:, 0]
        np.testing.assert_allclose(pushed, (ahead - behind).ravel() / 2.0, atol=2e-3 * np.abs(pushed).max())
    ignoring = {"gravity": TURNED["gravity"]}
    with Twin.open(folder, model="reference", **ignoring) as twin:
        missed = np.linalg.norm(twin.predict(forces).displacement - wanted, axis=1).max()
    assert missed > 0.01 * size  # ten times as much


def test_a_cloud_of_it_is_registered(problem: Problem, scanned: Body, folder: Path) -> None:
    """Forces, nodes and verdict: those of the weight are no part of the net force."""
    free, rng = problem.body, np.random.default_rng(0)
    forces = np.zeros_like(free.points)
    forces[free.node_sets["tip"], 1] = 0.5 / len(free.node_sets["tip"])
    moved = free.points + problem.solve(Loading(forces, body_force=-DENSITY * PRONE)).displacement
    triangles = free.boundary[rng.integers(len(free.boundary), size=800)]
    cloud = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), size=800), moved[triangles])
    cloud += 5e-4 * rng.standard_normal(cloud.shape)
    with Twin.open(folder, model="reference", zone="tip", **TURNED) as twin:
        found = twin.register(cloud)
        margin = found.uncertainty.margin()
    errors = np.linalg.norm(scanned.points + found.displacement - moved, axis=1)
    assert found.judgement.verdict is Verdict.ACCEPTED, found.judgement.reasons
    assert errors.mean() < 2e-4
    assert (errors < margin).mean() > 0.9
    missed = found.net_force - forces.sum(axis=0)
    assert missed @ np.linalg.solve(found.net_force_covariance, missed) < chi2.ppf(0.999, 3)
    assert (
        np.sqrt(np.trace(found.net_force_covariance)) < 0.1 * DENSITY * GRAVITY * free.volume
    )  # which is no part of it


def test_an_organ_that_could_not_hang_so_is_refused(folder: Path, tmp_path: Path) -> None:
    write_body(tmp_path / "body.vtu", beam((12, 2, 2), (1.0, 0.1, 0.1), "tetrahedron"))
    (tmp_path / "organ.toml").write_text("[material]\nyoung_modulus = 2000.0\n")
    with pytest.raises(ConfigError, match=r"registration\.scan_gravity: unloaded: no stress-free shape was found"):
        Twin.open(tmp_path, model="reference", scan_gravity=tuple(PRONE))


def test_what_cannot_go_with_it_is_said() -> None:
    gravity = list(PRONE)
    for other, said in (
        ({"model": "surrogate"}, r"registration\.model: expected reference with these"),
        ({"parameters": ["young-modulus"]}, "stress-free shape depends on them, got young-modulus"),
        ({"parameters": ["weight"], "gravity": gravity}, "got weight"),
        ({"forces": "normal"}, "got forces = 'normal'"),
        ({"parameters": ["weight", "gravity"], "gravity": gravity, "scan_gravity": [0, 0, 0]}, "got both"),
    ):
        with pytest.raises(ConfigError, match=said):
            parse_config({"registration": {"model": "reference", "scan_gravity": gravity, **other}})


@pytest.mark.parametrize(("model", "known"), [("reference", 0.5), ("torch", 0.0)])
def test_gravity_is_found_whichever_way_it_points(folder: Path, model: str, known: float) -> None:
    """Nobody pulls; a cloud tells the three components, which files in RAS have with two signs turned."""
    gravity = np.array([2.0, -1.0, 4.0])
    with Twin.open(folder, model="reference", gravity=tuple(gravity)) as twin:
        body, truth = twin.body, twin.predict(np.zeros_like(twin.body.points)).displacement
    rng = np.random.default_rng(0)
    triangles = body.boundary[rng.integers(len(body.boundary), size=1500)]
    moved = body.points + truth
    cloud = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), size=1500), moved[triangles])
    cloud += 3e-4 * rng.standard_normal(cloud.shape)
    expected = known * gravity
    forces = {"forces": "known"} if model == "reference" else {}
    with Twin.open(folder, model=model, gravity=tuple(expected), parameters=["gravity=5"], **forces) as twin:
        found = twin.register(cloud)
    values = np.array([estimate.value for estimate in found.estimates])
    halves = np.array([np.ptp(estimate.interval) / 2.0 for estimate in found.estimates])
    assert [estimate.name for estimate in found.estimates] == [f"gravity along {axis}" for axis in "xyz"]
    errors = np.linalg.norm(found.displacement - truth, axis=1)
    assert errors.mean() < 3e-4
    if model == "reference":
        assert (np.abs(values - gravity) < 1.5 * halves).all()
        assert (halves < 0.5).all()


def test_gravity_is_on_the_axes_of_the_files(scanned: Body) -> None:
    entries = {"model": "reference", "gravity": [0.0, 3.0, 1.0], "parameters": ["gravity"]}
    scenario = Scenario.of(parse_config({"registration": entries}))
    inputs = scenario.inputs(scanned, MODULUS, RATIO, Coordinates("mm", "ras"))
    assert inputs is not None
    net = inputs.forces(np.zeros(3)).sum(axis=0)
    mass = inputs.forces(np.array([0.0, 0.0, 1.0])).sum(axis=0)[2] - net[2]
    np.testing.assert_allclose(net / mass * 3.0, [0.0, -3.0, 1.0], atol=1e-9)
    assert scenario.loading(scanned, Coordinates("mm", "ras")).body_force is None
