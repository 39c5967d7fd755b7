"""The pages of results, made from the records: a dashboard of the most important rows, and one page a chapter.

    python benchmarks/dashboard.py          writes the tables into docs/results/*.md, between their marks

So is the page of the numbers that registration has chosen, docs/method/choices.md, from `registration/policy.py` and
the record of `policy.py`.

A row names its record and the way to the figure in it, so that no figure is typed by hand; what others reached and what
was asked for are typed once, in dashboard.toml, with their source. `tests/test_results.py` holds the pages to it.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal

from softtwin.registration.policy import ACCURACY, POLICY, RIGID

RESULTS = Path(__file__).parent / "results"
PAGES = Path(__file__).parents[1] / "docs" / "results"
CHOICES = PAGES.parent / "method" / "choices.md"
_SHORT = {"AMD EPYC": "EPYC", "Intel(R) Xeon(R) Processor": "Xeon"}
Chapter = Literal["reference", "surrogates", "registration", "organs", "live", "data"]
CHAPTERS: dict[Chapter, str] = {
    "reference": "The reference",
    "surrogates": "Surrogates",
    "registration": "Registration",
    "organs": "Real organs",
    "live": "Live",
    "data": "Data and building",
}
MOST_ROWS = {"index": 40, "chapter": 60}
Way = tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """One figure of a record beside what others reached and what was asked for.

    Args:
        chapter: whose page it stands on.
        quantity: what was measured, on what.
        record: name of its file, without `.json`.
        way: keys that lead to the figure; `*` takes the mean over a level, `>` its largest, `#` counts its entries.
        unit: in words.
        scale: that the stored number is multiplied with.
        digits: significant ones.
        peer: what the thesis or the best peer has, with the source; `{}` for each figure of `same_run`.
        same_run: ways to figures of others in the same record, scaled as the row's own.
        target: what was asked for, as a number in the same unit; None for nothing.
        most: whether the target is the largest good value, and not the least.
        front: whether it stands on the dashboard as well.
    """

    chapter: Chapter
    quantity: str
    record: str
    way: Way
    unit: str = ""
    scale: float = 1.0
    digits: int = 3
    peer: str = ""
    same_run: tuple[Way, ...] = ()
    target: float | None = None
    most: bool = True
    front: bool = False

    @property
    def value(self) -> float:
        """The figure in its unit."""
        return self.scale * _at(load(self.record)["figures"], self.way)

    @property
    def others(self) -> str:
        """What others have, in words."""
        figures = load(self.record)["figures"]
        return self.peer.format(*(shown(self.scale * _at(figures, way), self.digits) for way in self.same_run))

    @property
    def is_short(self) -> bool:
        """Whether it falls short of what was asked for."""
        if self.target is None:
            return False
        return self.value > self.target if self.most else self.value < self.target


@cache
def load(name: str) -> dict[str, Any]:
    """A record."""
    found: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return found


def _at(figures: Any, way: Way) -> float:
    for number, key in enumerate(way):
        if key == "#":
            return float(len(figures))
        if key in ("*", ">"):
            rest = way[number + 1 :]
            values = figures.values() if isinstance(figures, dict) else figures
            numbers = [_at(value, rest) for value in values]
            return max(numbers) if key == ">" else sum(numbers) / len(numbers)
        figures = figures[int(key)] if isinstance(figures, list) else figures[key]
    return float(figures)


def made(row: Row) -> str:
    """Commit, day and processor of a row's record; where rows carry their own, the row's."""
    record = load(row.record)
    told: dict[str, Any] = {"commit": record.get("commit"), "date": record.get("date", ""), "on": processor(record)}
    figures = record["figures"]
    for place in (record.get("made", {}), figures if isinstance(figures, dict) else {}):
        one = place.get(row.way[0], place.get("")) if isinstance(place, dict) else None  # "": rows without their own
        if isinstance(one, dict) and place is record.get("made"):
            told["commit"] = one.get("commit")  # a row from before rows had commits is of none, whatever came later
        if isinstance(one, dict):
            told |= {name: one[name] for name in told if name in one}
            own = one.get("made")
            told |= {name: own[name] for name in told if isinstance(own, dict) and name in own}
    words = [told["commit"] or "no commit", told["date"], _SHORT.get(told["on"], told["on"])]
    return ", ".join(word for word in words if word)


def processor(record: dict[str, Any]) -> str:
    """What a record's figures were made on: the accelerator, else the processor; empty where it does not say."""
    machine = record.get("machine") or {}
    gpu = machine.get("gpu", "none")
    return str(machine.get("processor", "") if gpu == "none" else gpu)


