"""Prescribed displacements that turn a part by any angle: the path of the load, and the states that it leads to.

Tolerances: ROUND_OFF is what doubles leave of coordinates about 1 after a few products; SOLVED what a solver tolerance
of 1e-10 of the reactions leaves in displacements and energies after conditioning.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from scipy.spatial.transform import Rotation

from softtwin.meshes.body import Body, corner_jacobians
from softtwin.meshes.shapes import beam
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import (
    IncompressibleNeoHookean,
    IsochoricNeoHookean,
    LinearElastic,
    Material,
    NeoHookean,
)
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.solve.newton import NewtonOptions
from softtwin.reference.solve.path import LoadPath
from softtwin.reference.solve.problem import Problem
from softtwin.reference.solve.rigid import RigidMotion, fitted

Floats = np.ndarray
E, NU = 5000.0, 0.4
ROUND_OFF, SOLVED = 1e-13, 1e-8
BOTH = {"fixed": "xyz", "tip": "xyz"}
SIZE = (0.6, 0.2, 0.2)
MIDDLE = (0.0, 0.1, 0.1)  # on the axis of the beam
SLANTED = (1.0, 2.0, -1.0)
LAWS: dict[str, tuple[Body, Material]] = {
    "tetra, Neo-Hookean": (beam((5, 2, 2), SIZE, "tetrahedron"), NeoHookean(E, NU)),
    "hexahedron, Neo-Hookean": (beam((5, 2, 2), SIZE, "hexahedron"), NeoHookean(E, NU)),
    "hexahedron, nearly incompressible": (beam((5, 2, 2), SIZE, "hexahedron"), IsochoricNeoHookean(E, 0.499)),
    "tetra10, incompressible": (beam((3, 1, 1), SIZE, "tetrahedron").quadratic(), IncompressibleNeoHookean(E / 3)),
}


@pytest.fixture(scope="module", params=LAWS)
def block(request: pytest.FixtureRequest) -> Iterator[Problem]:
    """A beam whose ends are prescribed."""
    body, material = LAWS[request.param]
    with Problem(body, material, NewtonOptions(tolerance=1e-10), held=BOTH) as problem:
        yield problem


@pytest.fixture(scope="module")
def hexahedra() -> Iterator[Problem]:
    """The same of hexahedra, whose mesh is its own mirror image."""
    body, material = LAWS["hexahedron, Neo-Hookean"]
    with Problem(body, material, NewtonOptions(tolerance=1e-10), held=BOTH) as problem:
        yield problem


def rotation(axis: tuple[float, ...], degrees: float) -> Floats:
    return Rotation.from_rotvec(np.deg2rad(degrees) * np.array(axis) / np.linalg.norm(axis)).as_matrix()


def turned(points: Floats, matrix: Floats, centre: tuple[float, ...], shift: tuple[float, ...] = (0, 0, 0)) -> Floats:
    """Displacement of points that turn about a centre and move on."""
    return (points - centre) @ matrix.T + centre + shift - points


def at_sets(body: Body, field: Floats, names: Mapping[str, str] = BOTH) -> dict[str, Floats]:
    return {name: field[body.node_sets[name]] for name in names}


def twist(body: Body, degrees: float) -> Loading:
    """The tip turned about the beam's axis, its other end at rest."""
    field = turned(body.points, rotation((1, 0, 0), degrees), MIDDLE)
    return Loading(displacement=at_sets(body, field, {"tip": "xyz"}))


def path_of(problem: Problem, load: Loading) -> LoadPath:
    return LoadPath(problem.system, *problem.system.load(load))


def prescribed(path: LoadPath, factor: float, names: Mapping[str, str] = BOTH) -> list[Floats]:
    moved = path.loading(factor).displacement
    return [np.asarray(moved[name]) for name in names]


# ---------------------------------------------------------------------- states


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), SLANTED])
@pytest.mark.parametrize("degrees", [30, 120, 179, 180, 340])
def test_a_block_turned_as_a_whole_has_no_energy_and_its_exact_rotation(block: Problem, degrees, axis) -> None:
    """Its centre lies outside the body. As displacements 340 degrees are 20 back: the state is the same."""
    body = block.body
    wanted = turned(body.points, rotation(axis, degrees), (1.0, -0.5, 0.3), (0.3, 0.1, -0.2))
    state = block.solve(Loading(displacement=at_sets(body, wanted)))
    assert abs(state.energy) <= 1e-12 * E * body.volume
    np.testing.assert_allclose(state.displacement, wanted, atol=1e-9 * body.size)
    assert state.load_steps == 1 and state.iterations <= 3  # it starts there


