"""A twin that learns in a second process while frames come: exchanged whole, kept or thrown away, never in the way."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app import learning, live
from softtwin.app.config import ConfigError
from softtwin.app.learning import AS_BUILT, BackgroundLearner
from softtwin.app.quickstart import CAMERA
from softtwin.app.twin import Sequence, Twin
from softtwin.meshes.clouds import partial_view
from softtwin.reference.data.dataset import DataSet
from softtwin.surrogate.exact_states import ExactStates
from softtwin.surrogate.twin import CARD, WEIGHTS

from .conftest import run

pytestmark = pytest.mark.fenicsx
BEYOND, PATIENCE = 2.0, 120.0  # times a load of the test split; seconds


@pytest.fixture(scope="module")
def clouds(small_quickstart: Path) -> list[np.ndarray]:
    """Of a load that grows beyond the training."""
    data, load = DataSet(small_quickstart / "data.zarr"), None
    load = np.zeros_like(data.body.points)
    load[data.response.loaded] = data.samples("test").forces[0]
    with Twin.open(small_quickstart) as twin:
        exact, rng = ExactStates(twin.network), np.random.default_rng(0)
        states = [exact.frame(share * load, None, twin.network) for share in np.linspace(0.5, BEYOND, 12)]
        return [partial_view(twin.body, u.displacement, CAMERA, 400, 5e-4, rng, surface="observed") for u in states]


def until(happens: Callable[[], bool], meanwhile: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not happens():
        assert time.monotonic() < end, "it has not happened"
        meanwhile()


@pytest.mark.parametrize("engine", ["hybrid", pytest.param("surrogate", marks=pytest.mark.slow)])
def test_a_sequence_is_given_what_was_learned_between_two_frames(
    small_quickstart: Path, clouds: list[np.ndarray], engine: str, tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    shutil.copytree(small_quickstart, folder)
    built = {name: (folder / "twin" / name).read_bytes() for name in (WEIGHTS, CARD)}
    lines: list[str] = []
    with (
        Twin.open(folder, engine, pose="fixed") as twin,
        BackgroundLearner(twin, seconds=0.5, say=lines.append) as learner,
    ):
        first, sequence = twin.network, Sequence(twin, "", is_live=True, learner=learner)
        numbers = iter(range(100_000))

        def watch() -> None:
            sequence.register(clouds[next(numbers) % len(clouds)])
            time.sleep(0.3)  # learning is given way to frames, and would wait where they take all of a machine

        until(lambda: twin.network is not first, watch)
        frame = sequence.register(clouds[3])
        sequence.close()
        assert frame.judgement.is_usable and twin.network.card["adaptation"]["kept_back"] >= 1
        assert learner.learned.adaptations >= 1 and learner.learned.frames >= 3 and not learner.learned.refused
        assert "learned 1 times from" in lines[0] and "% before" in lines[0]
        if engine == "surrogate":
            assert twin.bounded(frame.registration) is not None
        assert {name: (folder / "twin" / name).read_bytes() for name in built} == built  # nothing on disk so far
        assert learner.keep(folder / "twin") and learner.keep(folder / "twin")
    as_built = {name: (folder / "twin" / AS_BUILT / name).read_bytes() for name in built}
    assert as_built == built  # by the second time, too
    with Twin.open(folder) as kept, Twin.open(small_quickstart) as before:
        assert kept.network.card["adaptation"]["frames"] >= 3
        assert kept.network.discrepancy is not None and before.network.discrepancy is not None
        assert np.array_equal(kept.network.discrepancy.modes, before.network.discrepancy.modes)


def test_twins_are_exchanged_whole_while_frames_are_read(small_quickstart: Path, clouds: list[np.ndarray]) -> None:
    with Twin.open(small_quickstart, pose="fixed") as twin:
        plain = [twin.register(cloud, "").displacement for cloud in clouds[:3]]
        renewed = twin.with_network(twin.network.with_card(adaptation={}))
        assert twin.network is not renewed.network and renewed.registrar("").model is renewed.network
        ended = threading.Event()

        def exchange() -> None:
            pair = [twin.with_network(twin.network), twin.with_network(twin.network)]
            while not ended.is_set():
                for each in pair:
                    twin.adopt(each)

        thread = threading.Thread(target=exchange)
        thread.start()
        try:
            for _ in range(3):
                for cloud, displacement in zip(clouds, plain, strict=False):
                    assert np.allclose(twin.register(cloud, "").displacement, displacement, atol=1e-9)
        finally:
            ended.set()
            thread.join()


def test_what_follows_a_frame_starts_from_it_with_the_new_surrogate(
    small_quickstart: Path, clouds: list[np.ndarray]
) -> None:
    with Twin.open(small_quickstart, pose="fixed") as twin:
        last = twin.register(clouds[0], "")
        renewed = twin.with_network(twin.network.with_card(adaptation={}))
        plain, other = (each.register(clouds[1], "", last) for each in (twin, renewed))
        assert np.allclose(other.displacement, plain.displacement, atol=1e-6)
        assert other.prepared.whole is renewed.network


def test_the_end_of_the_other_process_ends_learning_and_nothing_else(
    small_quickstart: Path, clouds: list[np.ndarray]
) -> None:
    lines: list[str] = []
    with Twin.open(small_quickstart, pose="fixed") as twin, BackgroundLearner(twin, say=lines.append) as learner:
        sequence = Sequence(twin, "", learner=learner)
        os.kill(learner._process.pid or 0, signal.SIGKILL)
        until(lambda: bool(lines), lambda: time.sleep(0.05))
        assert lines == ["learning has ended by itself; the twin goes on as it is"]
        assert sequence.register(clouds[0]).judgement.is_usable and not learner.keep(small_quickstart / "twin")


def test_ctrl_c_keeps_what_was_learned(small_quickstart: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other process is sent it, too, and goes on until the twin ends it."""
    kept: list[bool] = []

    def interrupted(*_: object, learner: BackgroundLearner, **__: object) -> None:
        until(lambda: learner._is_ready, lambda: time.sleep(0.05))
        os.kill(learner._process.pid or 0, signal.SIGINT)
        time.sleep(0.5)
        kept.append(learner._process.is_alive())
        raise KeyboardInterrupt

    monkeypatch.setattr(live, "register_live", interrupted)
    monkeypatch.setattr(live, "_keep", lambda learner, folder, say: kept.append(folder == small_quickstart / "twin"))
    with pytest.raises(KeyboardInterrupt):
        live.watch_source(small_quickstart / "twin", tmp_path, tmp_path / "found", {}, learn=True, keep=True)
    assert kept == [True, True]


