"""Counts what pytest really ran, by folder, from its JUnit files, so that skipping never looks like passing.

python ci/tally.py build/ci/tests.xml      fails when every test of a folder, or every test at all, was skipped
python ci/tally.py --total build/ci/*.xml  one line over all files
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree


def outcome(case: ElementTree.Element) -> str:
    """One of passed, failed, skipped."""
    tags = {child.tag for child in case}
    if tags & {"failure", "error"}:
        return "failed"
    return "skipped" if "skipped" in tags else "passed"


def folder(case: ElementTree.Element) -> str:
    """The folder below tests/ that the case stands in: tests/reference/test_modes.py gives reference."""
    file = case.get("file") or case.get("classname", "").replace(".", "/")
    parts = Path(file).parts
    return parts[1] if len(parts) > 2 else "."


def cases(paths: Iterable[Path]) -> list[ElementTree.Element]:
    """All test cases of some JUnit files; a file that is not there (pytest died) has none."""
    return [case for path in paths if path.exists() for case in ElementTree.parse(path).iter("testcase")]


def reasons(found: Iterable[ElementTree.Element]) -> Counter[str]:
    """How often each reason was given for skipping."""
    return Counter(skip.get("message", "no reason given") for case in found for skip in case.iter("skipped"))


def by_folder(found: Iterable[ElementTree.Element]) -> dict[str, Counter[str]]:
    """Outcomes counted for each folder of tests."""
    counts: dict[str, Counter[str]] = {}
    for case in found:
        counts.setdefault(folder(case), Counter())[outcome(case)] += 1
    return counts


def total(found: Iterable[ElementTree.Element]) -> str:
    """The closing line, in a form that any job can read."""
    count = Counter(outcome(case) for case in found)
    return f"{count['passed']} passed, {count['failed']} failed, {count['skipped']} skipped"


def main(arguments: list[str]) -> int:
    """Prints the counts; 1 when something claims to have been tested and was not."""
    paths = [Path(argument) for argument in arguments if argument != "--total"]
    found = cases(paths)
    if "--total" in arguments:
        print(f"tests: {total(found)}")
        return 0
    for reason, count in reasons(found).items():
        print(f"skipped {count}: {reason}")
    folders = by_folder(found)
    idle = sorted(name for name, count in folders.items() if count["passed"] + count["failed"] == 0)
    for name in idle:
        print(f"error: tests/{name}: all {folders[name]['skipped']} tests were skipped, so nothing was tested there")
    if not found:
        print("error: no test was collected")
    each = ", ".join(f"{name} {count['passed']}" for name, count in sorted(folders.items()))
    print(f"{total(found)}" + (f" (passed by folder: {each})" if each else ""))
    return 1 if idle or not found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
