"""Clouds in files to results in files: what is read and in which order, what is written, what the command line says."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from softtwin.app.config import Config, ConfigError
from softtwin.app.landmarks import camera_from_landmarks
from softtwin.app.record import RECORD, describe, finite, millimetres
from softtwin.app.register import (
    CloudFile,
    camera_from_matrix,
    camera_of,
    find_clouds,
    read_truth,
    register_clouds,
)
from softtwin.app.twin import Twin
from softtwin.meshes.body import Body
from softtwin.meshes.clouds import CloudError
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import FileError, read_body, write_body
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose

from .conftest import pulled, run, seen_cloud

METRES = Coordinates()


@pytest.fixture(scope="module")
def forces(plain_twin: Twin) -> np.ndarray:
    return pulled(plain_twin.body, (0.0, 0.06, -0.2))


@pytest.fixture(scope="module")
def cloud(plain_twin: Twin, forces) -> np.ndarray:
    return seen_cloud(plain_twin, forces)


def record_of(folder: Path) -> dict:
    def refused(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads((folder / RECORD).read_text(), parse_constant=refused)


# --- Which clouds.


def names(found: list[CloudFile]) -> list[str]:
    return [file.path.name for file in found]


def test_folders_and_patterns_are_read_by_number(tmp_path: Path) -> None:
    for number in (1, 2, 10):
        np.save(tmp_path / f"cloud_{number}.npy", np.eye(3))
    (tmp_path / "notes.md").write_text("not a cloud")
    (tmp_path / "__MACOSX").mkdir()
    for companion in ("._cloud_1.npy", ".~lock.npy", "~$cloud_1.npy", "__MACOSX/cloud_1.npy"):
        (tmp_path / companion).write_bytes(b"Mac OS X        ")
    wanted = ["cloud_1.npy", "cloud_2.npy", "cloud_10.npy"]
    assert names(find_clouds([tmp_path], METRES)) == wanted
    assert names(find_clouds([f"{tmp_path}/cl*.npy"], METRES)) == wanted
    assert names(find_clouds([f"{tmp_path}/**/*.npy"], METRES)) == wanted
    given = [tmp_path / "cloud_10.npy", tmp_path / "cloud_1.npy"]
    assert names(find_clouds(given, METRES)) == ["cloud_10.npy", "cloud_1.npy"]  # as they were given


@pytest.mark.parametrize("name", ["nothing/*.ply", "nothing.ply", "empty"])
def test_no_clouds_are_said(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="found n"):
        find_clouds([tmp_path / name], METRES)


def test_a_file_that_cannot_be_read_is_said_before_the_first_frame(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.eye(3))
    (tmp_path / "b.npy").write_bytes(b"not numpy at all")
    with pytest.raises(FileError, match=r"b\.npy"):
        find_clouds([tmp_path], METRES)


def test_clouds_are_read_in_their_unit_and_on_their_axes(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", [[1000.0, 2000.0, 3000.0]] * 3)
    (file,) = find_clouds([tmp_path / "a.npy"], Coordinates("mm", "ras"))
    assert np.array_equal(file.read()[0], [-1.0, -2.0, 3.0])


# --- Truth and the camera.


def test_the_truth_of_one_frame_needs_no_frames(tmp_path: Path, plain_twin: Twin) -> None:
    np.save(tmp_path / "one.npy", plain_twin.body.points)
    assert read_truth(tmp_path / "one.npy", 1, plain_twin.body, METRES).shape == (1, *plain_twin.body.points.shape)
    turned = read_truth(tmp_path / "one.npy", 1, plain_twin.body, Coordinates("mm", "ras"))
    assert np.array_equal(turned[0], plain_twin.body.points * [-1.0, -1.0, 1.0])


@pytest.mark.parametrize(("shape", "frames"), [((5, 3), 1), ((176, 3), 2), ((1, 176, 3), 2), ((2, 3, 176), 2)])
def test_other_truths_are_refused_with_their_shape(tmp_path: Path, plain_twin: Twin, shape, frames: int) -> None:
    assert len(plain_twin.body.points) == 176
    np.save(tmp_path / "t.npy", np.zeros(shape))
    with pytest.raises(ConfigError, match=r"--truth: expected shape .*176, 3.*got \("):
        read_truth(tmp_path / "t.npy", frames, plain_twin.body, METRES)


def test_a_truth_that_is_not_finite_or_no_array_is_refused(tmp_path: Path, plain_twin: Twin) -> None:
    np.save(tmp_path / "t.npy", np.full((1, 176, 3), np.nan))
    with pytest.raises(ConfigError, match="finite"):
        read_truth(tmp_path / "t.npy", 1, plain_twin.body, METRES)
    (tmp_path / "t.npy").write_text("176")
    with pytest.raises(ConfigError, match="array"):
        read_truth(tmp_path / "t.npy", 1, plain_twin.body, METRES)


def test_displacements_are_no_truth(tmp_path: Path, plain_twin: Twin) -> None:
    away = plain_twin.body.points + np.array([0.0, 0.0, 1.0])  # where a scanner has it
    body = Body(away, plain_twin.body.cells, plain_twin.body.node_sets)
    np.save(tmp_path / "t.npy", 0.01 * np.ones((1, 176, 3)))
    with pytest.raises(ConfigError, match=r"--truth: expected positions .* are these displacements"):
        read_truth(tmp_path / "t.npy", 1, body, METRES)
    still = 0.01 * np.ones((1, 176, 3))
    still[:, body.fixed] = 0.0
    np.save(tmp_path / "t.npy", still)
    for centred in (plain_twin.body.points - plain_twin.body.points[body.fixed].mean(axis=0), plain_twin.body.points):
        near = Body(centred, plain_twin.body.cells, plain_twin.body.node_sets)  # what is held lies about the origin
        with pytest.raises(ConfigError, match="are these displacements"):
            read_truth(tmp_path / "t.npy", 1, near, METRES)


def test_a_matrix_is_in_the_clouds_unit_and_on_their_axes(tmp_path: Path, rng) -> None:
    pose = Pose.identity().moved(np.array([0.3, -0.2, 0.5, 0.1, 0.2, 0.3]), np.zeros(3))
    place = Coordinates("mm", "ras")
    outside = place.motion(pose.matrix)
    outside[:3, 3] *= 1e3
    np.savetxt(tmp_path / "start.txt", outside)
    found = camera_from_matrix(tmp_path / "start.txt", place)
    points = rng.random((5, 3))
    np.testing.assert_allclose(found.apply(points), pose.apply(points), atol=1e-12)
    through = outside[:3, :3] @ place.lengths(points).T + outside[:3, 3:]
    np.testing.assert_allclose(place.metres(through.T), pose.apply(points), atol=1e-12)


def test_landmarks_are_each_in_their_own_unit(tmp_path: Path, rng) -> None:
    pose = Pose.identity().moved(np.array([0.3, -0.2, 0.5, 0.1, 0.2, 0.3]), np.zeros(3))
    points = rng.random((4, 3))
    for file, places in (("body.csv", 1e3 * points), ("camera.csv", pose.apply(points))):
        lines = [f"p{i},{x},{y},{z}" for i, (x, y, z) in enumerate(places.tolist())]
        (tmp_path / file).write_text("\n".join(lines))
    fit = camera_from_landmarks(tmp_path / "body.csv", tmp_path / "camera.csv", Coordinates("mm"), METRES)
    np.testing.assert_allclose(fit.pose.matrix, pose.matrix, atol=1e-9)


@pytest.mark.parametrize(
    ("wanted", "given", "kind"),
    [
        ("auto", False, type(None)),
        ("auto", True, PosePrior),
        ("fixed", True, Pose),
        ("fixed", False, type(None)),
        ("unknown", False, PosePrior),
    ],
)
def test_a_start_is_an_unknown_unless_said_otherwise(plain_twin: Twin, wanted: str, given: bool, kind: type) -> None:
    twin = Twin(plain_twin.model, Config.model_validate({"registration": {"pose": wanted, "pose_rotation": 2.0}}))
    camera = camera_of(twin, Pose.identity() if given else None)
    assert type(camera) is kind
    assert not isinstance(camera, PosePrior) or camera.rotation_deviation == pytest.approx(np.deg2rad(2.0))


def test_of_a_start_that_was_fitted_to_the_moved_organ_nothing_is_believed(plain_twin: Twin) -> None:
    near, about = (camera_of(plain_twin, Pose.identity(), is_fitted=fitted) for fitted in (False, True))
    assert isinstance(near, PosePrior) and isinstance(about, PosePrior) and not about.is_said
    assert (about.deviations > 5.0 * near.deviations).all()


# --- What is written.


@pytest.mark.parametrize("off", [0.0, 4e-3])
def test_a_camera_that_is_seen_to_stand_elsewhere_is_said(plain_twin: Twin, cloud, tmp_path: Path, off: float) -> None:
    lines: list[str] = []
    (row,) = register_clouds(plain_twin, [cloud + off * np.array([0.0, 0.6, 0.8])], tmp_path, say=lines.append)
    assert row["pose_correction"]["is_seen"] == (off > 0.0)
    assert ("degrees from where it was said" in lines[0]) == (off > 0.0)
    if off:
        assert 0.2 * off < row["pose_correction"]["translation_m"] < 2.0 * off


def test_pixels_without_a_measurement_in_a_file_are_counted(plain_twin: Twin, cloud, tmp_path: Path) -> None:
    for name, hole in (("zeros", 0.0), ("nan", np.nan)):
        image = np.full((30, 20, 3), hole)
        image.reshape(-1, 3)[np.sort(np.random.default_rng(0).permutation(600)[:400])] = cloud
        np.save(tmp_path / f"{name}.npy", image)
    np.save(tmp_path / "whole.npy", cloud)
    rows = register_clouds(plain_twin, find_clouds([tmp_path], METRES), tmp_path / "out", say=lambda line: None)
    assert [row.get("points_missing", 0) for row in rows] == [200, 0, 200]
    assert [row["points"] for row in rows] == [400] * 3


def test_rows_of_zeros_are_passed_over_and_counted_apart(plain_twin: Twin, cloud, forces, tmp_path: Path) -> None:
    """A depth camera's missing pixels: the frame is the same with them and without, in every figure and file."""
    moved = plain_twin.body.points + plain_twin.predict(forces).displacement
    pose = Pose.identity().moved(np.array([0.3, -0.2, 0.5, 0.05, 0.1, 0.4]), np.zeros(3))
    start = pose.moved(np.array([0.02, -0.03, 0.01, 3e-3, -2e-3, 4e-3]), pose.apply(moved).mean(axis=0))
    seen, lines = pose.apply(cloud), list[str]()
    holed = np.insert(seen, np.random.default_rng(0).integers(len(seen), size=3000), 0.0, axis=0)
    rows = {}
    for name, given in (("whole", seen), ("holed", holed)):
        rows[name] = register_clouds(
            plain_twin, [given], tmp_path / name, camera=plain_twin.near(start), truth=moved[None], say=lines.append
        )[0]
    whole, row = rows["whole"], record_of(tmp_path / "holed")["frames"][0]
    assert row.pop("points_missing") == 3000 and "points_missing" not in whole
    assert row["points"] == 400 and row["points_left_out"] == 0 and row["rms_distance_m"] < 1e-3
    for entry in ("rms_distance_m", "noise_m", "outliers", "informed", "targets"):
        assert row[entry] == whole[entry], entry
    assert row["margins_in"] == "body"
    target = row["targets"]["tumour"]
    assert target["error_m"] < target["margin95_m"] and target["camera_margin95_m"] < target["margin95_m"]
    assert "3000 rows without a measurement passed over" in lines[1] and "in the camera's coordinates)" in lines[1]
    assert pv.read(tmp_path / "holed" / "cloud_0000.vtp").n_points == 400


