"""`softtwin pick`: a page on which one clicks what holds the organ, and gets the words for --fixed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
import viser
from numpy.typing import NDArray
from vtkmodules.vtkCommonCore import mutable

from softtwin.meshes.attachment import parse_file
from softtwin.meshes.body import Body, Surface
from softtwin.meshes.closest import cell_locator
from softtwin.meshes.embedding import outer
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import read_mesh, read_surface, stated_axes

from ..config import BodySection, ConfigError, files_axes, read_config
from ..organ import SHAPES, make_body
from ..record import NOTICE
from ..workspace import write_whole
from .figures import notice_html
from .scene import FRONT, PER_METRE, colour_of
from .server import address, open_browser, serving

Floats = NDArray[np.float64]
Say = Callable[[str], None]
_ORGAN, _BALL = (225, 170, 150), (200, 30, 60)
_RADIUS_MM = 15.0


@dataclass(frozen=True, eq=False)
class Subject:
    """What is picked on.

    Args:
        surface: the organ's, metres and LPS.
        inner: its inner surfaces, by name.
        coordinates: unit and axes of the organ's file.
        configuration: the file that the words can be written into; None where none was given.
    """

    surface: Surface
    inner: dict[str, Surface]
    coordinates: Coordinates
    configuration: Path | None


def subject_of(section: BodySection, root: Path, configuration: Path | None = None) -> Subject:
    """What a configuration's [body] names, before anything holds it.

    Args:
        section: the [body].
        root: folder that relative paths start from.
        configuration: the file it was read from.

    Raises:
        FileError, RegionError, BodyError: what cannot be read, and why.
    """
    axes = files_axes(section)
    if section.source in SHAPES:
        body = make_body(section.model_copy(update={"fixed": "", "observed": "", "zones": {}}), root)
        return Subject(outer(body).rest, dict(body.inner), Coordinates(section.unit, axes or "lps"), configuration)
    file = parse_file(section.source)
    unit = file.unit or section.unit
    found = read_mesh(root / file.path, unit, axes or "lps")
    surface = found if isinstance(found, Surface) else Body(found.points, found.cells, {}).boundary_surface
    inner = {}
    for name, text in section.inner.items():
        part = parse_file(text)
        path = root / part.path
        turned = part.axes or stated_axes(path) or axes
        inner[name] = read_surface(path, part.unit or section.unit, turned if turned and axes else "lps")
    return Subject(surface, inner, Coordinates(unit, axes or "lps"), configuration)


def ball_words(centre: Floats, radius: float, coordinates: Coordinates) -> str:
    """The words for a ball in the organ's file's own unit and axes, which `--fixed` takes.

    Args:
        centre: (3,), metres and LPS.
        radius: metres.
        coordinates: of the organ's file.
    """
    digits = {"m": 4, "cm": 2, "mm": 1}[coordinates.unit]
    numbers = ",".join(f"{x:.{digits}f}" for x in coordinates.lengths(centre) + 0.0)
    return f"ball:{numbers}{coordinates.unit}:{float(coordinates.distances(radius)):.{digits}f}{coordinates.unit}"


def write_fixed(configuration: Path, words: str) -> None:
    """Put words in the place of `fixed` in the [body] of a configuration; everything else in the file stays.

    Raises:
        ConfigError: the file is no configuration.
    """
    read_config(configuration)
    document: Any = tomlkit.parse(configuration.read_text())
    body = document.setdefault("body", tomlkit.table())
    comment = body["fixed"].trivia.comment.lstrip("# ") if "fixed" in body else ""
    item = tomlkit.item(words)
    body["fixed"] = item.comment(comment) if comment else item
    write_whole(configuration, tomlkit.dumps(document))


def hit(surface: Surface, origin: Floats, direction: Floats) -> Floats | None:
    """The first point of a surface along a ray, (3,), metres; None where there is none.

    Args:
        surface: triangle surface, metres.
        origin: of the ray, (3,), metres.
        direction: of the ray, (3,), any length.
    """
    reach = float(np.linalg.norm(origin - surface.points.mean(axis=0)) + np.linalg.norm(np.ptp(surface.points, axis=0)))
    end = origin + reach * direction / np.linalg.norm(direction)
    place, local = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    along: Any = mutable(0.0)
    part: Any = mutable(0)
    if not cell_locator(surface).IntersectWithLine(origin.tolist(), end.tolist(), 1e-9, along, place, local, part):
        return None
    return np.array(place)


class Picker:
    """The page.

    Args:
        server: that shows it.
        subject: what is picked on.
        say: prints a line.
    """

    def __init__(self, server: viser.ViserServer, subject: Subject, say: Say) -> None:
        self._server, self._subject, self._say = server, subject, say
        self._lock = threading.Lock()
        self._kept: list[str] = []
        self._place: Floats | None = None
        self._centre: Floats = subject.surface.points.mean(axis=0)
        self._draw()
        gui = server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.add_html(notice_html())
        gui.add_markdown("**Click the organ where it is held.** Drag beside it to turn it.")
        self._radius = gui.add_slider("radius, mm", 2.0, 60.0, 1.0, _RADIUS_MM)
        self._text = gui.add_html("")
        self._radius.on_update(lambda _: self._describe())
        gui.add_button("add another place").on_click(lambda _: self._keep())
        gui.add_button("start anew").on_click(lambda _: self._clear())
        if subject.configuration is not None:
            gui.add_button(f"write into {subject.configuration.name}").on_click(lambda _: self._write())
        self._describe()

    @property
    def words(self) -> str:
        """What --fixed wants; empty where nothing was picked."""
        picked = [] if self._place is None else [ball_words(self._place, self._metres, self._subject.coordinates)]
        return " + ".join([*self._kept, *picked])

    @property
    def _metres(self) -> float:
        return 1e-3 * float(self._radius.value)

    def pick(self, origin: Floats, direction: Floats) -> None:
        """Pick the first point of the organ along a ray in the scene."""
        place = hit(self._subject.surface, origin / PER_METRE + self._centre, direction)
        if place is not None:
            self._place = place
            self._describe()

    def _draw(self) -> None:
        scene, camera, subject = self._server.scene, self._server.initial_camera, self._subject
        organ = scene.add_mesh_simple(
            "/organ", self._placed(subject.surface.points), subject.surface.triangles, color=_ORGAN, opacity=0.75
        )
        for name, surface in subject.inner.items():
            points = self._placed(surface.points)
            scene.add_mesh_simple(f"/inner/{name}", points, surface.triangles, color=colour_of(name))
        size = PER_METRE * float(np.linalg.norm(np.ptp(subject.surface.points, axis=0)))
        camera.position, camera.look_at = size * FRONT / np.linalg.norm(FRONT), (0.0, 0.0, 0.0)
        scene.configure_default_lights(enabled=True, cast_shadow=False)

        @organ.on_click
        def _(event: Any) -> None:
            self.pick(np.array(event.ray_origin), np.array(event.ray_direction))

    def _placed(self, points: Floats) -> NDArray[np.float32]:
        return (PER_METRE * (points - self._centre)).astype(np.float32)

    def _describe(self) -> None:
        with self._lock:
            if self._place is not None:
                self._show_ball(f"/picked/{len(self._kept)}", self._place)
            self._text.content = _words_html(self.words, self._covered())

    def _show_ball(self, name: str, place: Floats) -> None:
        centre = self._placed(place[None])[0].astype(np.float64)
        self._server.scene.add_icosphere(
            name, radius=PER_METRE * self._metres, color=_BALL, opacity=0.45, position=centre, cast_shadow=False
        )

    def _covered(self) -> int:
        if self._place is None:
            return 0
        away = np.linalg.norm(self._subject.surface.points - self._place, axis=1)
        return int((away <= self._metres).sum())

    def _keep(self) -> None:
        with self._lock:
            if self._place is not None:
                self._kept, self._place = [self.words], None
        self._describe()

    def _clear(self) -> None:
        with self._lock:
            self._kept, self._place = [], None
            self._server.scene.remove_by_name("/picked")
        self._describe()

    def _write(self) -> None:
        words, file = self.words, self._subject.configuration
        if words and file is not None:
            write_fixed(file, words)
            self._say(f'{file}: fixed = "{words}"')
            self._text.content = _words_html(words, self._covered(), f"written into {file.name}")


def _words_html(words: str, covered: int, more: str = "") -> str:
    style = "padding:6px 12px;font-family:sans-serif"
    if not words:
        return f'<div style="{style};font-size:15px">nothing picked yet</div>'
    line = f"--fixed '{words}'"
    box = "font-family:monospace;font-size:14px;background:#eef;padding:8px;border-radius:6px;user-select:all"
    told = more or f"{covered} vertices of the surface lie in the last ball"
    return f'<div style="{style}"><div style="{box}">{escape(line)}</div><div style="font-size:13px">{told}</div></div>'


def run_pick(
    section: BodySection,
    root: Path,
    configuration: Path | None,
    port: int | None = None,
    browser: bool = True,
    say: Say = print,
) -> str:
    """Show the page until Ctrl-C; returns the words.

    Args:
        section: the [body] that names the organ.
        root: folder that relative paths start from.
        configuration: the file that the words can be written into.
        port: of the page; the first free one from 8080 on if not given.
        browser: open the page in a browser where there is a display.
        say: prints a line.

    Raises:
        ConfigError: the port is taken, or there is no source.
        FileError, RegionError, BodyError: what cannot be read, and why.
    """
    if not section.source:
        raise ConfigError("pick: expected a surface or a mesh, got a configuration without body.source.")
    subject = subject_of(section, root, configuration)
    with serving(port, "softtwin pick") as server:
        picker = Picker(server, subject, say)
        try:
            say(f"softtwin pick: {address(server)}   (Ctrl-C ends it). {NOTICE}")
            if browser:
                open_browser(server)
            threading.Event().wait()
        except KeyboardInterrupt:
            say(f"\n--fixed '{picker.words}'" if picker.words else "\nnothing was picked.")
    return picker.words
