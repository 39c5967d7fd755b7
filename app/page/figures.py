"""The figures beside the picture, in words that are read from the last row of a room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape

import numpy as np

from softtwin.registration.verdict import Verdict

from ..record import NOTICE
from .bands import COLOURS, UNINFORMED, Colour, Scale
from .scene import colour_of, spoken

_VERDICTS = {Verdict.ACCEPTED: "#1b7f4b", Verdict.DOUBTFUL: "#b36b00", Verdict.REFUSED: "#b00020"}
_WAITING = "#55606a"


@dataclass(frozen=True)
class Figures:
    """What is known of what is shown; lengths in metres, times in seconds, forces in newtons; NaN for unknown.

    Args:
        title: what is shown.
        verdict: of it; None where there is none yet.
        reason: why it is not accepted, or what is waited for.
        margins: 95 % margin of each structure, by name, of its part inside the organ.
        errors: distance of each structure from where it truly is, by name; empty where that is not known.
        outside: share of each structure that lies outside the organ, and of which nothing is known, by name.
        bound: on the largest nodal error of the prediction.
        confidence: of that bound, in (0, 1).
        net_force: size of the net force.
        net_force_deviation: its standard deviation.
        true_net_force: its true size.
        frame_time: from a cloud's turn to its answer.
        age: from a cloud's coming to its answer.
        dropped: clouds that came and were never registered, in all.
        rate: answers a second.
        engine: that registers.
        pose_correction: translation in metres and rotation in radians from where the camera was said to stand
            to where it is found; None where the cloud shows none.
    """

    title: str
    verdict: Verdict | None = None
    reason: str = ""
    margins: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    outside: Mapping[str, float] = field(default_factory=dict)
    bound: float = np.nan
    confidence: float = np.nan
    net_force: float = np.nan
    net_force_deviation: float = np.nan
    true_net_force: float = np.nan
    frame_time: float = np.nan
    age: float = np.nan
    dropped: int = 0
    rate: float = np.nan
    engine: str = ""
    pose_correction: tuple[float, float] | None = None


def figures_html(figures: Figures) -> str:
    """The figures as HTML, for a panel about 300 pixels wide."""
    colour = _WAITING if figures.verdict is None else _VERDICTS[figures.verdict]
    word = "waiting" if figures.verdict is None else figures.verdict.value
    reason = f'<div style="font-size:13px;margin-top:4px">{escape(figures.reason)}</div>' if figures.reason else ""
    head = (
        f'<div style="background:{colour};color:#fff;border-radius:6px;padding:8px 12px;margin-bottom:8px">'
        f'<div style="font-size:14px">{escape(figures.title)}</div>'
        f'<div style="font-size:26px;font-weight:700;line-height:1.2">{word}</div>{reason}</div>'
    )
    return f'<div style="padding:0 12px;font-family:sans-serif">{head}{_structures(figures)}{_others(figures)}</div>'


def legend_html(scale: Scale, has_uninformed: bool) -> str:
    """The bands' colours with their meaning, as HTML.

    Args:
        scale: the bands.
        has_uninformed: whether a part of the organ may have none.
    """
    rows = [_chip(colour, f"{words} mm") for colour, words in zip(COLOURS, scale.words(), strict=True)]
    if has_uninformed:
        rows.append(_chip(UNINFORMED, "not told"))
    title = f'<div style="font-size:14px;font-weight:600;margin-bottom:4px">{escape(scale.title)}</div>'
    return f'<div style="padding:4px 12px;font-family:sans-serif">{title}{"".join(rows)}</div>'


def notice_html() -> str:
    """That nobody be misled, as HTML."""
    return (
        '<div style="padding:2px 12px 8px;font-family:sans-serif;font-size:14px;font-weight:700;color:#b00020">'
        f"{escape(NOTICE)}</div>"
    )


def _structures(figures: Figures) -> str:
    names = sorted({*figures.margins, *figures.errors}, key=lambda name: ("tumo" not in name.lower(), name))
    if not names:
        return ""
    has_errors = bool(figures.errors)
    heads = ["", "95 % margin", *(["true error"] if has_errors else [])]
    rows = [
        [
            _chip(colour_of(name), spoken(name)) + _part_outside(figures.outside.get(name, 0.0)),
            _mm(figures.margins.get(name)),
            *([_mm(figures.errors.get(name))] if has_errors else []),
        ]
        for name in names
    ]
    first = "".join(f'<th style="text-align:right;font-weight:400;font-size:13px">{head}</th>' for head in heads)
    body = "".join(
        "<tr>" + "".join(f'<td style="{_cell(i, name)}">{cell}</td>' for i, cell in enumerate(row)) + "</tr>"
        for name, row in zip(names, rows, strict=True)
    )
    return f'<table style="width:100%;border-collapse:collapse;margin-bottom:6px"><tr>{first}</tr>{body}</table>'


def _part_outside(share: float) -> str:
    """That a part of a structure is not known, as HTML; nothing where all of it is inside."""
    if share == 0.0:
        return ""
    words = f"{100 * share:.0f} % of it outside the organ: not known"
    return f'<div style="font-size:12px;color:#666">{words}</div>'


def _cell(column: int, name: str) -> str:
    if column == 0:
        return "font-size:15px;padding:2px 0"
    size, weight = (22, 700) if "tumo" in name.lower() else (15, 500)
    return f"text-align:right;font-size:{size}px;font-weight:{weight};white-space:nowrap"


def _others(figures: Figures) -> str:
    rows = []
    if np.isfinite(figures.bound):
        share = f" ({100 * figures.confidence:.0f} % of loads)" if np.isfinite(figures.confidence) else ""
        rows.append((f"largest error{share}", f"≤ {_mm(figures.bound)}"))
    if np.isfinite(figures.net_force):
        deviation = f" ± {figures.net_force_deviation:.2f}" if np.isfinite(figures.net_force_deviation) else ""
        rows.append(("net force", f"{figures.net_force:.2f}{deviation} N"))
    if np.isfinite(figures.true_net_force):
        rows.append(("true net force", f"{figures.true_net_force:.2f} N"))
    if figures.pose_correction is not None:
        shift, turn = figures.pose_correction
        rows.append(("camera elsewhere by", f"{_mm(shift)}, {np.rad2deg(turn):.1f}°"))
    for name, seconds in (("frame time", figures.frame_time), ("age of the answer", figures.age)):
        if np.isfinite(seconds):
            rows.append((name, f"{1e3 * seconds:.0f} ms"))
    if np.isfinite(figures.rate):
        rows.append(("answers", f"{figures.rate:.0f} a second"))
    rows.append(("dropped frames", f"{figures.dropped}"))
    if figures.engine:
        rows.append(("engine", escape(figures.engine)))
    cells = "".join(
        f'<tr><td style="font-size:14px;padding:1px 0">{name}</td>'
        f'<td style="text-align:right;font-size:16px;font-weight:600;white-space:nowrap">{value}</td></tr>'
        for name, value in rows
    )
    return f'<table style="width:100%;border-collapse:collapse">{cells}</table>'


def _chip(colour: Colour, words: str) -> str:
    box = f"display:inline-block;width:14px;height:14px;border-radius:3px;background:rgb{colour};margin-right:8px"
    return f'<div style="font-size:15px;line-height:1.5"><span style="{box}"></span>{escape(words)}</div>'


def _mm(metres: float | None) -> str:
    return f"{1e3 * metres:.1f} mm" if metres is not None and np.isfinite(metres) else "unknown"
