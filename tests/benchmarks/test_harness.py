"""The harness of the benchmarks: what it records, what it keeps, what it refuses, and what it says is old."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import audit
import columns
import harness
import pytest
import record
from columns import Column
from harness import Benchmark, Given, Setting
from repository import Repository

SCRIPT = """
from harness import Benchmark
BENCHMARK = Benchmark(name="squares_{kind}", title="Squares", about=("organ",), work=print, also=("squares-*",))
"""


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Repository:
    found = Repository(tmp_path / "code", monkeypatch)
    found.commit("the code", **{"organ/liver.py": "1", "page/index.py": "1", "benchmarks/squares.py": SCRIPT})
    return found


class Counted:
    """A benchmark of three rows that counts how often each was made."""

    def __init__(self, **more: Any) -> None:
        self.made: list[str] = []
        self.benchmark = Benchmark(
            name="squares_{kind}",
            title="Squares",
            about=("organ",),
            work=self.work,
            rows=("two", "three", "twenty"),
            columns=(Column("square", "m2", "{square*10:.1f}"), Column("absent", "", "{nothing.at_all:.1f}")),
            settings={"factor": Setting(1.0), "kind": Setting("whole"), "ranks": Setting(2, picks=True)},
            seeds=(7,),
            small={"factor": 0.5},
            **more,
        )

    def work(self, row: str, given: Given) -> dict[str, Any]:
        self.made.append(row)
        return {"square": given.factor * {"two": 2, "three": 3, "twenty": 20}[row] ** 2}

    def run(self, *words: str) -> list[str]:
        """The rows that this run made."""
        before = len(self.made)
        harness.run(self.benchmark, words)
        return self.made[before:]


def test_a_record_says_what_each_row_is_of(repository: Repository) -> None:
    assert Counted().run("--only", "two") == ["two"]
    found = json.loads((repository.results / "squares_whole.json").read_text())
    assert list(found) == ["benchmark", "date", "command", "commit", "machine", "figures", "made"]
    assert found["figures"] == {"two": {"square": 4.0}}
    assert found["commit"] == found["made"]["two"]["commit"] == repository.git("rev-parse", "--short=10", "HEAD")
    assert found["command"] == "python benchmarks/test_harness.py --only two"
    assert found["made"]["two"]["settings"] == {"factor": 1.0, "kind": "whole"} and found["made"]["two"]["seeds"] == [7]
    assert found["made"]["two"]["seconds"] >= 0.0 and found["machine"]["versions"]["numpy"]


@pytest.mark.parametrize("changed", ["organ/liver.py", "page/index.py", "organ/new.py"])
def test_a_tree_with_uncommitted_changes_is_refused_before_anything_runs(repository: Repository, changed: str) -> None:
    repository.write(changed, "2")
    counted = Counted()
    with pytest.raises(SystemExit, match=rf"1 uncommitted change \({changed}\).*--dry"):
        counted.run()
    assert counted.made == [] and not list(repository.results.iterdir())
    assert counted.run("--dry") == ["two", "three", "twenty"]
    assert not list(repository.results.iterdir())


@pytest.mark.parametrize("change", ["write", "commit"])
def test_code_that_changes_under_a_run_is_not_recorded(repository: Repository, change: str) -> None:
    counted = Counted()

    def work(row: str, given: Given) -> dict[str, Any]:
        if row == "three" and change == "write":
            repository.write("organ/liver.py", "changed meanwhile")
        if row == "three" and change == "commit":
            repository.commit("meanwhile", **{"organ/liver.py": "committed meanwhile"})
        return {"square": 0.0}

    changing = Benchmark(
        "squares_{kind}", "Squares", ("organ",), work, ("two", "three"), settings=counted.benchmark.settings
    )
    with pytest.raises(SystemExit, match=r"organ/liver\.py|A commit changed organ"):
        harness.run(changing, [])
    assert list(record.recorded("squares_whole")) == ["two"]


def test_without_a_repository_nothing_is_recorded(
    repository: Repository, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "ROOT", tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    with pytest.raises(SystemExit, match="no commit here"):
        Counted().run()


def test_rows_go_on_where_they_stopped(repository: Repository) -> None:
    counted = Counted()
    assert counted.run("--only", "two", "three") == ["two", "three"]
    assert counted.run() == ["twenty"]  # its own record is no uncommitted change
    assert counted.run() == []
    assert counted.run("--ranks", "4") == []  # no figure depends on it
    assert counted.run("--only", "three", "--fresh") == ["three"]
    repository.commit("records and a page", **{"page/index.py": "2"})
    assert counted.run() == []
    repository.commit("the organ", **{"organ/liver.py": "2"})
    assert counted.run("--only", "two") == ["two"]
    assert counted.run() == ["three", "twenty"]
    assert counted.run("--factor", "2", "--only", "two") == ["two"]
    assert record.recorded("squares_whole")["two"] == {"square": 8.0}


def test_rows_that_another_process_made_meanwhile_are_kept(repository: Repository) -> None:
    class Slow(Counted):
        def work(self, row: str, given: Given) -> dict[str, Any]:
            if row == "two":
                Counted().run("--only", "three")
            return super().work(row, given)

    assert Slow().run("--only", "two") == ["two"]
    assert set(record.recorded("squares_whole")) == set(record.read("squares_whole")["made"]) == {"two", "three"}


def test_only_takes_names_and_parts_of_names(repository: Repository, capsys: pytest.CaptureFixture[str]) -> None:
    counted = Counted()
    assert counted.run("--dry", "--only", "tw") == ["two", "twenty"]
    assert counted.run("--dry", "--only", "two") == ["two"]
    with pytest.raises(SystemExit, match="'two', 'three', 'twenty', got 'four'"):
        counted.run("--only", "four")


def test_a_small_run_is_not_recorded(repository: Repository, capsys: pytest.CaptureFixture[str]) -> None:
    counted = Counted()
    counted.run("--small", "--only", "twenty")
    assert not list(repository.results.iterdir())
    assert "| twenty | 2000.0 | - |" in capsys.readouterr().out
    counted.run("--small", "--only", "twenty", "--factor", "3")
    assert "| twenty | 12000.0 | - |" in capsys.readouterr().out


def test_the_table_is_that_of_the_record(repository: Repository, capsys: pytest.CaptureFixture[str]) -> None:
    counted = Counted()
    counted.run()
    printed = columns.tables_of(capsys.readouterr().out)
    assert counted.run("--table") == []
    assert columns.tables_of(capsys.readouterr().out) == printed
    assert printed["squares_whole"].splitlines()[::2] == [
        "| squares_whole | square, m2 | absent |",
        "| two | 40.0 | - |",
        "| twenty | 4000.0 | - |",
    ]


def test_rows_may_lie_under_an_entry_with_figures_of_all_of_them(repository: Repository) -> None:
    def finish(figures: dict[str, Any], given: Given) -> dict[str, Any]:
        return {"sum": sum(row["square"] for row in figures["rows"].values())}

    counted = Counted(under="rows", finish=finish)
    counted.run("--only", "two")
    counted.run("--only", "three")
    assert record.recorded("squares_whole") == {"rows": {"two": {"square": 4.0}, "three": {"square": 9.0}}, "sum": 13.0}
    assert counted.run() == ["twenty"]


def test_what_rows_share_is_made_once_and_closed(repository: Repository) -> None:
    from contextlib import contextmanager

    said = []

    @contextmanager
    def engine(name):
        said.append(f"{name} opened")
        yield name
        said.append(f"{name} closed")

    def work(row: str, given: Given) -> dict[str, Any]:
        said.append(row)
        return {"engine": given.opened(engine, "hybrid"), "data": given.once(lambda: 1)}

    harness.run(Benchmark("shared", "Shared", ("organ",), work, ("a", "b")), ["--dry"])
    assert said == ["hybrid opened", "a", "b", "hybrid closed"] or said == ["a", "hybrid opened", "b", "hybrid closed"]


def states() -> dict[str, tuple[str, int, int]]:
    return {each.record: (each.state, each.rows, each.of) for each in audit.audit()}


def test_what_is_older_than_its_code_is_stale_row_by_row(repository: Repository) -> None:
    counted = Counted()
    counted.run()
    assert states() == {}
    repository.commit("elsewhere", **{"page/index.py": "3"})
    assert states() == {}
    repository.commit("the organ", **{"organ/liver.py": "3"})
    assert states() == {"squares_whole": ("older", 3, 3)}
    assert "organ changed in" in str(audit.audit()[0])
    counted.run("--only", "two")
    assert states() == {"squares_whole": ("older", 2, 3)}
    counted.run()
    assert states() == {}


def test_list_and_stale_are_printed(repository: Repository, capsys: pytest.CaptureFixture[str]) -> None:
    harness.main(["stale"])
    assert capsys.readouterr().out == "every record is of the last commit of what it is about\n"
    Counted().run("--only", "two")
    here = repository.commit("the organ", **{"organ/liver.py": "5"})
    capsys.readouterr()
    harness.main(["list"])
    listed = capsys.readouterr().out
    assert "squares.py" in listed and "Squares" in listed and "about organ" in listed and "squares_whole: " in listed
    harness.main(["stale"])
    told = capsys.readouterr().out
    assert told.split()[:6] == ["squares_whole", "older", "1", "of", "1", "rows"] and here[:7] in told


def test_orphans_dirty_and_unknown_records_are_told(repository: Repository) -> None:
    here = repository.git("rev-parse", "--short", "HEAD")
    told = {
        "squares_dirty": {"commit": f"{here}-dirty", "figures": {"two": {}}},
        "squares_clean": {"commit": here, "figures": {"two": {}}},
        "squares_none": {"date": "2026-11-21", "figures": [1, 2]},
        "squares_gone": {"commit": "1234567890", "figures": {}},
        "squares-also": {"commit": here, "figures": {}},
        "squares_rows": {
            "commit": here,
            "figures": {"a": {"made": {"commit": here}}, "b": {"made": {"commit": "f-dirty"}}},
        },
        "cubes": {"commit": here, "figures": {}},
    }
    for name, each in told.items():
        (repository.results / f"{name}.json").write_text(json.dumps({"benchmark": name, **each}))
    assert states() == {
        "squares_dirty": ("dirty", 1, 0),
        "squares_none": ("unknown", 1, 0),
        "squares_gone": ("unknown", 1, 0),
        "squares_rows": ("dirty", 1, 2),
        "cubes": ("orphan", 0, 0),
    }


def test_rows_of_before_are_told_apart_from_those_made_since(repository: Repository) -> None:
    here = repository.git("rev-parse", "--short", "HEAD")
    old = {
        "benchmark": "squares_whole",
        "commit": f"{here}-dirty",
        "date": "2026-11-21",
        "command": "python squares.py",
    }
    rows = {"two": {"square": 1.0}, "three": {"square": 1.0}, "twenty": {"square": 1.0}}
    (repository.results / "squares_whole.json").write_text(json.dumps({**old, "figures": rows}))
    counted = Counted()
    assert counted.run("--only", "two") == ["two"]
    found = record.read("squares_whole")
    assert found["figures"] == {**rows, "two": {"square": 4.0}}
    assert found["made"][""] == {name: old[name] for name in ("commit", "date", "command")}
    assert [str(each).split()[:3] for each in audit.audit()] == [["squares_whole", "dirty", "1"]]
    assert counted.run() == ["three", "twenty"]
    assert states() == {} and set(record.read("squares_whole")["made"]) == set(rows)


def test_figures_of_one_row_are_recorded_and_kept_as_a_whole(repository: Repository) -> None:
    made = []

    def work(row: str, given: Given) -> dict[str, Any]:
        made.append(row)
        return {"seconds": 1.0, "stages": {"mesh": 1.0}}

    whole = Benchmark("squares_whole", "Squares", ("organ",), work)
    harness.run(whole, [])
    harness.run(whole, [])
    assert made == [""] and record.recorded("squares_whole") == {"seconds": 1.0, "stages": {"mesh": 1.0}}
    assert states() == {}
    repository.commit("the organ", **{"organ/liver.py": "4"})
    assert states() == {"squares_whole": ("older", 1, 0)}
    harness.run(whole, [])
    assert made == ["", ""]


def test_a_declaration_that_cannot_be_read_from_its_source_is_an_error(repository: Repository) -> None:
    repository.write("benchmarks/cubes.py", 'Benchmark(name=f"{1}", title="", about=("organ",))')
    with pytest.raises(ValueError, match=r"cubes\.py: name: expected a literal"):
        audit.declarations()
    repository.write("benchmarks/cubes.py", 'Benchmark(name="cubes", title="", about=("organs",))')
    with pytest.raises(ValueError, match=r"cubes\.py: about: no such files: organs"):
        audit.declarations()


def test_declarations_are_checked_when_they_are_made() -> None:
    with pytest.raises(ValueError, match="about"):
        Benchmark("a", "A", (), print)
    with pytest.raises(ValueError, match="small: no settings draws"):
        Benchmark("a", "A", ("organ",), print, small={"draws": 1})


def test_every_script_here_declares_what_it_records() -> None:
    declared = audit.declarations()
    assert len(declared) > 40
    for each in declared:
        assert each.title and not each.title.endswith("."), each.script
    orphans = [path.stem for path in record.RESULTS.glob("*.json") if not any(d.declares(path.stem) for d in declared)]
    assert orphans == []


def test_a_table_is_replaced_and_the_text_around_it_kept() -> None:
    page = "before\n\n| a | b |\n| --- | --- |\n\nbetween\n\n| c |\n| --- |\n| 1 |\n\nafter\n"
    printed = "\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    wanted = "before\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\nbetween\n\n| c |\n| --- |\n| 1 |\n\nafter\n"
    assert columns.replaced(page, printed) == wanted
