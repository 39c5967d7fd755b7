"""What is installed here, which versions, which BLAS, GPU and MPI or not: a line a fact, advice where it helps."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from .installation import Way, fenicsx_way, launcher, what_it_brings

Status = Literal["ok", "warning", "missing"]

DISCLAIMER = "Research software: not a medical device."
_FENICSX_BRINGS = (
    "the reference: equilibria, data sets, softtwin build and the engines reference and hybrid; not for registration. "
    "Debian 12 and 13: apt-get install python3-dolfinx-real python3-slepc4py-real; another Linux with Python >= 3.12: "
    "pip install 'softtwin[fenicsx]'; or conda: docs/installation.md"
)
_RENDERING_TIMEOUT_S = 30  # VTK is loaded from disk for it
_COMPILER_BRINGS = "the reference's forms, which FFCx compiles at run time; not for registration"
_SCARCE_DISK = 2e9  # bytes: a virtual environment or a data set of some thousand samples no longer fits
# A red background, rendered without a screen and read back: the pixel proves what no version number does.
_RENDER = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkCommonCore import vtkUnsignedCharArray
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
window, renderer, pixel = vtkRenderWindow(), vtkRenderer(), vtkUnsignedCharArray()
renderer.SetBackground(1, 0, 0)
window.SetOffScreenRendering(1)
window.SetSize(8, 8)
window.AddRenderer(renderer)
window.Render()
window.GetPixelData(4, 4, 4, 4, 0, pixel, 0)
found = tuple(int(pixel.GetValue(i)) for i in range(3))
assert found == (255, 0, 0), f"expected a red pixel, got {found}"
print(window.GetClassName())
"""


@dataclass(frozen=True)
class Check:
    """One fact about this machine.

    Args:
        name: what was looked at.
        status: `ok`, `warning` (works, but slower or not everywhere) or `missing`.
        detail: what was found.
        advice: what to do about it, empty when nothing is to be done.
    """

    name: str
    status: Status
    detail: str
    advice: str = ""


def checks() -> list[Check]:
    """All facts about this machine, in reading order; something missing is a line and never an error."""
    # FEniCSx first: the libraries it loads are what the BLAS line looks at.
    way = _guarded("fenicsx", _fenicsx_way, _FENICSX_BRINGS)
    parts = {} if way.status == "missing" else _FENICSX_PARTS  # one line is enough to say that it is not there
    fenicsx = [way, *(_guarded(name, look, advice) for name, (look, advice) in parts.items())]
    core = [_guarded(name, look, advice) for name, (look, advice) in {**_CORE, **_required()}.items()]
    return [*core, *fenicsx, *(_guarded(name, look, "") for name, look in _MACHINE.items())]


def as_text(found: Iterable[Check]) -> str:
    """The checks as aligned lines for a terminal, with their advice below them and a count at the end."""
    found = list(found)
    width = max((len(check.name) for check in found), default=0)
    lines = [line for check in found for line in _lines(check, width)]
    count = {status: sum(check.status == status for check in found) for status in ("ok", "warning", "missing")}
    summary = f"{count['ok']} ok, {count['warning']} warnings, {count['missing']} missing"
    return "\n".join([*lines, "", summary, DISCLAIMER])


def _lines(check: Check, width: int) -> list[str]:
    line = f"{check.status:<8} {check.name:<{width}}  {check.detail}"
    return [line, f"{'':<9}{'':<{width}}  -> {check.advice}"] if check.advice else [line]


def _guarded(name: str, look: Callable[[], Check], advice: str) -> Check:
    try:
        return look()
    except Exception as error:  # a broken installation fails in any way it likes; the doctor tells and goes on
        reason = str(error).strip().splitlines() or [""]
        return Check(name, "missing", f"{type(error).__name__}: {reason[0]}"[:200], advice)


