"""Columns of printed tables, their cells, and tables in Markdown."""

from __future__ import annotations

import re
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

Figures = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """A column of the printed table.

    Args:
        heading: of it.
        unit: of its numbers; empty for those that have none, or for several.
        cell: what stands in it: a format over a row's figures, `{tre_mm.mean:.2f}`, `{force_error*100:.1f}`, or a
            function of them. What a row does not have is a dash.
    """

    heading: str
    unit: str
    cell: str | Callable[[Figures], object]

    @property
    def head(self) -> str:
        """Heading and unit."""
        return f"{self.heading}, {self.unit}" if self.unit else self.heading


class _Cells(string.Formatter):
    """Formats with paths into nested figures and a factor: `{tre_mm.mean:.2f}`, `{force_error*100:.1f}`."""

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        path, _, factor = field_name.partition("*")
        value = reduce(lambda at, key: at[int(key)] if isinstance(at, list) else at[key], path.split("."), kwargs)
        if value is None:
            raise KeyError(path)
        return (float(factor) * value if factor else value), path


def cell(column: Column, figures: Figures) -> str:
    """What stands in a column of a row; a dash where the row has no such figure."""
    try:
        if callable(column.cell):
            return str(column.cell(figures))
        return _Cells().vformat(column.cell, (), figures)
    except (KeyError, IndexError, TypeError):
        return "-"


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def verdicts(found: Figures) -> str:
    """How many frames were accepted, doubtful and refused."""
    return "; ".join(str(found["verdicts"].get(name, 0)) for name in ("accepted", "doubtful", "refused"))


def shares(covered: Mapping[str, float]) -> str:
    """Per cent, in their order."""
    return " / ".join(f"{100 * share:.0f}" for share in covered.values())


def replaced(page: str, printed: str) -> str:
    """A page with each of its tables that are printed, too, as it is printed; the text around them is kept."""
    new = tables_of(printed)
    for heading, old in tables_of(page).items():
        page = page.replace(old, new.get(heading, old))
    return page


def tables_of(page: str) -> dict[str, str]:
    """The tables of a page in Markdown, by their first headings."""
    found = re.findall(r"(?:^\|.*\n?)+", page, flags=re.MULTILINE)
    return {each.split("|")[1].strip(): each.rstrip("\n") for each in found}
