"""Measured lungs: landmarks inside at expiration, from the surface at inspiration and a cloud at expiration.

    python benchmarks/lungs.py [--only "case 7, right, whole" ...]
    python benchmarks/lungs.py picture 7 left FILE.png

Five patients of the DIR-Lab COPDgene set (../shared/data/lungs), each lung by itself, one setting for all
(examples/lung.toml). Each row is what docs/validate.md shows: `softtwin mesh`, then `softtwin evaluate` with the cloud
of the whole surface, of its lateral half, of the whole surface with a model that knows of no gravity, or of the whole
surface with a fifth of its points put anywhere. Landmarks pull nothing; their regions are widened by 1 mm, as experts
differ.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from columns import Column
from harness import Benchmark, Figures, Given, run
from numpy.typing import NDArray
from record import ROOT, RUNS

Floats = NDArray[np.float64]

LUNGS = ROOT.parent / "shared" / "data" / "lungs"
CASES, SIDES = (2, 4, 5, 7, 9), {"right": 1, "left": 2}
SEEN = {"whole": "", "half": "_half_lateral", "no gravity": "", "outliers": ""}
GRAVITY = "gravity = [0.0, -9.81, 0.0]"
OUTLIERS, BEYOND = 0.2, 0.2  # of the points; how far beyond the cloud these lie, of its extent
LOCALISATION = 0.001  # metres: what setting a landmark again differs by (Castillo et al. 2013)
ROWS = {f"case {case}, {side}, {seen}": (case, side, seen) for seen in SEEN for case in CASES for side in SIDES}


def softtwin(*words: object) -> None:
    """The command line program of this environment.

    Raises:
        RuntimeError: it failed; the message is what it said.
    """
    ended = subprocess.run(
        [str(Path(sys.executable).parent / "softtwin"), *map(str, words)], capture_output=True, text=True
    )
    if ended.returncode:
        raise RuntimeError(f"softtwin {' '.join(map(str, words))}: {ended.stderr[-2000:]}")


def prepared(case: int, side: str) -> tuple[Path, float]:
    """The configuration of one lung with its body, and the seconds that the body took."""
    folder, data, label = RUNS / "lungs" / f"case_{case:02d}_{side}", LUNGS / f"case_{case:02d}", SIDES[side]
    folder.mkdir(parents=True, exist_ok=True)
    text = (ROOT / "examples" / "lung.toml").read_text()
    text = text.replace('"inspiration.nii.gz:ras"', json.dumps(f"{data / 'inspiration.nii.gz'}:ras"))
    (folder / "organ.toml").write_text(text.replace('organ = "1"', f'organ = "{label}"'))
    np.savetxt(folder / "hilum.txt", np.loadtxt(data / "hilum.txt")[label - 1 : label])
    is_own = np.loadtxt(data / "landmarks_lung.txt").astype(int) == label
    for name in ("inspiration", "expiration"):
        np.savetxt(folder / f"landmarks_{name}.txt", np.loadtxt(data / f"landmarks_{name}.txt")[is_own])
    for made in folder.rglob("body.vtu"):
        made.unlink()
    begin = time.perf_counter()
    softtwin("mesh", folder / "organ.toml")
    return folder, time.perf_counter() - begin


def with_outliers(cloud: Floats, rng: np.random.Generator) -> Floats:
    """The same with a fifth of the points anywhere in a box around the cloud."""
    moved, wrong = cloud.copy(), rng.choice(len(cloud), int(OUTLIERS * len(cloud)), replace=False)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    reach = BEYOND * (high - low)
    moved[wrong] = rng.uniform(low - reach, high + reach, (len(wrong), 3))
    return moved


def best_affine(folder: Path) -> float:
    """Mean error of the affine map fitted to the landmarks themselves, mm: no method, a bound for affine ones."""
    rest, moved = (np.loadtxt(folder / f"landmarks_{name}.txt") for name in ("inspiration", "expiration"))
    known = np.hstack([rest, np.ones((len(rest), 1))])
    return float(np.linalg.norm(known @ np.linalg.lstsq(known, moved, rcond=None)[0] - moved, axis=1).mean())


def before(folder: Path) -> float:
    """Mean distance of the landmarks in both scans as they are, mm."""
    rest, moved = (np.loadtxt(folder / f"landmarks_{name}.txt") for name in ("inspiration", "expiration"))
    return float(np.linalg.norm(moved - rest, axis=1).mean())


def work(row: str, given: Given) -> dict[str, Any]:
    case, side, seen = ROWS[row]
    folder, meshing = given.once(prepared, case, side)
    output, data, organ = folder / seen, LUNGS / f"case_{case:02d}", folder / "organ.toml"
    if seen == "no gravity":
        text = organ.read_text()
        if GRAVITY not in text:
            raise ValueError(f"examples/lung.toml: expected {GRAVITY}.")
        organ = folder / "no-gravity.toml"
        organ.write_text(text.replace(GRAVITY, ""))
    cloud = data / f"cloud_expiration_{SIDES[side]}{SEEN[seen]}.txt"
    if seen == "outliers":
        np.savetxt(
            folder / "outliers.txt", with_outliers(np.loadtxt(cloud), np.random.default_rng([case, SIDES[side]]))
        )
        cloud = folder / "outliers.txt"
    begin = time.perf_counter()
    softtwin(
        *("evaluate", organ, "--unit", "mm", "--frame", "lps", "--output", output),
        *("--cloud", cloud, "--localisation-error", LOCALISATION),
        *("--landmarks", f"{folder / 'landmarks_inspiration.txt'}:mm:lps", folder / "landmarks_expiration.txt"),
    )
    seconds = time.perf_counter() - begin
    found = json.loads((output / "evaluation.json").read_text())
    every, (cloud,) = found["all"], found["cases"]
    return {
        "landmarks": every["landmarks"],
        "error_mm": 1e3 * every["error_m"]["mean"],
        "worst_mm": 1e3 * every["error_m"]["max"],
        "expected_mm": 1e3 * every["expected_error_m"],
        "before_mm": before(folder),
        "best_affine_mm": best_affine(folder),
        "within": every["within"],
        "verdict": cloud["verdict"],
        "reasons": cloud["reasons"],
        "mesh_seconds": meshing,
        "seconds": seconds,
    }


def lines(rows: Figures) -> list[tuple[str, Figures]]:
    """Each lung, and the mean over all landmarks of the whole surface and of half of it."""
    found = list(rows.items())
    for seen in SEEN:
        some = [each for name, each in rows.items() if name.endswith(seen)]
        if len(some) == len(CASES) * len(SIDES):
            found.append((f"all, {seen}", together(some)))
    return found


def together(some: list[Figures]) -> Figures:
    """Means over landmarks of several lungs; the worst is the worst lung's mean."""
    counts = np.array([each["landmarks"] for each in some])

    def mean(values: list[float]) -> float:
        return float(np.average(values, weights=counts))

    verdicts = [each["verdict"] for each in some]
    return {
        "landmarks": int(counts.sum()),
        **{name: mean([each[name] for each in some]) for name in ("error_mm", "before_mm", "best_affine_mm")},
        "expected_mm": float(np.sqrt(mean([each["expected_mm"] ** 2 for each in some]))),
        "worst_mm": max(each["worst_mm"] for each in some),
        "worst_lung_mm": max(each["error_mm"] for each in some),
        "within": {level: mean([each["within"][level] for each in some]) for level in some[0]["within"]},
        "least_within_90": min(each["within"]["0.9"] for each in some),
        "accepted": verdicts.count("accepted"),
        "verdict": ", ".join(f"{verdicts.count(each)} {each}" for each in sorted(set(verdicts))),
        "mesh_seconds": max(each["mesh_seconds"] for each in some),
        "seconds": max(each["seconds"] for each in some),
    }