def _package(name: str, extra: str) -> tuple[Callable[[], Check], str]:
    """A check that a package is there, with its advice; some are loaded, which tells of missing system libraries."""

    def look() -> Check:
        version = metadata.version(name)
        module = name.replace("-", "_")
        if module in _LOADED:
            importlib.import_module(module)
        return Check(name, "ok", version)

    command = f"pip install 'softtwin[{extra}]'" if extra else "pip install softtwin"
    return look, f"{what_it_brings(name, extra)}: {command}"


def _required() -> dict[str, tuple[Callable[[], Check], str]]:
    """A check for every package that softtwin names as its own need, but for those that have one already."""
    try:
        requirements = metadata.requires("softtwin") or []
    except metadata.PackageNotFoundError:
        return {}  # the line of softtwin says it
    found: dict[str, tuple[Callable[[], Check], str]] = {}
    for requirement in requirements:
        named, extra = re.match(r"[\w.-]+", requirement), re.search(r"""extra == ['"]([\w-]+)['"]""", requirement)
        part = extra.group(1) if extra else ""
        if named and part not in _NOT_FOR_USE and named.group(0) not in _CORE:
            found.setdefault(named.group(0), _package(named.group(0), part))
    return found


def _python() -> Check:
    return Check("python", "ok", f"{platform.python_version()} at {sys.executable}, {platform.platform()}")


def _softtwin() -> Check:
    return Check("softtwin", "ok", metadata.version("softtwin"))


def _numpy() -> Check:
    import numpy as np

    if int(np.__version__.split(".")[0]) < 2 or not _petsc_wants_numpy_1():
        return Check("numpy", "ok", np.__version__)
    return Check("numpy", "warning", f"{np.__version__}, but PETSc here is built for 1.x", "pip install 'numpy<2'")


def _petsc_wants_numpy_1() -> bool:
    try:
        version = metadata.version("petsc4py")
    except metadata.PackageNotFoundError:
        return False
    return tuple(int(part) for part in version.split(".")[:2]) < (3, 22)  # Debian's first one built for numpy 2


def _torch() -> Check:
    import torch

    if not torch.cuda.is_available():
        return Check("torch", "ok", f"{torch.__version__}, no GPU: runs on the CPU, {torch.get_num_threads()} threads")
    devices = ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
    return Check("torch", "ok", f"{torch.__version__}, CUDA {torch.version.cuda}: {devices}")


def _fenicsx() -> Any:
    """The one module that knows how every version of DOLFINx wants to be imported."""
    return importlib.import_module("softtwin.reference.fem.fenicsx")


def _fenicsx_way() -> Check:
    way = fenicsx_way()
    if way is Way.NONE:
        return Check("fenicsx", "missing", way.value, _FENICSX_BRINGS)
    return Check("fenicsx", "ok", f"{way.value}: {_folder_of('dolfinx')}")


def _folder_of(module: str) -> str:
    found = find_spec(module)
    return str(Path(found.origin).parent) if found and found.origin else "no folder"


def _dolfinx() -> Check:
    return Check("dolfinx", "ok", _fenicsx().dolfinx.__version__)


def _ufl() -> Check:
    _fenicsx()
    basix = importlib.import_module("basix")
    # Debian's distribution and the wheel's have one name; modules without __version__ are read from it.
    return Check("ufl", "ok", f"{metadata.version('fenics-ufl')}, basix {basix.__version__}")


def _petsc() -> Check:
    petsc = _fenicsx().PETSc
    kinds = f"{petsc.ScalarType.__name__} scalars, {petsc.IntType.__name__} integers"
    detail = f"{'.'.join(str(part) for part in petsc.Sys.getVersion())}, {kinds}"
    if petsc.ScalarType.__name__.startswith("complex"):
        return Check(
            "petsc", "warning", detail, "the reference needs real scalars: apt-get install python3-petsc4py-real"
        )
    if not petsc.Sys.hasExternalPackage("mumps"):
        return Check(
            "petsc", "warning", f"{detail}, no MUMPS", "the reference factorises with MUMPS: use a PETSc with it"
        )
    return Check("petsc", "ok", f"{detail}, MUMPS")


