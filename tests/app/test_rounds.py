"""Active rounds: draws chosen where a network is least in balance, none of them held out, nothing lost on the way."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")


from softtwin.app.config import Config, ConfigError, to_toml
from softtwin.app.stages import rounds
from softtwin.app.stages.generate import describe_data, generate_stage
from softtwin.app.stages.learn import train_stage, validate_stage
from softtwin.app.stages.mesh import mesh_stage
from softtwin.app.workspace import Workspace, open_workspace
from softtwin.meshes.shapes import beam
from softtwin.reference.data.dataset import NEEDED, DataSet, DataSetError
from softtwin.reference.data.jacobians import missing_jacobians, read_jacobians
from softtwin.reference.data.merge import merge
from softtwin.reference.data.shard import Shard
from softtwin.reference.data.summary import summary
from softtwin.reference.data.writing import drop_block, write_chosen
from softtwin.reference.generate import candidate_loads, plan_from_header, ramp_loads, solve_block
from softtwin.surrogate.acquisition import most_informative, spread_out
from softtwin.surrogate.error_indicators import CalibrationError, IndicatorReader
from softtwin.surrogate.model import Surrogate
from softtwin.surrogate.twin import load

from .conftest import run

SAMPLES = {"train": 6, "validation": 4, "test": 4, "block": 2, "ranks": 1, "rounds": 2, "chosen": 4, "candidates": 3}
ENTRIES = {
    "folder": ".",
    "body": {"source": "beam", "cell_size": 0.1},
    "loads": {"modes": 4, "displacement": 0.15, "patches": 1},
    "samples": SAMPLES,
    "training": {"modes": 4, "width": 16, "seconds": 0.8},
}


def workspace(folder: Path, **samples: object) -> Workspace:
    folder.mkdir(parents=True, exist_ok=True)
    config = Config.model_validate({**ENTRIES, "samples": {**SAMPLES, **samples}})
    (folder / "organ.toml").write_text(to_toml(config))
    space = open_workspace(folder / "organ.toml")
    mesh_stage(space)
    return space


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    space = workspace(tmp_path_factory.mktemp("rounds") / "twin")
    generate_stage(space.root / "organ.toml")
    return space


@pytest.fixture
def copied(made: Workspace, tmp_path: Path) -> Workspace:
    shutil.copytree(made.root, tmp_path / "twin")
    return open_workspace(tmp_path / "twin" / "organ.toml")


# ---------------------------------------------------------------------- what is chosen


@pytest.mark.slow
def test_each_round_takes_other_candidates_of_its_own_pool(made: Workspace) -> None:
    data = DataSet(made.data)
    assert data.chosen.shape == (8,) and len(set(data.chosen)) == 8
    for number in range(2):
        own = data.chosen[4 * number : 4 * number + 4]
        assert (own >= 12 * number).all() and (own < 12 * number + 12).all()
    assert "8 of them chosen in active rounds" in describe_data(data)
    assert summary(data).draws["active"]


def test_what_was_chosen_is_what_was_solved_and_is_held_out_nowhere(made: Workspace) -> None:
    data, plan = DataSet(made.data), plan_from_header(DataSet(made.data).header)
    draws = data.split_draws("active")
    stored = data.rows(draws)["forces"]
    for place, candidate in enumerate(data.chosen):
        loads, factors = candidate_loads(data, plan, int(candidate))
        np.testing.assert_array_equal(stored[place], (factors[0] * loads)[data.response.loaded])
        again, _ = ramp_loads(data, plan, draws.start + place)
        np.testing.assert_array_equal(again, loads)
    others = np.concatenate([data.rows(data.split_draws(split))["forces"] for split in NEEDED])
    gaps = np.abs(stored[:, None] - others[None]).max(axis=(2, 3))
    assert gaps.min() > 0.0


def test_they_are_learned_from_behind_the_training_draws(made: Workspace) -> None:
    data = DataSet(made.data)
    whole, active = data.samples("train"), data.samples("active")
    np.testing.assert_array_equal(whole.draws[-len(active) :], active.draws)
    assert len(data.samples("train", 6)) == len(whole) - len(active)
    np.testing.assert_array_equal(data.samples("train", 10).draws[-4:], active.draws[:4])
    assert len(data.figures("train")["reason"]) == 14
    assert missing_jacobians(data) == []
    known = read_jacobians(data, whole.draws)
    assert known is not None and (np.abs(known.values).max(axis=(1, 2)) > 0.0).all()


def test_a_twin_is_trained_and_validated_on_them(copied: Workspace) -> None:
    surrogate = train_stage(copied)
    assert surrogate.card["samples"]["train"] == len(DataSet(copied.data).samples("train"))
    assert "nodal" in validate_stage(copied)


def test_the_loads_least_in_balance_are_taken_and_as_many_as_they_come(made: Workspace) -> None:
    data, plan = DataSet(made.data), plan_from_header(DataSet(made.data).header)
    network = load(made.data.parent / "rounds" / "1", data.body)
    pool = [candidate_loads(data, plan, number) for number in range(40)]
    forces = [factors[:, None, None] * loads for loads, factors in pool]
    reader = IndicatorReader(network)
    steps = np.array([reader.read(each[0], network.solve(each[0])).step for each in forces])
    places = most_informative(network, forces, 5, data.samples("train", 6).forces)
    assert len(set(places)) == 5
    assert set(places[::2]) <= set(np.argsort(-steps)[:12])
    assert places[1::2].tolist() == [place for place in range(5) if place not in places[::2]][:2]
    with pytest.raises(ValueError, match="candidates: expected at least 41, got 40"):
        most_informative(network, forces, 41, data.samples("train", 6).forces)


def test_points_are_spread_out_from_what_is_taken() -> None:
    points = np.array([[0.1], [5.0], [4.9], [-3.0], [2.4]])
    assert spread_out(points, 4, np.zeros((1, 1))).tolist() == [1, 3, 4, 0]
    assert sorted(spread_out(np.zeros((3, 2)), 3, np.zeros((1, 2))).tolist()) == [0, 1, 2]  # all alike: each once


# ---------------------------------------------------------------------- nothing is lost


def test_it_goes_on_where_it_was_stopped(copied: Workspace) -> None:
    before = DataSet(copied.data)
    chosen, identity = before.chosen, before.identity
    first = before.split_draws("active").start
    truth = before.samples("train")
    generate_stage(copied.root / "organ.toml")
    assert DataSet(copied.data).identity == identity
    drop_block(copied.data, first // 2 + 1)
    with pytest.raises(DataSetError, match="was never finished"):
        DataSet(copied.data).samples("train")
    generate_stage(copied.root / "organ.toml")
    again = DataSet(copied.data)
    np.testing.assert_array_equal(again.chosen, chosen)
    np.testing.assert_array_equal(again.samples("train").displacements, truth.displacements)  # from the same network


def test_a_round_that_is_not_chosen_yet_is_chosen(copied: Workspace, tmp_path: Path) -> None:
    whole = DataSet(copied.data)
    fresh = workspace(tmp_path / "fresh", jacobians=False)
    from softtwin.app.inputs import plan_entries
    from softtwin.reference.generate import generate

    data = generate(fresh.data, whole.body, plan_from_header({"plan": plan_entries(fresh.config)}))
    assert data is not None and len(data.missing_blocks()) == 4 and rounds.next_round(fresh.config, data) == 0
    with pytest.raises(DataSetError, match="never finished"):
        train_stage(fresh)
    with pytest.raises(DataSetError, match="nobody has chosen yet"):
        ramp_loads(data, plan_from_header(data.header), data.split_draws("active").start)
    rounds.choose(fresh, data, 0)
    assert rounds.next_round(fresh.config, DataSet(fresh.data)) == 1
    done = generate_stage(fresh.root / "organ.toml")
    assert done is not None and done.missing_blocks() == [] and (done.chosen >= 0).all()


@pytest.mark.mpi
@pytest.mark.chain
def test_two_ranks_make_the_rounds_together(tmp_path: Path, mpi_environment: dict[str, str]) -> None:
    space = workspace(tmp_path / "twin")
    command = [
        "mpirun",
        "-n",
        "2",
        sys.executable,
        "-m",
        "softtwin.app.cli",
        "generate",
        str(space.root / "organ.toml"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, env=mpi_environment)
    assert done.returncode == 0, done.stdout + done.stderr
    data = DataSet(space.data)
    assert data.missing_blocks() == [] and missing_jacobians(data) == [] and len(set(data.chosen)) == 8


def test_a_start_from_a_network_ends_in_the_same_states(copied: Workspace) -> None:
    data = DataSet(copied.data)
    draws = data.split_draws("test")
    before = data.rows(draws)

    class Near:
        """Knows the equilibria to a thousandth."""

        body, learned_material, asked = data.body, None, 0

        def propose(self, forces: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
            self.asked += 1
            gaps = np.abs(before["forces"] - forces[data.response.loaded]).max(axis=(1, 2))
            assert gaps.min() == 0.0
            return 1.001 * before["displacements"][gaps.argmin()]

    network = Near()
    for block in (draws.start // 2, draws.start // 2 + 1):
        drop_block(copied.data, block)
        solve_block(str(copied.data), block, network)
    after = DataSet(copied.data).rows(draws)
    assert network.asked == 4 and after["iterations"].sum() < before["iterations"].sum()
    largest = np.abs(before["displacements"]).max()
    np.testing.assert_allclose(after["displacements"], before["displacements"], atol=1e-6 * largest)
    np.testing.assert_array_equal(after["reason"], before["reason"])


@pytest.mark.parametrize("part", [None, Shard(0, 1)], ids=["whole", "part"])
def test_the_stage_asks_the_network_of_its_round(
    copied: Workspace, monkeypatch: pytest.MonkeyPatch, part: Shard | None
) -> None:
    """For each draw of a round that is solved, and for no other; each asked network is that of its round."""
    data, asked = DataSet(copied.data), []
    own = [load(copied.data.parent / "rounds" / str(number), data.body).card["training"] for number in (1, 2)]
    propose = Surrogate.propose

    def counted(self: Surrogate, *arguments: object) -> np.ndarray:
        asked.append(own.index(self.card["training"]))
        return propose(self, *arguments)

    monkeypatch.setattr(Surrogate, "propose", counted)
    first = data.split_draws("active").start
    dropped = data.rows(range(first, first + 2)), data.rows(range(first + 4, first + 6))
    for block in (0, first // 2, first // 2 + 2):
        drop_block(copied.data, block)
    generate_stage(copied.root / "organ.toml", shard=part)
    assert asked == [0, 0, 1, 1]
    again = DataSet(copied.data)
    assert again.missing_blocks() == []
    for place, before in zip((first, first + 4), dropped, strict=True):
        np.testing.assert_array_equal(again.rows(range(place, place + 2))["displacements"], before["displacements"])


def test_a_block_whose_network_is_lost_is_solved_from_rest_and_that_is_said(copied: Workspace) -> None:
    data = DataSet(copied.data)
    draws = data.split_draws("active")
    before = data.rows(draws)
    shutil.rmtree(copied.root / "rounds" / "1")
    drop_block(copied.data, draws.start // 2)
    with pytest.warns(UserWarning, match=r"rounds/1: the network that chose these draws is not there"):
        generate_stage(copied.root / "organ.toml")
    after = DataSet(copied.data).rows(draws)
    largest = np.abs(before["displacements"]).max()
    np.testing.assert_allclose(after["displacements"], before["displacements"], atol=1e-6 * largest)


# ---------------------------------------------------------------------- what is refused


def test_rounds_of_a_material_that_torch_does_not_know_say_so(made: Workspace) -> None:
    data = DataSet(made.data)
    network = load(made.data.parent / "rounds" / "1", data.body)
    network = Surrogate(network.body, network.encoder_decoder, network.network, {**network.card, "data": {}})
    with pytest.raises(CalibrationError, match="material"):
        most_informative(network, [np.zeros((1, *data.body.points.shape))], 1, data.samples("train", 6).forces)


def test_a_network_of_another_body_is_no_start(made: Workspace, copied: Workspace) -> None:
    network = load(made.data.parent / "rounds" / "1", DataSet(made.data).body)
    network.body = beam((6, 2, 2), (0.7, 0.2, 0.2), "hexahedron")
    with pytest.raises(ValueError, match="predictor: expected a network of this body"):
        solve_block(str(copied.data), 0, network)


def test_places_are_taken_once(copied: Workspace) -> None:
    with pytest.raises(DataSetError, match=r"expected 2 free places from 0 in .*, got 0"):
        write_chosen(copied.data, 0, np.array([1, 2]))
    with pytest.raises(DataSetError, match=r"expected 2 free places from 8 in .*, got 0"):
        write_chosen(copied.data, 8, np.array([1, 2]))


def test_rounds_are_whole_blocks() -> None:
    with pytest.raises(ValueError, match=r"samples\.chosen: expected whole blocks of 2 draws, got 3"):
        Config.model_validate({**ENTRIES, "samples": {**SAMPLES, "chosen": 3}})


def test_rounds_without_torch_say_what_is_missing(copied: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "softtwin.app.stages.rounds")
    monkeypatch.delattr("softtwin.app.stages.rounds")
    monkeypatch.setitem(sys.modules, "softtwin.surrogate.train", None)
    with pytest.raises(ConfigError, match=r"samples\.rounds: expected torch for the networks that choose draws"):
        generate_stage(copied.root / "organ.toml")


def test_a_part_without_torch_says_what_it_does(copied: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "softtwin.app.stages.rounds")
    monkeypatch.delattr("softtwin.app.stages.rounds")
    monkeypatch.setitem(sys.modules, "softtwin.surrogate.train", None)
    data = DataSet(copied.data)
    drop_block(copied.data, data.split_draws("active").start // 2)
    with pytest.warns(UserWarning, match=r"shard 0/1: samples\.rounds: expected torch .* are solved from rest"):
        made = generate_stage(copied.root / "organ.toml", shard=Shard(0, 1))
    assert made is not None and made.missing_blocks() == []


@pytest.mark.mpi
def test_all_ranks_end_where_torch_is_missing(copied: Workspace, mpi_environment: dict[str, str]) -> None:
    program = "import sys; sys.modules['softtwin.surrogate.train'] = None; from softtwin.app.cli import main; main()"
    command = ["mpirun", "-n", "2", sys.executable, "-c", program, "generate", str(copied.root / "organ.toml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=mpi_environment)
    assert done.returncode != 0 and (done.stdout + done.stderr).count("samples.rounds: expected torch") == 1


def test_a_damaged_choice_is_told(copied: Workspace) -> None:
    (chunk,) = [path for path in (copied.data / "active" / "ramps" / "c").rglob("*") if path.is_file()]
    chunk.write_bytes(b"no zarr")
    with pytest.raises(DataSetError, match=r"active/ramps in .* cannot be read"):
        _ = DataSet(copied.data).chosen


def test_other_rounds_are_another_data_set(copied: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    path = copied.root / "organ.toml"
    path.write_text(path.read_text().replace("rounds = 2 ", "rounds = 3 "))
    said = run(capsys, "generate", path, code=2)
    assert "samples.active (8 there, 12 here)" in said


def test_merged_sets_learn_from_all_of_it(copied: Workspace, tmp_path: Path) -> None:
    other = workspace(tmp_path / "other", seed=1, rounds=0, jacobians=False)
    generate_stage(other.root / "organ.toml")
    data = DataSet(copied.data)
    both = merge([data, DataSet(other.data)], tmp_path / "both.zarr")
    assert len(both.split_draws("train")) == 14 + 6 and len(both.split_draws("active")) == 0
    own = data.samples("train").displacements
    np.testing.assert_array_equal(both.samples("train").displacements[: len(own)], own)
