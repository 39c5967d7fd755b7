"""Every difference between DOLFINx versions, and nothing else: 0.5.2 (Debian 12) to 0.11 (wheel) behind the same names.

It asks for signatures and attributes, never for version numbers.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import inspect
import itertools
import logging
import os
import platform
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_SHOWN = warnings.showwarning
with contextlib.suppress(ImportError):
    import dolfinx_solver  # noqa: F401  the PyPI wheel wants to be imported before dolfinx
import petsc4py
from mpi4py import MPI  # before PETSc, which would start MPI without the threads that the task farm needs

# PETSc's own handler turns SIGTERM and SIGPIPE into MPI_Abort; Python's must stay.
petsc4py.init(["softtwin", "-no_signal_handler"])

import cffi
import dolfinx
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc as fem_petsc
from dolfinx.jit import ffcx_jit
from numpy.typing import NDArray
from petsc4py import PETSc

from softtwin.meshes.elements import Kind
from softtwin.meshes.signals import restore_sigpipe

restore_sigpipe()  # PETSc took it where somebody imported DOLFINx before

# UFL orders the terms of sums and products by the text of their constants, numbers in it: "10" comes before "9". With
# numbers of one length a form is the same, and compiled once, however many constants there were before it.
_FIRST_CONSTANT = 10**9
if hasattr(ufl.Constant, "_globalcount"):  # 0.5.2
    ufl.Constant._globalcount = max(ufl.Constant._globalcount, _FIRST_CONSTANT)
else:
    ufl.Constant._counter = itertools.count(_FIRST_CONSTANT)

if warnings.showwarning is not _SHOWN:  # FFCx 0.5 turns all of Python's warnings into lines of its log
    logging.captureWarnings(False)

__all__ = [
    "MPI",
    "CellMatrices",
    "PETSc",
    "add_matrix",
    "assemble_matrix",
    "assemble_vector",
    "cell_dofs",
    "cell_space",
    "cell_vertices",
    "collapse",
    "constant",
    "create_matrix",
    "create_mesh",
    "dirichlet",
    "dolfinx",
    "exterior_facets",
    "facet_matrix",
    "facet_measure",
    "fem",
    "form",
    "ghosted_vector",
    "local_cells",
    "matrix_of",
    "original_cells",
    "quiet_jit",
    "scalar",
    "sparsity",
    "taylor_hood_space",
    "ufl",
    "vector_space",
    "vtk_order",
]

# -ffast-math changed residual and tangent by at most 6e-16 and gains up to 100 % of assembly.
_COMPILE = ["-O3", "-march=native", "-ffast-math"]
_LINK = ["m"]  # with -ffast-math logarithms are libmvec's, which comes with libm
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
    cpu += str(_COMPILE + _LINK)
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "softtwin" / f"forms-{dolfinx.__version__}-{hashlib.sha256(cpu.encode()).hexdigest()[:12]}"


@contextlib.contextmanager
def _compiling(cache: Path) -> Iterator[None]:
    """One process at a time compiles a form; what an earlier one left half-made when it was killed is removed.

    FFCx's own lock is a file that survives a kill: every later run would wait for it and fail.
    """
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for source in cache.glob("*.c"):
            if not source.with_suffix(".c.cached").exists():
                source.unlink()
        yield


def _lagrange(cell: str, degree: int, components: int, discontinuous: bool = False) -> Any:
    """A Lagrange element; one component is a scalar."""
    if not hasattr(ufl, "VectorElement"):
        import basix.ufl  # absent from the versions that have ufl.VectorElement

        shape = {"shape": (components,)} if components > 1 else {}
        return basix.ufl.element("Lagrange", cell, degree, discontinuous=discontinuous, **shape)
    family = ("DQ" if cell in ("quadrilateral", "hexahedron") else "DG") if discontinuous else "Lagrange"
    if components == 1:
        return ufl.FiniteElement(family, cell, degree)
    return ufl.VectorElement(family, cell, degree, components)


def _mixed(first: Any, second: Any) -> Any:
    if hasattr(ufl, "MixedElement"):
        return ufl.MixedElement(first, second)
    import basix.ufl

    return basix.ufl.mixed_element([first, second])


def _space(domain: Any, element: Any) -> Any:
    make = getattr(fem, "functionspace", None) or fem.FunctionSpace
    return make(domain, element)


def cell_name(domain: Any) -> str:
    """Name of a mesh's cells, `tetrahedron` for instance."""
    name = domain.ufl_cell().cellname
    return str(name() if callable(name) else name)