def _slepc() -> Check:
    _fenicsx()
    slepc = importlib.import_module("slepc4py.SLEPc")
    return Check("slepc", "ok", ".".join(str(part) for part in slepc.Sys.getVersion()))


def _mpi() -> Check:
    mpi = _fenicsx().MPI
    return Check("mpi", "ok", f"{_vendor()}, this is rank {mpi.COMM_WORLD.rank} of {mpi.COMM_WORLD.size}")


def _vendor() -> str:
    """The MPI that mpi4py is built with, empty without FEniCSx: its absence has lines of its own."""
    try:
        mpi = _fenicsx().MPI
    except ImportError:
        return ""
    name, version = mpi.get_vendor()
    return f"{name} {'.'.join(str(part) for part in version)}"


def _mpirun() -> Check:
    found = launcher()
    if found is None:
        advice = "many ranks, so that a data set is solved on all cores: apt-get install openmpi-bin; with wheels: "
        return Check("mpirun", "missing", "not on PATH", f"{advice}pip install mpich")
    built = _vendor()
    if built and not built.startswith(found.vendor):
        advice = "every rank would run alone: put the mpirun of the MPI that mpi4py is built with first on PATH"
        return Check("mpirun", "warning", f"{found.path} is {found.vendor}, mpi4py is built with {built}", advice)
    if found.vendor == "Open MPI" and os.geteuid() == 0 and "OMPI_ALLOW_RUN_AS_ROOT" not in os.environ:
        advice = "export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1"
        return Check("mpirun", "warning", f"{found.path}, {found.vendor}: refuses to run as root", advice)
    first = shutil.which("mpirun")
    if first and Path(first).resolve() != found.path.resolve():
        advice = f"softtwin takes {found.path}; put its folder first on PATH before you call mpirun yourself"
        return Check("mpirun", "warning", f"{first} is first on PATH, and another one", advice)
    return Check("mpirun", "ok", f"{found.path}, {found.vendor}")


def loaded_blas(memory_map: str) -> dict[str, str]:
    """The BLAS libraries that a process has loaded, and who brought each.

    Args:
        memory_map: text of /proc/PID/maps.

    Returns:
        Path of each library: the kind of BLAS. Those that a wheel of numpy, scipy or torch has for itself are left
        out, for PETSc and MUMPS do not call them.
    """
    paths = {match.group(0) for match in re.finditer(r"/\S*lib\S*(?:blas|blis|mkl_rt|atlas)\S*\.so\S*", memory_map)}
    shared = (path for path in sorted(paths) if not re.search(r"/(numpy|scipy|torch)(\.libs)?/", path))
    return {path: kind for path in shared if (kind := _blas_kind(path))}


def _blas_kind(path: str) -> str:
    for mark, kind in (("openblas", "OpenBLAS"), ("mkl", "MKL"), ("blis", "BLIS"), ("atlas", "ATLAS")):
        if mark in path:
            return kind
    return "reference BLAS" if re.search(r"/lib(gsl)?blas\.so", path) else ""


def blas_check(blas: Mapping[str, str]) -> Check:
    """What the BLAS of PETSc and MUMPS means for speed; `blas` as from `loaded_blas`."""
    if not blas:
        return Check("blas", "ok", "none loaded but those inside wheels")
    detail = ", ".join(f"{kind} ({path})" for path, kind in blas.items())
    if set(blas.values()) == {"reference BLAS"}:
        advice = "MUMPS is about 4 times slower with it: apt-get install libopenblas0-pthread"
        return Check("blas", "warning", detail, advice)
    fast = sorted(set(blas.values()) - {"reference BLAS"})
    return Check("blas", "ok", f"PETSc and MUMPS use {', '.join(fast)} ({_first_of(blas, fast[0])})")


def _first_of(blas: Mapping[str, str], kind: str) -> str:
    return next(path for path, found in blas.items() if found == kind)


