"""The configuration: defaults written out come back the same, wrong entries are all named."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from softtwin.app.config import Config, ConfigError, parse_config, read_config, to_toml


def test_defaults_written_out_come_back_the_same() -> None:
    assert parse_config(tomllib.loads(to_toml(Config()))) == Config()


def test_changed_entries_come_back_the_same() -> None:
    config = parse_config({"body": {"zones": {"tool": "a.ply"}}, "loads": {"radius": [0.1, 0.2], "zones": ["tool"]}})
    assert parse_config(tomllib.loads(to_toml(config))) == config


def test_every_entry_says_what_it_means() -> None:
    for line in to_toml(Config()).splitlines():
        if " = " in line:
            assert len(line.partition(" # ")[2]) > 3, line


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"material": {"young_modulus": 0.0}}, r"material\.young_modulus: .*greater than 0, got 0\.0"),
        ({"material": {"young_modulus": float("nan")}}, r"material\.young_modulus: "),
        ({"material": {"poisson_ratio": 0.5}}, r"material\.poisson_ratio: .*less than 0\.5, got 0\.5"),
        ({"material": {"poisson_ratio": 0.0}}, r"material\.poisson_ratio: .*greater than 0, got 0\.0"),
        ({"material": {"youngs": 3.0}}, r"material\.youngs: Extra inputs are not permitted"),
        ({"body": {"unit": "inch"}}, r"body\.unit: .*'m', 'cm' or 'mm', got 'inch'"),
        ({"samples": {"train": 0}}, r"samples\.train: .*greater than or equal to 1, got 0"),
        ({"loads": {"radius": [0.5, 0.1]}}, r"\n  loads\.radius: expected smallest <= largest, got \(0\.5, 0\.1\)$"),
        ({"samples": {"load_path": 3}}, r"\n  samples\.ramp: expected a divisor of samples\.block \(8\), got 3$"),
        ({"samples": {"seed": "x" * 999}}, r"samples\.seed: .*, got 'x+\.\.\.x+'$"),
        ({"body": {"source": "a.ply"}, "loads": {"modes": 3001}}, r"\n  loads\.modes: expected at most 3000 with body"),
    ],
)
def test_wrong_entries_are_named_with_what_came(entries: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config(entries)


def test_all_wrong_entries_are_named_at_once() -> None:
    with pytest.raises(ConfigError, match=r"2 wrong entries\n.*foo.*\n.*seed|2 wrong entries\n.*seed.*\n.*foo"):
        parse_config({"foo": 1, "samples": {"seed": -1}})


def test_missing_files_and_broken_toml_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected a TOML file, found none"):
        read_config(tmp_path / "nothing.toml")
    (tmp_path / "broken.toml").write_text("[body\n")
    with pytest.raises(ConfigError, match=r"broken\.toml is no TOML"):
        read_config(tmp_path / "broken.toml")


def test_an_entry_under_its_older_name_is_read() -> None:
    config = parse_config({"samples": {"path": 4}})
    assert config.samples.load_path == 4 and "ramp = 4" in to_toml(config) and "path =" not in to_toml(config)
