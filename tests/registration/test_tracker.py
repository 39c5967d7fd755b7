"""The state machine of a sequence: each transition of the table in `Tracker`, with frames that are told beforehand."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from softtwin.meshes.clouds import CloudError
from softtwin.reference.data.outcome import NotConverged
from softtwin.registration.tracker import Phase, Tracker
from softtwin.registration.verdict import Check, Code, Judgement, Verdict

CLOUD = np.zeros((4, 3))
LEVELS = {"good": Verdict.ACCEPTED, "odd": Verdict.DOUBTFUL, "wrong": Verdict.REFUSED}


@dataclass(frozen=True)
class Found:
    """As much of a result as a tracker looks at."""

    name: str
    judgement: Judgement
    scatter: float = 1e-3

    def with_check(self, check: Check) -> Found:
        return replace(self, judgement=self.judgement.with_check(check))


def found(name: str, level: str = "good", scatter: float = 1e-3) -> Any:
    return Found(name, Judgement(LEVELS[level]), scatter)


class Told:
    """Ways whose results are told beforehand; beside the frames they wait until they are let go."""

    def __init__(self, **results: Any) -> None:
        self.results, self.taken, self.go = results, list[tuple[str, str]](), threading.Event()
        self.asked_of: list[str] = []
        self.before_step: Callable[[], None] | None = None

    def beside(self, before_step: Callable[[], None]) -> Told:
        other = copy.copy(self)
        other.before_step = before_step
        return other

    def track(self, cloud: Any, last: Any) -> Any:
        return self._given("track" if self.before_step is None else "caught_up", last)

    def follow(self, cloud: Any, last: Any) -> Any:
        if self.before_step is None:
            return self._given("follow", last)
        assert self.go.wait(10.0)
        self.before_step()
        return self._given("search", last)

    def is_lost(self, found: Any, last: Any) -> bool:
        return bool(found.judgement.verdict is not Verdict.ACCEPTED or found.scatter > 1.5 * last.scatter)

    def is_missed(self, found: Any) -> bool:
        return "elsewhere" in self.results

    def asked(self, cloud: Any, found: Any) -> Any:
        assert self.go.wait(10.0)
        self.asked_of.append(found.name)
        return found.with_check(self.results["elsewhere"])

    def _given(self, way: str, last: Any) -> Any:
        self.taken.append((way, "" if last is None else last.name))
        if isinstance(self.results[way], Exception):
            raise self.results[way]
        return self.results[way]


def following(tracker: Tracker) -> Tracker:
    tracker.take(CLOUD, Told(follow=found("first")))
    assert tracker.phase is Phase.FOLLOWING
    return tracker


def searching(tracker: Tracker, tracked: Any, searched: Any) -> Told:
    """A tracker in whose background a search waits."""
    ways = Told(track=tracked, search=searched)
    answer = following(tracker).take(CLOUD, ways)
    assert tracker.phase is Phase.SEARCHING and answer.judgement.verdict is not Verdict.ACCEPTED
    return ways


def ended(tracker: Tracker, ways: Told) -> None:
    search = tracker._search
    assert search is not None
    ways.go.set()
    search.exception(10.0)


@pytest.fixture(params=[False, True], ids=["inline", "background"])
def tracker(request: pytest.FixtureRequest) -> Any:
    made = Tracker(background=request.param)
    yield made
    made.close()


@pytest.fixture
def live() -> Any:
    made = Tracker(background=True)
    yield made
    made.close()


def test_the_first_clouds_are_sought_from_rest_until_one_is_usable(tracker: Tracker) -> None:
    assert tracker.phase is Phase.LOST
    ways = Told(follow=found("nothing", "wrong"))
    assert tracker.take(CLOUD, ways).name == "nothing" and tracker.phase is Phase.LOST  # type: ignore[attr-defined]
    ways.results["follow"] = found("first", "odd")
    assert tracker.take(CLOUD, ways).name == "first" and tracker.phase is Phase.FOLLOWING  # type: ignore[attr-defined]
    assert ways.taken == [("follow", ""), ("follow", "")]


def test_without_a_background_an_answer_waits_for_the_better_one() -> None:
    ways, tracker = Told(follow=found("second", "odd")), following(Tracker())
    assert tracker.take(CLOUD, ways).name == "second"  # type: ignore[attr-defined]
    assert ways.taken == [("follow", "first")] and tracker.phase is Phase.FOLLOWING


def test_an_accepted_cloud_is_tracked_from_the_last(live: Tracker) -> None:
    ways = Told(track=found("second"))
    assert following(live).take(CLOUD, ways).judgement.verdict is Verdict.ACCEPTED
    ways.results["track"] = found("third")
    live.take(CLOUD, ways)
    assert ways.taken == [("track", "first"), ("track", "second")] and live.phase is Phase.FOLLOWING


@pytest.mark.parametrize("lost", [found("lost", "odd"), found("far", "good", 2e-3)], ids=["doubtful", "met worse"])
def test_no_answer_waits_for_a_search(live: Tracker, lost: Any) -> None:
    ways = searching(live, lost, found("rest"))
    ways.results["track"] = found("meanwhile", "good", 2e-3)
    answer = live.take(CLOUD, ways)
    assert answer.name == "meanwhile" and live.phase is Phase.SEARCHING  # type: ignore[attr-defined]
    assert answer.judgement.verdict is Verdict.DOUBTFUL and "searched for" in answer.judgement.reasons[-1]
    assert [way for way, _ in ways.taken] == ["track", "track"]  # the search waits, and no other was begun
    ways.go.set()


def test_what_a_search_found_better_is_gone_on_from(live: Tracker) -> None:
    ways = searching(live, found("lost", "odd"), found("rest"))
    ended(live, ways)
    ways.results["track"] = found("next")
    assert live.take(CLOUD, ways).judgement.verdict is Verdict.ACCEPTED
    assert ways.taken[-1] == ("track", "rest") and live.phase is Phase.FOLLOWING


@pytest.mark.parametrize(
    "searched",
    [found("rest", "odd", 5e-3), found("rest", "wrong"), NotConverged("none"), CloudError("far")],
    ids=["worse", "refused", "no state", "no cloud"],
)
def test_what_a_search_found_no_better_is_forgotten(live: Tracker, searched: Any) -> None:
    ways = searching(live, found("lost", "odd"), searched)
    ended(live, ways)
    ways.results["track"] = found("next")
    live.take(CLOUD, ways)
    assert ways.taken[-1] == ("track", "lost") and live.phase is Phase.FOLLOWING


@pytest.mark.parametrize(("caught_up", "begun"), [(found("there"), "there"), (found("there", "odd", 5e-3), "second")])
def test_a_search_catches_up_with_the_newest_cloud(live: Tracker, caught_up: Any, begun: str) -> None:
    """What is tracked from it counts where that is better for the newest cloud, too."""
    ways = searching(live, found("lost", "odd"), found("rest"))
    ways.results |= {"track": found("second", "odd"), "caught_up": caught_up}
    live.take(CLOUD, ways)
    ended(live, ways)
    assert ways.taken[-1] == ("caught_up", "rest")
    ways.results["track"] = found("third")
    live.take(CLOUD, ways)
    assert ways.taken[-1] == ("track", begun)


def test_a_refused_frame_is_an_answer_and_nothing_follows_from_it(live: Tracker) -> None:
    ways = searching(live, found("wrong", "wrong"), found("rest", "wrong"))
    ended(live, ways)
    ways.results["track"] = found("next")
    live.take(CLOUD, ways)
    assert ways.taken[-1] == ("track", "first")


def test_where_the_model_finds_no_state_it_begins_at_rest(live: Tracker) -> None:
    ways = Told(track=NotConverged("none"), follow=found("rest"))
    assert following(live).take(CLOUD, ways).name == "rest"  # type: ignore[attr-defined]
    assert ways.taken == [("track", "first"), ("follow", "")] and live.phase is Phase.FOLLOWING


def test_a_fault_of_a_search_is_no_silence(live: Tracker) -> None:
    ways = searching(live, found("lost", "odd"), ZeroDivisionError("a fault"))
    ended(live, ways)
    with pytest.raises(ZeroDivisionError, match="a fault"):
        live.take(CLOUD, ways)


def test_closing_forgets_what_is_sought(live: Tracker) -> None:
    ways = searching(live, found("lost", "odd"), found("rest"))
    ways.go.set()
    live.close()
    assert live.phase is Phase.FOLLOWING


def test_a_search_waits_for_the_answer_that_is_being_found(live: Tracker) -> None:
    class Slow(Told):
        """Tracks for as long as the search needs to reach its first step."""

        waited = False

        def track(self, cloud: Any, last: Any) -> Any:
            if last.name == "lost":
                self.go.set()
                assert live._search is not None
                self.waited = not live._search.done()
            return super().track(cloud, last)

    ways = Slow(track=found("lost", "odd"), search=found("rest"), caught_up=found("rest"))
    following(live).take(CLOUD, ways)
    live.take(CLOUD, ways)
    assert ways.waited
    assert live._search is not None
    assert live._search.result(10.0).name == "rest"  # type: ignore[union-attr]


def test_whether_forces_act_elsewhere_is_asked_beside_the_frames(live: Tracker) -> None:
    """No answer waits for it; the last answer goes with all frames until the next is known, or nothing is missed."""
    doubt = Check(Code.FORCES_ELSEWHERE, Verdict.DOUBTFUL, 0.3, 0.5, reason="forces act elsewhere")
    ways = Told(track=found("tracked"), elsewhere=doubt)
    first = following(live).take(CLOUD, ways)
    assert first.judgement.verdict is Verdict.ACCEPTED and live.phase is Phase.FOLLOWING
    assert live.take(CLOUD, ways).judgement.verdict is Verdict.ACCEPTED and ways.asked_of == []  # not known yet
    ways.go.set()
    assert live._inquiry is not None
    live._inquiry.exception(10.0)
    answer = live.take(CLOUD, ways)
    assert answer.judgement.reasons == ("forces act elsewhere",) and live.phase is Phase.FOLLOWING
    assert live.take(CLOUD, Told(track=found("met"))).judgement.verdict is Verdict.ACCEPTED  # nothing is missed


def test_a_search_that_nobody_waits_for_ends_with_its_next_step(live: Tracker) -> None:
    ways = searching(live, found("odd", "odd"), found("rest"))
    search = live._search
    assert search is not None
    threading.Timer(0.1, ways.go.set).start()  # while the tracker is being closed
    live.close()
    assert type(search.exception(10.0)).__name__ == "_Closed" and live.phase is Phase.FOLLOWING
    assert ("search", "") not in ways.taken


def test_a_search_for_a_cloud_before_one_that_began_anew_is_forgotten(live: Tracker) -> None:
    """It was begun from a state that is no longer gone on from, and is held against no cloud since."""
    ways = searching(live, found("lost", "odd"), found("rest"))
    search = live._search
    assert search is not None
    ways.results |= {"track": NotConverged("none"), "follow": found("anew")}
    assert live.take(CLOUD, ways).name == "anew" and live.phase is Phase.FOLLOWING  # type: ignore[attr-defined]
    ways.go.set()
    assert search.result(10.0) is not None
    ways.results["track"] = found("next")
    assert live.take(CLOUD, ways).judgement.verdict is Verdict.ACCEPTED
    assert ways.taken[-1] == ("track", "anew")


def test_a_fault_of_an_inquiry_is_said_once(live: Tracker) -> None:
    class Faulty(Told):
        def asked(self, cloud: Any, found: Any) -> Any:
            raise ZeroDivisionError("a fault")

    ways = Faulty(track=found("tracked"), elsewhere=None)
    following(live).take(CLOUD, ways)
    inquiry = live._inquiry
    assert inquiry is not None
    inquiry.exception(10.0)
    with pytest.raises(ZeroDivisionError, match="a fault"):
        live.take(CLOUD, ways)
    assert live.take(CLOUD, Told(track=found("next"))).judgement.verdict is Verdict.ACCEPTED