@pytest.mark.parametrize("degrees", [90, 180])
def test_a_beam_is_twisted_by_half_a_turn(block: Problem, degrees: float) -> None:
    body = block.body
    state = block.solve(twist(body, degrees))
    corners = body.cells[:, : 8 if body.kind.name.startswith("hexa") else 4]
    left = corner_jacobians(body.points + state.displacement, corners) / corner_jacobians(body.points, corners)
    assert left.min() > 0.1  # no cell is near being inside out
    assert state.is_stable and state.energy > 0.0
    middle = np.isclose(body.points[:, 0], body.points[:, 0].max() / 2, atol=0.13)  # the nodes nearest to mid-length
    arms, now = (body.points - MIDDLE)[middle, 1:], (body.points + state.displacement - MIDDLE)[middle, 1:]
    angle = np.arctan2((arms[:, 0] * now[:, 1] - arms[:, 1] * now[:, 0]).sum(), (arms * now).sum())
    assert 0.2 < angle / np.deg2rad(degrees) < 0.8  # half a turn goes to the positive side


def test_a_twist_and_its_mirror_image_cost_the_same(hexahedra: Problem) -> None:
    body, tip = hexahedra.body, hexahedra.body.node_sets["tip"]
    energies, moments = [], []
    for degrees in (170.0, -170.0):
        state = hexahedra.solve(twist(body, degrees))
        forces = hexahedra.internal_forces(state)[tip]
        arms = (body.points + state.displacement)[tip] - MIDDLE
        energies.append(state.energy)
        moments.append(np.cross(arms, forces).sum(axis=0)[0])
    assert moments[0] > 0.0
    assert energies[1] == pytest.approx(energies[0], rel=SOLVED)
    assert moments[1] == pytest.approx(-moments[0], rel=SOLVED)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_stretched_and_turned_has_the_energy_of_the_stretch(block: Problem, seed: int) -> None:
    """Both ends go where Q (x + u) + c is: the state turns with them, and so do its dead forces."""
    rng = np.random.default_rng(seed)
    body = block.body
    u = np.zeros_like(body.points)
    tip = body.node_sets["tip"]
    u[tip] = rng.uniform(-0.03, 0.03, 3) + np.array([0.03, 0.0, 0.0])
    u[tip] += 0.05 * (body.points[tip] - body.points[tip].mean(axis=0)) @ rng.standard_normal((3, 3))
    weight = 100.0 * rng.standard_normal(3)
    plain = block.solve(Loading(displacement=at_sets(body, u), body_force=weight))
    Q, c = Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3)
    moved = (body.points + u) @ Q.T + c - body.points
    state = block.solve(Loading(displacement=at_sets(body, moved), body_force=Q @ weight))
    wanted = (body.points + plain.displacement) @ Q.T + c - body.points
    np.testing.assert_allclose(state.displacement, wanted, atol=SOLVED * body.size)
    inside = [block.energy(found) if found.pressure is None else 0.0 for found in (plain, state)]
    assert inside[1] == pytest.approx(inside[0], rel=SOLVED, abs=0.0)


@pytest.mark.parametrize("step", [10.0, 60.0])
def test_from_a_guess_a_twist_goes_on_beyond_half_a_turn(hexahedra: Problem, step: float) -> None:
    """A whole turn has the displacements of none, and four times the energy of half a turn (five cells: to a tenth)."""
    body = hexahedra.body
    state = hexahedra.solve(twist(body, 180.0))
    half = state.energy
    for degrees in np.arange(180.0 + step, 361.0, step):
        state = hexahedra.solve(twist(body, degrees), state)
        assert state.start == "guess"
    assert state.energy == pytest.approx(4.0 * half, rel=0.1)
    np.testing.assert_allclose(state.displacement[body.node_sets["tip"]], 0.0, atol=ROUND_OFF)


def test_a_guess_turns_with_the_body(hexahedra: Problem) -> None:
    """A twisted beam turned by 150 degrees: the neighbour is the twisted beam turned, without an iteration but one."""
    body = hexahedra.body
    first = hexahedra.solve(twist(body, 100.0))
    matrix, centre = rotation(SLANTED, 150), (1.0, -0.5, 0.3)
    wanted = (body.points + first.displacement - centre) @ matrix.T + centre - body.points
    for guess in (first, first.displacement):
        state = hexahedra.solve(Loading(displacement=at_sets(body, wanted)), guess)
        assert state.start == "guess" and state.iterations <= 2
        np.testing.assert_allclose(state.displacement, wanted, atol=SOLVED * body.size)


