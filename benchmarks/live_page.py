"""The live page as a browser receives it: vertex updates a second, pull to answer, memory over time, five browsers.

    python benchmarks/live_page.py                 600 seconds of the demo in headless Chromium (Debian's chromium)
    python benchmarks/live_page.py --seconds 60    a shorter look

Software rendering draws three to twelve pictures a second, so that what is counted is what the browser receives:
messages on its websocket that move the organ's vertices. A pull is timed from the message with the mouse's place, which
the library sends at most every 50 ms, to the next one that moves the organ, both as Playwright tells of them.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zstandard
from columns import Column, cell
from harness import Benchmark, Setting, run
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright
from summaries import resident_mib

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
VIEW: ViewportSize = {"width": 1280, "height": 800}
PLACE = (0.62, 0.47)  # of the organ in the part of the page that shows it, where the mouse takes hold
_HEAD = 16  # bytes: sizes of what follows, before and after it was packed


def messages(payload: bytes) -> list[dict[str, Any]]:
    """The messages in one frame that viser's server has sent."""
    packed = int.from_bytes(payload[8:_HEAD], "little")
    inner = zstandard.ZstdDecompressor().decompress(payload[_HEAD : _HEAD + packed])
    found: list[dict[str, Any]] = msgspec.msgpack.decode(inner)["messages"]
    return found


def moves_organ(payload: bytes) -> bool:
    """Whether a frame from the server moves the organ's vertices."""
    return any(
        message.get("name") == "/organ/band 0" and "vertices" in (message.get("updates") or {})
        for message in messages(payload)
    )


@dataclass
class Heard:
    """What went over the websocket of one page.

    Args:
        updates: when the organ was moved, seconds of the monotonic clock.
        drags: when the mouse's place was sent, likewise.
        received: bytes.
    """

    updates: list[float] = field(default_factory=list)
    drags: list[float] = field(default_factory=list)
    received: int = 0

    def take(self, payload: str | bytes) -> None:
        """A frame that came."""
        assert isinstance(payload, bytes)
        self.received += len(payload)
        if moves_organ(payload):
            self.updates.append(time.monotonic())

    def give(self, payload: str | bytes) -> None:
        """A frame that was sent."""
        if "Drag" in msgspec.msgpack.decode(payload)["type"]:
            self.drags.append(time.monotonic())

    def answers(self) -> list[float]:
        """Seconds from each place of the mouse to the organ's next movement."""
        updates = np.array(self.updates)
        later = np.searchsorted(updates, self.drags)
        return [float(updates[i] - drag) for i, drag in zip(later, self.drags, strict=True) if i < len(updates)]


