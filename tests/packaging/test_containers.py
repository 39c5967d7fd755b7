"""The workflow and the container recipe say what they should; where no daemon is, this and a linter are the check."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

yaml = pytest.importorskip("yaml", reason="PyYAML is absent")

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def job() -> dict[str, Any]:
    (found,) = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())["jobs"].values()
    return found


@pytest.fixture(scope="module")
def recipe() -> list[tuple[str, str]]:
    """Instructions of the recipe with what follows them, continued lines joined, comments left out."""
    lines = [line for line in (ROOT / "Containerfile").read_text().splitlines() if not line.startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ").splitlines()
    return [tuple(line.split(maxsplit=1)) for line in joined if line]  # type: ignore[misc]


def test_the_workflow_runs_the_readmes_test_command_in_debian(job: dict[str, Any]) -> None:
    (command,) = re.findall(r"^ {4}(make test)\b", (ROOT / "README.md").read_text(), flags=re.M)
    assert job["container"] == "debian:12"
    assert [step["run"] for step in job["steps"] if step.get("run") == command] == [command]
    assert 0 < job["timeout-minutes"] <= 360


def test_actions_are_pinned_to_a_version_and_keep_what_ran(job: dict[str, Any]) -> None:
    used = [step["uses"] for step in job["steps"] if "uses" in step]
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@(v\d+\.\d+\.\d+|[0-9a-f]{40})", action) for action in used)
    (kept,) = (step for step in job["steps"] if step.get("if") == "always()")
    assert kept["with"]["path"] == "build/ci"  # where ci/test.sh writes its logs and JUnit files
    assert 'LOGS="$ROOT/build/ci"' in (ROOT / "ci" / "test.sh").read_text()


def test_git_is_there_before_the_source_is_fetched(job: dict[str, Any]) -> None:
    first, fetch = job["steps"][0].get("run", ""), job["steps"][1].get("uses", "")
    assert " git" in first and " make" in first and fetch.startswith("actions/checkout")


def test_the_image_runs_the_main_job_as_nobody_special(recipe: list[tuple[str, str]]) -> None:
    told = dict(recipe)
    assert recipe[0] == ("FROM", "debian:12")
    assert (told["ENTRYPOINT"], told["CMD"]) == ('["softtwin"]', '["quickstart"]')
    assert told["USER"].isdigit() and told["USER"] != "0"
    instructions = [name for name, _ in recipe]
    assert instructions.index("USER") > instructions.index("RUN")


def test_what_is_copied_is_there_and_is_let_through(recipe: list[tuple[str, str]]) -> None:
    copied = [word for name, rest in recipe if name == "COPY" for word in rest.split()[:-1]]
    assert {"pyproject.toml", "ci", "meshes", "reference", "surrogate", "registration", "app"} <= set(copied)
    assert all((ROOT / name).exists() for name in copied)
    let_through = [line[1:] for line in (ROOT / ".containerignore").read_text().splitlines() if line.startswith("!")]
    assert sorted(copied) == sorted(let_through)


def test_the_commands_of_the_recipe_are_bash(recipe: list[tuple[str, str]]) -> None:
    for command in (rest for name, rest in recipe if name == "RUN"):
        subprocess.run(["bash", "-n", "-c", command], check=True)
        scripts = re.findall(r"bash (\S+\.sh)", command)
        assert scripts and all((ROOT / script).is_file() for script in scripts)
