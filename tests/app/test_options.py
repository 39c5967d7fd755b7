"""One schema of options: flags, help, organ.toml and the documents say the same, and check the same."""

from __future__ import annotations

import re
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from softtwin.app.cli import softtwin
from softtwin.app.config import Config, ConfigError, RegistrationSection, parse_config, to_toml
from softtwin.app.flags import SchemaFlag
from softtwin.app.options import commands, options_table, pages
from softtwin.app.schema import Section, option_of, options_of
from softtwin.app.twin import with_options

PAGES = Path(__file__).parents[2] / "docs" / "options"
COMMANDS = dict(commands())
SECTIONS = [field.annotation for field in Config.model_fields.values() if isinstance(field.annotation, type)]
SECTIONS = [kind for kind in SECTIONS if issubclass(kind, Section)]


def refused(*words: str) -> str:
    done = CliRunner().invoke(softtwin, words)
    assert done.exit_code == 2, done.output
    return " ".join(done.output.split())


def test_pages_are_as_the_schema_writes_them() -> None:
    """Else run `python -m softtwin.app.options docs/options`."""
    assert {path.name: path.read_text() for path in PAGES.glob("*.md")} == pages()


@pytest.mark.parametrize("section", SECTIONS, ids=lambda kind: kind.__name__)
def test_every_entry_is_in_table_and_file_with_its_meaning(section: type[Section]) -> None:
    table, written = options_table(section), to_toml(Config())
    for entry in options_of(section):
        assert len(entry.meaning) > 3 and f"| `{entry.name}` | " in table
        (line, *_) = [line for line in written.splitlines() if line.startswith(f"{entry.name} = ")
                      and entry.meaning in line]  # fmt: skip
        assert not entry.allowed or line.endswith(f"[{entry.allowed}]")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_begins_with_ten_options_at_most_and_has_them_all(name: str) -> None:
    command = COMMANDS[name]
    flags = [param for param in command.params if isinstance(param, SchemaFlag)]
    assert flags == [param for param in command.params if isinstance(param, click.Option)]
    first = [flag for flag in flags if not flag.entry.is_advanced]
    assert len(first) <= 10
    shown = CliRunner().invoke(softtwin, [*name.split(), "--help"]).output
    begin, *_ = shown.partition("\nAdvanced: ")
    for flag in flags:
        within = begin if flag in first else shown.removeprefix(begin)
        assert re.search(rf"^  {re.escape(flag.opts[0])}\b", within, flags=re.M), flag.opts


def test_help_of_register_has_groups() -> None:
    shown = CliRunner().invoke(softtwin, ["register", "--help"]).output
    headings = re.findall(r"^(\S[^\n]*):$", shown, flags=re.M)
    assert headings[:5] == ["Input", "Pose", "Noise", "Solver", "Output"]
    assert all(heading.startswith("Advanced: ") for heading in headings[5:-1]) and headings[-1] == "Other"


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("noise", -1.0, "a finite number > 0, in metres"),
        ("noise", float("nan"), "a finite number > 0, in metres"),
        ("alpha", 2.0, "a finite number >= 0 and <= 1"),
        ("points", 0, "a whole number >= 1"),
        ("points", 1.5, "a whole number >= 1"),
        ("reweighting_rounds", -2, "a whole number >= -1"),
        ("pose_rotation", 0.0, "a finite number > 0, in degrees"),
    ],
)
def test_numbers_are_checked_alike_as_flags_entries_and_arguments(
    name: str, value: float, expected: str, tmp_path: Path
) -> None:
    flag = option_of(RegistrationSection, name).flag
    said = refused("register", str(tmp_path), "cloud.npy", flag, str(value))
    assert f"{flag}: expected {expected}, got '{value}'" in said
    for raised in (
        lambda: parse_config({"registration": {name: value}}),
        lambda: with_options(Config(), {name: value}),
    ):
        with pytest.raises(ConfigError) as caught:
            raised()
        assert f"registration.{name}: expected {expected}, got {value}" in str(caught.value)


@pytest.mark.parametrize(
    ("words", "now"),
    [
        (("register", "--pose-turn", "1"), "--pose-rotation"),
        (("register", "--pose-shift", "1"), "--pose-translation"),
        (("register", "--known-turn", "1"), "--known-rotation"),
        (("register", "--known-shift", "1"), "--known-translation"),
        (("register", "--rounds", "1"), "--reweighting-rounds"),
        (("register", "--unknown", "contact"), "--parameter"),
        (("identify", "--unknown", "poisson-ratio"), "--parameter"),
        (("register", "--marks", "a", "b"), "--frame-landmarks"),
        (("register", "--engine", "hybrid"), "--model"),
        (("live", "--engine", "hybrid"), "--model"),
        (("build", "--ramp", "4"), "--load-path"),
        (("generate", "--part", "0/2"), "--shard"),
    ],
)
def test_former_flags_are_refused_with_the_name_of_today(words: tuple[str, ...], now: str) -> None:
    assert f"no such option {words[1]}: it is called {now} now" in refused(*words)
    assert any(now in param.opts for param in COMMANDS[words[0]].params)


def test_a_former_command_is_refused_with_the_name_of_today() -> None:
    assert "no such command doubt: it is called model-error now" in refused("doubt", "organ.toml")
    assert "model-error" in softtwin.commands


def test_unheard_of_options_stay_click_s_matter() -> None:
    assert "No such option" in refused("register", "--nonsense")
    assert "No such command" in refused("nonsense")
