"""Imports every module that must work without FEniCSx; fails when one does not, or when FEniCSx is there.

python ci/import_fast_path.py                  with the extras torch and mesh
python ci/import_fast_path.py --register       with the extra register alone: meshes may then ask for mesh's packages,
                                               what trains a surrogate for training's, what writes data sets for zarr
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from importlib.util import find_spec

FENICSX = ("dolfinx", "dolfinx_solver", "ufl", "basix", "ffcx", "petsc4py", "slepc4py")
ABSENT = {
    "softtwin.reference": {"zarr"},
    "softtwin.meshes": {"gmsh", "nibabel", "nrrd", "pyacvd", "pytetwild", "pyvista"},
    "softtwin.surrogate": {"lightning", "tensorboardX", "zarr"},
}
PACKAGES = ("softtwin.meshes", "softtwin.reference.data", "softtwin.surrogate", "softtwin.registration")


def modules() -> list[str]:
    """Names of all modules of the fast path."""
    found: list[str] = []
    for name in PACKAGES:
        package = importlib.import_module(name)
        found += [name, *(module.name for module in pkgutil.walk_packages(package.__path__, f"{name}."))]
    return found


def main(register: bool) -> int:
    """Prints what could not be imported and how many modules could; 1 when one could not."""
    failed = [f"{name} can be imported: this environment has FEniCSx" for name in FENICSX if find_spec(name)]
    names = modules()
    for name in names:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            room = ".".join(name.split(".")[:2])
            if not (register and error.name in ABSENT.get(room, ())):
                failed.append(f"{name}: {error}")
    failed += [f"{name} was imported on the way" for name in FENICSX if name in sys.modules]
    for line in failed:
        print(f"error: {line}")
    print(f"fast path without FEniCSx: {len(names)} modules imported, {len(failed)} problems")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main("--register" in sys.argv))
