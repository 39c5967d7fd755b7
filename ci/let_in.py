"""Lets FEniCSx's own modules of another Python into a virtual environment, by name and nothing else.

    /usr/bin/python3 ci/let_in.py .venv

Run by the Python that has them (Debian's, a cluster's). Each package becomes a link in .venv/fenicsx, with the record
of its version, and one line in a .pth file puts that folder on the environment's path. What they need beside (NumPy,
cffi) the environment has of its own.
"""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("dolfinx", "basix", "ffcx", "ufl", "petsc4py", "slepc4py", "mpi4py")
# What a package alone needs and no other: the extension that pybind11 lays beside it, where there is one.
BESIDE = ("_basixcpp", "ufcx")
DISTRIBUTIONS = ("fenics-dolfinx", "fenics-basix", "fenics-ffcx", "fenics-ufl", "petsc4py", "slepc4py", "mpi4py")


def places(names: tuple[str, ...]) -> dict[str, Path]:
    """Folder or file of each importable module."""
    found = {}
    for name in names:
        spec = find_spec(name)
        if spec is not None and spec.origin:
            origin = Path(spec.origin)
            found[name] = origin.parent if spec.submodule_search_locations else origin
    return found


def records() -> list[Path]:
    """Folders (or files) that say which version of a distribution is there."""
    found = []
    for name in DISTRIBUTIONS:
        try:
            path = getattr(distribution(name), "_path", None)
        except PackageNotFoundError:  # Debian's DOLFINx has none
            continue
        if path is not None:
            found.append(Path(path))
    return found


def main(environment: Path) -> int:
    """Makes the links anew; 1 with a message where a package is missing."""
    modules = places(PACKAGES)
    missing = [name for name in PACKAGES if name not in modules]
    if missing:
        print(f"let_in: {sys.executable} has no {', '.join(missing)}", file=sys.stderr)
        return 1
    folder = environment.resolve() / "fenicsx"
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    for path in [*modules.values(), *places(BESIDE).values(), *records()]:
        (folder / path.name).symlink_to(path)
    site = environment / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    (site / "softtwin-fenicsx.pth").write_text(f"{folder}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
