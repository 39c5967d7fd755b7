"""The tables of all options, for the documents: `python -m softtwin.app.options docs/options` writes the pages."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import click

from .cli import softtwin
from .config import Config
from .flags import SchemaFlag
from .schema import Option, Section, options_of

_HEAD = ("| {key} | meaning | default | allowed | unit |", "|---|---|---|---|---|")
_WRITTEN = "<!-- written by `python -m softtwin.app.options docs/options`: change app/config.py or app/arguments.py -->"


def options_table(section: type[Section]) -> str:
    """The entries of a section as a table in Markdown.

    Args:
        section: its class.
    """
    return _table("entry", ((f"`{entry.name}`", entry) for entry in options_of(section)))


def _table(key: str, rows: Iterable[tuple[str, Option]]) -> str:
    lines = [_HEAD[0].format(key=key), _HEAD[1]]
    for name, entry in rows:
        allowed = ", ".join(f"`{word}`" for word in entry.choices if word) or entry.bounds
        cells = (name, entry.meaning, _default(entry.default), allowed, entry.unit)
        lines.append(f"| {' | '.join(_cell(cell) for cell in cells)} |")
    return "\n".join(lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _default(value: Any) -> str:
    if value in (None, "", (), {}):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    words = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return f"`{words}`"


def configuration_page() -> str:
    """All sections of organ.toml in Markdown."""
    top = _table("entry", ((f"`{entry.name}`", entry) for entry in options_of(Config)))
    parts = [
        "# organ.toml",
        _WRITTEN,
        "`softtwin config` writes this file with every default. An entry under a former name is read; the CHANGELOG "
        "lists them.",
        top,
    ]
    for name, field in Config.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Section):
            parts += [f"## [{name}]", (kind.__doc__ or "").strip(), options_table(kind)]
    return "\n\n".join(parts) + "\n"


def command_page(name: str, command: click.Command) -> str:
    """The flags of a command in Markdown, those that most people need first.

    Args:
        name: as it is typed behind `softtwin`.
        command: the command.
    """
    flags = [param for param in command.params if isinstance(param, SchemaFlag)]
    parts = [f"# softtwin {name}", _WRITTEN, (command.help or "").partition("\n\n")[0]]
    for heading, is_advanced in (("Options that most people need first", False), ("Advanced options", True)):
        rows = [(f"`{flag.opts[0]}`", flag.entry) for flag in flags if flag.entry.is_advanced is is_advanced]
        if rows:
            parts += [f"## {heading}", _table("flag", rows)]
    return "\n\n".join(parts) + "\n"


def commands() -> Iterator[tuple[str, click.Command]]:
    """All commands that have flags of the schema, with what is typed behind `softtwin`."""
    yield from _leaves("", softtwin)


def _leaves(before: str, group: click.Group) -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from _leaves(f"{before}{name} ", command)
        elif any(isinstance(param, SchemaFlag) for param in command.params):
            yield f"{before}{name}", command


def pages() -> dict[str, str]:
    """All pages: name of the file, and its text."""
    found = {"organ.md": configuration_page()}
    return found | {f"{name.replace(' ', '-')}.md": command_page(name, command) for name, command in commands()}


def main(folder: Path) -> None:
    """Write the pages.

    Args:
        folder: to write to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / name).write_text(text)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