def test_twins_that_cannot_learn_say_why(small_quickstart: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(said: str, engine: str = "surrogate", **options: object) -> None:
        with Twin.open(small_quickstart, engine, **options) as twin, pytest.raises(ConfigError, match=said):
            BackgroundLearner(twin)

    refused("expected a twin that registers with its surrogate", "torch")
    refused("expected forces in known places as all that is unknown", "hybrid", parameters=["young-modulus"])
    monkeypatch.setattr(learning.OnlineLearner, "check", lambda surrogate: (_ for _ in ()).throw(ValueError("no way")))
    refused("--learn: no way")


def test_the_command_line_learns_while_it_watches(
    small_quickstart: Path, clouds: list[np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, source = tmp_path / "out", tmp_path / "clouds"
    shutil.copytree(small_quickstart, folder)
    source.mkdir()
    twin, where = folder / "twin", ["--pose", "fixed", "--output", tmp_path / "found"]
    for words, said in (
        (["--learn"], "--learn: expected --watch beside it"),
        (["--watch", "--keep"], "--keep: expected --learn beside it"),
    ):
        assert said in run(capsys, "register", twin, source, *words, *where, code=2)
    for number, cloud in enumerate(clouds[:3]):
        np.save(source / f"cloud_{number}.npy", cloud)
    said = run(capsys, "register", twin, source, "--watch", "--learn", "--keep", "--idle", "4", *where)
    assert "learned" in said and "frames, " in said
    assert "nothing to keep" in said or (twin / AS_BUILT / WEIGHTS).is_file()


def test_a_disk_that_is_full_leaves_the_twin_as_it_was(
    small_quickstart: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    shutil.copytree(small_quickstart, folder)
    before = {path.name: path.read_bytes() for path in (folder / "twin").iterdir()}
    with Twin.open(folder) as twin, BackgroundLearner(twin) as learner:
        learner.learned.adaptations = 1

        def full(*_: object, **__: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(learning.shutil, "copy2", full)
        with pytest.raises(OSError, match="No space left"):
            learner.keep(folder / "twin")
    after = {path.name: path.read_bytes() for path in (folder / "twin").iterdir() if path.is_file()}
    assert after == before
