"""Twins and data sets that many tests read: built once, whole or not there, for all workers of a run and later runs.

A folder of the cache is named after what was built and the SHA-256 of all that it depends on: the packages' sources,
the versions of what they stand on, the file that declares it, and its configuration. So nothing stale is found.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from filelock import FileLock

PACKAGES = ("meshes", "reference", "surrogate", "registration", "app")
SOURCES = ("*.py", "*.toml")
DISTRIBUTIONS = (
    "numpy",
    "scipy",
    "zarr",
    "vtk",
    "pyvista",
    "pytetwild",
    "torch",
    "lightning",
    "fenics-dolfinx",
    "petsc4py",
)
AN_HOUR = 3600.0


def cache() -> Path:
    """The folder of all that is shared: `SOFTTWIN_TEST_CACHE`, or build/test-cache of this checkout."""
    return Path(os.environ.get("SOFTTWIN_TEST_CACHE") or Path(__file__).parents[1] / "build" / "test-cache")


def identity(declared_in: Path, configuration: object, packages: Sequence[str] = PACKAGES) -> str:
    """SHA-256 of what a shared folder depends on.

    Args:
        declared_in: the file whose code builds it.
        configuration: what it is built from besides, in JSON's types.
        packages: the project's packages that take part.
    """
    digest = hashlib.sha256(json.dumps([_versions(), configuration], sort_keys=True).encode())
    for path in [declared_in, *(file for package in packages for file in _sources(package))]:
        digest.update(f"{path.name}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def built_once(
    name: str,
    build: Callable[[Path], object],
    declared_in: str | Path,
    configuration: object = None,
    packages: Sequence[str] = PACKAGES,
) -> Path:
    """The folder that `build` fills, filled now unless this or another process has done so; for reading alone.

    Args:
        name: of the folder, for who looks into the cache.
        build: fills an empty folder. It is given another place than the folder's last one: what it writes down about
            its own place is wrong afterwards.
        declared_in: the file that calls this (`__file__`); a change of it builds anew.
        configuration: what `build` reads besides code, in JSON's types.
        packages: the project's packages that take part; a change of another one does not build anew.
    """
    home = cache()
    home.mkdir(parents=True, exist_ok=True)
    folder = home / f"{name}-{identity(Path(declared_in), configuration, packages)[:16]}"
    with FileLock(home / f"{folder.name}.lock"):
        if not folder.exists():
            _drop_old(home.glob(f"{name}-{'?' * 16}"))
            partial = home / f"{folder.name}.partial"
            shutil.rmtree(partial, ignore_errors=True)  # a run that was killed left it
            partial.mkdir()
            build(partial)
            partial.rename(folder)
        os.utime(folder)
    return folder


@contextmanager
def unchanged(folder: Path) -> Iterator[Path]:
    """The folder, and an error at the end where a test has written into it.

    Raises:
        AssertionError: files were added, removed or written.
    """
    before = _listing(folder)
    yield folder
    after = _listing(folder)
    changed = sorted(path for path in before | after if before.get(path) != after.get(path))
    if changed:
        shutil.rmtree(folder)  # the next run must not find it
        raise AssertionError(f"tests wrote into {folder}, which others share; they need a copy: {', '.join(changed)}")


def _drop_old(folders: Iterable[Path]) -> None:
    """Of other code, and longer unused than a run lasts."""
    for folder in folders:
        if time.time() - folder.stat().st_mtime > AN_HOUR:
            shutil.rmtree(folder, ignore_errors=True)


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of each file."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns) for path in files}


def _sources(package: str) -> list[Path]:
    found = find_spec(f"softtwin.{package}")
    assert found is not None and found.submodule_search_locations is not None, package
    places = [Path(place) for place in found.submodule_search_locations]
    return sorted(file for place in places for pattern in SOURCES for file in place.rglob(pattern))


def _versions() -> dict[str, Any]:
    """Of the interpreter, the processor and the packages; None for what is absent."""
    known: dict[str, Any] = {"python": sys.version, "machine": platform.machine()}
    for name in DISTRIBUTIONS:
        try:
            known[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            known[name] = None
    return known