def vtk_order(kind: Kind) -> list[int]:
    """Positions in VTK's order of a cell's nodes in DOLFINx's order."""
    return [int(i) for i in dolfinx.cpp.io.perm_vtk(getattr(mesh.CellType, kind.shape), kind.nodes)]


def create_mesh(points: NDArray[np.float64], cells: NDArray[np.int64], kind: Kind, comm: Any = MPI.COMM_SELF) -> Any:
    """A DOLFINx mesh, cells shared out between the ranks.

    Args:
        points: node positions, (n, 2) or (n, 3).
        cells: node numbers in VTK order, (m, k).
        kind: shape and degree of the cells.
        comm: communicator that shares the mesh; every rank gives the same arrays.
    """
    domain = ufl.Mesh(_lagrange(kind.shape, kind.degree, points.shape[1]))
    ordered = np.ascontiguousarray(cells[:, vtk_order(kind)])
    if comm.rank != 0:
        ordered, points = ordered[:0], points[:0]
    names = inspect.signature(mesh.create_mesh).parameters
    with quiet_jit():
        if "e" in names:
            return mesh.create_mesh(comm, cells=ordered, x=points, e=domain)
        return mesh.create_mesh(comm, cells=ordered, x=points, domain=domain, ghost_mode=mesh.GhostMode.none)


def vector_space(domain: Any, degree: int = 1) -> Any:
    """Continuous piecewise polynomial vector fields on a mesh."""
    with quiet_jit():
        return _space(domain, _lagrange(cell_name(domain), degree, domain.geometry.dim))


def cell_space(domain: Any) -> Any:
    """Numbers constant on each cell."""
    with quiet_jit():
        return _space(domain, _lagrange(cell_name(domain), 0, 1, discontinuous=True))


def taylor_hood_space(domain: Any) -> Any:
    """Quadratic displacement with continuous linear pressure (Taylor and Hood 1973)."""
    cell = cell_name(domain)
    with quiet_jit():
        return _space(domain, _mixed(_lagrange(cell, 2, domain.geometry.dim), _lagrange(cell, 1, 1)))


def collapse(space: Any, part: int) -> tuple[Any, NDArray[np.int64]]:
    """A part of a mixed space on its own, and the number in the whole of each of its unknowns."""
    with quiet_jit():
        alone, numbers = space.sub(part).collapse()
    return alone, np.asarray(numbers, dtype=np.int64).ravel()


def _table(list_: Any, rows: int) -> NDArray[np.int64]:
    values = list_.array if hasattr(list_, "array") else list_
    return np.asarray(values, dtype=np.int64).reshape(rows, -1)


def cell_dofs(space: Any) -> NDArray[np.int64]:
    """Block numbers of each local cell, (cells, k)."""
    return _table(space.dofmap.list, local_cells(space.mesh))


def local_cells(domain: Any) -> int:
    """How many cells this rank knows, those of its neighbours included."""
    cells = domain.topology.index_map(domain.topology.dim)
    return int(cells.size_local + cells.num_ghosts)


def original_cells(domain: Any) -> NDArray[np.int64]:
    """Row of each local cell in the array that the mesh was made from."""
    return np.asarray(domain.topology.original_cell_index, dtype=np.int64)


def cell_vertices(domain: Any) -> NDArray[np.int64]:
    """Local vertex numbers of each local cell, in DOLFINx's order."""
    dimension = domain.topology.dim
    domain.topology.create_connectivity(dimension, 0)
    return _table(domain.topology.connectivity(dimension, 0).array, local_cells(domain))


def exterior_facets(domain: Any) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Local numbers of the boundary's facets, and their vertices, (facets, k)."""
    dimension = domain.topology.dim - 1
    domain.topology.create_connectivity(dimension, dimension + 1)
    domain.topology.create_connectivity(dimension, 0)
    facets = np.asarray(mesh.exterior_facet_indices(domain.topology), dtype=np.int32)
    vertices = domain.topology.connectivity(dimension, 0)
    return facets, np.array([vertices.links(facet) for facet in facets], dtype=np.int64).reshape(len(facets), -1)


