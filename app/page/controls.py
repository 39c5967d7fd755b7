"""What a person can set: the simulated camera, the engine, what the colours show; values that others read."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import viser

from .bands import SCALES
from .camera import View
from .figures import Figures, figures_html, legend_html, notice_html

RECORDED_S = 8.0
ENGINES = ("surrogate", "hybrid", "reference", "torch")
_ALONE = ("reference", "torch")  # that need no network
_SHOWS = {
    "true error": "error",
    "95 % margin": "margin",
    "cloud to surface": "distance",
    "movement since the scan": "movement",
}


def engines_here(has_network: bool = True) -> tuple[str, ...]:
    """The engines that this machine can run.

    Args:
        has_network: whether the twin has a surrogate.
    """
    has_reference = find_spec("dolfinx") is not None
    found = [name for name in ENGINES if name in ("surrogate", "torch") or has_reference]
    return tuple(name for name in found if has_network or name in _ALONE)


@dataclass(frozen=True)
class Wishes:
    """What is asked for.

    Args:
        view: how a simulated camera sees.
        engine: that registers.
        shows: what the colours show, a word of `SCALES`.
        is_running: whether a simulated organ moves.
    """

    view: View
    engine: str
    shows: str
    is_running: bool = True


class Controls:
    """The panel of the page.

    Args:
        server: that shows it.
        engines: that can be chosen; the first is.
        is_simulated: whether there is a simulated camera to set, and a truth to compare with.
        changed: is called, in any thread, when something was set.
    """

    def __init__(
        self, server: viser.ViserServer, engines: Sequence[str], is_simulated: bool, changed: Callable[[], None]
    ) -> None:
        gui, self._changed = server.gui, changed
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.add_html(notice_html())
        self._figures = gui.add_html("")
        self._legend = gui.add_html("")
        self._lock = threading.Lock()
        words = [word for word, name in _SHOWS.items() if is_simulated or name != "error"]
        self._shows = gui.add_dropdown("colours", words, initial_value=words[0], hint="What the organ's colours show")
        only = len(engines) == 1
        why = "FEniCSx is not installed here: the surrogate alone" if only else "What registers the clouds"
        self._engine = gui.add_dropdown("engine", list(engines), initial_value=engines[0], hint=why, disabled=only)
        inputs: list[Any] = [self._shows, self._engine]
        if only:
            gui.add_markdown(f"*{why}.*")
        self._sliders: list[viser.GuiSliderHandle[float]] = []
        if is_simulated:
            with gui.add_folder("simulated camera"):
                self._sliders = [
                    gui.add_slider("noise, mm", 0.0, 4.0, 0.1, 0.5),
                    gui.add_slider("share seen, %", 10.0, 100.0, 5.0, 100.0),
                    gui.add_slider("camera turned, °", -8.0, 8.0, 1.0, 0.0),
                    gui.add_slider("camera shifted, mm", -15.0, 15.0, 1.0, 0.0),
                ]
                self._runs = gui.add_checkbox("organ moves", True)
            inputs += [*self._sliders, self._runs]
        for handle in inputs:
            handle.on_update(self._on_update)
        self._record = gui.add_button(f"record {RECORDED_S:g} s as one HTML file", hint="The scene, without this panel")
        self.show(Figures("softtwin", reason="the twin is being opened"))
        self.describe(self.wishes.shows)

    @property
    def wishes(self) -> Wishes:
        """What is asked for now."""
        view, runs = View(), True
        if self._sliders:
            noise, share, turn, shift = (float(slider.value) for slider in self._sliders)
            view = View(1e-3 * noise, share / 100.0, float(np.deg2rad(turn)), 1e-3 * shift)
            runs = bool(self._runs.value)
        return Wishes(view, str(self._engine.value), _SHOWS[str(self._shows.value)], runs)

    def on_record(self, callback: Callable[[viser.ClientHandle], None]) -> None:
        """Call with the browser in which a recording was asked for."""
        self._record.on_click(lambda event: callback(event.client) if event.client is not None else None)

    def show(self, figures: Figures) -> None:
        """Show figures."""
        self._figures.content = figures_html(figures)

    def _on_update(self, _: Any) -> None:
        self.describe(self.wishes.shows)
        self._changed()

    def describe(self, shows: str) -> None:
        """Say what the colours mean.

        Args:
            shows: a word of `SCALES`.
        """
        self._legend.content = legend_html(SCALES[shows], shows == "distance")
