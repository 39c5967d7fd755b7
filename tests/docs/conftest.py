"""Code blocks of the pages, and what takes those that are not run: the real command lines, files that must be there."""

from __future__ import annotations

import re
import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import pytest
from markdown_it import MarkdownIt
from mkdocs.__main__ import cli as mkdocs

from softtwin.app.cli import softtwin
from softtwin.app.config import parse_config
from softtwin.app.stages.plan import training_plan

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = [page for page in PAGES if "archive" not in page.parts]  # whose commands are those of their time

# Programs whose words nothing here can take, and why that is left.
UNTRIED = {
    "apt-get": "packages of a system: ci/setup.sh and ci/bare_debian.sh install those of Debian",
    "dnf": "packages of a system that no test has",
    "conda": "no channel of conda can be reached from where tests run",
    "export": "sets a variable, whose value is the reader's",
    "cd": "goes to a folder of the reader's",
}


@dataclass(frozen=True)
class Block:
    """A code block of a page: fenced, or indented by four spaces.

    Args:
        page: the file, from the repository's root.
        line: where it begins, counted from 1.
        language: what stands behind the fence; empty for none.
        text: the code.
    """

    page: str
    line: int
    language: str
    text: str

    @property
    def kind(self) -> str:
        """What is done with it: python, toml, options (of a command), folders (with a phrase each, or in their
        order) or shell.
        """
        if self.language in ("python", "toml"):
            return self.language
        lines = self.text.strip().splitlines()
        if lines[0].startswith(("from ", "import ")):
            return "python"
        if all(re.match(r"[\w.]+/\s{2,}\S|\w+( -> \w+)+$", line.strip()) for line in lines):
            return "folders"
        return "options" if lines[0].strip().startswith("--") else "shell"

    @property
    def name(self) -> str:
        """Page and line."""
        return f"{self.page}:{self.line}"


def blocks_of(path: Path) -> list[Block]:
    """All code blocks of a page, in their order."""
    tokens = MarkdownIt().parse(path.read_text())
    found = [token for token in tokens if token.type in ("fence", "code_block")]
    page = str(path.relative_to(ROOT))
    return [Block(page, (token.map or [0])[0] + 1, token.info.strip(), token.content) for token in found]


def commands_of(text: str) -> list[list[str]]:
    """The commands of a shell block as words: lines that go on joined; comments, settings of variables and the names of
    systems in front (`Debian: apt-get ...`) left out.
    """
    lines = text.replace("\\\n", " ").splitlines()
    commands = [shlex.split(re.sub(r"^[A-Z][\w, ]*:\s+", "", line.strip()), comments=True) for line in lines]
    setting = re.compile(r"[A-Z_]+=")
    return [[word for i, word in enumerate(words) if i or not setting.match(word)] for words in commands if words]


class CommandLines:
    """Takes commands as the programs named in them would, without running what they start.

    Args:
        patch: undone at the end of the test.
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(click.Path, "convert", lambda self, value, param, context: Path(value))  # none of them is here
        patch.setattr("softtwin.app.chain.build_twin", lambda *told: None)  # `build` itself makes the configuration
        patch.setattr("softtwin.app.cli._with_axes", str)  # it reads the surface
        patch.setattr("softtwin.app.scan.frame_of", lambda path: ("mm", "ras", 1e-3))  # and the segmentation's header
        for command in _leaves(softtwin):
            if command.name != "build":
                patch.setattr(command, "callback", lambda **told: None)
        for command in _leaves(mkdocs):
            patch.setattr(command, "callback", lambda **told: None)

    def take(self, words: list[str]) -> None:
        """Fails where the program would refuse its words, or where a script or target that is named is not there."""
        program, rest = words[0], words[1:]
        if program in UNTRIED:
            return None
        if program in ("mpirun", "srun"):
            assert "softtwin" in rest, words
            return self.take(rest[rest.index("softtwin") :])
        taken = getattr(self, f"_{program.replace('-', '_')}", None)
        assert taken is not None, f"no check for {program!r}: {shlex.join(words)}"
        taken(rest)

    def _softtwin(self, words: list[str]) -> None:
        if ">" in words:
            words = words[: words.index(">")]
        softtwin.main(args=words, standalone_mode=False)

    def _mkdocs(self, words: list[str]) -> None:
        mkdocs.main(args=words, standalone_mode=False)

    def _make(self, words: list[str]) -> None:
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.M)
        assert words and set(words) <= set(targets), f"targets of the Makefile are {targets}, got {words}"

    def _bash(self, words: list[str]) -> None:
        assert (ROOT / words[0]).is_file(), f"{words[0]} is not there"

    def _python(self, words: list[str]) -> None:
        self._bash(words)

    def _sbatch(self, words: list[str]) -> None:
        scripts = [word for word in words if word.endswith(".sh")]
        assert scripts, words
        self._bash(scripts)

    def _podman(self, words: list[str]) -> None:
        if words[0] == "build":
            assert (ROOT / "Containerfile").is_file()
        else:
            assert words[0] == "run", words
            self._softtwin(words[words.index("softtwin") + 1 :])  # behind the image's name

    def _pip(self, words: list[str]) -> None:
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert words[0] == "install", words
        asked = {extra for word in words for found in re.findall(r"\[(.*?)\]", word) for extra in found.split(",")}
        assert asked <= extras.keys(), f"extras are {sorted(extras)}, got {sorted(asked)}"


def _leaves(command: click.Command) -> list[click.Command]:
    if isinstance(command, click.Group):
        return [leaf for one in command.commands.values() for leaf in _leaves(one)]
    return [command]


@pytest.fixture
def command_lines(monkeypatch: pytest.MonkeyPatch) -> CommandLines:
    return CommandLines(monkeypatch)


def parse_toml(text: str) -> Any:
    """A configuration, checked as `softtwin` checks it, the network's settings, too."""
    config = parse_config(tomllib.loads(text))
    training_plan(config.training)
    return config