def facet_measure(domain: Any, facets: NDArray[np.int32], degree: int) -> Any:
    """The measure ds over given facets of the boundary."""
    marked = mesh.meshtags(domain, domain.topology.dim - 1, np.sort(facets), np.ones(len(facets), dtype=np.int32))
    return ufl.Measure("ds", domain=domain, subdomain_data=marked, metadata={"quadrature_degree": degree})(1)


def constant(domain: Any, value: float) -> Any:
    """A number that a compiled form reads when it is assembled."""
    return fem.Constant(domain, PETSc.ScalarType(value))


def form(expression: Any) -> Any:
    """Compile a UFL form with optimisation, in a cache of this processor's own.

    Each form has a folder and a lock there: who loads a form that is compiled waits for no compiler of another one.
    """
    cache = _cache_directory() / hashlib.sha256(expression.signature().encode()).hexdigest()[:24]
    jit = {
        "cffi_extra_compile_args": _COMPILE,
        "cffi_libraries": _LINK,
        "cache_dir": cache,
        "timeout": _COMPILE_TIMEOUT_S,
    }
    new = "jit_options" in inspect.signature(fem.form).parameters
    with quiet_jit():
        if expression.ufl_domains()[0].ufl_cargo().comm.size == 1:
            with _compiling(cache):
                return fem.form(expression, **{"jit_options" if new else "jit_params": jit})
        # Ranks that share a mesh would wait for each other in the lock: each one compiles, or loads, for itself, and
        # the collective call finds it in the cache (0.5.2 may give one form another name on each rank).
        with _compiling(cache):
            ffcx_jit(MPI.COMM_SELF, expression, {"scalar_type": PETSc.ScalarType if new else "double"}, jit)
        return fem.form(expression, **{"jit_options" if new else "jit_params": jit})


