"""Named points in files: tables with a name and three numbers, tables and markups of 3D Slicer."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..body import Floats
from .common import METRES, Axes, FileError, Unit, existing, spelled_unit
from .formats.numbers import numbers

SUFFIXES = (".csv", ".txt", ".tsv", ".fcsv", ".mrk.json", ".json")
_COLUMNS: dict[tuple[str, str, str], Axes | None] = {
    ("x", "y", "z"): None,
    ("r", "a", "s"): "ras",
    ("l", "p", "s"): "lps",
}
_LABELS = ("label", "name", "id")
_FIDUCIALS = ("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label")
_STATES = ("defined", "undefined", "preview", "missing")  # of Slicer; only the first has a place
_SYSTEMS: dict[str, Axes] = {"0": "ras", "1": "lps", "RAS": "ras", "LPS": "lps"}


@dataclass(frozen=True)
class Landmarks:
    """Points by name.

    Args:
        points: each (3,), metres, on the axes of the file.
        axes: that the file states; None where it states none.
    """

    points: dict[str, Floats]
    axes: Axes | None


def read_named_points(path: str | Path, unit: Unit = "m") -> Landmarks:
    """The named points of a file, on its own axes.

    Args:
        path: a table with lines `name,x,y,z` (CSV, TSV, TXT), a table of 3D Slicer (`label,r,a,s,...` or `l,p,s`), its
            `.fcsv` or `.mrk.json`. Points that Slicer calls undefined are none.
        unit: of tables that state none; those of Slicer are in millimetres, or in the unit that they state.

    Raises:
        FileError: missing or damaged file, another suffix, no points, or a name twice; the message names it.
    """
    path = existing(path)
    axes: Axes | None
    try:
        if path.name.lower().endswith(".json"):
            found, axes, scale = _markups(path)
        elif path.suffix.lower() == ".fcsv":
            found, axes, scale = *_fiducials(path), METRES["mm"]
        elif path.suffix.lower() in SUFFIXES:
            found, axes = _table(path)
            scale = METRES[unit] if axes is None else METRES["mm"]
        else:
            raise FileError(f"{path}: expected landmarks as {', '.join(SUFFIXES[:-1])}, got {path.suffix!r}.")
        points = [(name, numbers([str(number).strip() for number in place])) for name, place in found]
    except FileError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, OSError, csv.Error) as error:
        raise FileError(f"{path}: expected points, each a name with x, y and z ({error}).") from error
    return Landmarks({name: place / round(1 / scale) for name, place in _checked(path, points)}, axes)


_Named = list[tuple[str, Sequence[Any]]]


def _rows(path: Path) -> list[list[str]]:
    """Fields of each line that is no comment, without blanks and quotes around them."""
    lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip() and line[0] != "#"]
    first = lines[0] if lines else ""
    separator = ";" if ";" in first else "\t" if "\t" in first else ","
    return [[word.strip() for word in row] for row in csv.reader(lines, delimiter=separator, skipinitialspace=True)]


def _table(path: Path) -> tuple[_Named, Axes | None]:
    rows = _rows(path)
    names = [word.lower() for word in rows[0]] if rows else []
    for three, axes in _COLUMNS.items():
        if all(names.count(column) == 1 for column in three):
            label = next((names.index(word) for word in _LABELS if word in names), 0)
            defined = names.index("defined") if "defined" in names else None
            wrong = next((row for row in rows if len(row) != len(names)), None)
            if wrong is not None:
                raise ValueError(f"got the line {','.join(wrong)!r}")
            places = [names.index(column) for column in three]
            there = [row for row in rows[1:] if defined is None or row[defined] not in ("0", "false", "False")]
            return [(row[label], [row[place] for place in places]) for row in there], axes
    wrong = next((row for row in rows if len(row) != 4), None)
    if wrong is not None:
        raise ValueError(f"got the line {','.join(wrong)!r}")
    return [(row[0], row[1:]) for row in rows], None


def _fiducials(path: Path) -> tuple[_Named, Axes]:
    said, columns = "0", list(_FIDUCIALS)
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            said = value.strip() if key.strip() == "CoordinateSystem" else said
            columns = [word.strip() for word in value.split(",")] if key.strip() == "columns" else columns
    rows = [dict(zip(columns, row, strict=False)) for row in _rows(path)]
    return [(row["label"], [row["x"], row["y"], row["z"]]) for row in rows], _axes(path, said)


def _markups(path: Path) -> tuple[_Named, Axes, float]:
    """All points of a file; several lists in it are taken together."""
    lists = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=_once)["markups"]
    found: _Named = []
    frames = set()
    for markup in lists:
        units = markup.get("coordinateUnits", "mm")
        word = units if isinstance(units, str) else units[0]
        unit = spelled_unit(word)
        if unit is None:
            raise FileError(f"{path}: expected points in m, cm, mm or um, got {word!r}.")
        frames.add((_axes(path, str(markup.get("coordinateSystem", "LPS"))), unit[0]))
        points = markup.get("controlPoints", [])
        states = {str(point.get("positionStatus", "defined")) for point in points}
        if unknown := states - set(_STATES):
            raise ValueError(f"positionStatus: expected {', '.join(_STATES)}, got {min(unknown)!r}")
        found += [(p["label"], p["position"]) for p in points if p.get("positionStatus", "defined") == "defined"]
    if len(frames) != 1:
        raise FileError(f"{path}: expected lists of points in one unit and on one kind of axes, got {len(frames)}.")
    axes, scale = frames.pop()
    return found, axes, scale


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; a key that is there twice swallowed what stood between."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key twice in one object")
    return found


def _axes(path: Path, said: str) -> Axes:
    if said.upper() not in _SYSTEMS:
        raise FileError(f"{path}: expected points in LPS or RAS, got {said!r}.")
    return _SYSTEMS[said.upper()]


def _checked(path: Path, points: list[tuple[str, Floats]]) -> list[tuple[str, Floats]]:
    if not points:
        raise FileError(f"{path}: expected landmarks, got none.")
    names = [name for name, _ in points]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise FileError(f"{path}: expected each landmark once, got {', '.join(twice)} more than once.")
    wrong = [name for name, place in points if place.shape != (3,) or not np.isfinite(place).all()]
    if wrong:
        raise FileError(f"{path}: expected three finite coordinates, got others for {', '.join(wrong)}.")
    return points
