"""How the parts of softtwin came to this machine, what each is for, and whose `mpirun` starts ranks."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

_PROBE_TIMEOUT_S = 8


class Way(Enum):
    """The ways on which FEniCSx comes."""

    APT = "Debian's packages, by apt"
    WHEELS = "wheels from PyPI, by pip"
    CONDA = "conda"
    OTHER = "built or laid there by hand"
    NONE = "not there"


# What an extra is for, and what single packages are for that leave the rest usable when they are absent.
EXTRAS = {
    "": "the core: bodies, finished twins, registration with a forward model of your own",
    "data": "data sets of samples as Zarr folders",
    "torch": "surrogates: training, prediction and registration with them",
    "mesh": "tetrahedra inside of surfaces and segmentations, softtwin mesh",
    "onnx": "surrogates as graphs for other programs, softtwin export",
    "app": "reports, pictures and the live view",
}
PACKAGES = {
    "gmsh": "tetrahedra of even size in closed, smooth surfaces, the quickstart's phantom among them",
    "pytetwild": "tetrahedra in any segmented surface, with its holes and overlaps",
    "pyacvd": "surfaces of triangles of even size",
    "nibabel": "segmentations as NIfTI",
    "pynrrd": "segmentations as NRRD",
    "pyvista": "pictures of organs and clouds",
    "matplotlib": "plots in reports",
    "jinja2": "reports as pages",
    "viser": "the live view in a browser",
    "rich": "lines of live registration in a terminal",
    "pyigtl": "clouds from and results to 3D Slicer by OpenIGTLink",
    "lightning": "training of surrogates",
    "tensorboardX": "logs of a training for TensorBoard",
    "zarr": "data sets of samples: making them, training on them, looking into them",
    "safetensors": "reading and writing of a twin's weights",
}


def what_it_brings(package: str, extra: str) -> str:
    """What a package is for, in half a sentence.

    Args:
        package: its name on PyPI.
        extra: the extra of softtwin that asks for it, empty for the core.
    """
    return PACKAGES.get(package) or EXTRAS.get(extra, f"the extra {extra}")


def way_of(dolfinx: Path | None, prefix: Path, wheel: bool) -> Way:
    """The way on which FEniCSx came.

    Args:
        dolfinx: where its Python module lies, None where there is none.
        prefix: the folder of the interpreter's installation.
        wheel: whether PyPI's distribution of its solvers is installed.
    """
    if dolfinx is None:
        return Way.NONE
    if wheel:
        return Way.WHEELS
    if (prefix / "conda-meta").is_dir() and prefix in dolfinx.parents:
        return Way.CONDA
    return Way.APT if dolfinx.is_relative_to("/usr/lib") else Way.OTHER


def fenicsx_way() -> Way:
    """The way on which the FEniCSx came that this interpreter sees; it is not loaded for that."""
    found = find_spec("dolfinx")
    folder = Path(found.origin).resolve() if found and found.origin else None  # the environment has a link
    return way_of(folder, Path(sys.base_prefix), _is_installed("dolfinx-solver-real"))


def _is_installed(distribution: str) -> bool:
    try:
        metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


@dataclass(frozen=True)
class Launcher:
    """A program that starts MPI ranks.

    Args:
        path: the program.
        vendor: whose it is, as mpi4py names it.
    """

    path: Path
    vendor: str

    def command(self, ranks: int, program: Sequence[str]) -> list[str]:
        """The words that start a program on some ranks, as many as asked for and on whatever cores are free.

        Args:
            ranks: how many.
            program: its words.
        """
        more = ["--oversubscribe"] if self.vendor == "Open MPI" else []  # others do it unasked and refuse the word
        return [str(self.path), *more, "--bind-to", "none", "-n", str(ranks), *program]


def launcher() -> Launcher | None:
    """The `mpirun` beside this interpreter, as wheels and conda bring it, else the first on PATH; None without one.

    That of another MPI would start ranks that do not know of each other.
    """
    beside = Path(sys.executable).parent / "mpirun"
    found = str(beside) if beside.exists() else shutil.which("mpirun")
    if found is None:
        return None
    output = subprocess.run([found, "--version"], capture_output=True, text=True, timeout=_PROBE_TIMEOUT_S).stdout
    return Launcher(Path(found), launcher_vendor(output))


def launcher_vendor(output: str) -> str:
    """Whose `mpirun` it is, from what `mpirun --version` printed: named as mpi4py names it."""
    if "Open MPI" in output or "OpenRTE" in output:
        return "Open MPI"
    if "HYDRA" in output:
        return "Intel MPI" if "Intel" in output else "MPICH"
    return (output.strip().splitlines() or ["an unknown MPI"])[0]
