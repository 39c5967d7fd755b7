"""Normals in the clouds' files: read in every format, on the axes of the file, and pulling beside the points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softtwin.app.register import CloudFile, find_clouds, register_clouds
from softtwin.app.twin import Twin
from softtwin.meshes.export import Coordinates, write_points
from softtwin.meshes.io import FileError, read_cloud
from softtwin.registration.cloud import turned
from softtwin.registration.pose import Pose
from softtwin.registration.surface_distance import SurfaceDistance

from .conftest import pulled, run, seen_cloud


@pytest.fixture(scope="module")
def seen(plain_twin: Twin) -> np.ndarray:
    return with_normals(plain_twin, seed=0)


def with_normals(twin: Twin, seed: int) -> np.ndarray:
    """A cloud with the normals of the surface that it lies on, (400, 6)."""
    forces = pulled(twin.body, (0.0, 0.06, -0.2))
    cloud, u = seen_cloud(twin, forces, seed=seed), twin.predict(forces).displacement
    observed = SurfaceDistance(twin.body, twin.body.surfaces["observed"])
    moved = u[observed.nodes]
    return np.hstack([cloud, observed.facing(observed.match(moved, cloud), moved)])


def write_ply(path: Path, table: np.ndarray) -> None:
    names = [f"property double {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head = ["ply", "format ascii 1.0", f"element vertex {len(table)}", *names, "end_header"]
    path.write_text("\n".join(head) + "\n" + "\n".join(" ".join(f"{x:.17g}" for x in row) for row in table) + "\n")


def write_pcd(path: Path, table: np.ndarray) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    fields = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    cloud = pypcd4.PointCloud.from_points(table, fields, (np.float64,) * 6)
    cloud.save(path, pypcd4.Encoding.ASCII)


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".npy", ".ply", ".vtp", ".pcd"])
def test_normals_are_read_with_their_points(suffix: str, tmp_path: Path, seen: np.ndarray) -> None:
    path = tmp_path / f"cloud{suffix}"
    table = seen * [1000.0, 1000.0, 1000.0, 1.0, 1.0, 1.0]
    if suffix == ".npy":
        np.save(path, table)
    elif suffix == ".ply":
        write_ply(path, table)
    elif suffix == ".vtp":
        write_points(path, table[:, :3], {"Normals": table[:, 3:]})
    elif suffix == ".pcd":
        write_pcd(path, table)
    else:
        np.savetxt(path, table, fmt="%.17g", delimiter="," if suffix == ".csv" else " ")
    np.testing.assert_allclose(read_cloud(path, "mm", normals=True), seen, atol=1e-6 if suffix == ".pcd" else 1e-12)
    flipped = read_cloud(path, "mm", "ras", normals=True)
    np.testing.assert_allclose(flipped[:, 3:], seen[:, 3:] * [-1.0, -1.0, 1.0], atol=1e-6)
    if suffix in (".ply", ".vtp", ".pcd"):
        assert read_cloud(path, "mm").shape == (400, 3)


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".ply", ".vtp"])
def test_a_file_without_normals_says_so(suffix: str, tmp_path: Path, seen: np.ndarray) -> None:
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".npy":
        np.save(path, seen[:, :3])
    elif suffix == ".txt":
        np.savetxt(path, seen[:, :3])
    else:
        write_points(path, seen[:, :3])
    with pytest.raises(FileError, match="expected a normal for each point, got none; without --normals"):
        read_cloud(path, normals=True)


def test_they_pull_from_files_as_from_arrays(tmp_path: Path, plain_twin: Twin, seen: np.ndarray) -> None:
    np.save(tmp_path / "cloud.npy", seen)
    (file,) = find_clouds([tmp_path], Coordinates(), normals=True)
    (row,) = register_clouds(plain_twin, [file], tmp_path / "out", say=lambda line: None)
    alone = plain_twin.register(seen[:, :3])
    both = plain_twin.register(seen)
    np.testing.assert_allclose(row["net_force_N"], both.net_force, rtol=1e-9)
    assert not np.allclose(both.net_force, alone.net_force, rtol=1e-9, atol=0.0)
    assert CloudFile(tmp_path / "cloud.npy", Coordinates(), normals=True).read().shape == (400, 6)


def test_they_leave_less_unknown(plain_twin: Twin) -> None:
    """In the median of clouds: of each, noise and size of the forces are estimated, too, and may come out larger."""
    clouds = [with_normals(plain_twin, seed) for seed in range(5)]
    deviations = [
        [plain_twin.register(given).uncertainty.deviation.mean() for given in (seen, seen[:, :3])] for seen in clouds
    ]
    assert np.median([both / alone for both, alone in deviations]) < 1.0


def test_they_turn_with_the_camera(plain_twin: Twin, seen: np.ndarray) -> None:
    pose = Pose.identity().moved(np.array([0.3, -0.2, 0.5, 0.02, 0.01, -0.03]), np.zeros(3))
    here = plain_twin.register(seen, camera=Pose.identity())
    there = plain_twin.register(turned(seen, pose.rotation, pose.translation), camera=pose)
    # Rounding decides to which of two triangles a point at their edge belongs, and each search may have a tenth to go.
    away = np.linalg.norm(there.displacement - here.displacement, axis=1)
    assert (away <= 0.3 * here.uncertainty.deviation + 1e-12).all()
    near = plain_twin.register(turned(seen, pose.rotation, pose.translation), camera=plain_twin.near(pose))
    assert near.judgement.is_usable
    assert np.linalg.norm(near.displacement - here.displacement, axis=1).mean() < 1e-3


@pytest.mark.fenicsx
def test_the_command_line_reads_them(
    tmp_path: Path, mesh_folder: Path, seen: np.ndarray, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "cloud.npy", 0.0 * seen[:, :1] + seen[:, :3])
    options = ("--model", "reference", "--output", tmp_path / "out")
    said = run(capsys, "register", mesh_folder, tmp_path / "cloud.npy", *options, "--normals", "--strict", code=2)
    assert "expected a normal for each point, got none" in said
    np.save(tmp_path / "cloud.npy", seen)
    run(
        capsys, "register", mesh_folder, tmp_path / "cloud.npy", *options, "--normals", "--normal-deviation", 5.0,
        "--distance", "plane",
    )  # fmt: skip
    record = json.loads((tmp_path / "out" / "registration.json").read_text())
    assert record["options"]["normals"] is True and record["options"]["distance"] == "plane"
    assert record["frames"][0]["verdict"] in ("accepted", "doubtful")
