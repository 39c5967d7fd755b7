"""The site builds without a warning, and nothing that a browser loads comes from elsewhere."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import runpy
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip("mkdocs", reason="the extra docs is absent")
pytest.importorskip("material", reason="the extra docs is absent")
pytest.importorskip("latex2mathml", reason="the extra docs is absent")

from mkdocs.exceptions import PluginError

ROOT = Path(__file__).resolve().parents[2]
LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not (ROOT / ".venv" / "types" / "softtwin").is_dir():
        pytest.skip("ci/setup.sh has not laid the folders under one name in .venv/types")
    built = os.environ.get("SOFTTWIN_SITE")  # by the group docs of ci/test.sh, strictly, of these sources
    if built:
        return Path(built)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert told.returncode == 0, told.stdout + told.stderr
    return folder


class _Loads(HTMLParser):
    """Addresses that a page has its browser load."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        told = dict(attrs)
        if tag in LOADED and told.get("rel") != "canonical" and told.get(LOADED[tag]):
            self.found.append(str(told[LOADED[tag]]))


def loads(page: Path) -> list[str]:
    parser = _Loads()
    parser.feed(page.read_text())
    return parser.found


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    found = [address for page in pages for address in loads(page)]
    assert len(pages) > 20 and len(found) > 5 * len(pages)
    assert [address for address in found if re.match(r"(\w+:)?//", address)] == []
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    assert styles and re.findall(r"url\(\s*[\"']?(?:https?:)?//|@import[^;]*//", styles) == []


@pytest.mark.parametrize("name", ["equilibrium", "registration", "surrogates"])
def test_equations_are_mathml_and_no_latex_is_left(site: Path, name: str) -> None:
    page = (site / "method" / f"{name}.html").read_text()
    equations = re.findall(r"<math .*?</math>", page, flags=re.S)
    assert sum('display="block"' in equation for equation in equations) >= 8
    assert all(ElementTree.fromstring(equation).tag.endswith("math") for equation in equations)
    assert re.findall(r"arithmatex|\\[(\[]|\$\$", re.sub(r"<script.*?</script>", "", page, flags=re.S)) == []


@pytest.mark.parametrize("formula", [r"\unheard{x}", r"x^", r"\left( x"])
def test_latex_that_is_not_known_ends_the_build(formula: str) -> None:
    with pytest.raises(PluginError, match=r"mathml"):
        runpy.run_path(str(ROOT / "ci" / "mkdocs_math.py"))["mathml"](formula)


def test_the_archive_is_not_in_the_site(site: Path) -> None:
    assert not (site / "archive").exists() and list((ROOT / "docs" / "archive").glob("*.md"))


def test_the_reference_has_what_the_docstrings_say(site: Path) -> None:
    """Mkdocstrings renders a module whose docstrings it cannot find without a word."""
    text = (site / "api" / "app.html").read_text()
    assert 'id="softtwin.app.twin.Twin.register"' in text
    assert "What does not depend on the cloud" in text or "Raises:" in text
    pages = {page.stem: page.read_text().count('id="softtwin.') for page in (site / "api").glob("*.html")}
    assert all(pages[stage] > 50 for stage in ("app", "meshes", "reference", "registration", "surrogate"))


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *told: object) -> None:
            """Nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.browser
def test_a_browser_asks_nobody_else_and_finds_what_is_searched_for(site: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is absent")
    browser_path = shutil.which("chromium")
    if browser_path is None:
        pytest.skip("chromium is absent")
    asked, wrong = [], []
    with served(site) as address, playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
        page = browser.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("response", lambda answer: wrong.append(answer.url) if answer.status >= 400 else None)
        for name in ("index", "tutorial", "credibility", "api/registration"):
            page.goto(f"{address}/{name}.html", wait_until="load")
        page.fill("input.md-search__input", "Taylor")
        page.wait_for_selector(".md-search-result__item", timeout=30_000)
        browser.close()
        assert asked and [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
        assert wrong == []
