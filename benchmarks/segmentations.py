"""Surfaces made of segmentations: how far from the true ones, for voxels fine, coarse and flat.

    python benchmarks/segmentations.py [--largest]

The liver phantom and its portal vein (branches 5 to 9 mm across), and livers as strangers bring them where
../shared/data/surfaces has them, are filled with voxels whose middles they enclose, written as NIfTI in a grid that is
turned by 20 degrees, and read back as `softtwin build` reads a segmentation. Distances are from points all over the
surface made to the true one. The phantom's outline here is that of its mesh. `--largest`
reads the phantom in 512 x 512 x 512 voxels by a process of its own: its time, and by how much its memory grew at most.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pyvista
from columns import Column
from harness import Benchmark, Given, Setting, run
from numpy.typing import NDArray
from surfaces import SURFACES, surface_of
from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

from softtwin.meshes.body import Surface
from softtwin.meshes.segmentation import inner_surface, organ_surface, read_segmentation
from softtwin.meshes.shapes import liver_phantom

Floats = NDArray[np.float64]
SPACINGS = ((1.0, 1.0, 1.0), (0.8, 0.8, 2.5), (0.7, 0.7, 5.0), (3.0, 3.0, 3.0))  # mm
TURN = np.deg2rad(20.0)
STRANGERS = ("sofa-liver.vtk", "sks-liver-sub.ply")
_SAMPLES = 20_000


def true_surface(name: str) -> tuple[Surface, bool]:
    """A surface by name, metres, and whether it is an organ (its largest component counts) or lies inside one."""
    if name in STRANGERS:
        return surface_of(name), True
    body = liver_phantom(0.004)
    return (body.boundary_surface, True) if name == "phantom" else (body.inner["vessel_portal"], False)


def poly(points: Floats, surface: Surface) -> pyvista.PolyData:
    """A surface with other points, for PyVista."""
    return pyvista.PolyData.from_regular_faces(points, surface.triangles)


def write_labels(path: Path, surface: Surface, spacing: tuple[float, ...], count: int | None = None) -> None:
    """Fill a surface with voxels of a turned grid (count a side): label 1 in a NIfTI file, millimetres, RAS."""
    turn = np.array([[np.cos(TURN), -np.sin(TURN), 0.0], [np.sin(TURN), np.cos(TURN), 0.0], [0.0, 0.0, 1.0]])
    points = 1e3 * surface.points @ turn  # in the grid's axes
    low = points.min(axis=0) - 3.3 * np.array(spacing)  # so that no voxel's middle falls on a coordinate of the shape
    fitting = np.ceil((points.max(axis=0) - low) / spacing).astype(int) + 4
    counts = fitting if count is None else np.full(3, count)
    grid = pyvista.ImageData(dimensions=counts, spacing=spacing, origin=low)
    filled = poly(points, surface).voxelize_binary_mask(reference_volume=grid)["mask"].reshape(counts, order="F")
    to_lps = np.eye(4)
    to_lps[:3, :3], to_lps[:3, 3] = turn * np.array(spacing), turn @ low
    image = nibabel.Nifti1Image(filled.astype(np.uint8), np.diag([-1.0, -1.0, 1.0, 1.0]) @ to_lps)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)


def off(made: Surface, truth: Surface) -> Floats:
    """Distances in mm from points all over the surface made to the true one, (p,)."""
    rng = np.random.default_rng(0)
    a, b, c = (made.points[made.triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(areas), _SAMPLES, p=areas / areas.sum())
    u, v = np.sqrt(rng.random(_SAMPLES)), rng.random(_SAMPLES)
    weights = np.column_stack([1 - u, u * (1 - v), u * v])
    points = 1e3 * np.einsum("pi,pij->pj", weights, made.points[made.triangles[chosen]])
    distance = vtkImplicitPolyDataDistance()
    distance.SetInput(poly(1e3 * truth.points, truth))
    return np.abs([distance.EvaluateFunction(point) for point in points])


def measured(truth: Surface, is_organ: bool, spacing: tuple[float, ...], file: Path) -> dict[str, Any]:
    """Figures of one row."""
    write_labels(file, truth, spacing)
    begin = time.perf_counter()
    segmentation = read_segmentation(file)
    made, said = (organ_surface if is_organ else inner_surface)(segmentation, "1")
    seconds = time.perf_counter() - begin
    distances = off(made, truth)
    return {
        "volume_off": made.volume / abs(truth.volume) - 1.0,
        "mean_mm": distances.mean(),
        "p95_mm": np.quantile(distances, 0.95),
        "largest_mm": distances.max(),
        "triangles": len(made.triangles),
        "seconds": seconds,
        "said": said,
    }


def largest(truth: Surface, file: Path) -> dict[str, Any]:
    """Seconds and memory of the largest volume."""
    size = 1e3 * np.ptp(truth.points, axis=0).max()
    write_labels(file, truth, (1.2 * size / LARGEST,) * 3, LARGEST)
    told = subprocess.run([sys.executable, "-c", _READ, file], check=True, capture_output=True, text=True).stdout
    return {"file_mb": file.stat().st_size / 1e6, **json.loads(told)}


LARGEST = 512
_READ = """
import json, sys, time
from pathlib import Path
from softtwin.meshes.segmentation import organ_surface, read_segmentation

def most():
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024e-9

before, begin = most(), time.perf_counter()
surface, _ = organ_surface(read_segmentation(sys.argv[1]), "1")
print(json.dumps({"seconds": time.perf_counter() - begin, "memory_gb": most() - before}))
"""


ROWS = {
    f"{name}, {' x '.join(f'{size:g}' for size in spacing)}": (name, spacing)
    for name in ("phantom", "phantom, portal vein", *STRANGERS)
    for spacing in SPACINGS
}


def work(row: str, given: Given) -> dict[str, Any]:
    name, spacing = ROWS[row]
    with tempfile.TemporaryDirectory() as folder:
        return measured(*given.once(true_surface, name), spacing, Path(folder) / "labels.nii.gz")


def with_largest(figures: dict[str, Any], given: Given) -> dict[str, Any]:
    """Seconds and memory of the largest volume, once a record and only where it is asked for."""
    if not given.largest:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        return {"largest": given.once(largest, given.once(true_surface, "phantom")[0], Path(folder) / "largest.nii.gz")}


BENCHMARK = Benchmark(
    name="segmentations",
    title="Surfaces made of segmentations: volume, and distances to the true surface",
    about=("meshes",),
    work=work,
    rows=lambda given: [row for row, (name, _) in ROWS.items() if name not in STRANGERS or (SURFACES / name).is_file()],
    columns=(
        Column("volume", "", "{volume_off*100:+.2f} %"),
        Column("mean", "mm", "{mean_mm:.2f}"),
        Column("95 %", "mm", "{p95_mm:.2f}"),
        Column("largest", "mm", "{largest_mm:.2f}"),
        Column("time", "s", "{seconds:.1f}"),
    ),
    settings={"largest": Setting(False, f"read {LARGEST} x {LARGEST} x {LARGEST} voxels, too", picks=True)},
    seeds=(0,),
    under="surfaces",
    finish=with_largest,
)


if __name__ == "__main__":
    run(BENCHMARK)
