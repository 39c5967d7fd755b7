"""Searches from rest in a process of their own: the states that a search here finds, and none that is waited for."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app import searching as module
from softtwin.app.quickstart import CAMERA
from softtwin.app.searching import SearchProcess, searching
from softtwin.app.twin import SearchEnded, Sequence, Twin, TwinWays
from softtwin.meshes.clouds import partial_view
from softtwin.reference.data.dataset import DataSet
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.pose import Pose
from softtwin.registration.result import Registration
from softtwin.registration.strategies.resuming import Found
from softtwin.registration.verdict import Verdict

pytestmark = pytest.mark.fenicsx
PATIENCE = 120.0  # seconds


def nothing() -> None:
    """What waits for nothing."""


@pytest.fixture(scope="module")
def clouds(small_quickstart: Path) -> list[np.ndarray]:
    """Of three held-out states."""
    data, rng = DataSet(small_quickstart / "data.zarr"), np.random.default_rng(0)
    states = data.samples("test").displacements[:3]
    return [partial_view(data.body, u, CAMERA, 400, 5e-4, rng, surface="observed") for u in states]


@pytest.fixture(scope="module")
def twin(small_quickstart: Path) -> Iterator[Twin]:
    with Twin.open(small_quickstart, "surrogate") as opened:
        yield opened


def ready(process: SearchProcess) -> SearchProcess:
    end = time.monotonic() + PATIENCE
    while not process.is_ready:
        assert time.monotonic() < end, "it has not begun"
        time.sleep(0.05)
    return process


@pytest.fixture(scope="module")
def process(twin: Twin) -> Iterator[SearchProcess]:
    with closing(SearchProcess(twin)) as started:
        yield ready(started)


def far_apart(one: Registration, other: Registration) -> float:
    """In their margins."""
    off = np.linalg.norm(one.displacement - other.displacement, axis=1)
    return float(off.mean() / other.uncertainty.margin().mean())


@pytest.mark.parametrize(
    "camera", [None, Pose.identity().moved(np.array([0.3, 0.1, 0.0, 0.02, 0.0, 0.1]), np.zeros(3))]
)
def test_it_finds_what_is_found_here(
    twin: Twin, process: SearchProcess, clouds: list[np.ndarray], camera: Pose | None
) -> None:
    for cloud in clouds[:2]:
        given = cloud if camera is None else camera.apply(cloud)
        found = process.found(given, None, camera or twin.as_said, nothing)
        assert found is not None
        waiting = replace(twin.ways(None, camera), search=_Given(found)).beside(nothing)
        resumed, wanted = waiting.follow(given, None), twin.ways(None, camera).follow(given, None)
        assert far_apart(resumed, wanted) < 0.2, (resumed.judgement, wanted.judgement)
        np.testing.assert_array_equal(resumed.pose.rotation, wanted.pose.rotation)


class _Given:
    """Gives what is given, or raises it, and counts how often."""

    is_ready = True

    def __init__(self, found: Found | Exception | None) -> None:
        self._found, self.asked = found, 0

    def found(self, *words: Any) -> Found | None:
        self.asked += 1
        if isinstance(self._found, Exception):
            raise self._found
        return self._found


def test_clouds_of_no_use_have_no_answer_and_the_next_has_one(process: SearchProcess, clouds: list[np.ndarray]) -> None:
    for poor in (np.full((50, 3), np.nan), clouds[0] + 3.0, clouds[0][:0]):
        assert process.found(poor, None, None, nothing) is None
    assert process.found(clouds[0], "no such zone", None, nothing) is None
    assert process.found(clouds[0], None, None, nothing) is not None


def test_a_sequence_that_is_lost_goes_on_from_there(
    twin: Twin, process: SearchProcess, clouds: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = _Counted(process)
    monkeypatch.setattr(TwinWays, "is_lost", lambda ways, found, last: counted.asked == 0)
    with closing(Sequence(twin, is_live=True, search=counted)) as sequence:
        frames = [sequence.register(cloud) for cloud in (clouds[0], clouds[1])]
        end = time.monotonic() + PATIENCE
        while not counted.answered:
            assert time.monotonic() < end, "nothing was searched for"
            frames.append(sequence.register(clouds[1]))
    assert frames[1].judgement.verdict is Verdict.DOUBTFUL
    assert any("is being searched for from rest" in reason for reason in frames[1].judgement.reasons)
    assert all(frame.judgement.is_usable for frame in frames)
    assert counted.asked == 1


class _Counted:
    """A process that counts what it is asked for."""

    def __init__(self, process: SearchProcess) -> None:
        self._process, self.asked, self.answered = process, 0, 0

    @property
    def is_ready(self) -> bool:
        return self._process.is_ready

    def found(self, *words: Any) -> Found | None:
        self.asked += 1
        found = self._process.found(*words)
        self.answered += 1
        return found


def test_where_it_has_ended_the_search_is_made_here(twin: Twin, clouds: list[np.ndarray]) -> None:
    ended = _Given(SearchEnded("gone"))
    ways = replace(twin.ways(None, None), search=ended)
    assert ways.beside(nothing).follow(clouds[0], None).judgement.is_usable
    assert ended.asked == 1
    assert ways.follow(clouds[0], None).judgement.is_usable  # no frame waits for it
    assert ended.asked == 1
    with pytest.raises(NotConverged):
        replace(ways, search=_Given(None)).beside(nothing).follow(clouds[0], None)


@pytest.mark.parametrize("ends", ["killed", "closed", "not wanted"])
def test_who_waits_is_told_of_the_end(twin: Twin, clouds: list[np.ndarray], ends: str) -> None:
    other = SearchProcess(twin)
    count = iter(range(10**6))

    def wait() -> None:
        if next(count) == 1 and ends == "killed":
            other._process.kill()
        elif ends == "not wanted":
            raise KeyboardInterrupt

    if ends == "closed":
        other.close()
    wanted: Callable[..., Any] = pytest.raises(KeyboardInterrupt if ends == "not wanted" else SearchEnded)
    with wanted:
        other.found(clouds[0], None, None, wait)
        other.found(clouds[0], None, None, wait)
    assert not other.is_ready
    other.close()
    assert other._process.poll() is not None


def test_it_is_started_where_it_is_of_use(twin: Twin, small_quickstart: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda number: {0, 1}, raising=False)
    with searching(twin) as started:
        assert isinstance(started, SearchProcess)
    assert started._process.poll() is not None
    with Twin.open(small_quickstart, "reference") as exact, searching(exact) as none:
        assert none is None
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda number: {0}, raising=False)
    with searching(twin) as none:
        assert none is None
