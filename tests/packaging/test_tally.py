"""The tally of ci/: what was skipped never counts as tested."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TALLY = Path(__file__).resolve().parents[2] / "ci" / "tally.py"
PASSED = '<testcase file="tests/{0}/test_a.py" name="a"/>'
SKIPPED = '<testcase file="tests/{0}/test_a.py" name="b"><skipped message="no DOLFINx"/></testcase>'
FAILED = '<testcase file="tests/{0}/test_a.py" name="c"><failure message="1 != 2"/></testcase>'


def _tally(folder: Path, cases: list[str], *arguments: str) -> tuple[int, str]:
    file = folder / "junit.xml"
    file.write_text(f"<testsuites><testsuite>{''.join(cases)}</testsuite></testsuites>")
    told = subprocess.run([sys.executable, TALLY, file, *arguments], capture_output=True, text=True)
    return told.returncode, told.stdout


def test_a_folder_that_was_skipped_whole_fails(tmp_path: Path) -> None:
    code, told = _tally(tmp_path, [PASSED.format("meshes"), SKIPPED.format("reference"), SKIPPED.format("reference")])
    assert code == 1
    assert "error: tests/reference: all 2 tests were skipped" in told
    assert "skipped 2: no DOLFINx" in told


def test_a_folder_with_one_test_that_ran_is_enough(tmp_path: Path) -> None:
    code, told = _tally(tmp_path, [PASSED.format("reference"), SKIPPED.format("reference"), FAILED.format("app")])
    assert code == 0  # pytest itself told of the failure
    assert told.splitlines()[-1] == "1 passed, 1 failed, 1 skipped (passed by folder: app 0, reference 1)"


@pytest.mark.parametrize("name", ["junit.xml", "never-written.xml"])
def test_no_test_at_all_fails(tmp_path: Path, name: str) -> None:
    (tmp_path / "junit.xml").write_text("<testsuites/>")
    told = subprocess.run([sys.executable, TALLY, tmp_path / name], capture_output=True, text=True)
    assert told.returncode == 1
    assert "no test was collected" in told.stdout


def test_total_is_one_plain_line(tmp_path: Path) -> None:
    code, told = _tally(tmp_path, [PASSED.format("app"), SKIPPED.format("app"), FAILED.format("app")], "--total")
    assert (code, told) == (0, "tests: 1 passed, 1 failed, 1 skipped\n")
