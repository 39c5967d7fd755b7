"""One word for one meaning: words that were given up stay out of names, options, keys, documents and messages."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("meshes", "reference", "surrogate", "registration", "app")
_TEXTS_ALLOWED = ("docs/glossary.md",)  # the old words stand there beside the new ones


@dataclass(frozen=True)
class Word:
    """A word that is used no more, what it stands in, and what is said instead."""

    word: str
    names: frozenset[str]
    text: re.Pattern[str] | None
    replacement: str
    allowed: tuple[str, ...]

    def is_in_name(self, name: str, place: str) -> bool:
        """Whether a name at a place has it, and may not."""
        parts = {part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}
        return bool(parts & self.names) and not any(fnmatchcase(place, glob) for glob in self.allowed)


def retired() -> list[Word]:
    """The table."""
    rows = tomllib.loads((Path(__file__).parent / "retired_words.toml").read_text())["word"]
    return [
        Word(
            row["word"],
            frozenset(row["names"]),
            re.compile(row["text"], re.IGNORECASE) if "text" in row else None,
            row["replacement"],
            tuple(glob for glob, _ in row["allowed"]),
        )
        for row in rows
    ]


WORDS = retired()


def offending_names(names: list[tuple[str, str]]) -> list[str]:
    """Of (name, place), those with a retired word, and what to say instead."""
    return [
        f"{place}: {word.word} -> {word.replacement}"
        for name, place in names
        for word in WORDS
        if word.is_in_name(name, place)
    ]


def offending_texts(texts: list[tuple[str, str]]) -> list[str]:
    """Of (text, place), those with a retired word."""
    return [
        f"{place}: {found[0]!r} -> {word.replacement}"
        for text, place in texts
        for word in WORDS
        if word.text is not None and (found := word.text.search(text))
    ]


def _arguments(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, *filter(None, (given.vararg, given.kwarg))]
    return [argument.arg for argument in every if argument.arg not in ("self", "cls")]


def public_names(source: str, place: str) -> Iterator[tuple[str, str]]:
    """Public functions, classes, their members and arguments, and constants of a module, each with its place."""

    def defined(nodes: list[ast.stmt], prefix: str) -> Iterator[tuple[str, str]]:
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                if node.name.startswith("_") and node.name != "__init__":
                    continue
                yield node.name, f"{prefix}{node.name}"
                yield from ((name, f"{prefix}{node.name}({name})") for name in _arguments(node))
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield node.name, f"{prefix}{node.name}"
                yield from defined(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    for name in ast.walk(target):
                        if isinstance(name, ast.Name) and not name.id.startswith("_"):
                            yield name.id, f"{prefix}{name.id}"

    yield from defined(ast.parse(source).body, f"{place}:")


def messages(source: str, place: str) -> Iterator[tuple[str, str]]:
    """String literals of what is raised or printed for people."""
    for node in ast.walk(ast.parse(source)):
        shown = isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in ("echo", "secho", "say")
        if isinstance(node, ast.Raise) or shown:
            for part in ast.walk(node):
                if isinstance(part, ast.Constant) and isinstance(part.value, str) and " " in part.value:
                    yield part.value, f"{place}:{part.lineno}"


def _sources(package: str) -> list[tuple[str, str]]:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files, f"no files in {package}"
    return [(path.read_text(), str(path.relative_to(ROOT))) for path in files]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_public_name_has_a_retired_word(package: str) -> None:
    names = [(Path(place).stem, place) for _, place in _sources(package)]
    names += [name for source, place in _sources(package) for name in public_names(source, place)]
    assert not (found := offending_names(names)), "\n".join(["", *found])


@pytest.mark.parametrize("package", PACKAGES)
def test_no_message_has_a_retired_word(package: str) -> None:
    texts = [text for source, place in _sources(package) for text in messages(source, place)]
    assert not (found := offending_texts(texts)), "\n".join(["", *found])


def _options(command: Any, path: str) -> Iterator[tuple[str, str]]:
    yield path.rpartition(" ")[2], path
    for option in getattr(command, "params", ()):
        yield from ((name.lstrip("-").replace("-", "_"), f"{path} {name}") for name in (*option.opts, option.name))
    for name, inner in getattr(command, "commands", {}).items():
        yield from _options(inner, f"{path} {name}")


def test_no_option_has_a_retired_word() -> None:
    from softtwin.app.cli import softtwin

    names = list(_options(softtwin, "softtwin"))
    assert len(names) > 50
    assert not (found := offending_names(names)), "\n".join(["", *found])


def _keys(schema: dict[str, Any], path: str = "") -> Iterator[tuple[str, str]]:
    for part in (schema, *schema.get("$defs", {}).values()):
        title = part.get("title", path)
        yield from ((name, f"{title}.{name}") for name in part.get("properties", {}))


def test_no_key_of_the_configuration_has_a_retired_word() -> None:
    from softtwin.app.config import Config

    names = list(_keys(Config.model_json_schema()))
    assert len(names) > 30
    assert not (found := offending_names(names)), "\n".join(["", *found])


def _documents() -> list[tuple[str, str]]:
    paths = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md"]
    return [
        (line, f"{path.relative_to(ROOT)}:{number}")
        for path in paths
        if str(path.relative_to(ROOT)) not in _TEXTS_ALLOWED and path.parent.name != "archive"
        for number, line in enumerate(path.read_text().splitlines(), 1)
    ]


def test_no_document_has_a_retired_word() -> None:
    assert not (found := offending_texts(_documents())), "\n".join(["", *found])


def test_each_word_can_be_found() -> None:
    """The table's own words are found in a module, a message and a text made of them."""
    for word in WORDS:
        for name in word.names:
            source = f"def with_{name}(x):\n    raise ValueError('nothing here')\n"
            found = offending_names(list(public_names(source, "made_up.py")))
            assert any(line.startswith(f"made_up.py:with_{name}: {word.word}") for line in found), name
    made = "def f(least):\n    raise ValueError('got a certificate of lessons')\n"
    assert [place for _, place in public_names(made, "m.py")] == ["m.py:f", "m.py:f(least)"]
    assert len(offending_texts(list(messages(made, "m.py")))) == 2
    assert not offending_names([("foremost_coursework", "m.py")])
