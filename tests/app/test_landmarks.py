"""Landmarks in files that pull beside the clouds: whose frame a file is of, what they change, what is refused."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from softtwin.app.config import ConfigError
from softtwin.app.landmarks import LandmarkFiles
from softtwin.app.live import register_live
from softtwin.app.record import RECORD
from softtwin.app.register import CloudFile, register_clouds
from softtwin.app.streams import Mailbox
from softtwin.app.twin import Twin
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import FileError
from softtwin.registration.pose import Pose

from .conftest import pulled, run, seen_cloud

METRES, ASIDE = Coordinates(), np.array([0.0, 0.002, -0.002])
TURNED = Pose.from_matrix(np.array([[0.0, -1, 0, 0.1], [1, 0, 0, -0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]))


def write(path: Path, points: Mapping[str, np.ndarray], scale: float = 1.0) -> Path:
    path.parent.mkdir(exist_ok=True, parents=True)
    rows = [f"{name},{','.join(str(x) for x in scale * place)}" for name, place in points.items()]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def truth(plain_twin: Twin) -> np.ndarray:
    return plain_twin.predict(pulled(plain_twin.body, (0.0, 0.06, -0.2))).displacement


@pytest.fixture(scope="module")
def poor(plain_twin: Twin) -> np.ndarray:
    """A cloud that lies 3 mm aside as a whole, so that landmarks tell more."""
    return seen_cloud(plain_twin, pulled(plain_twin.body, (0.0, 0.06, -0.2))) + ASIDE


@pytest.fixture(scope="module")
def ends(plain_twin: Twin) -> np.ndarray:
    """Nodes of the side that a camera sees, at its far end."""
    seen = plain_twin.registrar().observed.nodes
    return seen[np.argsort(plain_twin.body.points[seen, 0])[-6:]]


def at_rest(twin: Twin, ends: np.ndarray) -> dict[str, np.ndarray]:
    return {f"m{number}": twin.body.points[node] for number, node in enumerate(ends)}


def moved(twin: Twin, ends: np.ndarray, truth: np.ndarray) -> dict[str, np.ndarray]:
    return {f"m{number}": (twin.body.points + truth)[node] for number, node in enumerate(ends)}


def test_each_cloud_has_the_file_of_its_name(plain_twin, ends, truth, poor, tmp_path: Path) -> None:
    """Millimetres of the camera's own file are read as such; a frame without a file has its cloud alone."""
    names = ["a.1", "b", "c"]
    for name in names:
        np.save(tmp_path / f"{name}.npy", poor)
    found = moved(plain_twin, ends, truth)
    write(tmp_path / "frame_landmarks" / "a.1.csv", found, 1e3)
    write(
        tmp_path / "frame_landmarks" / "c.txt",
        {name: found[name] for name in ("m0", "m3")} | {"other": np.ones(3)},
        1e3,
    )
    body = write(tmp_path / "body.csv", at_rest(plain_twin, ends))
    clouds = [CloudFile(tmp_path / f"{name}.npy", METRES) for name in names]
    frame_landmarks = LandmarkFiles.read(
        body, tmp_path / "frame_landmarks", METRES, Coordinates("mm"), [cloud.path for cloud in clouds]
    )
    rows = register_clouds(
        plain_twin, clouds, tmp_path / "found", frame_landmarks=frame_landmarks, say=lambda line: None
    )
    assert [row.get("landmarks") for row in rows] == [6, None, 2]
    recorded = json.loads((tmp_path / "found" / RECORD).read_text())["frames"]
    assert [row.get("landmarks") for row in recorded] == [6, None, 2]


@pytest.mark.parametrize("camera", [None, TURNED], ids=["at rest", "camera"])
def test_landmarks_in_files_do_what_those_in_arrays_do(
    plain_twin, ends, truth, poor, tmp_path: Path, camera: Pose | None
) -> None:
    turned = (lambda points: points) if camera is None else camera.apply
    np.save(tmp_path / "cloud.npy", turned(poor))
    body = write(tmp_path / "body.csv", at_rest(plain_twin, ends))
    seen = {name: turned(place[None])[0] for name, place in moved(plain_twin, ends, truth).items()}
    file = write(tmp_path / "camera.csv", seen)
    cloud = CloudFile(tmp_path / "cloud.npy", METRES)
    frame_landmarks = LandmarkFiles.read(body, file, METRES, METRES, [cloud.path])
    (row,) = register_clouds(
        plain_twin, [cloud], tmp_path / "f", camera=camera, frame_landmarks=frame_landmarks, say=lambda line: None
    )
    (bare,) = register_clouds(plain_twin, [cloud], tmp_path / "g", camera=camera, say=lambda line: None)
    places = np.array(list(seen.values()))
    direct = plain_twin.register(turned(poor), camera=camera, landmarks=(plain_twin.body.points[ends], places))
    assert row["landmarks"] == 6 and "landmarks" not in bare
    apart = [np.linalg.norm(each["net_force_N"] - direct.net_force) for each in (row, bare)]
    assert apart[0] < 0.05 * apart[1]