def shown(value: float, digits: int) -> str:
    """A number with so many significant digits, without an exponent where it needs none."""
    if value == 0.0:
        return "0"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        text = f"{value:.0f}"
    return text


def table(rows: Iterable[Row]) -> str:
    """Rows as a table in Markdown."""
    lines = ["| quantity | ours | thesis or best peer | target | record of |", "|---|---|---|---|---|"]
    for row in rows:
        ours = f"{shown(row.value, row.digits)} {row.unit}".strip()
        asked = "" if row.target is None else f"{'at most' if row.most else 'at least'} {row.target:g}"
        short = " (**short**)" if row.is_short else ""
        lines.append(f"| {row.quantity} | {ours}{short} | {row.others} | {asked} | {made(row)} |")
    return "\n".join(lines)


def choices() -> str:
    """What registration has chosen, as one table of each kind: meaning, value, source, half and twice."""
    whole = load("policy")
    record, parts = whole["figures"], [_of(whole)]
    for title, kind in (("Answers depend on these", POLICY), ("How closely, or how much of it", ACCURACY)):
        lines = ["| number | meaning | value | source | at half | at twice |", "|---|---|---|---|---|---|"]
        for each in fields(kind):
            about, row = each.metadata, record.get(each.name)
            value = getattr(kind, each.name)
            half, twice = (_changed(row, value, factor) for factor in ("half", "twice"))
            told = f"{value:g} {about['unit']}".strip()
            lines.append(f"| `{each.name}` | {about['meaning']} | {told} | {about['source']} | {half} | {twice} |")
        parts.append(f"## {title}\n\n" + "\n".join(lines))
    lines = ["| number | meaning | value | source |", "|---|---|---|---|"]
    for each in fields(RIGID):
        about, value = each.metadata, getattr(RIGID, each.name)
        told = ", ".join(f"{part:g}" for part in value) if isinstance(value, tuple) else f"{value:g}"
        lines.append(
            f"| `{each.name}` | {about['meaning']} | {(told + ' ' + about['unit']).strip()} | {about['source']} |"
        )
    parts.append("## The search for a pose that nobody gave\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def _of(record: dict[str, Any]) -> str:
    """Where the last two columns come from."""
    told = {each.name for kind in (POLICY, ACCURACY) for each in fields(kind)}
    figures = {name: row for name, row in record["figures"].items() if name in told}
    clouds = max(row["clouds"] for row in figures.values())
    rows = Counter((record["made"][name]["commit"], record["made"][name]["date"]) for name in figures)
    of = "; ".join(f"{count} rows of commit {commit}, {date}" for (commit, date), count in rows.most_common())
    return f"The last two columns: {clouds} clouds; {of}."


def _changed(row: dict[str, Any] | None, value: float, factor: str) -> str:
    """What a number at half or twice its value has changed: of the error, and how many verdicts."""
    if row is None or row["value"] != value:
        return "not measured"
    told = row[factor]
    verdicts = f"; verdicts: {told['verdicts_changed']}" if told["verdicts_changed"] else ""
    return f"{told['error_percent']:+.1f} ± {told['error_percent_deviation']:.1f} %{verdicts}"


def tables() -> dict[str, str]:
    """The table of each page, by its file's stem."""
    found = {"index": table(row for row in ROWS if row.front)}
    return found | {chapter: table(row for row in ROWS if row.chapter == chapter) for chapter in CHAPTERS}


def placed(page: str, text: str) -> str:
    """A page with the text between its marks."""
    marks = r"(<!-- made by benchmarks/dashboard.py -->\n).*?(\n<!-- end -->)"
    if not re.search(marks, page, flags=re.DOTALL):
        raise ValueError("the page has no marks `<!-- made by benchmarks/dashboard.py -->` and `<!-- end -->`")
    return re.sub(marks, lambda found: found[1] + text + found[2], page, flags=re.DOTALL)


def _rows() -> tuple[Row, ...]:
    entries = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())["row"]
    ways = [tuple(tuple(way) for way in entry.get("same_run", ())) for entry in entries]
    return tuple(
        Row(**{**entry, "way": tuple(entry["way"]), "same_run": same_run})
        for entry, same_run in zip(entries, ways, strict=True)
    )


ROWS = _rows()


def main() -> int:
    """Writes the tables into their pages; 1 where a page is not there or has no marks."""
    for stem, text in tables().items():
        path = PAGES / f"{stem}.md"
        path.write_text(placed(path.read_text(), text))
        print(f"written: {path.relative_to(PAGES.parents[1])}, {text.count(chr(10)) - 1} rows")
    CHOICES.write_text(placed(CHOICES.read_text(), choices()))
    print(f"written: {CHOICES.relative_to(PAGES.parents[1])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
