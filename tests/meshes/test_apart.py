"""VTK reads files of other programs in a process of its own, which may end without harm."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softtwin.meshes.body import Surface
from softtwin.meshes.export import Coordinates, write_surface
from softtwin.meshes.io import FileError, read_surface, stated_unit
from softtwin.meshes.io.formats import apart

TETRAHEDRON = Surface(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
                      np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))  # fmt: skip


def served(program: str) -> subprocess.Popen[bytes]:
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)


def test_it_is_begun_once_and_again_where_it_is_gone(tmp_path: Path) -> None:
    write_surface(tmp_path / "a.vtp", TETRAHEDRON, place=Coordinates("cm", "ras"))
    assert stated_unit(tmp_path / "a.vtp") == "cm"
    first = apart._SERVICE._process
    assert first is not None and len(read_surface(tmp_path / "a.vtp", "m").triangles) == 4
    assert apart._SERVICE._process is first
    first.kill()
    first.wait()
    assert len(read_surface(tmp_path / "a.vtp", "m").triangles) == 4
    assert apart._SERVICE._process is not first


def test_a_file_that_ends_it_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_surface(tmp_path / "a.vtp", TETRAHEDRON)
    service = apart._Service()
    service._process, service._owner = served("import os, sys; sys.stdin.readline(); os.abort()"), apart.os.getpid()
    monkeypatch.setattr(apart, "_SERVICE", service)
    with pytest.raises(FileError, match=r"a\.vtp: could not be read as vtp; .* \(it ended the process that read it\)"):
        read_surface(tmp_path / "a.vtp")
    assert service._process is None


def test_one_that_takes_too_long_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_surface(tmp_path / "a.vtp", TETRAHEDRON)
    service = apart._Service()
    service._process, service._owner = served("import time; time.sleep(60)"), apart.os.getpid()
    monkeypatch.setattr(apart, "_SERVICE", service)
    monkeypatch.setattr(apart, "_TIME", 0.2)
    with pytest.raises(FileError, match="was not read within 0 s"):
        read_surface(tmp_path / "a.vtp")
    assert service._process is None


def test_a_name_that_no_shell_likes_is_read(tmp_path: Path) -> None:
    (folder := tmp_path / "Fall 1 + Müller,\n[x]").mkdir()
    write_surface(folder / 'a "b".vtp', TETRAHEDRON)
    assert len(read_surface(folder / 'a "b".vtp', "m").triangles) == 4
