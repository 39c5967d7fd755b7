"""Every difference between DOLFINx versions, and nothing else: 0.5.2 (Debian 12) to 0.11 (wheel) behind the same names.

It asks for signatures and attributes, never for version numbers.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import inspect
import logging
import os
import platform
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

with contextlib.suppress(ImportError):
    import dolfinx_solver  # noqa: F401  the PyPI wheel wants to be imported before dolfinx
import petsc4py
from mpi4py import MPI  # before PETSc, which would start MPI without the threads that the task farm needs

# PETSc's own handler turns SIGTERM and SIGPIPE into MPI_Abort; Python's must stay.
petsc4py.init([sys.argv[0] if sys.argv else "softtwin", "-no_signal_handler"])

import dolfinx
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc as fem_petsc
from numpy.typing import NDArray
from petsc4py import PETSc

__all__ = [
    "MPI",
    "PETSc",
    "assemble_matrix",
    "assemble_vector",
    "constant",
    "create_matrix",
    "create_mesh",
    "dirichlet",
    "dolfinx",
    "fem",
    "form",
    "node_dofs",
    "quiet_jit",
    "scalar",
    "ufl",
    "vector_space",
]

_CELLS = {4: "tetrahedron", 8: "hexahedron"}
_VTK_TO_DOLFINX = {4: [0, 1, 2, 3], 8: [0, 1, 3, 2, 4, 5, 7, 6]}
# -ffast-math changed residual and tangent by at most 6e-16 and gains up to 100 % of assembly.
_COMPILE = ["-O3", "-march=native", "-ffast-math"]
_COMPILE_TIMEOUT_S = 180


@contextlib.contextmanager
def quiet_jit() -> Iterator[None]:
    """Keep the root logger silent and as it was: setuptools sets it to INFO while 0.5.2 compiles a form."""
    root = logging.getLogger()
    level, handlers, disabled = root.level, list(root.handlers), root.manager.disable
    logging.disable(max(disabled, logging.INFO))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # FFCx 0.5 uses names that NumPy deprecates and leaves files open
            yield
    finally:
        logging.disable(disabled)
        root.setLevel(level)
        root.handlers[:] = handlers


def _cache_directory() -> Path:
    """A cache of compiled forms for this processor alone, since -march=native code must not travel."""
    cpu = platform.machine() + platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        cpu += next((line for line in info.read_text().splitlines() if line.startswith(("flags", "Features"))), "")
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "softtwin" / f"forms-{dolfinx.__version__}-{hashlib.sha256(cpu.encode()).hexdigest()[:12]}"


@contextlib.contextmanager
def _compiling(cache: Path) -> Iterator[None]:
    """One compiling process at a time; what an earlier one left half-made when it was killed is removed.

    FFCx's own lock is a file that survives a kill: every later run would wait for it and fail.
    """
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for source in cache.glob("*.c"):
            if not source.with_suffix(".c.cached").exists():
                source.unlink()
        yield


def _element(cell: str) -> Any:
    if hasattr(ufl, "VectorElement"):
        return ufl.VectorElement("Lagrange", cell, 1)
    import basix.ufl  # absent from the versions that have ufl.VectorElement

    return basix.ufl.element("Lagrange", cell, 1, shape=(3,))


def create_mesh(points: NDArray[np.float64], cells: NDArray[np.int64], comm: Any = MPI.COMM_SELF) -> Any:
    """A DOLFINx mesh of linear tetrahedra or hexahedra.

    Args:
        points: node positions, (n, 3).
        cells: node numbers in VTK order, (m, 4) or (m, 8).
        comm: communicator that shares the mesh.
    """
    corners = cells.shape[1]
    domain = ufl.Mesh(_element(_CELLS[corners]))
    ordered = np.ascontiguousarray(cells[:, _VTK_TO_DOLFINX[corners]])
    names = inspect.signature(mesh.create_mesh).parameters
    with quiet_jit():
        if "e" in names:
            return mesh.create_mesh(comm, cells=ordered, x=points, e=domain)
        return mesh.create_mesh(comm, cells=ordered, x=points, domain=domain, ghost_mode=mesh.GhostMode.none)


def vector_space(domain: Any) -> Any:
    """Continuous piecewise linear vector fields on a mesh."""
    with quiet_jit():
        name = domain.ufl_cell().cellname
        element = _element(name() if callable(name) else name)
        make = getattr(fem, "functionspace", None) or fem.FunctionSpace
        return make(domain, element)


def node_dofs(domain: Any, space: Any) -> NDArray[np.int64]:
    """For every original node its block number in the space, (n,): unknown 3 * block + axis belongs to it."""
    geometry = domain.geometry.dofmaps[0] if hasattr(domain.geometry, "dofmaps") else domain.geometry.dofmap
    geometry = geometry.array if hasattr(geometry, "array") else geometry
    dofs = space.dofmap.list
    dofs = dofs.array if hasattr(dofs, "array") else dofs
    original = np.asarray(domain.geometry.input_global_indices)[np.ravel(geometry)]
    blocks = np.empty(original.max() + 1, dtype=np.int64)
    blocks[original] = np.ravel(dofs)
    return blocks


def constant(domain: Any, value: float) -> Any:
    """A number that a compiled form reads when it is assembled."""
    return fem.Constant(domain, PETSc.ScalarType(value))


def form(expression: Any) -> Any:
    """Compile a UFL form with optimisation, in a cache of this processor's own."""
    cache = _cache_directory()
    jit = {"cffi_extra_compile_args": _COMPILE, "cache_dir": cache, "timeout": _COMPILE_TIMEOUT_S}
    name = "jit_options" if "jit_options" in inspect.signature(fem.form).parameters else "jit_params"
    with quiet_jit(), _compiling(cache):
        return fem.form(expression, **{name: jit})


def dirichlet(space: Any, blocks: NDArray[np.int64]) -> Any:
    """A zero displacement on the given blocks."""
    zero = fem.Function(space)
    return fem.dirichletbc(zero, np.sort(blocks).astype(np.int32))


def create_matrix(compiled: Any) -> Any:
    """A PETSc matrix with the sparsity of a bilinear form."""
    return fem_petsc.create_matrix(compiled)


def assemble_matrix(matrix: Any, compiled: Any, conditions: list[Any]) -> None:
    """Assemble a bilinear form; rows and columns with conditions become those of the identity."""
    matrix.zeroEntries()
    fem_petsc.assemble_matrix(matrix, compiled, conditions, 1.0)
    matrix.assemble()


def assemble_vector(vector: Any, compiled: Any) -> None:
    """Assemble a linear form into a PETSc vector of one process."""
    vector.zeroEntries()
    fem_petsc.assemble_vector(vector, compiled)


def scalar(compiled: Any) -> float:
    """The value of a functional on this process."""
    return float(fem.assemble_scalar(compiled))
