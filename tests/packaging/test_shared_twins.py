"""What tests share is built once, whole or not there, and anew when what it depends on changes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import shared_twins
from shared_twins import built_once, unchanged

HERE = Path(__file__)
SLOW = """
import os, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import shared_twins

def build(folder):
    with open(sys.argv[2], "a") as log:
        log.write("built\\n")
    (folder / "half").write_text("1")
    time.sleep(0.5)
    (folder / "whole").write_text("2")

found = shared_twins.built_once("slow", build, shared_twins.__file__)
assert (found / "whole").read_text() == "2"
"""


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SOFTTWIN_TEST_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Counted:
    """Builds a file, and counts how often."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self, folder: Path) -> None:
        self.times += 1
        (folder / "file").write_text("content")


def test_processes_at_the_same_moment_build_once(tmp_path: Path) -> None:
    words = [sys.executable, "-c", SLOW, str(HERE.parents[1]), str(tmp_path / "log")]
    both = [subprocess.Popen(words, env=dict(os.environ)) for _ in range(2)]
    assert [each.wait(timeout=60) for each in both] == [0, 0]
    assert (tmp_path / "log").read_text() == "built\n"


def test_what_it_depends_on_builds_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build, module = Counted(), tmp_path / "declares.py"
    module.write_text("first")
    places = [built_once("a", build, module, {"draws": draws}) for draws in (8, 8, 9)]
    assert places[0] == places[1] != places[2] and build.times == 2
    module.write_text("second")
    built_once("a", build, module, {"draws": 8})
    monkeypatch.setattr(shared_twins, "_versions", lambda: {"numpy": "of another day"})
    built_once("a", build, module, {"draws": 8})
    assert build.times == 4


@pytest.mark.parametrize("package", shared_twins.PACKAGES)
def test_a_line_of_the_sources_builds_anew(package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = shared_twins.identity(HERE, None)
    sources = shared_twins._sources
    assert len(sources(package)) > 5
    (tmp_path / "new.py").write_text("# a line more")
    monkeypatch.setattr(
        shared_twins, "_sources", lambda name: [*sources(name), *([tmp_path / "new.py"] if name == package else [])]
    )
    assert shared_twins.identity(HERE, None) != usual
    others = [name for name in shared_twins.PACKAGES if name != package]
    monkeypatch.undo()
    assert shared_twins.identity(HERE, None, others) != usual


def test_what_fails_or_is_killed_leaves_nothing_that_is_taken_for_whole(own_cache: Path) -> None:
    def fail(folder: Path) -> None:
        (folder / "half").write_text("half")
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        built_once("a", fail, HERE)
    found = built_once("a", Counted(), HERE)
    assert [path.name for path in found.iterdir()] == ["file"]


def test_who_writes_into_it_is_told_and_nobody_finds_it_again(own_cache: Path) -> None:
    build = Counted()
    with unchanged(built_once("a", build, HERE)) as folder:
        assert (folder / "file").read_text() == "content"
    with (
        pytest.raises(AssertionError, match="they need a copy: more"),
        unchanged(built_once("a", build, HERE)) as folder,
    ):
        (folder / "more").write_text("of a test")
    assert not folder.exists()
    built_once("a", build, HERE)
    assert build.times == 2


def test_those_of_other_code_go_when_no_run_can_still_read_them(own_cache: Path) -> None:
    old, young, newest = (built_once("a", Counted(), HERE, number) for number in range(3))
    other = built_once("another", Counted(), HERE)
    for folder in (old, other):
        os.utime(folder, (time.time() - 2 * shared_twins.AN_HOUR,) * 2)
    built_once("a", Counted(), HERE, "one more")
    assert not old.exists() and young.exists() and newest.exists() and other.exists()