def test_load_steps_turn_with_the_load(hexahedra: Problem) -> None:
    """By parts of the load: the same states; and a rigid motion costs one check of balance a step."""
    body = hexahedra.body
    whole = Loading(displacement=at_sets(body, turned(body.points, rotation(SLANTED, 170), (1.0, -0.5, 0.3))))
    loads = {"whole": whole, "twist": twist(body, 180)}
    with Problem(body, hexahedra.material, NewtonOptions(tolerance=1e-10, first_step=0.25), held=BOTH) as steps:
        for name, load in loads.items():
            state, wanted = steps.solve(load, trace=True), hexahedra.solve(load)
            assert state.start == "load steps" and state.load_steps >= 3
            np.testing.assert_allclose(state.displacement, wanted.displacement, atol=SOLVED * body.size, err_msg=name)
            if name == "whole":
                assert state.iterations <= 3 * state.load_steps


def test_where_a_turn_ends_early_the_last_state_is_that_of_a_part_of_it(hexahedra: Problem) -> None:
    body, tip = hexahedra.body, hexahedra.body.node_sets["tip"]
    options = NewtonOptions(first_step=0.25, max_load_steps=2)
    with Problem(body, hexahedra.material, options, held=BOTH) as problem, pytest.raises(NotConverged) as raised:
        problem.solve(twist(body, 160))
    error = raised.value
    assert error.last is not None and error.load_factor == 0.625
    wanted = twist(body, 0.625 * 160).displacement["tip"]
    np.testing.assert_allclose(error.last.displacement[tip], wanted, atol=ROUND_OFF)
    np.testing.assert_allclose(error.last.load.displacement["tip"], wanted, atol=ROUND_OFF)


PARALLEL = """
import sys
import numpy as np
from mpi4py import MPI
from scipy.spatial.transform import Rotation
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Loading, NewtonOptions, Problem

body, found = beam((5, 2, 2), (0.6, 0.2, 0.2), "tetrahedron"), {}
whole = body.points @ Rotation.from_rotvec([1.5, 1.0, -1.0]).as_matrix().T + 0.1 - body.points
twist = (body.points - 0.1) @ Rotation.from_rotvec([2.5, 0.0, 0.0]).as_matrix().T + 0.1 - body.points
loads = {
    "whole": {name: whole[body.node_sets[name]] for name in ("fixed", "tip")},
    "twist": {"tip": twist[body.node_sets["tip"]]},
}
held = {"fixed": "xyz", "tip": "xyz"}
for first in (1.0, 0.5):
    options = NewtonOptions(tolerance=1e-10, first_step=first)
    with Problem(body, NeoHookean(5e3, 0.4), options, held=held, comm=MPI.COMM_WORLD) as problem:
        for name, moved in loads.items():
            found[f"{name} {first}"] = problem.solve(Loading(displacement=moved)).displacement
if MPI.COMM_WORLD.rank == 0:
    np.savez(sys.argv[1], wanted=whole, ranks=MPI.COMM_WORLD.size, **found)
"""


@pytest.mark.mpi
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="mpirun is absent")
def test_ranks_that_share_a_mesh_turn_alike(tmp_path: Path, mpi_environment: dict[str, str]) -> None:
    script = ["mpirun", "-n", "2", sys.executable, "-c", PARALLEL, tmp_path / "found.npz"]
    subprocess.run(script, env=mpi_environment, check=True, timeout=300)
    found = dict(np.load(tmp_path / "found.npz"))
    assert found["ranks"] == 2
    body, material = LAWS["tetra, Neo-Hookean"]
    field = turned(body.points, Rotation.from_rotvec([2.5, 0.0, 0.0]).as_matrix(), (0.1, 0.1, 0.1))
    with Problem(body, material, NewtonOptions(tolerance=1e-10), held=BOTH) as problem:
        twisted = problem.solve(Loading(displacement=at_sets(body, field, {"tip": "xyz"}))).displacement
    for first in ("1.0", "0.5"):
        np.testing.assert_allclose(found[f"whole {first}"], found["wanted"], atol=1e-9 * body.size)
        np.testing.assert_allclose(found[f"twist {first}"], twisted, atol=SOLVED * body.size)