@contextmanager
def demo(*more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`softtwin demo` in a process of its own, without a display, and its address."""
    hidden = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [sys.executable, "-u", "-c", _PROGRAM, "demo", *more]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=hidden)
    assert process.stdout is not None
    try:
        said = process.stdout.readline()
        if "http://" not in said:
            raise RuntimeError(f"softtwin demo said: {said}{process.stdout.read()}")
        yield process, said.split("http://")[1].split()[0]
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=120)
        finally:
            process.kill()
            process.stdout.close()


# Who runs in the background may have Ctrl-C ignored, and programs inherit that.
_PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from softtwin.app.cli import main
main(sys.argv[1:])
"""


def opened(browser: Browser, address: str, view: ViewportSize = VIEW) -> tuple[Page, Heard]:
    """A page with the demo in it, and what it hears."""
    page, heard = browser.new_page(viewport=view), Heard()
    page.on("websocket", lambda wire: (wire.on("framereceived", heard.take), wire.on("framesent", heard.give)))
    page.goto(f"http://{address}", timeout=120_000)
    page.wait_for_selector("canvas", timeout=120_000)
    return page, heard


def take_hold(page: Page) -> tuple[float, float]:
    """Press the mouse on the organ; returns where."""
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    x, y = box["x"] + PLACE[0] * box["width"], box["y"] + PLACE[1] * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    return x, y


def pull(page: Page, seconds: float) -> None:
    """Pull at the organ to and fro."""
    x, y = take_hold(page)
    end, step = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        step += 1
        page.mouse.move(x + 20 * np.sin(0.3 * step), y - 12 * (1 - np.cos(0.3 * step)))
        page.wait_for_timeout(50)
    page.mouse.up()


def rate(heard: Heard, page: Page, seconds: float) -> float:
    """Vertex updates a second over so many seconds from now."""
    before = len(heard.updates)
    begin = time.monotonic()
    page.wait_for_timeout(1000 * seconds)
    return (len(heard.updates) - before) / (time.monotonic() - begin)


def cpu_seconds(process: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(seconds: float) -> dict[str, Any]:
    """All figures."""
    began = time.monotonic()
    with demo() as (process, address), sync_playwright() as playwright:
        served = time.monotonic() - began
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        page, heard = opened(browser, address)
        while not heard.updates:
            page.wait_for_timeout(50)
        first = time.monotonic() - began
        page.wait_for_timeout(5000)
        updates = rate(heard, page, 15.0)
        pull(page, 10.0)
        answers = heard.answers()
        pages = [opened(browser, address) for _ in range(4)]
        together = [len(other.updates) for _, other in [(page, heard), *pages]]
        begin = time.monotonic()
        page.wait_for_timeout(15_000)
        spent = time.monotonic() - begin
        five = [(len(other.updates) - n) / spent for n, (_, other) in zip(together, [(page, heard), *pages],
                                                                          strict=True)]  # fmt: skip
        for other, _ in pages:
            other.close()
        course = []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            course.append(resident_mib(process.pid))
            page.wait_for_timeout(min(10_000, 1000 * seconds / 6))
        browser.close()
        time.sleep(2.0)
        before = cpu_seconds(process.pid)
        time.sleep(5.0)
        idle = (cpu_seconds(process.pid) - before) / 5.0
    half = len(course) // 2
    return {
        "seconds_to_page": served,
        "seconds_to_first_update": first,
        "updates_a_second": updates,
        "pull_to_answer_ms": {
            name: 1e3 * float(np.quantile(answers, share)) for name, share in (("median", 0.5), ("p95", 0.95))
        },
        "pulls": len(answers),
        "five_browsers_updates_a_second": five,
        "memory_mib": {"first": course[0], "middle": course[half], "last": course[-1], "seconds": seconds},
        "cores_used_with_no_browser": idle,
    }


ASKED = {
    "page served; first vertices there, s": ("{seconds_to_page:.1f}; {seconds_to_first_update:.1f}", "15"),
    "vertex updates a second that the browser receives": ("{updates_a_second:.1f}", "30"),
    "pull to answer (95 %), ms": ("{pull_to_answer_ms.median:.0f} ({pull_to_answer_ms.p95:.0f})", "95 %: 100"),
    "five browsers, updates a second, the least": ("{five_least:.1f}", "at once"),
    "resident memory: first, middle, last, MiB": (
        "{memory_mib.first:.0f}; {memory_mib.middle:.0f}; {memory_mib.last:.0f}",
        "flat",
    ),
    "cores used with no browser": ("{cores_used_with_no_browser:.2f}", "-"),
}


def lines(figures: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A line for each figure."""
    told = {**figures, "five_least": min(figures["five_browsers_updates_a_second"])}
    for label, (reached, asked) in ASKED.items():
        yield label, {"reached": cell(Column("", "", reached), told), "asked": asked}


BENCHMARK = Benchmark(
    name="live_page",
    title="The live page as a browser receives it: updates, pull to answer, memory, five browsers",
    about=("app",),
    work=lambda row, given: measured(given.seconds),
    columns=(Column("reached", "", "{reached}"), Column("asked", "", "{asked}")),
    settings={"seconds": Setting(600.0, "over which memory is watched")},
    small={"seconds": 12.0},
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK)