def test_a_stream_takes_them_as_they_come(plain_twin, ends, truth, poor, tmp_path: Path) -> None:
    body = write(tmp_path / "body.csv", at_rest(plain_twin, ends))
    (tmp_path / "frame_landmarks").mkdir()
    frame_landmarks = LandmarkFiles.read(body, tmp_path / "frame_landmarks", METRES, METRES, None)
    np.save(tmp_path / "now.npy", poor)
    write(tmp_path / "frame_landmarks" / "now.csv", moved(plain_twin, ends, truth))
    box = Mailbox()
    box.put(CloudFile(tmp_path / "now.npy", METRES))
    box.close()
    (row,) = register_live(plain_twin, box, tmp_path / "found", frame_landmarks=frame_landmarks, say=lambda line: None)
    assert row["landmarks"] == 6 and row["dropped"] == 0


def test_a_frame_whose_landmarks_cannot_be_read_is_refused(plain_twin, ends, truth, poor, tmp_path: Path) -> None:
    body = write(tmp_path / "body.csv", at_rest(plain_twin, ends))
    for name in ("one", "two"):
        np.save(tmp_path / f"{name}.npy", poor)
        write(tmp_path / "frame_landmarks" / f"{name}.csv", moved(plain_twin, ends, truth))
    clouds = [CloudFile(tmp_path / f"{name}.npy", METRES) for name in ("one", "two")]
    frame_landmarks = LandmarkFiles.read(
        body, tmp_path / "frame_landmarks", METRES, METRES, [cloud.path for cloud in clouds]
    )
    (tmp_path / "frame_landmarks" / "one.csv").write_text("m1,1,2\n")
    rows = register_clouds(
        plain_twin, clouds, tmp_path / "found", frame_landmarks=frame_landmarks, say=lambda line: None
    )
    assert rows[0]["verdict"] == "refused" and "one.csv: expected points" in rows[0]["reasons"][0]
    assert rows[1]["landmarks"] == 6


def test_what_are_no_landmarks_of_the_clouds_is_said_before_the_first(plain_twin, ends, tmp_path: Path) -> None:
    body = write(tmp_path / "body.csv", at_rest(plain_twin, ends))
    other = write(tmp_path / "frame_landmarks" / "elsewhere.csv", {"tip": np.zeros(3)})
    clouds = [tmp_path / "one.npy", tmp_path / "two.npy"]
    with pytest.raises(ConfigError, match=r"expected files in .* named like the clouds, such as one\.csv .*found none"):
        LandmarkFiles.read(body, tmp_path / "frame_landmarks", METRES, METRES, clouds)
    for files, words in ((clouds, "2 clouds"), (None, "yet to come")):
        with pytest.raises(ConfigError, match=rf"--frame-landmarks: expected a folder .* got the file .*{words}"):
            LandmarkFiles.read(body, other, METRES, METRES, files)
    with pytest.raises(FileError, match=r"expected landmarks that the body has \(m0, .*\), got tip"):
        LandmarkFiles.read(body, other, METRES, METRES, clouds[:1])
    with pytest.raises(
        ConfigError, match=r"--frame-landmarks: .*expected points on the observed surface; point 0 lies"
    ):
        LandmarkFiles({"far": np.ones(3)}, other, METRES).check(plain_twin)


def test_a_contact_of_unknown_place_takes_none(seen_body, ends, tmp_path: Path) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    from softtwin.app.config import Config
    from softtwin.reference.data.materials import NeoHookean
    from softtwin.reference.derivatives.model import ReferenceModel
    from softtwin.reference.solve.problem import Problem

    section = {"zone": "tip", "parameters": ["contact"], "model": "reference"}
    with Problem(seen_body, NeoHookean(5000.0, 0.45)) as problem:
        twin = Twin(ReferenceModel(problem), Config.model_validate({"registration": section}))
        with pytest.raises(ConfigError, match="landmarks: expected none beside a contact of unknown place"):
            LandmarkFiles({"m": np.zeros(3)}, tmp_path, METRES).check(twin)


def test_the_command_line_takes_them(capsys, plain_twin, mesh_folder: Path, ends) -> None:
    pytest.importorskip("petsc4py", reason="FEniCSx is absent")
    forces = pulled(plain_twin.body, (0.0, 0.0, -0.02))
    np.save(mesh_folder / "cloud.npy", seen_cloud(plain_twin, forces, 1e-4))
    write(mesh_folder / "body.csv", at_rest(plain_twin, ends))
    write(mesh_folder / "camera.csv", moved(plain_twin, ends, plain_twin.predict(forces).displacement))
    words = ["register", mesh_folder, mesh_folder / "cloud.npy", "--output", mesh_folder / "found"]
    words += ["--model", "reference", "--zone", "tip", "--landmark-deviation", 1e-3]
    said = run(capsys, *words, "--frame-landmarks", mesh_folder / "body.csv", mesh_folder / "camera.csv")
    assert "frame   0: accepted" in said and ", 6 landmarks," in said
