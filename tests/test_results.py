"""The pages of results hold what the records say, and no more rows than a person reads."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

dashboard = pytest.importorskip("dashboard", reason="benchmarks is not on the path")

PAGES = Path(__file__).resolve().parents[1] / "docs" / "results"


@pytest.mark.parametrize("stem", ["index", *dashboard.CHAPTERS])
def test_a_page_shows_its_records(stem: str) -> None:
    page = (PAGES / f"{stem}.md").read_text()
    assert dashboard.placed(page, dashboard.tables()[stem]) == page, "run `python benchmarks/dashboard.py`"


def test_the_page_of_choices_shows_all_of_them() -> None:
    page = dashboard.CHOICES.read_text()
    assert dashboard.placed(page, dashboard.choices()) == page, "run `python benchmarks/dashboard.py`"


@pytest.mark.parametrize("stem", ["index", *dashboard.CHAPTERS])
def test_a_page_is_no_longer_than_it_may_be(stem: str) -> None:
    rows = [line for line in (PAGES / f"{stem}.md").read_text().splitlines() if re.match(r"\|(?!---)", line)]
    assert 3 < len(rows) - 1 <= dashboard.MOST_ROWS["index" if stem == "index" else "chapter"]


def test_a_figure_that_misses_what_was_asked_for_is_marked() -> None:
    short = [row for row in dashboard.ROWS if row.is_short]
    assert short and all("(**short**)" in dashboard.table([row]) for row in short)
    assert "(**short**)" not in dashboard.table([row for row in dashboard.ROWS if not row.is_short])


def test_what_others_reached_in_the_same_run_is_read_from_its_record() -> None:
    """A typed figure would stay behind when the record is made anew."""
    told = [row for row in dashboard.ROWS if re.search("same (run|record)", row.peer)]
    assert len(told) > 5
    for row in told:
        assert row.peer.count("{}") == len(row.same_run) > 0, row.quantity
        before = re.split(
            r"\{\}", re.sub(r"\([^()]*\d{4}[^()]*\)|thesis.*|4,096 |of 100|full steps: 20 %", "", row.peer)
        )
        assert not any(re.search(r"\d", part) for part in before), row.quantity
        assert row.others in dashboard.table([row])


def test_every_figure_of_the_pages_is_of_a_clean_commit() -> None:
    """What was made with uncommitted changes, or by nobody knows what, is measured again before it is shown."""
    told = {row.quantity: dashboard.made(row) for row in dashboard.ROWS}
    assert len(told) > 100
    assert {what: made for what, made in told.items() if not re.match(r"[0-9a-f]{7,}, 20\d\d-", made)} == {}


def test_no_record_is_of_uncommitted_changes() -> None:
    records = sorted(dashboard.RESULTS.rglob("*.json"))
    assert len(records) > 40
    assert [path.name for path in records if re.search(r'"commit": "[^"]*-dirty"', path.read_text())] == []


def test_a_row_without_a_commit_of_its_own_is_not_given_a_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    record = {
        "commit": "new", "date": "today", "machine": {},
        "figures": {"old": {"f": 1.0}, "new": {"f": 2.0}},
        "made": {"": {"date": "once"}, "new": {"commit": "new", "date": "today"}},
    }  # fmt: skip
    monkeypatch.setattr(dashboard, "load", lambda name: record)
    rows = [dashboard.Row("live", name, "some", (name, "f")) for name in ("old", "new")]
    assert [dashboard.made(row) for row in rows] == ["no commit, once", "new, today"]


def test_a_changed_record_changes_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check itself: another figure in the record, and the page is not its any more."""
    page = (PAGES / "live.md").read_text()
    changed = {
        **dashboard.load("stream"),
        "figures": {**dashboard.load("stream")["figures"], "age_ms": {"p50": 9, "p95": 9, "p999": 9}},
    }
    load = dashboard.load
    monkeypatch.setattr(dashboard, "load", lambda name: changed if name == "stream" else load(name))
    assert dashboard.placed(page, dashboard.tables()["live"]) != page


def test_a_way_takes_the_mean_the_largest_or_the_count_of_a_level() -> None:
    figures = {"s1": {"errors": [1.0, 2.0]}, "s2": {"errors": [4.0, 3.0]}}
    ways = {
        ("*", "errors", "0"): 2.5,
        (">", "errors", "0"): 4.0,
        ("s2", "errors", ">"): 4.0,
        ("s1", "errors", "#"): 2.0,
    }
    assert {way: dashboard._at(figures, way) for way in ways} == ways