def test_every_frame_is_written_with_its_verdict(plain_twin: Twin, cloud, forces, tmp_path: Path) -> None:
    truth = plain_twin.body.points + plain_twin.predict(forces).displacement
    lines: list[str] = []
    rows = register_clouds(
        plain_twin, [cloud, np.empty((0, 3)), cloud], tmp_path, truth=np.stack([truth] * 3), say=lines.append
    )
    record = record_of(tmp_path)
    assert record["counts"] == {"accepted": 2, "doubtful": 0, "refused": 1}
    assert record["body"] == plain_twin.body.fingerprint and record["options"]["zone"] == "tip"
    first, second, third = record["frames"]
    assert first["verdict"] == "accepted" and first["reasons"] == [] and first["outcome"] == "converged"
    misfit = next(check for check in first["checks"] if check["code"] == "misfit")
    assert (
        misfit["verdict"] == "accepted"
        and 0.0 < misfit["statistic"] < misfit["level"]
        and 0.0 < misfit["p_value"] < 1.0
    )
    assert "checks" not in second  # nothing was registered
    assert first["error"]["mean"] < 5e-4 and first["targets"]["tumour"]["error_m"] < 5e-4
    assert np.allclose(first["pose"], np.eye(4))
    deviations = np.sqrt(np.diag(first["net_force_covariance_N2"]))
    np.testing.assert_allclose(deviations, first["net_force_deviation_N"], rtol=1e-12)
    middle, reach = np.mean(first["net_force_90_N"], axis=1), 0.5 * np.diff(first["net_force_90_N"], axis=1)[:, 0]
    np.testing.assert_allclose(middle, first["net_force_N"], atol=1e-12)
    np.testing.assert_allclose(reach, 1.6449 * deviations, rtol=1e-9)
    assert f", {first['informed']:.0f} directions seen" in lines[0] and first["informed"] > 1.5
    assert second["verdict"] == "refused" and "empty" in second["reasons"][0] and second["files"] == []
    assert third["evaluations"] < first["evaluations"]
    assert lines[0].startswith("frame   0: accepted, cloud to surface 0.")
    assert lines[1] == "frame   1: refused (cloud: expected at least one point, got an empty cloud.)"
    assert len(rows) == 3


