"""What is loaded comes from the environment: nothing leaks in from the system but FEniCSx's own modules, by name."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

ROOMS = ("meshes", "reference", "surrogate", "registration", "app")
IMPORTS = "import softtwin.app.cli"
SOLVES = """
import numpy as np
from softtwin.meshes.shapes import beam
from softtwin.reference.data.loading import Loading
from softtwin.reference.data.materials import MATERIALS
from softtwin.reference.solve.problem import Problem

body = beam((2, 1, 1), (0.2, 0.1, 0.1))
forces = np.zeros_like(body.points)
forces[body.free[-1]] = 1e-3
assert Problem(body, MATERIALS["neo-hookean"](5000.0, 0.45)).solve(forces).displacement.any()
"""
LISTS = """
import json, sys
origins = {
    name: getattr(getattr(module, "__spec__", None), "origin", None) or getattr(module, "__file__", None)
    for name, module in list(sys.modules.items())
}
print(json.dumps(origins))
"""


def let_in() -> object:
    spec = importlib.util.spec_from_file_location("let_in", ROOT / "ci" / "let_in.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def loaded(program: str) -> dict[str, str]:
    """Module names and files after a program, in a process of its own; built-in ones left out."""
    done = subprocess.run([sys.executable, "-c", program + LISTS], capture_output=True, text=True, check=False, cwd="/")
    assert done.returncode == 0, done.stderr[-2000:]
    origins = json.loads(done.stdout.splitlines()[-1])
    return {name: origin for name, origin in origins.items() if origin and origin.startswith("/")}


def strangers(origins: dict[str, str]) -> dict[str, str]:
    """Those from neither the environment, Python's own library, this project, nor the list of what is let in."""
    environment, base = Path(sys.prefix), Path(sys.base_prefix)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    library = base / "lib" / version
    names = (*let_in().PACKAGES, *let_in().BESIDE)  # type: ignore[attr-defined]
    found = {}
    for name, origin in origins.items():
        path = Path(origin)
        inside = path.is_relative_to(environment) and not path.is_relative_to(environment / "fenicsx")
        listed = name.split(".")[0] in names and path.is_relative_to(environment / "fenicsx")
        python = path.is_relative_to(library) and "-packages" not in path.relative_to(library).parts[0]
        compiled = name.startswith("libffcx_")  # forms that FFCx compiled, in the user's cache
        own = any(path.is_relative_to(ROOT / room) for room in ROOMS)
        if not (inside or listed or python or compiled or own):
            found[name] = origin
    return found


@pytest.fixture(autouse=True)
def _isolated() -> None:
    if sys.prefix == sys.base_prefix:
        pytest.skip("these tests run outside a virtual environment")


def test_the_command_line_loads_nothing_of_the_system() -> None:
    origins = loaded(IMPORTS)
    assert "softtwin.app.cli" in origins
    assert strangers(origins) == {}


@pytest.mark.fenicsx
def test_a_solve_loads_nothing_of_the_system_but_fenicsx() -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    origins = loaded(IMPORTS + SOLVES)
    assert {"dolfinx", "petsc4py.PETSc", "numpy", "cffi"} <= set(origins)
    assert strangers(origins) == {}


def test_a_module_of_the_system_would_be_seen() -> None:
    """The check itself: Debian's folder, a foreign module among what is let in, a leak into FEniCSx's folder."""
    environment = Path(sys.prefix)
    leaks = {
        "pandas": "/usr/lib/python3/dist-packages/pandas/__init__.py",
        "matplotlib": str(environment / "fenicsx" / "matplotlib" / "__init__.py"),
        "numpy": f"{sys.base_prefix}/lib/python{sys.version_info.major}/dist-packages/numpy/__init__.py",
    }
    assert set(strangers(leaks)) == set(leaks)


def test_the_environment_reads_no_site_packages_of_the_system() -> None:
    told = (Path(sys.prefix) / "pyvenv.cfg").read_text()
    assert "include-system-site-packages = false" in told
