"""The task farm: the same data for any number of ranks and after any kill; what is damaged is found and made again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import qmc

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import SPLITS, DataSet, DataSetError, Split, probe_cotangents
from softtwin.reference.data.samplers import LoadPlan, QuasiRandom, sobol_point
from softtwin.reference.data.shard import Shard, at_work_on
from softtwin.reference.data.writing import drop_block, write_block
from softtwin.reference.generate import DamagedBlock, Plan, generate, linear_response, solve_block
from softtwin.reference.solve.problem import NewtonOptions, Problem

PLAN = Plan(
    loads=LoadPlan(modes=6, displacement=0.08),
    samples={"train": 9, "validation": 3, "test": 4, "calibration": 2},
    block=3,
    seed=5,
)
PROGRAM = """
import sys
from softtwin.meshes.shapes import beam
from softtwin.reference.generate import Plan, generate
from softtwin.reference.data.shard import Shard
from softtwin.reference.data.samplers import LoadPlan
plan = Plan(loads=LoadPlan(modes=6, displacement=0.08), block=3, seed=5,
            samples={"train": 9, "validation": 3, "test": 4, "calibration": 2})
shard = Shard.parse(sys.argv[2]) if len(sys.argv) > 2 else None
generate(sys.argv[1], beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron"), plan, shard=shard)
"""


def body() -> Body:
    return beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron")


def contents(data: DataSet) -> dict[str, np.ndarray]:
    found = {}
    for split in PLAN.samples:
        samples = data.samples(split)
        for name in ("draws", "forces", "displacements", "probes", "adjoints"):
            found[f"{split}.{name}"] = getattr(samples, name)
    return found


def assert_same(first: DataSet, second: DataSet) -> None:
    one, other = contents(first), contents(second)
    for name, values in one.items():
        assert values.size and np.array_equal(values, other[name]), name


def start(path: Path, ranks: int, environment: dict[str, str]) -> subprocess.Popen:
    launch = [] if ranks == 1 else ["mpirun", "-n", str(ranks)]
    return subprocess.Popen(
        [*launch, sys.executable, "-c", PROGRAM, str(path)], env=environment, start_new_session=True
    )


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> DataSet:
    made = generate(tmp_path_factory.mktemp("data") / "data.zarr", body(), PLAN)
    assert made is not None
    return made


def test_a_data_set_holds_what_was_asked(undisturbed: DataSet) -> None:
    assert undisturbed.missing_blocks() == []
    total = sum(len(undisturbed.samples(split)) for split in SPLITS)
    assert total + len(undisturbed.rejected().draws) == sum(PLAN.samples.values())
    assert undisturbed.header["plan"]["seed"] == 5 and "dolfinx" in undisturbed.header["versions"]
    sizes = np.linalg.norm(undisturbed.samples("train").displacements, axis=2).max(axis=1)
    assert sizes.min() > 0.0 and sizes.max() < 2 * 0.08


def test_samples_are_equilibria_with_their_adjoints(undisturbed: DataSet) -> None:
    samples = undisturbed.samples("test")
    loaded = undisturbed.response.loaded
    with Problem(undisturbed.body, PLAN.build_material()) as problem:
        for load, u, probe, adjoint in zip(
            samples.forces, samples.displacements, samples.probes, samples.adjoints, strict=True
        ):
            forces = np.zeros_like(u)
            forces[loaded] = load
            balance = (problem.internal_forces(u) - forces)[problem.body.free]
            assert np.linalg.norm(balance) <= 1.01e-8 * np.linalg.norm(load)
            cotangent = probe_cotangents(problem.body, undisturbed.shapes, probe[None])[0]
            again = problem.apply_inverse(cotangent.ravel(), u).reshape(-1, 3)[loaded]
            np.testing.assert_allclose(adjoint, again, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("one", "other"), list(combinations(PLAN.samples, 2)))
def test_splits_share_no_draw(undisturbed: DataSet, one: Split, other: Split) -> None:
    """Neither numbers nor blocks nor loads, those of the calibration included."""
    draws = [set(undisturbed.split_draws(split)) for split in (one, other)]
    blocks = [{draw // PLAN.block for draw in each} for each in draws]
    loads = [{forces.tobytes() for forces in undisturbed.samples(split).forces} for split in (one, other)]
    for first, second in (draws, blocks, loads):
        assert first and second and not first & second


@pytest.mark.mpi
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="mpirun is absent")
@pytest.mark.parametrize("ranks", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_ranks_do_not_change_the_data(
    undisturbed: DataSet, tmp_path: Path, mpi_environment: dict[str, str], ranks: int
) -> None:
    assert start(tmp_path / "data.zarr", ranks, mpi_environment).wait(timeout=120) == 0
    assert_same(undisturbed, DataSet(tmp_path / "data.zarr"))


@pytest.mark.mpi
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="mpirun is absent")
@pytest.mark.parametrize("ranks", [1, 2])
def test_kill_9_loses_only_what_was_under_way(
    undisturbed: DataSet, tmp_path: Path, mpi_environment: dict[str, str], ranks: int
) -> None:
    path = tmp_path / "data.zarr"
    kills = 0
    for delay in (0.0, 0.05, 0.1, 0.15):  # after the first block: a kill falls into different moments of the work
        process = start(path, ranks, mpi_environment)
        while process.poll() is None and not _blocks(path):
            time.sleep(0.005)
        time.sleep(delay)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            kills += 1
        process.wait()
    assert kills > 0
    again = generate(path, body(), PLAN)
    assert again is not None and again.missing_blocks() == []
    assert_same(undisturbed, again)


def _blocks(path: Path) -> int:
    return len(list((path / "samples" / "checksum" / "c").glob("*"))) if path.exists() else 0


@pytest.mark.mpi
def test_ctrl_c_leaves_whole_blocks(undisturbed: DataSet, tmp_path: Path, mpi_environment: dict[str, str]) -> None:
    path = tmp_path / "data.zarr"
    process = start(path, 1, mpi_environment)
    while process.poll() is None and not _blocks(path):
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    process.wait(timeout=30)
    stopped = DataSet(path)
    assert len(stopped.missing_blocks()) < stopped.block_count
    again = generate(path, body(), PLAN)
    assert again is not None
    assert_same(undisturbed, again)


def test_another_plan_or_body_is_refused_by_name(undisturbed: DataSet) -> None:
    other = Plan(loads=PLAN.loads, samples=PLAN.samples, block=3, seed=6)
    with pytest.raises(DataSetError, match=r"differs in seed \(5 there, 6 here\)\); choose another folder"):
        generate(undisturbed.path, body(), other)
    with pytest.raises(DataSetError, match=r"differs in the body \(63 nodes, fingerprint \w{12} there, 54 nodes"):
        generate(undisturbed.path, beam((5, 2, 2), (0.6, 0.2, 0.2)), PLAN)


def test_a_sparse_grid_is_carried_from_the_body_to_the_data_and_its_physics(tmp_path: Path) -> None:
    """Cells cut in half count half: in the equilibria, in what is stored, and in torch."""
    torch = pytest.importorskip("torch", reason="torch is absent")
    from softtwin.meshes.checks import compacted
    from softtwin.meshes.embedding import outer_nodes
    from softtwin.meshes.grid import sparse_grid
    from softtwin.surrogate.residual import ElasticBody

    surface = compacted(beam((3, 1, 1), (0.6, 0.2, 0.2), "tetrahedron").boundary_surface)
    left = np.flatnonzero(np.isclose(surface.points[:, 0], 0.0))
    grid = sparse_grid(surface, left, spacing=0.08)
    assert grid.fractions.min() < 0.6 and grid.body.volume == pytest.approx(0.6 * 0.2 * 0.2, rel=0.01)
    plan = replace(PLAN, samples={"train": 3, "validation": 3, "test": 3})
    data = generate(tmp_path / "data.zarr", grid.body, plan)
    assert data is not None and np.array_equal(data.body.fractions, grid.fractions)
    assert np.array_equal(data.body.skin.points, surface.points)
    assert np.array_equal(data.body.skin.triangles, surface.triangles)
    assert np.array_equal(data.response.loaded, np.setdiff1d(outer_nodes(grid.body), grid.body.fixed))
    samples = data.samples("train")
    forces = np.zeros((len(samples), *data.body.points.shape))
    forces[:, data.response.loaded] = samples.forces
    given = torch.from_numpy(samples.displacements), torch.from_numpy(forces)
    assert float(ElasticBody(data.body, data.material).residual(*given).max()) < 1e-7
    full = replace(data.body, fractions=None)
    assert float(ElasticBody(full, data.material).residual(*given).min()) > 0.05
    with pytest.raises(DataSetError, match="differs in the body"):
        generate(tmp_path / "data.zarr", full, plan)


def test_another_zone_on_the_same_nodes_is_another_body(tmp_path: Path) -> None:
    zoned = replace(PLAN, loads=replace(PLAN.loads, zones=("tip",)), samples={"train": 1, "validation": 1, "test": 1})
    generate(tmp_path / "data.zarr", body(), zoned)
    other = body().with_sets(tip=body().node_sets["tip"][1:])
    with pytest.raises(DataSetError, match="differs in the zone 'tip'"):
        generate(tmp_path / "data.zarr", other, zoned)


def test_a_data_set_that_was_thrown_away_is_made_anew_in_the_same_process(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    generate(path, body(), replace(PLAN, young_modulus=9000.0))
    assert_same(undisturbed, generate(path, body(), PLAN, again=True))


def test_options_that_came_later_had_their_defaults_before(undisturbed: DataSet, tmp_path: Path) -> None:
    import zarr

    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    attributes = zarr.open_group(str(path), mode="r+").attrs
    header = json.loads(attributes["header"])
    del header["plan"]["newton"]["max_load_steps"], header["checksums"]
    header["plan"]["path"] = header["plan"].pop("ramp")  # its name then
    attributes["header"] = json.dumps(header)
    assert_same(undisturbed, generate(path, body(), PLAN))
    with pytest.raises(DataSetError, match=r"newton\.max_load_steps"):
        generate(path, body(), replace(PLAN, newton=NewtonOptions(max_load_steps=3)))


@pytest.mark.slow
def test_two_do_not_write_one_data_set(undisturbed: DataSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lock is the system's: it goes with the process that holds it, even where that is killed."""
    from softtwin.reference import generate as farm

    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    monkeypatch.setattr(farm, "_PATIENCE_S", 0.1)
    program = (
        "import pathlib, sys, time; from softtwin.reference.generate import writing\n"
        "with writing(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    holder = subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(DataSetError, match=r"another `generate` is at work in .*data\.zarr"):
            generate(path, body(), PLAN)
    finally:
        holder.kill()
        holder.communicate()
    assert_same(undisturbed, generate(path, body(), PLAN))


# ---------------------------------------------------------------------- parts


@pytest.mark.mpi
def test_parts_that_know_nothing_of_each_other_make_the_same_data(
    undisturbed: DataSet, tmp_path: Path, mpi_environment: dict[str, str]
) -> None:
    """Three at the same moment, none of which finds a data set; one of them under two ranks."""
    path = tmp_path / "data.zarr"
    launches = [["mpirun", "-n", "2"] if shutil.which("mpirun") else [], [], []]
    jobs = [
        subprocess.Popen([*launch, sys.executable, "-c", PROGRAM, str(path), f"{i}/3"], env=mpi_environment)
        for i, launch in enumerate(launches)
    ]
    assert [job.wait(timeout=120) for job in jobs] == [0, 0, 0]
    assert_same(undisturbed, DataSet(path))


def test_what_a_part_left_out_is_told_and_made_again(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    for number in (0, 2):
        generate(path, body(), PLAN, shard=Shard(number, 3))
    there = DataSet(path)
    assert there.missing_blocks() == list(range(1, there.block_count, 3))
    with pytest.raises(DataSetError, match=r"block 1 of .* was never finished; run `softtwin generate` again"):
        there.samples("train")
    drop_block(path, 0)
    generate(path, body(), PLAN, shard=Shard(1, 3))
    assert DataSet(path).missing_blocks() == [0]
    assert_same(undisturbed, generate(path, body(), PLAN))


def test_a_part_is_written_once_at_a_time(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    with at_work_on(path, Shard(3, 16)):
        with pytest.raises(DataSetError, match=r"another `generate` is at work on shard 3/16"):
            generate(path, body(), PLAN, shard=Shard(3, 16))
        with pytest.raises(DataSetError, match=r"shard 3/16 of .*data\.zarr is being made; wait for it"):
            generate(path, body(), PLAN)
        generate(path, body(), PLAN, shard=Shard(4, 16))
    assert_same(undisturbed, generate(path, body(), PLAN))


@pytest.mark.parametrize("words", ["3", "a/b", "-1/4", "4/4", "0/0", "1/2/3", ""])
def test_parts_that_are_none_are_refused(words: str) -> None:
    with pytest.raises(DataSetError, match=r"shard: expected NUMBER/COUNT like 3/16|Shard\.number: expected 0\.\."):
        Shard.parse(words)


@pytest.mark.parametrize("others", [{"redo": [0]}, {"again": True}])
def test_a_part_throws_nothing_away(undisturbed: DataSet, others: dict) -> None:
    with pytest.raises(DataSetError, match=r"generate\.shard: expected no blocks to redo and nothing to throw away"):
        generate(undisturbed.path, body(), PLAN, shard=Shard(0, 2), **others)


# ---------------------------------------------------------------------- Sobol draws


def test_sobol_draws_are_even_and_leave_what_is_held_out_alone(undisturbed: DataSet, tmp_path: Path) -> None:
    """The sums of the loads, which the drawn coefficients are behind, leave smaller gaps than random ones do."""
    plan = replace(PLAN, loads=replace(PLAN.loads, sequence="sobol"))
    made = generate(tmp_path / "data.zarr", body(), plan)
    np.testing.assert_array_equal(made.samples("test").forces, undisturbed.samples("test").forces)
    assert not np.array_equal(made.samples("train").forces, undisturbed.samples("train").forces)
    points = np.stack([sobol_point(plan.loads, 1, number, plan.seed) for number in range(128)])
    chance = np.random.default_rng(0).random(points.shape)
    assert points.shape == (128, 1 + 9 + 1) and points.min() >= 0.0 and points.max() < 1.0
    assert qmc.discrepancy(points) < 0.5 * qmc.discrepancy(chance)
    again = generate(tmp_path / "again.zarr", body(), plan, shard=Shard(1, 3))
    assert again is not None
    assert_same(made, generate(tmp_path / "again.zarr", body(), plan))
    with pytest.raises(DataSetError, match=r"differs in loads\.sequence \(None there, sobol here\)"):
        generate(undisturbed.path, body(), plan)


def test_smooth_draws_leave_the_others_as_they_are(undisturbed: DataSet, tmp_path: Path) -> None:
    plan = replace(PLAN, samples={**PLAN.samples, "smooth": 4}, loads=replace(PLAN.loads, smoothness=0.1))
    made = generate(tmp_path / "data.zarr", body(), plan)
    assert made is not None
    assert_same(undisturbed, made)
    smooth, others = made.samples("smooth"), made.samples("test")
    assert smooth.draws.tolist() == [21, 22, 23, 24]  # in blocks of their own, behind all others
    assert np.abs(smooth.forces).max(axis=(1, 2)).min() > 0.0
    # A modal load is a combination of six shapes, masked; a smooth one has as many as its patch has nodes.
    span = made.shapes[:, made.response.loaded].reshape(len(made.shapes), -1).T

    def missed(loads: np.ndarray) -> float:
        masked = np.abs(loads).max(axis=1) > 0.0
        rows = np.repeat(masked, 3)
        found = np.linalg.lstsq(span[rows], loads.ravel()[rows], rcond=None)[0]
        return float(np.linalg.norm(span[rows] @ found - loads.ravel()[rows]) / np.linalg.norm(loads))

    assert max(map(missed, others.forces)) < 1e-9 and max(map(missed, smooth.forces)) > 0.1
    assert generate(tmp_path / "data.zarr", body(), plan).identity == made.identity
    with pytest.raises(DataSetError, match=r"differs in .*samples\.smooth \(None there, 4 here\)"):
        generate(undisturbed.path, body(), plan)
    other = replace(plan, loads=replace(plan.loads, smoothness=0.2))
    with pytest.raises(DataSetError, match=r"differs in loads\.smoothness \(0\.1 there, 0\.2 here\)"):
        generate(made.path, body(), other)
    unused = replace(PLAN, loads=replace(PLAN.loads, smoothness=0.2))  # without smooth draws it changes nothing
    assert generate(undisturbed.path, body(), unused).identity == undisturbed.identity
    with pytest.raises(ValueError, match=r"LoadPlan\.smoothness: expected a positive length in metres, got 0"):
        LoadPlan(smoothness=0.0)


def test_a_point_of_a_sequence_draws_in_its_range() -> None:
    chance = QuasiRandom(np.array([0.0, 0.999999, 0.5, 0.25, 0.75]))
    assert [chance.integers(1, 4), chance.integers(3), chance.uniform(2.0, 4.0)] == [1, 2, 3.0]
    np.testing.assert_allclose(chance.uniform(-1.0, 1.0, 2), [-0.5, 0.5])


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"sequence": "halton"}, r"LoadPlan\.sequence: expected 'random' or 'sobol', got 'halton'"),
        ({"kind": "random", "sequence": "sobol"}, r"LoadPlan\.sequence: expected 'random' for loads"),
    ],
)
def test_sequences_that_cannot_be_are_refused(entries: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LoadPlan(**entries)


FAILING = """
import sys
from softtwin.meshes.shapes import beam
from softtwin.reference import generate as farm
from softtwin.reference.fem.fenicsx import MPI
from softtwin.reference.ranks import FailedElsewhere
rank = MPI.COMM_WORLD.rank
def full(*_):
    raise OSError(28, "No space left on device")
if rank == int(sys.argv[2]):
    farm.write_block = full
plan = farm.Plan(loads=farm.LoadPlan(modes=6, displacement=0.08), block=1, seed=5,
                 samples={"train": 4, "validation": 1, "test": 1})
try:
    farm.generate(sys.argv[1], beam((6, 2, 2), (0.6, 0.2, 0.2), "hexahedron"), plan)
except (OSError, FailedElsewhere) as error:
    with open(f"{sys.argv[1]}.{rank}", "w") as told:  # what ranks print is mixed
        told.write(type(error).__name__)
    MPI.COMM_WORLD.Barrier()  # everyone comes here
"""


@pytest.mark.mpi
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="mpirun is absent")
@pytest.mark.parametrize("failing", [0, 1])
def test_a_rank_that_fails_at_work_ends_all(tmp_path: Path, mpi_environment: dict[str, str], failing: int) -> None:
    command = ["mpirun", "-n", "2", sys.executable, "-c", FAILING, str(tmp_path / "data.zarr"), str(failing)]
    told = subprocess.run(command, env=mpi_environment, capture_output=True, text=True, timeout=120, check=False)
    errors = [Path(f"{tmp_path / 'data.zarr'}.{rank}") for rank in (0, 1)]
    assert told.returncode == 0 and all(path.exists() for path in errors), told.stderr
    assert [path.read_text() for path in errors] == ["OSError", "FailedElsewhere"]