def test_forces_over_stiffness_are_no_less_known_where_the_stiffness_is_not(plain_twin: Twin, cloud, tmp_path) -> None:
    """The prior of the modulus is what newtons are worth: it is in their interval, and not in what the cloud tells."""
    rows = []
    for deviation in (0.0, 0.3):
        material = {"young_modulus": 4000.0, "young_modulus_deviation": deviation}
        config = Config.model_validate({"material": material, "registration": {"zone": "tip"}})
        twin = Twin(plain_twin.model, config)
        rows.append(register_clouds(twin, [cloud], tmp_path / f"{deviation}", say=lambda line: None)[0])
    sharp, wide = rows
    np.testing.assert_allclose(wide["net_force_over_modulus_m2"], np.array(wide["net_force_N"]) / 4000.0, rtol=1e-12)
    for name in ("net_force_over_modulus_m2", "net_force_over_modulus_deviation_m2"):
        np.testing.assert_allclose(wide[name], sharp[name], rtol=1e-6)
    assert np.ptp(wide["net_force_90_N"][2]) > 2.0 * 1.6449 * 0.3 * abs(wide["net_force_N"][2])
    assert np.ptp(sharp["net_force_90_N"][2]) < 0.5 * np.ptp(wide["net_force_90_N"][2])


def test_clouds_that_hold_nothing_usable_are_refused_frames(plain_twin: Twin, cloud, tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", cloud)
    np.save(tmp_path / "1.npy", np.empty((0, 3)))
    (tmp_path / "2.txt").write_text("")
    np.save(tmp_path / "3.npy", np.full_like(cloud, np.nan))
    np.save(tmp_path / "4.npy", cloud)
    found = find_clouds([tmp_path], METRES)
    rows = register_clouds(plain_twin, found, tmp_path / "out", say=lambda line: None)
    assert [row["verdict"] for row in rows] == ["accepted", "refused", "refused", "refused", "accepted"]
    assert [row["cloud"] for row in rows] == ["0.npy", "1.npy", "2.txt", "3.npy", "4.npy"]


def test_where_no_cloud_can_be_used_that_is_an_error(plain_twin: Twin, cloud, tmp_path: Path) -> None:
    with pytest.raises(CloudError, match=r"no cloud could be registered.*--unit"):
        register_clouds(plain_twin, [1e3 * cloud] * 2, tmp_path, say=lambda line: None)
    assert record_of(tmp_path)["counts"]["refused"] == 2


def test_ctrl_c_between_frames_keeps_the_frames_before(plain_twin: Twin, cloud, tmp_path: Path) -> None:
    def interrupted(line: str) -> None:
        if line.startswith("frame   1"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        register_clouds(plain_twin, [cloud] * 3, tmp_path, say=interrupted)
    assert [frame["frame"] for frame in record_of(tmp_path)["frames"]] == [0, 1]
    assert (tmp_path / "frame_0001.vtu").exists() and not list(tmp_path.glob(".*"))


def test_a_folder_is_used_again_without_leftovers(plain_twin: Twin, cloud, tmp_path: Path) -> None:
    """Files of a longer sequence before do not stay; files that are not this program's do."""
    (tmp_path / "notes.txt").write_text("mine")
    register_clouds(plain_twin, [cloud] * 3, tmp_path, say=lambda line: None)
    assert (tmp_path / "tumour_0002.vtp").exists()
    register_clouds(plain_twin, [cloud], tmp_path, formats=("stl",), say=lambda line: None)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"notes.txt", RECORD, "organ_0000.stl", "tumour_0000.stl"}


def test_a_record_removes_nothing_outside_its_folder(plain_twin: Twin, cloud, tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    (out / RECORD).write_text(json.dumps({"frames": [{"files": ["../precious.txt", 3]}]}))
    register_clouds(plain_twin, [cloud], out, say=lambda line: None)
    assert (tmp_path / "precious.txt").exists()


def test_numbers_that_json_has_no_word_for_are_null() -> None:
    value = {"a": [1.0, float("nan")], "b": {"c": (float("inf"), True, "x", None, 2)}}
    assert finite(value) == {"a": [1.0, None], "b": {"c": [None, True, "x", None, 2]}}


def test_no_line_speaks_of_infinite_millimetres() -> None:
    assert millimetres(float("inf")) == millimetres(float("nan")) == "unknown"
    row = {"frame": 2, "verdict": "doubtful", "reasons": ["far off", "and more"], "seconds": 0.1, "targets": {}}
    row |= {"rms_distance_m": float("inf"), "net_force_N": [0.0, 3.0, 4.0], "net_force_deviation_N": [0.0] * 3}
    assert describe(row) == (
        "frame   2: doubtful (far off), cloud to surface unknown, net force 5.000 ± 0.000 N, 100 ms"
    )


def test_figures_are_on_the_axes_of_the_twins_files(plain_twin: Twin, cloud, forces, tmp_path: Path) -> None:
    """The same body from files in RAS: x and y of forces, pose and surfaces have the other sign."""

    class Turned(Twin):
        @property
        def coordinates(self) -> Coordinates:
            return Coordinates("mm", "ras")

    known = Pose.identity().moved(np.array([0.0, 0.02, 0.1, 0.01, 0.0, 0.0]), np.zeros(3))
    seen = known.apply(cloud)
    plain = register_clouds(plain_twin, [seen], tmp_path / "lps", camera=known, say=lambda line: None)[0]
    section = {"zone": "tip", "output_frame": "source", "output_unit": "source"}
    twin = Turned(plain_twin.model, Config.model_validate({"registration": section}))
    turned = register_clouds(twin, [seen], tmp_path / "ras", camera=known, say=lambda line: None)[0]
    flip = np.array([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(turned["net_force_N"], flip * plain["net_force_N"], rtol=1e-12)
    middle = np.mean(turned["net_force_90_N"], axis=1)
    np.testing.assert_allclose(middle, turned["net_force_N"], rtol=1e-9)
    covariance = flip[:, None] * np.array(plain["net_force_covariance_N2"]) * flip
    np.testing.assert_allclose(turned["net_force_covariance_N2"], covariance, rtol=1e-12)
    point = np.array([0.1, 0.2, 0.3])
    through = np.array(turned["pose"])[:3, :3] @ (flip * point) + np.array(turned["pose"])[:3, 3]
    np.testing.assert_allclose(flip * through, known.apply(point), atol=1e-12)
    assert record_of(tmp_path / "ras")["files_in"] == {"unit": "mm", "axes": "ras"}


# --- The command line.


def register(capsys, twin: Path, *clouds: object, code: int = 0, model: str = "reference") -> str:
    return run(capsys, "register", twin, *clouds, "--model", model, "--output", twin / "found", code=code)


@pytest.fixture
def mesh_cloud(mesh_folder: Path, plain_twin: Twin) -> Path:
    """A cloud that the reference can explain: the linear model's shape, hardly bent."""
    np.save(mesh_folder / "cloud.npy", seen_cloud(plain_twin, pulled(plain_twin.body, (0.0, 0.0, -0.02)), 1e-4))
    return mesh_folder / "cloud.npy"


def test_the_reference_registers_with_a_mesh_alone(capsys, mesh_folder: Path, mesh_cloud: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    np.save(mesh_folder / "truth.npy", read_body(mesh_folder / "body.vtu").points)
    said = register(capsys, mesh_folder, mesh_cloud, "--truth", mesh_folder / "truth.npy", "--strict")
    assert "frame   0: accepted" in said and "1 accepted" in said and "not a medical device" in said
    frame = record_of(mesh_folder / "found")["frames"][0]
    assert frame["rms_distance_m"] < 1e-3 and frame["error"]["mean"] > 0.0
    assert (mesh_folder / "found" / "frame_0000.vtu").exists()


def test_every_option_reaches_the_registrar(capsys, mesh_folder: Path, mesh_cloud: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    wanted = {
        "zone": "tip",
        "noise": 2e-4,
        "force_scale": 0.02,
        "smoothness": 0.0,
        "directions": 9,
        "points": 150,
        "reweighting_rounds": 1,
        "solver": "l-bfgs",
        "max_iterations": 60,
        "pose": "fixed",
        "pose_rotation": 3.0,
        "pose_translation": 0.02,
        "known_rotation": 0.5,
        "known_translation": 1e-3,
        "landmark_deviation": 1e-3,
        "penalty": "amplitude",
        "alpha": 0.2,
        "output_frame": "ras",
        "output_unit": "m",
        "voxel": 0.01,
        "target_points": 2,
    }
    flags = [word for name, value in wanted.items() for word in (f"--{name.replace('_', '-')}", value)]
    register(capsys, mesh_folder, mesh_cloud, *flags, "--noise-known", "--format", "ply", "--format", "stl")
    record = record_of(mesh_folder / "found")
    unused = {"forces": "unknown", "parameters": [], "known_forces": "", "gravity": [0.0, 0.0, 0.0], "pressure": 0.0}
    unused |= {"scan_gravity": [0.0, 0.0, 0.0]}
    unused |= {"distance": "surface", "normals": False, "normal_deviation": 10.0, "budget": 0.0}
    assert record["options"] == {"model": "reference", "noise_known": True, **wanted, **unused}
    assert record["frames"][0]["points"] <= 150
    assert {path.suffix for path in (mesh_folder / "found").iterdir()} == {".json", ".ply", ".stl"}


def test_a_budget_bounds_each_frame_of_a_sequence(capsys, mesh_folder: Path, mesh_cloud: Path) -> None:
    """No time at all: where each search begins, and said so; time enough: as without a budget."""
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    frames = []
    for budget in ("1e-9", "600"):
        said = register(capsys, mesh_folder, mesh_cloud, mesh_cloud, "--budget", budget)
        frames.append(record_of(mesh_folder / "found")["frames"])
        assert ("the time for it was over" in said) == (budget == "1e-9")
    short, long = frames
    assert [frame["verdict"] for frame in short] == ["doubtful"] * 2
    assert [frame["outcome"] for frame in short + long] == ["out_of_time"] * 2 + ["converged"] * 2
    assert short[0]["evaluations"] < long[0]["evaluations"] and short[0]["rms_distance_m"] > long[0]["rms_distance_m"]
    said = register(capsys, mesh_folder, mesh_cloud, "--budget", 0, code=2)
    assert "--budget: expected a finite number > 0, in seconds, got '0'" in said


def test_strict_ends_with_code_3(capsys, mesh_folder: Path, mesh_cloud: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    np.save(mesh_folder / "empty.npy", np.empty((0, 3)))
    clouds = (mesh_cloud, mesh_folder / "empty.npy")
    assert "1 accepted, 1 refused" in register(capsys, mesh_folder, *clouds)
    register(capsys, mesh_folder, *clouds, "--strict", code=3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--zone", "nowhere"), "registration.zone: expected one of"),
        (("--format", "xyz"), "--format: expected vtu, stl, ply, obj, vtp, nrrd, mrk.json, seq.mrb, got xyz"),
        (("--noise", "-1"), "--noise: expected a finite number > 0, in metres"),
        (
            ("--pose", "unknown", "--pose-rotation", "0"),
            "--pose-rotation: expected a finite number > 0, in degrees, got '0'",
        ),
        (
            ("--pose", "unknown", "--pose-translation", "0"),
            "--pose-translation: expected a finite number > 0, in metres, got '0'",
        ),
        (("--zone", "tip", "--parameter", "moved@tip"), "got tip, all of which moved@ holds"),
        (("--truth", "cloud.npy"), "--truth: expected shape"),
        (("--align", "auto", "--start", "cloud.npy"), "expected one of them"),
        (("--start", "cloud.npy"), "cloud.npy"),
    ],
)
def test_what_cannot_be_is_one_message(capsys, monkeypatch, mesh_folder, mesh_cloud, words, message: str) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    monkeypatch.chdir(mesh_folder)
    said = register(capsys, mesh_folder, mesh_cloud, *words, code=2)
    assert message in said and "Traceback" not in said
    assert not (mesh_folder / "found").exists()


@pytest.mark.parametrize(
    ("points", "message"),
    [(np.empty((0, 3)), "point"), (np.array([[0.1, 0.1, np.nan]] * 9), "9 rows without"), (np.zeros((4, 2)), "(p, 3)")],
)
def test_a_cloud_that_cannot_be_is_refused_with_its_file(capsys, mesh_folder: Path, points, message: str) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    np.save(mesh_folder / "bad.npy", points)
    said = register(capsys, mesh_folder, mesh_folder / "bad.npy", code=2)
    assert "bad.npy" in said and message in said and "Traceback" not in said


PLY = "ply\nformat {} 1.0\nelement vertex 50\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize("kind", ["npy", "ascii", "binary_little_endian"])
@pytest.mark.parametrize("part", [0.05, 0.5, 0.95])
def test_a_cloud_that_is_cut_is_said_to_be_truncated(capsys, mesh_folder: Path, kind: str, part: float) -> None:
    points = np.random.default_rng(0).random((50, 3)).astype("<f4")
    path = mesh_folder / ("cut.npy" if kind == "npy" else "cut.ply")
    if kind == "npy":
        np.save(path, points)
    else:
        rows = points.tobytes() if kind != "ascii" else "".join(f"{x} {y} {z}\n" for x, y, z in points).encode()
        path.write_bytes(PLY.format(kind).encode() + rows)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    said = register(capsys, mesh_folder, path, code=2)
    assert path.name in said and "truncated" in said and "Traceback" not in said


def test_a_support_without_a_free_node_is_said(capsys, mesh_folder: Path, mesh_cloud: Path, seen_body: Body) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    write_body(mesh_folder / "body.vtu", seen_body.with_sets(fixed=seen_body.boundary_nodes))
    said = register(capsys, mesh_folder, mesh_cloud, code=2)
    assert "Body.fixed: expected free nodes on the boundary, got all" in said and "nothing is left" in said


def test_a_camera_inside_the_organ_is_asked_about(capsys, mesh_folder: Path, tmp_path: Path) -> None:
    words = ("--fixed", "halfspace:0.001,0,0:-1,0,0", "--observed", "seen-from:0.15,0.03,0.03")
    said = run(capsys, "build", mesh_folder / "body.vtu", *words, "--output", tmp_path / "made", code=2)
    assert "seen from (150, 30, 30) mm" in said and "is the camera inside?" in said


def test_a_cloud_one_metre_away_is_refused_with_the_distance(capsys, mesh_folder: Path, mesh_cloud: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    np.save(mesh_cloud, np.load(mesh_cloud) + 1.0)
    said = register(capsys, mesh_folder, mesh_cloud, code=2)
    assert " m" in said and "rigid" in said


def test_a_folder_that_is_no_twin_is_refused(capsys, mesh_folder: Path, mesh_cloud: Path, tmp_path: Path) -> None:
    shutil.move(mesh_cloud, tmp_path / "cloud.npy")
    shutil.rmtree(mesh_folder)
    mesh_folder.mkdir()
    assert "softtwin build" in run(capsys, "register", mesh_folder, tmp_path / "cloud.npy", code=2)


def test_a_twin_without_a_network_says_so(capsys, mesh_folder: Path, mesh_cloud: Path) -> None:
    said = register(capsys, mesh_folder, mesh_cloud, code=2, model="surrogate")
    assert "surrogate.json" in said and "--model reference" in said and "Traceback" not in said


def test_the_clouds_unit_is_the_organs_unless_said(
    plain_twin: Twin, mesh_folder: Path, mesh_cloud: Path, capsys
) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    text = (mesh_folder / "organ.toml").read_text().replace('unit = "m"', 'unit = "mm"')
    (mesh_folder / "organ.toml").write_text(text)
    np.save(mesh_folder / "mm.npy", 1e3 * np.load(mesh_cloud))
    register(capsys, mesh_folder, mesh_folder / "mm.npy")
    register(capsys, mesh_folder, mesh_cloud, "--unit", "m")
    assert record_of(mesh_folder / "found")["files_in"] == {"unit": "mm", "axes": "lps"}
