"""Forms are compiled once for a processor: by one process each, without waiting for others, whatever a kill left."""

from __future__ import annotations

import fcntl
import threading
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from verification_cases import box

from softtwin.reference.fem.discretisation import Discretisation
from softtwin.reference.fem.fenicsx import constant, form, ufl


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def volume(weight: float) -> object:
    """Another form for each weight."""
    domain = Discretisation(box("tetra", 1), False, {"x0": "xyz"}).mesh
    return weight * ufl.dx(domain)


def test_a_form_has_one_folder_and_is_compiled_once(own_cache: Path) -> None:
    for weight in (2.0, 3.0, 2.0):
        form(volume(weight))
    libraries = list(own_cache.rglob("*.so"))
    assert len(libraries) == 2 and libraries[0].parent != libraries[1].parent


def test_who_compiles_one_form_keeps_nobody_from_another(own_cache: Path) -> None:
    form(volume(2.0))
    (own,) = own_cache.rglob("lock")
    other = threading.Thread(target=form, args=(volume(3.0),), daemon=True)
    with own.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        other.start()
        other.join(timeout=60.0)
        assert not other.is_alive()


def test_what_a_kill_left_half_made_is_made_anew(own_cache: Path) -> None:
    form(volume(2.0))
    (library,), (source,) = own_cache.rglob("*.so"), own_cache.rglob("*.c")
    library.unlink()
    source.with_suffix(".c.cached").unlink()
    form(volume(2.0))
    assert library.exists()


def signatures(count: int) -> set[str]:
    """Of one form of two constants, of each of so many with the next."""
    domain = Discretisation(box("tetra", 1), False, {"x0": "xyz"}).mesh
    constants = [constant(domain, 1.0) for _ in range(count)]
    return {(ufl.sqrt(a * b) * a * ufl.dx(domain)).signature() for a, b in pairwise(constants)}


def test_a_form_is_the_same_however_many_constants_there_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """UFL orders factors by the text of their constants: with numbers that gain a digit it would be another form."""
    assert len(signatures(60)) == 1
    if hasattr(ufl.Constant, "_globalcount"):
        monkeypatch.setattr(ufl.Constant, "_globalcount", 0)
        assert len(signatures(60)) > 1