def test_a_block_in_the_plane_turns_by_any_angle() -> None:
    x, y = np.meshgrid(np.linspace(0.0, 0.6, 7), np.linspace(0.0, 0.2, 3), indexing="ij")
    numbers = np.arange(x.size).reshape(x.shape)
    cells = np.stack([numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]], axis=-1).reshape(-1, 4)
    body = Body(np.column_stack([x.ravel(), y.ravel()]), cells, {"fixed": numbers[0], "tip": numbers[-1]})
    with Problem(body, NeoHookean(E, NU), held={"fixed": "xy", "tip": "xy"}) as problem:
        for degrees in (120, 180, 340):
            wanted = turned(body.points, rotation((0, 0, 1), degrees)[:2, :2], (1.0, -0.5), (0.3, 0.1))
            state = problem.solve(Loading(displacement=at_sets(body, wanted)))
            np.testing.assert_allclose(state.displacement, wanted, atol=1e-9 * body.size)
        tip = turned(body.points, rotation((0, 0, 1), 100)[:2, :2], (0.6, 0.1), (-0.25, 0.3))  # bent
        state = problem.solve(Loading(displacement=at_sets(body, tip, {"tip": "xy"})))
        assert state.start == "rotation" and state.is_stable


def test_a_linear_law_goes_straight() -> None:
    """It does not know rotations: its state is linear in what is prescribed."""
    body = LAWS["tetra, Neo-Hookean"][0]
    load = twist(body, 120)
    with Problem(body, LinearElastic(E, NU), held=BOTH) as problem:
        state = problem.solve(load)
        half = path_of(problem, load).loading(0.5)
        np.testing.assert_array_equal(half.displacement["tip"], 0.5 * np.asarray(load.displacement["tip"]))
        np.testing.assert_allclose(problem.solve(half).displacement, 0.5 * state.displacement, atol=SOLVED * body.size)


# ---------------------------------------------------------------------- the path


@pytest.mark.parametrize("factor", [0.1, 0.5, 0.9])
def test_sets_that_move_alike_stay_as_they_lie_to_each_other(hexahedra: Problem, factor: float) -> None:
    body = hexahedra.body
    whole = turned(body.points, rotation(SLANTED, 140), (1.0, -0.5, 0.3), (0.3, 0.1, -0.2))
    path = path_of(hexahedra, Loading(displacement=at_sets(body, whole)))
    ends = np.concatenate([body.node_sets[name] for name in BOTH])
    moved = body.points[ends] + np.concatenate(prescribed(path, factor))
    motion, _ = fitted(body.points[ends], moved)
    np.testing.assert_allclose(motion.of(body.points[ends]), moved, atol=ROUND_OFF)
    assert Rotation.from_matrix(motion.rotation).magnitude() == pytest.approx(factor * np.deg2rad(140))


def test_a_set_turns_on_its_screw_and_what_rests_stays(hexahedra: Problem) -> None:
    """Forces grow with the factor, and the whole load is what was given."""
    body, load = hexahedra.body, twist(hexahedra.body, 180)
    forces = np.zeros_like(body.points)
    forces[20] = [1.0, 2.0, 3.0]
    path = path_of(hexahedra, Loading(forces=forces, pressure={"boundary": 7.0}, displacement=load.displacement))
    tip = body.node_sets["tip"]
    half = path.loading(0.5)
    quarter_turn = turned(body.points[tip], rotation((1, 0, 0), 90), MIDDLE)
    np.testing.assert_allclose(half.displacement["tip"], quarter_turn, atol=ROUND_OFF)
    np.testing.assert_array_equal(half.forces, 0.5 * forces)
    assert half.pressure == {"boundary": 3.5}
    field = hexahedra.system.space.field(path.load(0.5).lift)
    np.testing.assert_array_equal(field[body.fixed], 0.0)
    np.testing.assert_array_equal(field[tip], half.displacement["tip"])
    np.testing.assert_array_equal(path.loading(1.0).displacement["tip"], load.displacement["tip"])


@pytest.mark.parametrize("degrees", [180.0, 180.0 - 1e-10, 180.0 + 1e-10])
@pytest.mark.parametrize("axis", [(1, 0, 0), (-1, 0, 0), (0, -1, 1), (-1, 2, 3)])
def test_half_a_turn_goes_to_one_side_whatever_rounding_says(axis: tuple[float, ...], degrees: float) -> None:
    motion = RigidMotion(rotation(axis, degrees), np.array([0.1, 0.2, 0.3]))
    half = Rotation.from_matrix(motion.part(0.5).rotation).as_rotvec()
    side = np.array(axis) / np.linalg.norm(axis)
    side *= np.sign(side[np.flatnonzero(side)[0]])
    np.testing.assert_allclose(half, np.pi / 2 * side, atol=1e-9)
    np.testing.assert_allclose(motion.part(1.0).of(np.eye(3)), motion.of(np.eye(3)), atol=ROUND_OFF)