class CellMatrices:
    """The matrices of a bilinear form on each cell, before they are added up.

    Args:
        compiled: a form with one integral, over cells, whose elements need no orientation (Lagrange of degree 1 or 2).
        space: of both its arguments, on one rank.
    """

    def __init__(self, compiled: Any, space: Any) -> None:
        self._form = getattr(compiled, "_cpp_object", compiled)
        self._ffi = cffi.FFI()
        ufcx = compiled.ufcx_form
        integral = ufcx.form_integrals[0] if hasattr(ufcx, "form_integrals") else ufcx.integrals(0)[0]
        self._kernel = integral.tabulate_tensor_float64
        # After A, w, c and x come the facet and its orientation, later also custom data: nothing of it is for cells.
        self._absent = [self._ffi.NULL] * (len(self._ffi.typeof(self._kernel).args) - 4)
        geometry = space.mesh.geometry
        numbers = geometry.dofmaps[0] if isinstance(getattr(geometry, "dofmaps", None), list) else geometry.dofmap
        self._points = geometry.x[_table(numbers, local_cells(space.mesh))]
        unknowns = cell_dofs(space).shape[1] * space.dofmap.index_map_bs
        self._all: NDArray[np.float64] = np.empty((0, unknowns, unknowns))

    def some(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Matrices of local cells at the present coefficients, (cells, k, k).

        Rows and columns are in the order of `cell_dofs`, all components of a block together.
        """
        out = np.zeros((len(cells), *self._all.shape[1:]))
        self._tabulate(out, np.ascontiguousarray(self._coefficients()[cells]), self._points[cells])
        return out

    def all(self) -> NDArray[np.float64]:
        """Matrices of all local cells; the next call overwrites them."""
        if not len(self._all):
            self._all = np.empty((len(self._points), *self._all.shape[1:]))
        self._all.fill(0.0)
        self._tabulate(self._all, self._coefficients(), self._points)
        return self._all

    def _coefficients(self) -> Any:
        (values,) = dolfinx.cpp.fem.pack_coefficients(self._form).values()
        return values

    def _tabulate(self, out: Any, values: Any, points: Any) -> None:
        numbers = np.ascontiguousarray(dolfinx.cpp.fem.pack_constants(self._form))
        to, w, c, x = (self._ffi.cast("double *", array.ctypes.data) for array in (out, values, numbers, points))
        kernel, absent = self._kernel, self._absent
        entries, coefficients, coordinates = (array[:1].size for array in (out, values, points))
        for cell in range(len(out)):
            kernel(to + cell * entries, w + cell * coefficients, c, x + cell * coordinates, *absent)


def dirichlet(space: Any, domain: Any, unknowns: list[NDArray[np.int64]], mixed: bool) -> list[Any]:
    """Conditions that hold given unknowns: one for each axis, with their local numbers in the whole space."""
    zero = constant(domain, 0.0)
    parts = space.sub(0) if mixed else space
    return [
        fem.dirichletbc(zero, np.sort(numbers).astype(np.int32), parts.sub(axis))
        for axis, numbers in enumerate(unknowns)
        if _any(domain.comm, len(numbers))
    ]


def _any(comm: Any, count: int) -> bool:
    return bool(comm.allreduce(count))


def create_matrix(compiled: Any) -> Any:
    """A PETSc matrix with the sparsity of a bilinear form."""
    return fem_petsc.create_matrix(compiled)


def sparsity(compiled: Any) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows' starts and columns of a bilinear form's matrix, on one rank."""
    matrix = create_matrix(compiled)
    assemble_matrix(matrix, compiled, [])  # what is not inserted is dropped
    starts, columns, _ = matrix.getValuesCSR()
    matrix.destroy()
    return starts, columns


def matrix_of(starts: NDArray[np.int64], columns: NDArray[np.int64]) -> Any:
    """A PETSc matrix on one rank over a NumPy array, its attribute `values`; who writes there calls `stateIncrease`."""
    values, size = np.zeros(len(columns)), len(starts) - 1
    matrix = PETSc.Mat().createAIJWithArrays((size, size), (starts, columns, values), comm=MPI.COMM_SELF)
    matrix.setAttr("values", values)
    return matrix


def assemble_matrix(matrix: Any, compiled: Any, conditions: list[Any]) -> None:
    """Assemble a bilinear form; rows and columns with conditions become those of the identity."""
    matrix.zeroEntries()
    fem_petsc.assemble_matrix(matrix, compiled, conditions, 1.0)
    matrix.assemble()


def facet_matrix(compiled: Any, held: NDArray[np.int32]) -> Any:
    """A matrix of a bilinear form over facets, without the rows and columns of held unknowns (this rank's numbers).

    DOLFINx 0.5.2 puts the zeros of conditions into wrong places of facet matrices: they are made afterwards.
    """
    matrix = create_matrix(compiled)
    fem_petsc.assemble_matrix(matrix, compiled, [], 1.0)
    matrix.assemble()
    matrix.zeroRowsColumns(held + matrix.getOwnershipRange()[0], 0.0)
    return matrix


def add_matrix(matrix: Any, part: Any) -> None:
    """Add a matrix whose entries are among the other's, and free it."""
    matrix.axpy(1.0, part, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
    part.destroy()


def assemble_vector(vector: Any, compiled: list[Any]) -> None:
    """Assemble the sum of linear forms into a ghosted vector; afterwards its owned part is whole."""
    with vector.localForm() as local:
        local.set(0.0)
    for part in compiled:
        fem_petsc.assemble_vector(vector, part)
    if vector.comm.size > 1:
        vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)


def ghosted_vector(space: Any) -> Any:
    """A vector of a space with room for the neighbours' values."""
    layout, block = space.dofmap.index_map, space.dofmap.index_map_bs
    owned, total = layout.size_local * block, layout.size_global * block
    ghosts = np.asarray(layout.ghosts, dtype=np.int64)
    unrolled = (ghosts[:, None] * block + np.arange(block)).ravel().astype(PETSc.IntType)
    return PETSc.Vec().createGhost(unrolled, size=(owned, total), comm=space.mesh.comm)


def scalar(compiled: Any, comm: Any = MPI.COMM_SELF) -> float:
    """The value of a functional over all ranks."""
    here = float(fem.assemble_scalar(compiled))
    return here if comm.size == 1 else float(comm.allreduce(here))
