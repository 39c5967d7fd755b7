"""What benchmarks there are, read from their source, and how old their records are beside what they are about."""

from __future__ import annotations

import ast
import fnmatch
import re
from dataclasses import dataclass

import record


@dataclass(frozen=True)
class Declared:
    """What a declaration says of itself in its source.

    Args:
        script: its file's name.
        name: of its record, as declared.
        title: in one line.
        about: folders and files.
        under: entry of the figures with the rows.
        also: other names of its records.
    """

    script: str
    name: str
    title: str
    about: tuple[str, ...]
    under: str = ""
    also: tuple[str, ...] = ()

    def declares(self, record_name: str) -> bool:
        """Whether a record of that name is one of its."""
        return any(fnmatch.fnmatchcase(record_name, each) for each in (re.sub(r"\{\w+\}", "*", self.name), *self.also))


def declarations() -> list[Declared]:
    """The declarations of all scripts beside the records, read from their source.

    Raises:
        ValueError: an entry that is no literal, or a path that is not there.
    """
    found = []
    for path in sorted(record.RESULTS.parent.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Benchmark":
                found.append(_declared(path.name, node))
    return found


def _declared(script: str, call: ast.Call) -> Declared:
    entries = {}
    for keyword in call.keywords:
        if keyword.arg in ("name", "title", "about", "under", "also"):
            try:
                entries[keyword.arg] = ast.literal_eval(keyword.value)
            except ValueError:
                raise ValueError(f"{script}: {keyword.arg}: expected a literal, line {keyword.value.lineno}") from None
    absent = [path for path in entries["about"] if not (record.ROOT / path).exists()]
    if absent:
        raise ValueError(f"{script}: about: no such files: {', '.join(absent)}")
    return Declared(script, **entries)


@dataclass(frozen=True)
class Finding:
    """A record that no present figure may be quoted from without a look.

    Args:
        record: its name.
        state: `older` than what it is about, of a `dirty` tree, without a commit (`unknown`), or an `orphan`.
        rows: how many of its rows.
        of: how many there are; 0 where the record does not tell its rows apart.
        says: more, in words.
    """

    record: str
    state: str
    rows: int
    of: int
    says: str

    def __str__(self) -> str:
        count = f"{self.rows} of {self.of} rows" if self.of else "all of it"
        return f"{self.record:42} {self.state:8} {'' if self.state == 'orphan' else count:18} {self.says}"


def audit() -> list[Finding]:
    """What is to be said of the records, by name; nothing of one that is of the last commit of what it is about."""
    declared, found = declarations(), list[Finding]()
    for path in sorted(record.RESULTS.glob("*.json")):
        owner = next((each for each in declared if each.declares(path.stem)), None)
        if owner is None:
            found.append(Finding(path.stem, "orphan", 0, 0, "no script declares it"))
        else:
            found += _of_record(path.stem, owner)
    return found


def _of_record(name: str, owner: Declared) -> list[Finding]:
    made = record.made_of(record.read(name), owner.under)
    states: dict[str, list[str]] = {}
    for told in made.values():
        states.setdefault(_state(told.get("commit", ""), owner.about), []).append(told.get("commit", ""))
    of = len(made) if set(made) != {""} else 0
    change = record.git("log", "-1", "--format=%h of %cs", record.last_change(owner.about)) or "?"
    says = {
        "older": f"{', '.join(owner.about)} changed in {change}",
        "dirty": "made with uncommitted changes",
        "unknown": "names no commit that is here",
    }
    return [
        Finding(
            name, state, len(each), of, f"{', '.join(sorted(set(filter(None, each))))[:60]}; {says[state]}".lstrip("; ")
        )
        for state, each in states.items()
        if state != "current"
    ]


def _state(commit: str, about: tuple[str, ...]) -> str:
    if commit.endswith("-dirty"):
        return "dirty"
    if not commit or record.git("cat-file", "-e", f"{commit}^{{commit}}") is None:
        return "unknown"
    return "current" if record.holds(commit, about) else "older"


def listed() -> str:
    """Every benchmark with its records: name, commit and day."""
    lines, names = [], [path.stem for path in sorted(record.RESULTS.glob("*.json"))]
    for each in declarations():
        lines.append(f"{each.script:32} {each.title}\n{'':32} about {', '.join(each.about)}")
        for name in filter(each.declares, names):
            told = record.read(name)
            lines.append(f"{'':32} {name}: {told.get('commit', 'no commit')}, {told.get('date', 'no date')}")
    return "\n".join(lines)
