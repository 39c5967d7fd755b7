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
        (
            {"material": {"young_modulus": 0.0}},
            r"material\.young_modulus: expected a finite number > 0, in pascals, got 0\.0",
        ),
        (
            {"material": {"young_modulus": float("nan")}},
            r"material\.young_modulus: expected a finite number > 0, in pascals, got nan",
        ),
        (
            {"material": {"poisson_ratio": 0.5}},
            r"material\.poisson_ratio: expected a finite number > 0 and < 0\.5, got 0\.5",
        ),
        (
            {"material": {"poisson_ratio": 0.0}},
            r"material\.poisson_ratio: expected a finite number > 0 and < 0\.5, got 0\.0",
        ),
        (
            {"material": {"youngs": 3.0}},
            r"material\.youngs: there is no such entry; did you mean young_modulus\?, got 3\.0",
        ),
        (
            {"registration": {"model": "reference", "parameters": ["weight=0.5"]}},
            r"registration\.parameters: expected gravity beside weight, got none",
        ),
        (
            {"registration": {"model": "hybrid", "parameters": ["weight"], "gravity": [0.0, 0.0, -9.81]}},
            r"registration\.model: expected reference or torch with these parameters and known loads",
        ),
        ({"body": {"unit": "inch"}}, r"body\.unit: expected one of m, cm, mm, got 'inch'"),
        ({"samples": {"train": 0}}, r"samples\.train: expected a whole number >= 1, got 0"),
        ({"loads": {"radius": [0.5, 0.1]}}, r"\n  loads\.radius: expected smallest <= largest, got \(0\.5, 0\.1\)$"),
        ({"samples": {"load_path": 3}}, r"\n  samples\.load_path: expected a divisor of samples\.block \(8\), got 3$"),
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


@pytest.mark.parametrize("name", ["path", "ramp", "load_path"])
def test_an_entry_under_a_former_name_is_read(name: str) -> None:
    config = parse_config({"samples": {name: 4}})
    written = tomllib.loads(to_toml(config))["samples"]
    assert config.samples.load_path == written["load_path"] == 4 and not {"path", "ramp"} & set(written)


def test_a_configuration_of_before_is_read_whole() -> None:
    before = {
        "doubt": {"draws": 12, "attachment": 0.003},
        "registration": {
            **{"pose_turn": 3.0, "pose_shift": 0.02, "known_turn": 0.5, "known_shift": 0.001, "rounds": 1},
            **{"model": "reference", "unknowns": ["young-modulus"]},
        },
    }
    config = parse_config(before)
    section = config.registration
    assert (config.model_error.draws, config.model_error.attachment) == (12, 0.003)
    assert (section.pose_rotation, section.pose_translation) == (3.0, 0.02)
    assert (section.known_rotation, section.known_translation) == (0.5, 0.001)
    assert (section.reweighting_rounds, section.parameters) == (1, ("young-modulus",))
    assert parse_config(tomllib.loads(to_toml(config))) == config and "doubt" not in tomllib.loads(to_toml(config))


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"samples": {"ramp": 4, "load_path": 4}}, "ramp: is called load_path now, expected one of them, got both"),
        ({"doubt": {}, "model_error": {}}, "doubt: is called model_error now, expected one of them, got both"),
    ],
)
def test_former_and_present_name_together_are_refused(entries: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config(entries)