def _blas() -> Check:
    return blas_check(loaded_blas(Path("/proc/self/maps").read_text()))


def available_cores() -> int:
    """Cores that this process may use, which a container or a batch system may have made fewer than there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _threads() -> Check:
    cores = available_cores()
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    detail = f"{cores} cores; " + ", ".join(f"{name}={os.environ.get(name, 'not set')}" for name in names)
    if cores > 1 and "1" not in (os.environ.get(name) for name in names):
        return Check(
            "threads", "warning", detail, "under mpirun, export OPENBLAS_NUM_THREADS=1: ranks are the parallelism"
        )
    return Check("threads", "ok", detail)


def _compiler() -> Check:
    compiler = shutil.which(os.environ.get("CC", "gcc")) or shutil.which("cc")
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if compiler is None:
        return Check("compiler", "missing", "no gcc on PATH", f"{_COMPILER_BRINGS}: apt-get install gcc libc6-dev")
    if not header.exists():
        return Check(
            "compiler", "missing", f"{compiler}, but no {header}", f"{_COMPILER_BRINGS}: apt-get install python3-dev"
        )
    return Check("compiler", "ok", f"{compiler}, headers in {header.parent}")


def _rendering() -> Check:
    # In a process of its own: a broken OpenGL driver ends the process that asks it.
    command = [sys.executable, "-c", _RENDER]
    try:
        told = subprocess.run(command, capture_output=True, text=True, timeout=_RENDERING_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return Check("rendering", "warning", f"no picture within {_RENDERING_TIMEOUT_S} s", "try again when it is idle")
    if told.returncode == 0:
        return Check("rendering", "ok", f"off-screen with {told.stdout.split()[-1]}")
    reason = (told.stderr.strip().splitlines() or [f"the probe ended with {told.returncode}"])[-1]
    return Check("rendering", "missing", reason[:200], "pictures without a screen: apt-get install libegl1 libgl1")


def _disk() -> Check:
    free = shutil.disk_usage(Path.cwd()).free
    detail = f"{free / 1e9:.1f} GB free in {Path.cwd()}"
    if free < _SCARCE_DISK:
        return Check("disk", "warning", detail, "a data set may not fit: free some space or write elsewhere")
    return Check("disk", "ok", detail)


_CORE: Mapping[str, tuple[Callable[[], Check], str]] = {
    "python": (_python, ""),
    "softtwin": (_softtwin, "pip install --editable . in the repository"),
    "numpy": (_numpy, "pip install numpy"),
    "torch": (_torch, f"{what_it_brings('torch', 'torch')}: pip install 'softtwin[torch]'"),
}
_LOADED = ("scipy", "zarr", "meshio", "gmsh", "pytetwild", "small_gicp")
_NOT_FOR_USE = (
    "fenicsx",
    "register",  # the core and torch, as small as may be: each of its packages has a line already
    "benchmark",
    "test",
    "docs",
    "dev",
)  # extras of developers, and FEniCSx, which has lines of its own
_FENICSX_PARTS: Mapping[str, tuple[Callable[[], Check], str]] = {
    "dolfinx": (_dolfinx, "spaces and assembly, without which there is no reference: docs/installation.md"),
    "ufl": (_ufl, "the language of the forms: docs/installation.md"),
    "petsc": (_petsc, "the reference's solvers: apt-get install python3-petsc4py-real, or by conda petsc4py"),
    "slepc": (_slepc, "eigenmodes of an organ: apt-get install python3-slepc4py-real, or by conda slepc4py"),
    "mpi": (_mpi, "many ranks: apt-get install python3-mpi4py, or by conda mpi4py"),
}
_MACHINE: Mapping[str, Callable[[], Check]] = {
    "mpirun": _mpirun,
    "blas": _blas,
    "threads": _threads,
    "compiler": _compiler,
    "rendering": _rendering,
    "disk": _disk,
}