def finish(figures: Figures, given: Given) -> Figures:
    """The means, where all lungs are there."""
    return {**figures, "all": {name: found for name, found in lines(figures["lungs"]) if name.startswith("all")}}


def picture(case: str, side: str, file: str) -> None:
    """Draw one lung: both surfaces, and landmarks at expiration with where they were found and their 90 % regions."""
    import pyvista

    from softtwin.app.twin import Twin
    from softtwin.meshes.embedding import embed

    folder, _ = prepared(int(case), side)
    rest, truth = (1e-3 * np.loadtxt(folder / f"landmarks_{name}.txt") for name in ("inspiration", "expiration"))
    cloud = 1e-3 * np.loadtxt(LUNGS / f"case_{int(case):02d}" / f"cloud_expiration_{SIDES[side]}.txt")
    with Twin.open(folder / "organ.toml", "reference") as twin:
        result, carried, body = twin.register(cloud), embed(twin.body, rest), twin.body
        found = result.pose.apply(rest + carried.displace(result.displacement))
        margins = result.camera_uncertainty.margin(carried, 0.9)
    faces = np.column_stack([np.full(len(body.boundary), 3), body.boundary]).ravel()
    plotter: Any = pyvista.Plotter(off_screen=True, shape=(1, 2), window_size=[1500, 800], border=False)
    shown = (
        ("before: inspiration, and landmarks as they lay", body.points, rest, np.full(len(rest), 1e-3)),
        (
            "after: registered to expiration, with 90 % regions",
            result.pose.apply(body.points + result.displacement),
            found,
            margins,
        ),
    )
    for column, (title, points, places, radii) in enumerate(shown):
        plotter.subplot(0, column)
        plotter.add_mesh(pyvista.PolyData(points, faces), color="#c96f53", opacity=0.25, smooth_shading=True)
        plotter.add_points(cloud[::10], color="#737373", point_size=2)
        lines = np.stack([places, truth], axis=1).reshape(-1, 3)
        plotter.add_mesh(pyvista.line_segments_from_points(lines), color="black", line_width=1.5)
        plotter.add_points(truth, color="black", point_size=7, render_points_as_spheres=True)
        plotter.add_points(places, color="#1f4e8c", point_size=7, render_points_as_spheres=True)
        if column:
            regions = pyvista.PolyData(places)
            regions["radius"] = radii
            ball = pyvista.Sphere(radius=1.0, theta_resolution=16, phi_resolution=12)
            plotter.add_mesh(regions.glyph(scale="radius", orient=False, geom=ball), color="#1f4e8c", opacity=0.07)
        plotter.add_text(title, font_size=11, color="black")
    plotter.link_views()
    plotter.camera_position = "xz"
    plotter.reset_camera()
    plotter.camera.zoom(1.25)
    plotter.set_background("white")
    plotter.screenshot(file)
    plotter.close()


BENCHMARK = Benchmark(
    name="lungs",
    title="Lungs in vivo, inspiration to expiration: landmarks inside, whole surface and its lateral half",
    about=("registration", "reference", "app/scenario.py", "app/twin.py", "meshes"),
    work=work,
    rows=tuple(ROWS),
    columns=(
        Column("landmarks", "", "{landmarks}"),
        Column("before", "mm", "{before_mm:.1f}"),
        Column("error; worst landmark", "mm", "{error_mm:.1f}; {worst_mm:.1f}"),
        Column("expected", "mm", "{expected_mm:.1f}"),
        Column("best affine map of the landmarks", "mm", "{best_affine_mm:.1f}"),
        Column(
            "within 50; 90; 95 %", "%", lambda f: "; ".join(f"{100 * f['within'][k]:.0f}" for k in sorted(f["within"]))
        ),
        Column("verdict", "", "{verdict}"),
        Column("mesh; registration", "s", "{mesh_seconds:.0f}; {seconds:.0f}"),
    ),
    under="lungs",
    finish=finish,
    lines=lines,
)


if __name__ == "__main__":
    run(BENCHMARK, parts={"picture": picture})
