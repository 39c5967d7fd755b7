"""Set-up chooses the way on which FEniCSx comes, and says at the door what a machine does not have."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCED = "set -euo pipefail; source ci/environment.sh; source ci/way.sh; source ci/wheels.sh; "


def _shell(script: str, **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("SOFTTWIN_", "PIP_"))}
    command = ["bash", "-c", SOURCED + script]
    return subprocess.run(command, cwd=ROOT, env=kept | variables, capture_output=True, text=True, timeout=60)


def _os_release(folder: Path, text: str) -> str:
    file = folder / "os-release"
    file.write_text(text)
    return str(file)


def _python(folder: Path, version: str, name: str = "python3.x") -> Path:
    """A program that answers as a Python of that version where it is asked for path and version."""
    path = folder / name
    path.write_text(f'#!/bin/sh\ncase "$2" in *version_info*) echo "{path} {version}";; *) exit 1;; esac\n')
    path.chmod(0o755)
    return path


@pytest.mark.parametrize(
    ("system", "way"),
    [
        ("ID=debian\nVERSION_ID=12\n", "apt"),
        ('ID=debian\nVERSION_ID="13"\n', "apt"),
        ('ID=debian\nVERSION_ID="11"\n', "wheels"),
        ("ID=debian\n", "wheels"),
        ('ID=ubuntu\nID_LIKE=debian\nVERSION_ID="24.04"\n', "wheels"),
        ("ID=fedora\nVERSION_ID=42\n", "wheels"),
        ("ID=arch\n", "wheels"),
        ('ID="opensuse-leap"\nVERSION_ID="12"\n', "wheels"),
    ],
)
def test_debian_12_and_13_take_apt_and_every_other_linux_wheels(tmp_path: Path, system: str, way: str) -> None:
    told = _shell("setup_way", SOFTTWIN_OS_RELEASE=_os_release(tmp_path, system))
    assert (told.returncode, told.stdout.strip()) == (0, way), told.stderr


def test_a_system_that_says_nothing_of_itself_takes_wheels(tmp_path: Path) -> None:
    assert _shell("setup_way", SOFTTWIN_OS_RELEASE=str(tmp_path / "absent")).stdout.strip() == "wheels"


def test_alpine_is_refused_with_the_reason(tmp_path: Path) -> None:
    file = _os_release(tmp_path, 'ID=alpine\nVERSION_ID=3.22\nPRETTY_NAME="Alpine Linux v3.22"\n')
    told = _shell("WAY=$(setup_way); echo went on", SOFTTWIN_OS_RELEASE=file)
    assert told.returncode == 1 and told.stdout == ""
    assert "musl" in told.stderr and "Alpine Linux v3.22" in told.stderr


def test_a_way_can_be_forced_and_a_wrong_one_is_named(tmp_path: Path) -> None:
    file = _os_release(tmp_path, "ID=debian\nVERSION_ID=12\n")
    assert _shell("setup_way", SOFTTWIN_OS_RELEASE=file, SOFTTWIN_SETUP="wheels").stdout.strip() == "wheels"
    told = _shell("setup_way", SOFTTWIN_SETUP="yum")
    assert told.returncode == 1 and "expected apt, wheels or present, got 'yum'" in told.stderr


def test_a_python_that_has_fenicsx_is_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "python"
    path.write_text("#!/bin/sh\nexit 0\n")  # whatever it is asked to import is there
    path.chmod(0o755)
    for system in ("ID=debian\nVERSION_ID=12\n", "ID=fedora\n"):
        file = _os_release(tmp_path, system)
        assert _shell("setup_way", SOFTTWIN_OS_RELEASE=file, SOFTTWIN_PYTHON=str(path)).stdout.strip() == "present"


@pytest.mark.parametrize(("version", "good"), [("3.9", False), ("3.11", False), ("3.12", True), ("3.14", True)])
def test_wheels_need_python_3_12(tmp_path: Path, version: str, good: bool) -> None:
    path = _python(tmp_path, version)
    told = _shell("wheel_python", SOFTTWIN_PYTHON=str(path))
    assert (told.returncode == 0) == good
    if good:
        assert told.stdout.strip() == str(path)
    else:
        assert f"found: {path} ({version})" in told.stderr and "Python >= 3.12" in told.stderr


def test_the_python_of_the_pins_comes_first_and_an_old_one_is_passed_over(tmp_path: Path) -> None:
    _python(tmp_path, "3.11", "python3")
    newest = _python(tmp_path, "3.14", "python3.14")
    path = f"{tmp_path}:/usr/bin:/bin"
    empty = {"PYENV_ROOT": str(tmp_path / "no-pyenv")}
    assert _shell("wheel_python", PATH=path, **empty).stdout.strip() == str(newest)
    pinned = _python(tmp_path, "3.12", "python3.12")
    assert _shell("wheel_python", PATH=path, **empty).stdout.strip() == str(pinned)


def test_no_python_at_all_is_said(tmp_path: Path) -> None:
    told = _shell("wheel_python", SOFTTWIN_PYTHON=str(tmp_path / "python3.12"))
    assert told.returncode == 1 and "found: none" in told.stderr


def test_a_machine_without_compiler_hears_of_it_before_anything_is_installed() -> None:
    told = _shell(f"check_machine {sys.executable}", CC="no-such-compiler")
    assert told.returncode == 1
    assert "a C compiler" in told.stderr and "no-such-compiler" in told.stderr and "Fedora" in told.stderr


def test_a_library_that_is_absent_is_named_and_one_that_is_there_is_not() -> None:
    told = _shell(f"SHARED_LIBRARIES=(libc.so.6 libno-such-thing.so.1); missing_libraries {sys.executable}")
    assert told.stdout.split() == ["libno-such-thing.so.1"]


def test_a_full_disk_is_said_with_both_sizes() -> None:
    told = _shell("CPU_BUILD_GB=900000 CUDA_BUILD_GB=900000; announce_torch")
    assert told.returncode == 1 and "900000 GB are needed" in told.stderr
