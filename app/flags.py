"""The schema's options as flags of click commands, in groups, with the most needed ones first."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, get_args, get_origin

import click

from .schema import ConfigError, Option, Section, options_of

_ORDER = ("input", "pose", "noise", "forces", "parameters", "material", "equilibria", "training", "solver", "output")


class SchemaType(click.ParamType):  # type: ignore[type-arg]  # generic in recent click alone
    """A value that the schema checks: the message has the flag, what is allowed, and what came.

    Args:
        entry: of the schema.
    """

    def __init__(self, entry: Option) -> None:
        self.entry = entry
        self.name = {int: "integer", float: "float"}.get(entry.type, "text")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number that a text stands for."""
        try:
            return self.entry.check(value, self.entry.flag)
        except ConfigError as error:
            raise click.UsageError(str(error), ctx) from None


class SchemaFlag(click.Option):
    """A flag that a schema describes.

    Args:
        *words: as for `click.Option`.
        entry: of the schema.
        **more: as for `click.Option`.
    """

    def __init__(self, *words: Any, entry: Option, **more: Any) -> None:
        super().__init__(*words, **more)
        self.entry = entry


def flags(
    section: type[Section],
    names: Collection[str] = (),
    *,
    without: Collection[str] = (),
    unset: bool | Collection[str] = False,
    required: Collection[str] = (),
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator that gives a command the entries of a section as flags.

    Args:
        section: class of the section.
        names: of the entries, in their order; all of them if none.
        without: of entries that have no flag.
        unset: whether a flag that is not given is None (or empty) in place of the schema's default, or for which.
        required: of entries that have to be given.
    """
    entries = {entry.name: entry for entry in options_of(section) if entry.name not in without}
    chosen = [entries[name] for name in names] if names else list(entries.values())

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for entry in reversed(chosen):
            is_unset = unset if isinstance(unset, bool) else entry.name in unset
            command = _flag(entry, is_unset, entry.name in required)(command)
        return command

    return decorate


def _flag(entry: Option, unset: bool, required: bool) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    more: dict[str, Any] = {"help": help_of(entry), "required": required}
    word = entry.flag
    if entry.type is bool:
        word = f"{word}/--no-{word[2:]}" if unset or entry.default else word
        more |= {"is_flag": True, "default": None if unset else entry.default}
    elif entry.is_repeated:
        more |= {"multiple": True, "type": _type(entry)}
    else:
        more |= {"type": _type(entry), "nargs": entry.count, "default": None if unset else entry.default}
    if entry.metavar:
        more["metavar"] = entry.metavar
    return click.option(word, entry.name, cls=SchemaFlag, entry=entry, **more)


def _type(entry: Option) -> Any:
    kind = get_args(entry.type)[0] if get_origin(entry.type) is tuple else entry.type
    if entry.must_exist or kind is Path:
        return click.Path(exists=entry.must_exist, path_type=Path)
    words = [word for word in entry.choices if word]
    if words:
        return click.Choice(words, case_sensitive=False)
    if kind is entry.type and kind in (int, float):
        return SchemaType(entry)
    return {int: click.INT, float: click.FLOAT}.get(kind, click.STRING)


def help_of(entry: Option) -> str:
    """A sentence for the help, with unit, range and default behind it."""
    sentence = entry.meaning[:1].upper() + entry.meaning[1:]
    words = "" if entry.choices else entry.allowed
    default = "" if entry.default in (None, "", (), {}, False) else f"default {_shown(entry.default)}"
    behind = "; ".join(filter(None, (words, default, "may be repeated" if entry.is_repeated else "")))
    return f"{sentence}.{f'  [{behind}]' if behind else ''}"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


class Command(click.Command):
    """A command whose help has groups, the most needed options first, and that names what a former flag is now."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, those that most people need first, each under its group."""
        entries = [param for param in self.get_params(ctx) if isinstance(param, SchemaFlag)]
        for advanced in (False, True):
            for heading, params in _grouped(param for param in entries if param.entry.is_advanced is advanced):
                with formatter.section(f"Advanced: {heading}" if advanced else heading.capitalize()):
                    formatter.write_dl([record for param in params if (record := param.get_help_record(ctx))])
        others = [
            param
            for param in self.get_params(ctx)
            if isinstance(param, click.Option) and not isinstance(param, SchemaFlag)
        ]
        if records := [record for param in others if (record := param.get_help_record(ctx))]:
            with formatter.section("Other"):
                formatter.write_dl(records)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """The arguments read; a former flag is refused with the name that it has now."""
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            former = {
                old: param.entry.flag
                for param in self.get_params(ctx)
                if isinstance(param, SchemaFlag)
                for old in param.entry.former_flags
            }
            name = error.option_name
            if name not in former:
                raise
            raise click.NoSuchOption(name, f"no such option {name}: it is called {former[name]} now", ctx=ctx) from None


def _grouped(params: Iterable[SchemaFlag]) -> list[tuple[str, list[SchemaFlag]]]:
    found: dict[str, list[SchemaFlag]] = {}
    for param in params:
        found.setdefault(param.entry.group, []).append(param)
    return sorted(found.items(), key=lambda item: _ORDER.index(item[0]) if item[0] in _ORDER else len(_ORDER))


class Commands(click.Group):
    """Commands of that kind; one under its former name is refused with the name that it has now."""

    command_class = Command
    group_class = type
    former: Mapping[str, str] = {"doubt": "model-error"}

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that the arguments name."""
        if args and args[0] in self.former and args[0] not in self.commands:
            raise click.UsageError(f"no such command {args[0]}: it is called {self.former[args[0]]} now", ctx)
        return super().resolve_command(ctx, args)
