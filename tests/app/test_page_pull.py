"""Pulls at the organ: the place follows the mouse, the certificate judges, one hand at a time holds and lets go."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is absent")
pytest.importorskip("torch", reason="torch is absent")

from softtwin.app.page.demo import PHANTOM
from softtwin.app.page.hand import Hand
from softtwin.app.page.pull import Place, Pull, farthest, judged
from softtwin.app.twin import Twin, find_twin
from softtwin.registration.verdict import Verdict


@pytest.fixture(scope="module")
def twin() -> Iterator[Twin]:
    with Twin.open(PHANTOM) as found:
        yield found


@pytest.fixture(scope="module")
def tip(twin: Twin) -> int:
    """The node of the seen side that lies farthest from what holds the organ."""
    seen = np.unique(twin.body.surfaces["observed"])
    away = np.linalg.norm(twin.body.points[seen][:, None] - twin.body.points[twin.body.fixed], axis=2).min(axis=1)
    return int(seen[np.argmax(away)])


def pull_at(twin: Twin, node: int) -> Pull:
    nothing = np.zeros_like(twin.body.points)
    return Pull(twin, twin.body.points[node], nothing, nothing)


@pytest.fixture(scope="module")
def away(twin: Twin, tip: int) -> np.ndarray:
    """The direction in which the tip gives way most."""
    push = np.zeros((3 * len(twin.body.points), 3))
    push[3 * tip : 3 * tip + 3] = np.eye(3)
    state = twin.predict(np.zeros_like(twin.body.points))
    return np.linalg.svd(state.jvp(push)[3 * tip : 3 * tip + 3])[0][:, 0]


def place(millimetres: float, away: np.ndarray) -> Place:
    return Place(1e-3 * millimetres * away, 0.0)


def test_the_place_follows_the_mouse_and_the_state_is_that_of_its_forces(
    twin: Twin, tip: int, away: np.ndarray
) -> None:
    pull = pull_at(twin, tip)
    for size in (2.0, 4.0, 6.0):
        found = pull.to(place(size, away))
        moved = np.linalg.norm(found.displacement[tip])
        # The place is a patch that the tip stands out of: it moves along, by half to twice as much.
        assert 0.5e-3 * size < moved < 2e-3 * size
        assert np.allclose(found.displacement, twin.predict(found.forces).displacement, atol=1e-12)
        assert np.allclose(found.forces[twin.body.fixed], 0.0)
        assert np.allclose(found.pull, found.forces.sum(axis=0))
    assert judged(found) == (Verdict.ACCEPTED, "")


def test_going_back_gives_what_was_there(twin: Twin, tip: int, away: np.ndarray) -> None:
    pull = pull_at(twin, tip)
    first = pull.to(place(3.0, away))
    pull.to(place(6.0, away))
    again = pull.to(place(3.0, away))
    again = pull.to(place(3.0, away))
    # Three amounts make the place be where it is wanted: Newton's method ends where it was, to its own accuracy.
    assert np.abs(again.displacement - first.displacement).max() < 1e-4


def test_a_pull_too_far_is_doubtful_and_stays_worth_a_look(twin: Twin, tip: int, away: np.ndarray) -> None:
    pull = pull_at(twin, tip)
    found = [pull.to(place(size, away)) for size in np.linspace(5.0, 4e3 * farthest(twin), 30)]
    verdict, reason = judged(found[-1])
    assert verdict is Verdict.DOUBTFUL
    assert reason
    assert np.linalg.norm(found[-1].displacement, axis=1).max() < 2.0 * farthest(twin)


def test_a_pull_goes_on_from_what_acts_already(twin: Twin, tip: int, away: np.ndarray) -> None:
    forces = pull_at(twin, tip).to(place(5.0, away)).forces
    shown = twin.predict(forces).displacement
    found = Pull(twin, twin.body.points[tip] + shown[tip], shown, forces).to(Place(np.zeros(3), 0.0))
    assert np.abs(found.displacement - shown).max() < 1e-6


class Page:
    """What a hand draws on and tells."""

    def __init__(self, nodes: int) -> None:
        self.shown, self.predictions = np.zeros((nodes, 3)), list[Any]()
        self.answered, self.ended = threading.Semaphore(0), threading.Semaphore(0)

    def jump(self, displacement: Any) -> None:
        self.shown = displacement

    def show(self, found: Any) -> None:
        self.predictions.append(found)
        self.answered.release()

    def let_go(self) -> None:
        self.ended.release()


@pytest.fixture
def hand() -> Iterator[SimpleNamespace]:
    home = find_twin(PHANTOM)
    page = Page(len(home.body.points))
    found = Hand(home, page, page.show, page.let_go)  # type: ignore[arg-type]
    yield SimpleNamespace(hand=found, page=page, body=home.body)
    found.close()


def test_the_newest_place_wins(hand: Any) -> None:
    held = hand.body.points[hand.body.boundary_nodes[0]]
    hand.hand.take_hold(1, held, np.zeros_like(hand.body.points))
    asked = [held + 1e-5 * k for k in range(200)]
    for target in asked:
        hand.hand.move(1, target)
    assert hand.page.answered.acquire(timeout=120)
    hand.hand.let_go(1)
    assert len(hand.page.predictions) < len(asked)


def test_another_browser_neither_moves_nor_ends_a_pull(hand: Any) -> None:
    held, nothing = hand.body.points[hand.body.boundary_nodes[0]], np.zeros_like(hand.body.points)
    hand.hand.take_hold(1, held, nothing)
    hand.hand.take_hold(2, held, nothing)
    hand.hand.move(2, held + 0.01)
    hand.hand.let_go(2)
    assert hand.hand.is_pulling
    hand.hand.let_go(1)
    assert not hand.hand.is_pulling
    assert hand.page.ended.acquire(timeout=10)
    assert not hand.page.predictions


def test_a_browser_that_goes_away_in_the_middle_leaves_a_hand_that_can_take_hold_again(hand: Any) -> None:
    held, nothing = hand.body.points[hand.body.boundary_nodes[0]], np.zeros_like(hand.body.points)
    hand.hand.take_hold(1, held, nothing)
    hand.hand.move(1, held + 1e-3)
    hand.hand.let_go(1)  # its connection was closed
    hand.hand.take_hold(2, held, nothing)
    hand.hand.move(2, held + 1e-3)
    assert hand.page.answered.acquire(timeout=120)
    hand.hand.let_go(2)
