"""The page in a browser: Debian's Chromium, headless, with software rendering."""

import io
import signal
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is absent")
pytest.importorskip("torch", reason="torch is absent")
pytest.importorskip("playwright", reason="playwright is absent")
import live_page
from live_page import CHROMIUM, FLAGS, demo, take_hold
from playwright.sync_api import Error, Page, ViewportSize, expect, sync_playwright

if not CHROMIUM.exists():
    pytest.skip(
        "no chromium here (apt-get install chromium): the page was tried in no browser", allow_module_level=True
    )

pytestmark = pytest.mark.browser
NAMED = (  # what the console may say, all of it from the library's own page
    "Unable to preventDefault inside passive event listener invocation",
    "GPU stall due to ReadPixels",  # of taking screenshots
)
WAIT = 120_000.0  # milliseconds, on busy cores
VIEW: ViewportSize = {"width": 968, "height": 540}  # a processor draws it: half of what a user's window has


@pytest.fixture(scope="module")
def shown() -> Iterator[SimpleNamespace]:
    with demo() as (process, address), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield SimpleNamespace(browser=browser, address=address, process=process)
        browser.close()


@pytest.fixture
def page(shown: Any) -> Iterator[SimpleNamespace]:
    errors, asked = list[str](), list[str]()
    found, heard = live_page.opened(shown.browser, shown.address, VIEW)
    found.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    found.on("pageerror", lambda error: errors.append(str(error)))
    found.on("request", lambda request: asked.append(request.url))
    until(found, lambda: len(heard.updates) > 3)
    yield SimpleNamespace(page=found, heard=heard, errors=errors)
    found.close()
    assert [line for line in errors if not any(name in line for name in NAMED)] == []
    local = (f"http://{shown.address}", f"ws://{shown.address}", "data:", "blob:")
    assert [url for url in asked if not url.startswith(local)] == []


def until(page: Page, claim: Any) -> None:
    waited = 0.0
    while not claim() and waited < WAIT:
        page.wait_for_timeout(100)
        waited += 100
    assert claim()


def pull(page: Page, heard: live_page.Heard) -> None:
    """Take hold of the organ and pull a little; once more where it was not drawn yet under the mouse."""
    before = len(heard.drags)
    for _ in range(60):
        x, y = take_hold(page)
        for step in range(1, 9):
            page.mouse.move(x + 3 * step, y - 2 * step)
            page.wait_for_timeout(80)
        if len(heard.drags) > before:
            return
        page.mouse.up()
        page.wait_for_timeout(1000)
    raise AssertionError("the organ could not be taken hold of")


def picture(page: Page) -> Any:
    """The canvas with whatever lies over it, (h, w, 3), of 0 to 1."""
    from matplotlib.image import imread

    shot = imread(io.BytesIO(page.locator("canvas").first.screenshot(timeout=WAIT)))[..., :3]
    return shot[:, : int(0.95 * shot.shape[1])]  # the panel throws a shadow on the rest


def test_the_canvas_shows_an_organ_and_nothing_else(page: Any) -> None:
    def drawn() -> Any:
        return picture(page.page)

    def amid(shot: Any) -> Any:
        height, width = shot.shape[:2]
        return shot[height // 3 : 2 * height // 3, width // 6 : 2 * width // 3]

    until(page.page, lambda: (amid(drawn()) < 0.97).any(axis=2).mean() > 0.2)
    found = drawn()
    is_drawn = (found < 0.97).any(axis=2)
    height, width = is_drawn.shape
    assert 0.1 < is_drawn.mean() < 0.7
    assert not is_drawn[-20:].any() and not is_drawn[height // 2 :, :20].any()  # it floats, whole
    middle = found[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3].reshape(-1, 3)
    assert len(np.unique(np.round(20 * middle), axis=0)) > 30  # shaded, with structures inside: no flat patch


def test_figures_legend_and_notice_are_read(page: Any) -> None:
    text = page.page.locator("body")
    for words in (
        "Research software: not a medical device.",
        "95 % margin",
        "true error",
        "tumour",
        "net force",
        "frame time",
        "age of the answer",
        "dropped frames",
        "below 1 mm",
    ):
        expect(text).to_contain_text(words, timeout=WAIT)
    expect(text).to_contain_text("accepted", timeout=WAIT)


def test_the_page_has_no_button_for_a_public_address(page: Any) -> None:
    assert "share.viser" not in page.page.content()
    assert page.page.get_by_text("Share", exact=True).count() == 0


def test_the_organ_follows_a_pull_and_comes_back(page: Any) -> None:
    text = page.page.locator("body")
    before = len(page.heard.drags)
    pull(page.page, page.heard)
    expect(text).to_contain_text("forward prediction of a pull", timeout=WAIT)
    expect(text).to_contain_text("largest error (90 % of loads)", timeout=WAIT)
    until(page.page, lambda: len(page.heard.drags) > before + 3 and len(page.heard.answers()) > 3)
    page.page.mouse.up()
    expect(text).to_contain_text("true error", timeout=WAIT)
    expect(text).not_to_contain_text("forward prediction", timeout=WAIT)


def test_a_browser_that_goes_away_in_the_middle_of_a_drag_leaves_the_page_sound(shown: Any, page: Any) -> None:
    other, heard = live_page.opened(shown.browser, shown.address, VIEW)
    pull(other, heard)
    expect(page.page.locator("body")).to_contain_text("forward prediction of a pull", timeout=WAIT)
    other.close()
    expect(page.page.locator("body")).to_contain_text("true error", timeout=WAIT)
    count = len(page.heard.updates)
    until(page.page, lambda: len(page.heard.updates) > count + 10)
    assert shown.process.poll() is None


def test_with_nobody_looking_it_rests_and_goes_on_when_somebody_comes(shown: Any) -> None:
    for found in shown.browser.contexts:
        found.close()
    import time

    time.sleep(3.0)
    before = live_page.cpu_seconds(shown.process.pid)
    time.sleep(4.0)
    assert live_page.cpu_seconds(shown.process.pid) - before < 0.4  # a tenth of a core
    found, heard = live_page.opened(shown.browser, shown.address, VIEW)
    until(found, lambda: len(heard.updates) > 3)
    found.close()


def test_ctrl_c_ends_it_without_a_traceback() -> None:
    with demo() as (process, _):
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        said = process.stdout.read()
        assert process.wait(timeout=120) == 0, said
    assert "the page is closed" in said and "Traceback" not in said


def test_a_page_of_another_origin_cannot_open_its_websocket(shown: Any) -> None:
    found = shown.browser.new_page()
    found.goto("data:text/html,<p>elsewhere")
    script = f"""() => new Promise(done => {{
        const socket = new WebSocket("ws://{shown.address}");
        socket.onopen = () => done("open"); socket.onerror = () => done("refused"); }})"""
    try:
        assert found.evaluate(script) == "refused"
    except Error as error:  # a browser that forbids even to ask has refused, too
        assert "SecurityError" in str(error)
    found.close()
