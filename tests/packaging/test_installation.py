"""The way on which FEniCSx came, what each part is for, and the `mpirun` that belongs to this interpreter."""

from __future__ import annotations

import re
import sys
from importlib import metadata
from pathlib import Path

import pytest

from softtwin.app import doctor, installation
from softtwin.app.installation import Launcher, Way


@pytest.mark.parametrize(
    ("where", "wheel", "way"),
    [
        (None, False, Way.NONE),
        ("{prefix}/lib/python3.13/site-packages/dolfinx/__init__.py", True, Way.WHEELS),
        ("{prefix}/lib/python3.13/site-packages/dolfinx/__init__.py", False, Way.CONDA),
        ("/usr/lib/petsc/lib/python3/dist-packages/dolfinx/__init__.py", False, Way.APT),
        ("/opt/fenicsx/dolfinx/__init__.py", False, Way.OTHER),
    ],
)
def test_the_way_is_told_by_where_dolfinx_lies(tmp_path: Path, where: str | None, wheel: bool, way: Way) -> None:
    (tmp_path / "conda-meta").mkdir()
    place = None if where is None else Path(where.format(prefix=tmp_path))
    assert installation.way_of(place, tmp_path, wheel) is way


def test_without_conda_a_folder_of_packages_is_not_condas(tmp_path: Path) -> None:
    assert installation.way_of(tmp_path / "dolfinx" / "__init__.py", tmp_path, wheel=False) is Way.OTHER


def test_no_fenicsx_is_one_line_with_what_it_would_bring(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "fenicsx_way", lambda: Way.NONE)
    found = {check.name: check for check in doctor.checks()}
    assert found["fenicsx"].status == "missing" and "equilibria" in found["fenicsx"].advice
    assert not {"dolfinx", "petsc", "slepc"} & found.keys()


def test_every_package_of_use_says_what_it_brings() -> None:
    """What the doctor advises starts with a purpose and names no more than the extra where a package is unknown."""
    for requirement in metadata.requires("softtwin") or []:
        name = re.match(r"[\w.-]+", requirement).group(0)  # type: ignore[union-attr]
        extra = re.search(r"extra == ['\"]([\w-]+)", requirement)
        if extra and extra.group(1) not in doctor._NOT_FOR_USE:
            assert not installation.what_it_brings(name, extra.group(1)).startswith("the extra "), requirement


def _program(path: Path, told: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho '{told}'\n")
    path.chmod(0o755)
    return path


def test_the_mpirun_beside_the_interpreter_comes_before_that_on_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = _program(tmp_path / "system" / "mpirun", "mpirun (Open MPI) 4.1.4")
    monkeypatch.setenv("PATH", f"{other.parent}:/usr/bin:/bin")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "venv" / "bin" / "python"))
    assert installation.launcher() == Launcher(other, "Open MPI")
    own = _program(tmp_path / "venv" / "bin" / "mpirun", "HYDRA build details:")
    assert installation.launcher() == Launcher(own, "MPICH")
    monkeypatch.setattr(doctor, "_vendor", lambda: "MPICH 5.0.2")
    check = doctor._mpirun()
    assert check.status == "warning" and str(other) in check.detail and str(own) in check.advice


def test_no_mpirun_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    assert installation.launcher() is None


def test_only_open_mpi_is_told_to_oversubscribe() -> None:
    words = {vendor: Launcher(Path("mpirun"), vendor).command(3, ["a", "b"]) for vendor in ("Open MPI", "MPICH")}
    assert "--oversubscribe" in words["Open MPI"] and "--oversubscribe" not in words["MPICH"]
    assert all(line[-4:] == ["-n", "3", "a", "b"] for line in words.values())
