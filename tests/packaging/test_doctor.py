"""The doctor: every fact is a line, something missing is a line too, and the slow BLAS is told from the fast ones."""

from __future__ import annotations

import builtins
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

import pytest

from softtwin.app import doctor, installation
from softtwin.app.doctor import Check

REFERENCE = "7f00-7f01 r-xp 00000000 fe:00 1  /usr/lib/x86_64-linux-gnu/blas/libblas.so.3.11.0\n"
OPENBLAS = "7f00-7f01 r-xp 00000000 fe:00 1  /usr/lib/x86_64-linux-gnu/openblas-pthread/libblas.so.3\n"
SCALAPACK = "7f00-7f01 r-xp 00000000 fe:00 1  /usr/lib/x86_64-linux-gnu/libscalapack-openmpi.so.2.2.1\n"
NUMPY_WHEEL = "7f00-7f01 r-xp 00000000 fe:00 1  /venv/site-packages/numpy.libs/libopenblas64_p-r0.so\n"


@pytest.mark.parametrize(
    ("maps", "status"),
    [
        (REFERENCE + SCALAPACK + NUMPY_WHEEL, "warning"),
        (OPENBLAS + SCALAPACK + NUMPY_WHEEL, "ok"),
        (NUMPY_WHEEL + SCALAPACK, "ok"),
        ("", "ok"),
    ],
)
def test_only_the_reference_blas_that_petsc_calls_is_warned_of(maps: str, status: str) -> None:
    check = doctor.blas_check(doctor.loaded_blas(maps))
    assert check.status == status
    assert ("libopenblas0-pthread" in check.advice) == (status == "warning")


def test_a_blas_inside_a_wheel_is_not_petscs() -> None:
    assert doctor.loaded_blas(NUMPY_WHEEL) == {}
    assert list(doctor.loaded_blas(NUMPY_WHEEL + OPENBLAS).values()) == ["OpenBLAS"]


@pytest.mark.parametrize(
    ("told", "vendor"),
    [
        ("mpirun (Open MPI) 4.1.4\n\nReport bugs to ...", "Open MPI"),
        ("HYDRA build details:\n    Version: 5.0.2", "MPICH"),
        ("Intel(R) MPI Library for Linux, Version 2021\nHYDRA", "Intel MPI"),
        ("", "an unknown MPI"),
    ],
)
def test_launchers_are_named_as_mpi4py_names_them(told: str, vendor: str) -> None:
    assert installation.launcher_vendor(told) == vendor


def test_text_has_every_check_with_its_advice_and_the_disclaimer_once() -> None:
    found = [Check("blas", "warning", "slow", "install a fast one"), Check("torch", "missing", "not there")]
    text = doctor.as_text(found)
    assert "-> install a fast one" in text
    assert "0 ok, 1 warnings, 1 missing" in text
    assert text.count("not a medical device") == 1
    assert all(any(line.split()[:2] == [c.status, c.name] for line in text.splitlines()) for c in found)


def test_every_package_that_softtwin_needs_has_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = [
        "zarr>=3.1",
        "pytetwild>=0.2 ; extra == 'mesh'",
        'no-such-thing>=1; extra == "app"',
        "pytest>=8; extra == 'test'",
    ]
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: needs)
    monkeypatch.setattr(doctor, "_LOADED", ())
    found = {check.name: check for check in doctor.checks()}
    assert {"python", "zarr", "pytetwild", "no-such-thing", "torch", "disk"} <= found.keys() and "pytest" not in found
    assert found["no-such-thing"].status == "missing"
    assert found["no-such-thing"].advice == "reports, pictures and the live view: pip install 'softtwin[app]'"


def test_meshing_has_its_lines() -> None:
    """What the extra `mesh` of this source tree names is what the doctor looks for once it is installed."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    extra = tomllib.loads(text)["project"]["optional-dependencies"]["mesh"]
    named = {re.match(r"[\w-]+", requirement).group(0) for requirement in extra}  # type: ignore[union-attr]
    installed = {re.match(r"[\w-]+", entry).group(0) for entry in metadata.requires("softtwin") or []}  # type: ignore[union-attr]
    assert named & installed <= {check.name for check in doctor.checks()}
    assert "gmsh" in named & installed


def test_what_cannot_be_imported_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_torch(name: str, *arguments: object, **options: Mapping[str, object]) -> object:
        if name == "torch":
            raise ImportError("libcudart.so.13: cannot open shared object file")
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without_torch)
    found = {check.name: check for check in doctor.checks()}
    assert found["torch"].status == "missing"
    assert "libcudart" in found["torch"].detail
    assert found["numpy"].status == "ok"


def test_a_whole_run_in_a_fresh_process_finds_what_the_tests_run_on() -> None:
    script = "from softtwin.app.doctor import as_text, checks; print(as_text(checks()))"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, cwd="/")
    assert told.returncode == 0, told.stderr
    lines = {
        line.split()[1]: line for line in told.stdout.splitlines() if line.startswith(("ok", "warning", "missing"))
    }
    assert {"python", "numpy", "dolfinx", "petsc", "mpirun", "blas", "torch", "rendering", "disk"} <= lines.keys()
    assert lines["python"].startswith("ok")
