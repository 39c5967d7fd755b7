"""`softtwin demo`: the small twin of the phantom that comes with the package, before a simulated camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np

from ..config import ConfigError
from ..record import NOTICE
from ..twin import Home, find_twin
from .camera import AROUND_S, Shot, TrueStates, shot
from .server import address, open_browser, serving
from .session import Session

PHANTOM = Path(__file__).parents[1] / "twins" / "phantom"
EVERY = 1.0 / 15.0  # seconds between two clouds of the simulated camera
Say = Callable[[str], None]


def run_demo(
    port: int | None = None, browser: bool = True, record: Path | None = None, seconds: float = 8.0, say: Say = print
) -> None:
    """Show the phantom until Ctrl-C.

    Args:
        port: of the page; the first free one from 8080 on if not given.
        browser: open the page in a browser where there is a display.
        record: a file to write a recording of the scene to, as one HTML page, and end.
        seconds: that a recording takes.
        say: prints a line.

    Raises:
        ConfigError: the port is taken.
    """
    if record is not None and not record.absolute().parent.is_dir():
        raise ConfigError(f"--record: expected a file in a folder that is there, got {record}.")
    home, states = find_twin(PHANTOM), TrueStates.read(PHANTOM)
    with ExitStack() as stack:  # however early Ctrl-C comes: a thread at work when Python ends takes the process down
        server = stack.enter_context(serving(port, "softtwin demo"))
        session = stack.enter_context(closing(Session(server, home, is_simulated=True)))

        def show() -> None:
            say(f"softtwin demo: {address(server)}   (Ctrl-C ends it). {NOTICE}")
            if record is not None:
                session.record(seconds, _written(record, session, say))
            elif browser and not open_browser(server):
                say("no display here: open that address in a browser on this machine, or through an ssh tunnel.")
            session.run(simulated(session, home, states))

        run_until_interrupted(show, say)


def run_until_interrupted(work: Callable[[], None], say: Say) -> None:
    """Do it; Ctrl-C is a way to end it like any other."""
    try:
        work()
    except KeyboardInterrupt:
        say("\nthe page is closed.")


def simulated(session: Session, home: Home, states: TrueStates) -> Iterator[Shot]:
    """Clouds of the simulated camera, while they are wanted.

    Args:
        session: that wants them.
        home: of the twin.
        states: true states of its body.
    """
    rng, angle, known = np.random.default_rng(5), 0.0, -1
    last = time.monotonic()
    while True:
        known = session.wait_until_wanted(known)
        if session.is_closed:
            return
        wishes, now = session.wishes, time.monotonic()
        if wishes.is_running:
            angle += 2.0 * np.pi * min(now - last, 2.0 * EVERY) / AROUND_S
        last = now
        yield shot(home.body, states, angle, wishes.view, rng)
        time.sleep(max(0.0, EVERY - (time.monotonic() - now)))


def _written(path: Path, session: Session, say: Say) -> Callable[[str], None]:
    def write(page: str) -> None:
        path.write_text(page)
        say(f"written: {path} ({len(page) / 1e6:.1f} MB)")
        session.end()

    return write
