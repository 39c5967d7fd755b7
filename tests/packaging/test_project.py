"""What the project promises about itself: versions agree, every dependency is pinned, packages say what they are."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("meshes", "reference", "surrogate", "registration", "app")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FENICSX = ("dolfinx", "ufl", "basix", "ffcx", "petsc4py", "slepc4py")


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _pins(file: str) -> dict[str, str]:
    lines = (ROOT / "ci" / file).read_text().splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {_canonical(name): version for name, version in pairs}


def _names(requirements: list[str]) -> set[str]:
    return {_canonical(re.match(r"[A-Za-z0-9._-]+", text).group(0)) for text in requirements}  # type: ignore[union-attr]


def test_torch_is_new_enough_for_fused_steps_on_the_cpu() -> None:
    (floor,) = (text for text in PROJECT["optional-dependencies"]["torch"] if text.startswith("torch"))
    assert tuple(map(int, floor.removeprefix("torch>=").split("."))) >= (2, 4)


def test_every_dependency_is_pinned_for_ci() -> None:
    extras = PROJECT["optional-dependencies"]
    wanted = _names(PROJECT["dependencies"]).union(*(_names(extras[name]) for name in extras if name != "fenicsx"))
    assert wanted - {"softtwin"} <= _pins("constraints.txt").keys()
    second = _names(PROJECT["dependencies"]).union(
        *(_names(extras[name]) for name in ("fenicsx", "torch", "mesh", "app", "test", "onnx", "docs", "dev"))
    )
    assert second - {"softtwin"} <= _pins("constraints-011.txt").keys()


def test_no_pin_of_the_wheels_names_a_part_of_torchs_cuda_build() -> None:
    """The build for the CPU fits the same pins and brings none of them."""
    assert not {name for name in _pins("constraints-011.txt") if name.startswith(("nvidia-", "cuda-", "triton"))}


def test_debians_modules_get_the_numpy_they_are_built_for() -> None:
    assert _pins("constraints.txt")["numpy"].startswith("1.")


def test_one_version_everywhere() -> None:
    version = PROJECT["version"]
    changes = re.findall(r"^## \[([^]]+)\]", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert version in changes
    assert re.search(rf'^version: "?{re.escape(version)}"?$', (ROOT / "CITATION.cff").read_text(), flags=re.MULTILINE)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_package_file_holds_a_docstring_only(folder: str) -> None:
    body = ast.parse((ROOT / folder / "__init__.py").read_text()).body
    assert len(body) == 1
    assert isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)


def test_all_folders_are_packaged_and_watched() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    names = {f"softtwin.{folder}" for folder in FOLDERS}
    inside = (path.parent.relative_to(ROOT) for name in FOLDERS for path in (ROOT / name).rglob("__init__.py"))
    assert set(settings["setuptools"]["packages"]) == {f"softtwin.{'.'.join(path.parts)}" for path in inside} >= names
    assert set(settings["importlinter"]["root_packages"]) == names
    assert set(settings["mypy"]["packages"]) == names


@pytest.mark.parametrize("stage", ["meshes", "surrogate", "registration"])
def test_the_fast_path_loads_no_fenicsx(stage: str) -> None:
    script = (
        "import importlib, pkgutil, sys\n"
        f"package = importlib.import_module('softtwin.{stage}')\n"
        "names = [module.name for module in pkgutil.iter_modules(package.__path__)]\n"
        f"for name in names: importlib.import_module(f'softtwin.{stage}.{{name}}')\n"
        f"print(len(names), [name for name in {FENICSX!r} if name in sys.modules])\n"
    )
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, cwd="/")
    assert told.returncode == 0, told.stderr
    count, loaded = told.stdout.split(maxsplit=1)
    assert int(count) > 0
    assert loaded.strip() == "[]"


def test_no_path_of_one_machine_is_in_the_tree() -> None:
    files = [path for folder in (*FOLDERS, "ci", "tests", "benchmarks", "docs") for path in (ROOT / folder).rglob("*")]
    kept = [path for path in files if ROOT / "benchmarks" / "runs" not in path.parents]  # what benchmarks make here
    texts = {path: path.read_text() for path in kept if path.suffix in {".py", ".sh", ".md", ".txt", ".toml", ".json"}}
    assert texts
    local = re.compile(r"/(?:work|root|home/\w+)/(?!\.)")
    found = [
        str(path.relative_to(ROOT)) for path, text in texts.items() if path != Path(__file__) and local.search(text)
    ]
    assert found == []
