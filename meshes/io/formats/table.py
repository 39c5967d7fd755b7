"""Tables of numbers as text, of any program and locale: separators, comments, a count, names of columns."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...body import Floats

_LAST_LINES = 100  # to see how the numbers of a table end
_COMMENTS = ("#", "%", "!")
# NaN, as C, Windows and people say it.
_MISSING = re.compile(r"(|[-+]?nan\(\w*\)|[-+]?1\.#\w+|null|none|n/?a)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class Table:
    """Numbers of a text file.

    Args:
        values: (rows, columns); NaN where a field is empty or says so.
        names: of the columns, lower case, without units and quotes; empty where the file says none.
    """

    values: Floats
    names: tuple[str, ...]


def read_table(path: Path) -> Table:
    """The rows of a file.

    Separators are semicolons, tabs, commas or blanks; with semicolons, tabs or blanks decimals may have commas. Lines
    of comment (`#`, `%`, `!`, `//`) and empty lines are passed over; the last of them before the rows, or a line that
    is not of numbers, names the columns. A line with one whole number before the rows is their count.

    Args:
        path: the file.

    Raises:
        ValueError: rows of different lengths, another count than was said, words that are no numbers, or a last number
            that is cut off.
    """
    text = _text(path)
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    comments = [line for _, line in lines if _is_comment(line)]
    rows = [(number, line) for number, line in lines if not _is_comment(line)]
    if not rows:
        return Table(np.empty((0, 3)), ())
    separator = _separator([line for _, line in rows])
    split = [(number, _words(line, separator)) for number, line in rows]
    names: tuple[str, ...] = ()
    if not _is_row(split[0][1]):
        names, split = tuple(map(_name, split[0][1])), split[1:]
    count = None
    if len(split) > 1 and len(split[0][1]) == 1 < len(split[1][1]) and split[0][1][0].isdigit():
        count, split = int(split[0][1][0]), split[1:]
    if not split:
        return Table(np.empty((0, max(3, len(names)))), names)
    if not text.endswith("\n") and _is_cut([words for _, words in split]):
        raise ValueError("its last number has fewer digits than all others in its column, and no line ends there")
    width = len(split[0][1])
    wrong = next((number for number, words in split if len(words) != width), None)
    if wrong is not None:
        raise ValueError(f"line {wrong}: expected {width} columns as in the lines before")
    if count is not None and count != len(split):
        raise ValueError(f"expected the {count} rows that it names, got {len(split)}")
    if not names and comments:
        told = tuple(map(_name, _words(comments[-1].lstrip("#%!/ "), _separator([comments[-1]]))))
        names = told if len(told) == width else ()
    if names and len(names) != width:
        raise ValueError(f"expected {len(names)} columns ({', '.join(names[:12])}), got {width}")
    return Table(_values(split, separator), names)


def _text(path: Path) -> str:
    content = path.read_bytes()
    for coding in ("utf-8-sig", "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1"):
        try:
            text = content.decode(coding)
        except UnicodeDecodeError:
            continue
        if "\0" in text:
            raise ValueError("it is no text")
        return text
    raise ValueError("it is no text")


def _is_comment(line: str) -> bool:
    return line.startswith((*_COMMENTS, "//"))


def _separator(lines: list[str]) -> str | None:
    """The character between columns; None for blanks."""
    first = lines[len(lines) // 2]
    if ";" in first:
        return ";"
    if "\t" in first:
        return "\t"
    words = first.split()
    local = len(words) > 1 and all(_is_number(word) or _DECIMAL_COMMA.fullmatch(word) for word in words)
    if "," in first and not local:
        return ","
    return None


def _words(line: str, separator: str | None) -> list[str]:
    words = line.split() if separator is None else [word.strip() for word in line.split(separator)]
    if separator is not None and len(words) > 1 and not words[-1]:
        words.pop()  # a separator at the end
    return [word.strip("\"'") for word in words]


def _is_row(words: list[str]) -> bool:
    return any(_is_number(word.replace(",", ".", 1)) for word in words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _name(word: str) -> str:
    return re.sub(r"\s*[\[(].*[\])]\s*$", "", word.strip("\"' ")).strip().lower().replace(" ", "_")


def _values(rows: list[tuple[int, list[str]]], separator: str | None) -> Floats:
    flat = [word for _, words in rows for word in words]
    has_commas = separator != "," and any(_DECIMAL_COMMA.fullmatch(word) for word in flat)
    width = len(rows[0][1])
    if separator == "," and width in (6, 8) and all(re.fullmatch(r"[-+]?\d+", word) for word in flat):
        raise ValueError("only whole numbers between commas: are they decimal commas? Write points, or semicolons "
                         "between the columns")  # fmt: skip
    if has_commas:
        flat = [word.replace(",", ".") for word in flat]
    flat = ["nan" if _MISSING.fullmatch(word) else word for word in flat]
    try:
        values = np.array(flat, dtype=np.float64)
    except ValueError:
        at = next(i for i, word in enumerate(flat) if not _is_number(word))
        raise ValueError(f"line {rows[at // width][0]}: {flat[at][:40]!r} is no number") from None
    return values.reshape(-1, width)


def _is_cut(rows: list[list[str]]) -> bool:
    """True where all last numbers but that of the last line end alike (digits after the point, exponent)."""
    ends = [re.sub(r"^[-+]?\d*", "", words[-1]) for words in rows[-_LAST_LINES:]]
    shapes = {re.sub(r"\d", "0", end).replace("-", "+") for end in ends[:-1]}
    return len(ends) > 2 and len(shapes) == 1 and len(ends[-1]) < len(ends[0])