def test_a_screw_does_not_know_the_origin() -> None:
    rng = np.random.default_rng(0)
    points, origin = rng.standard_normal((2, 5, 3))
    motion = RigidMotion(rotation(SLANTED, 130), rng.standard_normal(3))
    there, _ = fitted(points + origin[0], motion.of(points) + origin[0])
    np.testing.assert_allclose(
        there.part(0.3).of(points + origin[0]) - origin[0], motion.part(0.3).of(points), atol=1e-12
    )
    again = motion.part(0.3)
    for factor in (0.6, 0.9):  # each third of the way is the same motion once more
        points_there = again.of(motion.part(factor - 0.3).of(points))
        np.testing.assert_allclose(points_there, motion.part(factor).of(points), atol=1e-12)


def test_sets_too_small_turn_no_more_than_they_have_to() -> None:
    point, line = np.array([[1.0, 2.0, 3.0]]), np.outer([0.0, 0.5, 1.0], [1.0, 0.0, 0.0])
    motion, is_told = fitted(point, point + 1.0)
    assert not is_told
    np.testing.assert_allclose(motion.rotation, np.eye(3), atol=ROUND_OFF)
    about_itself = rotation((0, 0, 1), 100) @ rotation((1, 0, 0), 70)
    motion, is_told = fitted(line, line @ about_itself.T)
    assert not is_told
    np.testing.assert_allclose(motion.rotation, rotation((0, 0, 1), 100), atol=1e-8)  # without the turn about the line
    motion, is_told = fitted(line[:, ::-1], -line[:, ::-1])
    np.testing.assert_allclose(motion.of(line[:, ::-1]), -line[:, ::-1], atol=1e-8)
    assert np.linalg.det(motion.rotation) == pytest.approx(1.0)


def test_single_nodes_tell_a_rotation_together_or_follow_the_set_that_tells_one() -> None:
    body = LAWS["tetra, Neo-Hookean"][0]
    corners = body.node_sets["tip"][[0, 2, -1]]
    nodes = {**{f"node {i}": [node] for i, node in enumerate(corners)}, "last": [0]}
    hinge = np.flatnonzero((body.points[:, 0] == 0.0) & (body.points[:, 1] == 0.0))
    about, aside = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)), (SLANTED, (1.0, -0.5, 0.3))
    cases = [
        (nodes, aside),
        ({"fixed": body.fixed, **nodes, "last": [40]}, aside),
        ({"hinge": hinge, "tip": body.node_sets["tip"]}, about),  # at rest on a line about which the tip turns
    ]
    for sets, (axis, centre) in cases:
        whole = turned(body.points, rotation(axis, 120), centre)
        pinned = Body(body.points, body.cells, {name: np.array(of) for name, of in sets.items()})
        held = dict.fromkeys(sets, "xyz")
        with Problem(pinned, NeoHookean(E, NU), held=held) as problem:
            load = Loading(displacement=at_sets(pinned, whole, held))
            state = problem.solve(load)
            np.testing.assert_allclose(state.displacement, whole, atol=1e-9 * body.size)
            half = np.concatenate(prescribed(path_of(problem, load), 0.5, held))
            points = body.points[np.concatenate(list(sets.values())).astype(int)]
            motion, _ = fitted(points, points + half)
            np.testing.assert_allclose(motion.of(points), points + half, atol=ROUND_OFF)


def test_what_is_held_in_some_axes_goes_straight() -> None:
    """A side that slides in its plane beside a tip that turns in it: the plane tells no rotation, the tip does."""
    bare = LAWS["hexahedron, Neo-Hookean"][0]
    side = np.flatnonzero(np.isclose(bare.points[:, 1], 0.0))
    body = Body(bare.points, bare.cells, {"fixed": bare.fixed, "tip": bare.node_sets["tip"], "side": side})
    tip = turned(body.points, rotation((0, -1, 0), 60), (0.6, 0.0, 0.1), (-0.1, 0.0, 0.25))
    load = Loading(displacement={"side": [0.0, 0.0, 0.0], **at_sets(body, tip, {"tip": "xyz"})})
    with Problem(body, NeoHookean(E, NU), held={"side": "y", **BOTH}) as problem:
        state = problem.solve(load)
        assert state.is_stable and np.abs(state.displacement[side, 1]).max() < ROUND_OFF
        half = path_of(problem, load).load(0.5)
        assert np.abs(problem.system.space.field(half.lift)[side, 1]).max() < ROUND_OFF
        sheared = Loading(displacement={"side": [0.0, 0.02, 0.0], **at_sets(body, tip + np.array([0.0, 0.02, 0.0]))})
        half = path_of(problem, sheared).load(0.5)
        only = np.setdiff1d(side, np.concatenate([body.fixed, body.node_sets["tip"]]))
        np.testing.assert_allclose(problem.system.space.field(half.lift)[only, 1], 0.01, rtol=1e-12)