def test_a_truncated_block_is_found_and_made_again(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    chunk = path / "samples" / "displacements" / "c" / "1" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[: chunk.stat().st_size // 2])
    with pytest.raises(DataSetError, match=r"block 1 .*(damaged|checksum)"):
        DataSet(path).samples("train")
    with pytest.warns(DamagedBlock, match=r"block 1 in .* is damaged .*made again"):
        assert_same(undisturbed, generate(path, body(), PLAN))
    drop_block(path, 1)
    with pytest.raises(DataSetError, match=r"block 1 of \d+ .* never finished.*softtwin generate"):
        DataSet(path).samples("train")
    generate(path, body(), PLAN)
    assert_same(undisturbed, DataSet(path))


def test_a_changed_number_does_not_pass_the_checksum(undisturbed: DataSet, tmp_path: Path) -> None:
    import zarr

    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    forces = zarr.open_group(str(path), mode="r+")["samples/forces"]
    forces[4, 0, 0] = float(forces[4, 0, 0]) + 1e-9
    with pytest.raises(DataSetError, match=r"block 1 .* does not match its checksum.*makes damaged blocks again"):
        DataSet(path).samples("train")
    with pytest.warns(DamagedBlock, match=r"block 1 in .* does not match its checksum"):
        assert_same(undisturbed, generate(path, body(), PLAN))


def test_a_damaged_checksum_costs_its_block(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    (path / "samples" / "checksum" / "c" / "2").write_bytes(b"no")
    assert DataSet(path).missing_blocks() == [2]
    assert_same(undisturbed, generate(path, body(), PLAN))


@pytest.mark.parametrize("name", ["response/left", "modes/shapes", "body/points"])
def test_damage_outside_the_blocks_is_named(undisturbed: DataSet, tmp_path: Path, name: str) -> None:
    import zarr

    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    array = zarr.open_group(str(path), mode="r+")[name]
    array[0] = np.asarray(array[0]) + 1e-9
    with pytest.raises(DataSetError, match=f"{name.split('/')[0]}.*truncated or changed.*--again"):
        generate(path, body(), PLAN)


def test_only_blocks_that_are_there_can_be_made_again(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    for wrong in (999, -1):
        with pytest.raises(DataSetError, match=rf"blocks in 0\.\.6, got \[{wrong}\]"):
            generate(path, body(), PLAN, redo=(0, wrong))
        with pytest.raises(DataSetError, match=rf"a number in 0\.\.6, got {wrong}"):
            drop_block(path, wrong)
    assert DataSet(path).missing_blocks() == []
    assert_same(undisturbed, generate(path, body(), PLAN, redo=(0,)))
    with pytest.raises(DataSetError, match=r"expected a data set with blocks \[0\]"):
        generate(tmp_path / "nothing.zarr", body(), PLAN, redo=(0,))


def test_the_identity_is_that_of_the_samples(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    assert DataSet(path).identity == undisturbed.identity
    drop_block(path, 0)
    assert DataSet(path).identity != undisturbed.identity


def test_a_header_that_was_never_written_is_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(DataSetError, match=r"expected a Zarr 3 data set .*`softtwin generate`"):
        DataSet(tmp_path / "nothing.zarr")


def test_a_lost_header_does_not_cost_what_was_solved(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    (path / "zarr.json").write_text("{")
    with pytest.raises(DataSetError, match="cannot be read"):
        generate(path, body(), PLAN)
    assert len(list((path / "samples" / "checksum" / "c").iterdir())) == undisturbed.block_count


def test_a_full_disk_keeps_what_was_whole(undisturbed: DataSet, tmp_path: Path, monkeypatch) -> None:
    """Writes fail with the error of a full disk from the second block on; with room again the run ends the same."""
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    for block in range(1, undisturbed.block_count):
        drop_block(path, block)
    from softtwin.reference import generate as farm

    written = []

    def full(target: Path, block: int, arrays: dict) -> None:
        if written:
            raise OSError(28, "No space left on device")
        written.append(block)
        write_block(target, block, arrays)

    monkeypatch.setattr(farm, "write_block", full)
    with pytest.raises(OSError, match="No space left"):
        generate(path, body(), PLAN)
    assert DataSet(path).missing_blocks() == list(range(2, undisturbed.block_count))
    monkeypatch.undo()
    generate(path, body(), PLAN)
    assert_same(undisturbed, DataSet(path))


def test_rejected_draws_are_kept_apart_with_their_reason(tmp_path: Path) -> None:
    """A solver that is given no time rejects what needs it; the rest is accepted, and both are told apart."""
    hasty = Plan(
        loads=LoadPlan(modes=6, amplitude=0.5),
        samples={"train": 12, "validation": 1, "test": 1},
        block=3,
        newton=NewtonOptions(max_iterations=6, max_load_steps=1),
    )
    data = generate(tmp_path / "data.zarr", body(), hasty)
    assert data is not None
    rejected, kept = data.rejected(), data.samples("train")
    assert len(rejected.draws) > 0 and len(kept) > 0
    assert set(rejected.reasons) <= {"not converged", "unstable equilibrium"}
    assert not set(rejected.draws) & set(kept.draws)
    assert np.abs(rejected.forces).max() > 0.0  # what was asked of the solver is not lost


def test_the_linear_response_of_low_rank_is_close_to_the_whole(monkeypatch) -> None:
    from softtwin.reference import generate as farm

    with Problem(body(), PLAN.build_material()) as problem:
        loaded = np.setdiff1d(problem.body.boundary_nodes, problem.body.fixed)
        whole = linear_response(problem, loaded)
        monkeypatch.setattr(farm, "_EXACT_COLUMNS", 0)
        monkeypatch.setattr(farm, "_RANK", 60)
        low = linear_response(problem, loaded)
        forces = np.random.default_rng(0).standard_normal((3, len(loaded), 3))
        assert low.left.shape[1] == 60 and low.right.shape == (60, 3 * len(loaded))
        exact, close = whole.apply(forces), low.apply(forces)
        assert np.linalg.norm(close - exact) < 0.03 * np.linalg.norm(exact)
        monkeypatch.setattr(farm, "_RANK", 30)
        monkeypatch.setattr(farm, "_ANY", 10)
        # Loads that are sharper than what the range finder sees best: known ones are met, others as well as before.
        patterns = np.random.default_rng(1).standard_normal((6, len(loaded), 3))
        weights = np.random.default_rng(2).standard_normal((40, 6))
        known, unknown = np.tensordot(weights[:30], patterns, 1), np.tensordot(weights[30:], patterns, 1)
        drawn, blind = linear_response(problem, loaded, known), linear_response(problem, loaded)
    assert drawn.left.shape[1] <= 30 and np.allclose(drawn.left.T @ drawn.left, np.eye(drawn.left.shape[1]), atol=1e-9)
    missed = [np.linalg.norm(each.apply(unknown) - whole.apply(unknown)) for each in (drawn, blind)]
    assert missed[0] < 1e-6 * np.linalg.norm(whole.apply(unknown)) < missed[1]
    exact = whole.apply(forces)
    assert np.linalg.norm(drawn.apply(forces) - exact) < 1.5 * np.linalg.norm(blind.apply(forces) - exact)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"material": "rubber"}, r"Plan\.material: expected one of .* got 'rubber'"),
        ({"young_modulus": -1.0}, r"young_modulus: expected a positive"),
        ({"poisson_ratio": 0.5}, r"poisson_ratio: expected a number in \[0, 0.5\)"),
        ({"samples": {"train": 3}}, r"Plan\.samples: expected at least one draw"),
        ({"block": 0}, r"Plan\.block: expected at least 1"),
    ],
)
def test_plans_that_cannot_be_are_refused(entries: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Plan(**entries)


@pytest.mark.parametrize(
    ("sets", "loads", "message"),
    [
        ({"fixed": body().boundary_nodes}, {}, r"Body\.fixed: expected free nodes on the boundary, got all \d+"),
        ({"held": body().fixed}, {"zones": ("held",)}, r"none of the 9 nodes of \('held',\) is on the free boundary"),
        ({"held": body().fixed}, {"zones": ("tip", "held")}, r"none of the 9 nodes of \('held',\)"),
        ({}, {"zones": ("liver",)}, r"LoadPlan\.zones: expected names among"),
        ({}, {"modes": 81}, r"LoadPlan\.modes: expected 1\.\.80 for 54 free nodes, got 81"),
        (
            {},
            {"displacement": 50.0},
            r"LoadPlan\.displacement: expected at most the size of the body, 0\.663 m, got 50",
        ),
    ],
)
def test_loads_that_a_body_cannot_carry_are_refused(sets: dict, loads: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        generate(tmp_path / "data.zarr", body().with_sets(**sets), replace(PLAN, loads=replace(PLAN.loads, **loads)))
    assert not (tmp_path / "data.zarr").exists()


def test_pilots_that_find_no_equilibrium_are_said(tmp_path: Path) -> None:
    hopeless = replace(PLAN, newton=NewtonOptions(max_iterations=1, max_load_steps=1))
    with pytest.raises(RuntimeError, match="most pilot loads found no equilibrium"):
        generate(tmp_path / "data.zarr", body(), hopeless)


def test_solving_a_block_again_changes_nothing(undisturbed: DataSet, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    shutil.copytree(undisturbed.path, path)
    solve_block(str(path), 2)
    assert_same(undisturbed, DataSet(path))
