"""Every code block of README, CONTRIBUTING and docs/ is run, or taken by the command line that it is written for."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

pytest.importorskip("markdown_it", reason="markdown-it-py is absent")
pytest.importorskip("mkdocs", reason="the extra docs is absent")

from softtwin.app.twin import Twin

from .conftest import PAGES, ROOT, Block, CommandLines, blocks_of, commands_of, parse_toml

BLOCKS = [block for page in PAGES for block in blocks_of(page)]

# Pages whose Python runs here, by their names from the root. What they need beside an empty folder: `twin_folder`.
ALONE = ["docs/gpu.md", "docs/materials.md", "docs/networks.md"]
WITH_A_TWIN = ["README.md", "docs/registration.md"]
WHOLE = ["docs/tutorial.md"]  # commands and Python, one after the other, as a reader goes through them
A_PAGE = ["docs/live.md"]  # Python that shows a page in a browser
ELSEWHERE = {"docs/reference.md": "tests/reference/test_docs.py", "docs/surrogates.md": "tests/surrogate/test_docs.py"}
RUN = {*ALONE, *WITH_A_TWIN, *WHOLE, *A_PAGE, *ELSEWHERE}


def of_kind(*kinds: str) -> list[Any]:
    return [pytest.param(block, id=block.name) for block in BLOCKS if block.kind in kinds]


def run_python(page: str, names: dict[str, Any]) -> dict[str, Any]:
    """The Python blocks of a page in one namespace, in the current folder."""
    found = [block for block in BLOCKS if block.page == page and block.kind == "python"]
    assert found
    for block in found:
        code = "\n" * block.line + block.text  # errors name the line of the page
        exec(compile(code, str(ROOT / page), "exec"), names)
    return names


def test_blocks_are_found_fenced_and_indented() -> None:
    assert len(BLOCKS) > 40
    assert {"python", "toml", "shell", "options", "folders"} == {block.kind for block in BLOCKS}
    assert any(block.language == "" and block.kind == "python" for block in BLOCKS)


def test_no_page_has_python_that_nothing_runs() -> None:
    assert {block.page for block in BLOCKS if block.kind == "python"} == RUN


@pytest.mark.parametrize("page", ELSEWHERE)
def test_what_runs_elsewhere_is_read_and_executed_there(page: str) -> None:
    text = (ROOT / ELSEWHERE[page]).read_text()
    assert Path(page).name in text and "exec(compile(" in text
    wanted = sum(block.page == page and block.kind == "python" for block in BLOCKS)
    assert f"len(blocks) == {wanted}" in text


@pytest.mark.parametrize("block", of_kind("toml"))
def test_configurations_are_such(block: Block) -> None:
    parse_toml(block.text)


@pytest.mark.parametrize("block", of_kind("shell"))
def test_commands_are_taken(block: Block, command_lines: CommandLines, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    commands = commands_of(block.text)
    assert commands
    for words in commands:
        command_lines.take(words)


@pytest.mark.parametrize("block", of_kind("options"))
def test_options_are_those_of_build(block: Block, command_lines: CommandLines) -> None:
    for words in commands_of(block.text):
        command_lines.take(["softtwin", "build", "liver.stl", "--unit", "mm", *words])


@pytest.mark.parametrize("block", of_kind("folders"))
def test_folders_are_there(block: Block) -> None:
    for line in block.text.strip().splitlines():
        for name in line.split(" -> ") if " -> " in line else line.split()[:1]:
            assert (ROOT / name).is_dir(), line


@pytest.mark.parametrize("page", [str(page.relative_to(ROOT)) for page in PAGES])
def test_files_that_are_named_are_there(page: str) -> None:
    named = re.findall(
        r"`((?:tests|ci|benchmarks|examples|meshes|reference|surrogate|registration|app)/[\w./-]+)`",
        (ROOT / page).read_text(),
    )
    made = (ROOT / ".gitignore").read_text().split()  # what a command makes is named too, and is in no fresh clone
    assert [name for name in named if f"/{name}" not in made and not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_links_outside_the_site_lead_to_files_and_headings(page: str) -> None:
    """Mkdocs checks those of docs/."""
    links = re.findall(r"\]\(([^)#:]+)(?:#([^)]+))?\)", (ROOT / page).read_text())
    for name, anchor in links:
        assert (ROOT / name).is_file(), name
        if anchor:
            headings = re.findall(r"^#+ (.+)$", (ROOT / name).read_text(), flags=re.M)
            assert anchor in [re.sub(r"[^\w-]+", "-", heading.lower()).strip("-") for heading in headings], anchor
    assert page != "README.md" or len(links) >= 15


@pytest.mark.parametrize(
    "words", ["softtwin register", "softtwin build a.stl --fixed ball:1,2:3mm", "softtwin nothing"]
)
def test_commands_that_are_wrong_are_not_taken(words: str, command_lines: CommandLines) -> None:
    with pytest.raises(Exception, match=r"Missing|expected|No such command"):
        command_lines.take(words.split())


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.fenicsx
@pytest.mark.parametrize("page", ALONE)
def test_a_page_runs(page: str, here: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    pytest.importorskip("torch", reason="torch is absent")
    from softtwin.surrogate.registry import ARCHITECTURES

    with patch.dict(ARCHITECTURES):  # a page may add one of its own
        run_python(page, {})


@pytest.mark.fenicsx
@pytest.mark.parametrize("page", WITH_A_TWIN)
def test_a_page_runs_on_a_twin(page: str, here: Path, small_quickstart: Path, capsys) -> None:
    """`liver` is the small quickstart's folder; clouds are its own."""
    shutil.copytree(small_quickstart, here / "liver")
    cloud = np.load(here / "liver" / "demo" / "cloud.npy")
    run_python(page, {"cloud": cloud, "clouds": [cloud, cloud], "camera": [cloud, cloud], "np": np})
    assert re.search("accepted|doubtful", capsys.readouterr().out)


@pytest.mark.parametrize("page", A_PAGE)
def test_a_page_shows_a_page(page: str, here: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """The package's phantom is the twin; one cloud comes, and no browser is opened."""
    pytest.importorskip("viser", reason="viser is absent")
    pytest.importorskip("torch", reason="torch is absent")
    from softtwin.app.page.demo import PHANTOM

    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    shutil.copytree(PHANTOM, here / "liver" / "twin")
    with Twin.open(PHANTOM) as twin:
        cloud = twin.body.points[np.unique(twin.body.boundary)] + np.array([0.0, 0.0, 1e-3])
    run_python(page, {"camera_frames": lambda: [cloud]})
    assert "http://127.0.0.1:" in capsys.readouterr().out


@pytest.mark.fenicsx
@pytest.mark.chain
@pytest.mark.parametrize("page", WHOLE)
@pytest.mark.slow
def test_a_page_runs_from_its_beginning_to_its_end(page: str, here: Path, capsys) -> None:
    """Commands as a shell runs them, Python beside them."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    names: dict[str, Any] = {}
    for block in (block for block in BLOCKS if block.page == page):
        if block.kind == "python":
            exec(compile("\n" * block.line + block.text, str(ROOT / page), "exec"), names)
        elif block.kind == "shell":
            told = subprocess.run(
                ["bash", "-euc", block.text], env=environment, capture_output=True, text=True, check=False
            )
            assert told.returncode == 0, f"{block.name}\n{told.stdout}{told.stderr}"
