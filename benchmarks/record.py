"""What every benchmark writes beside its table: command, commit, machine, versions, figures, as JSON under results/."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from softtwin.app.doctor import available_cores

RESULTS = Path(__file__).parent / "results"
LIVER = Path(__file__).parents[2] / "shared" / "data" / "liver"


def recorded(name: str) -> dict[str, Any]:
    """Figures that were written under a name; none where nothing was."""
    path = RESULTS / f"{name}.json"
    found: dict[str, Any] = json.loads(path.read_text())["figures"] if path.exists() else {}
    return found


def machine() -> dict[str, Any]:
    """Processor, cores and load of this machine, and the versions that figures depend on."""
    info = Path("/proc/cpuinfo")
    model = next(
        (line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")), ""
    )
    names = ("numpy", "scipy", "torch", "vtk", "zarr", "fenics-dolfinx", "petsc4py", "slepc4py")
    return {
        "processor": model,
        "cores": available_cores(),
        "gpu": _gpu(),
        "load_at_the_end": os.getloadavg()[0],
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in names},
        "threads": os.environ.get("OPENBLAS_NUM_THREADS", "not set"),
    }


def command() -> str:
    """What made a record: the script and what was asked of it; the rest are the script's own defaults."""
    return " ".join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]])


def commit() -> str:
    """The state of the sources, with a mark where they differ from it."""
    told = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=RESULTS.parent, capture_output=True, text=True, check=False
    )
    return told.stdout.strip() or "not known"


def stamp() -> dict[str, str]:
    """What one row of a record carries where rows are made at several times: command, commit, day, processor, GPU."""
    told = machine()
    day = time.strftime("%Y-%m-%d")
    return {"command": command(), "commit": commit(), "date": day, "on": told["processor"], "gpu": told["gpu"]}


def _gpu() -> str:
    try:
        import torch
    except ModuleNotFoundError:  # the reference alone
        return "none"
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "none"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def write(name: str, figures: Any) -> Path:
    """Write the figures of a benchmark; returns the file."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    told = {"benchmark": name, "date": time.strftime("%Y-%m-%d"), "command": command(), "commit": commit()}
    record = {**told, "machine": machine(), "figures": figures}
    path.write_text(json.dumps(record, indent=1, default=_plain) + "\n")
    print(f"written: {path.relative_to(RESULTS.parents[1])}")
    return path


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
