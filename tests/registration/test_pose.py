from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtwin.meshes.io import FileError
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.pose import Pose, PoseError, from_landmarks, read_landmarks, read_matrix


def _pose(rng: np.random.Generator) -> Pose:
    return Pose(Rotation.random(random_state=int(rng.integers(2**31))).as_matrix(), rng.normal(size=3))


def test_a_pose_and_its_inverse_undo_each_other(rng: np.random.Generator) -> None:
    pose, points = _pose(rng), rng.normal(size=(20, 3))
    assert np.allclose(pose.inverse().apply(pose.apply(points)), points, rtol=0, atol=1e-14)
    assert np.allclose(pose.then(pose.inverse()).matrix, np.eye(4), rtol=0, atol=1e-14)
    assert np.array_equal(Pose.identity().apply(points), points)


def test_then_is_the_product_of_matrices(rng: np.random.Generator) -> None:
    first, second, points = _pose(rng), _pose(rng), rng.normal(size=(20, 3))
    assert np.allclose(first.then(second).apply(points), second.apply(first.apply(points)), rtol=0, atol=1e-14)
    assert np.allclose(first.then(second).matrix, second.matrix @ first.matrix, rtol=0, atol=1e-14)
    assert np.allclose(Pose.from_matrix(first.matrix).matrix, first.matrix, rtol=0, atol=1e-14)


def test_a_pose_cannot_be_changed(rng: np.random.Generator) -> None:
    pose = _pose(rng)
    for array in (pose.rotation, pose.translation, pose.matrix):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_angle_and_distance_between_poses(rng: np.random.Generator) -> None:
    pose = _pose(rng)
    turned = pose.moved([0.0, 0.3, 0.0, 0.0, 0.0, 0.0], pose.translation)
    assert pose.angle_to(turned) == pytest.approx(0.3, abs=1e-12)
    shifted = pose.moved([0.0, 0.0, 0.0, 0.003, 0.0, 0.004], pose.translation)
    assert pose.distance_to(shifted, rng.normal(size=(9, 3))) == pytest.approx(0.005, abs=1e-14)


def test_a_move_leaves_its_centre_where_the_shift_puts_it(rng: np.random.Generator) -> None:
    pose, centre, twist = _pose(rng), rng.normal(size=3), rng.normal(size=6)
    at_centre = pose.inverse().apply(centre)
    assert np.allclose(pose.moved(twist, centre).apply(at_centre), centre + twist[3:], rtol=0, atol=1e-13)


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.8])
def test_the_derivative_of_a_move_is_exact(rng: np.random.Generator, size: float) -> None:
    pose, points, centre = _pose(rng), rng.normal(size=(7, 3)), rng.normal(size=3)
    twist, direction = size * rng.normal(size=6), rng.normal(size=6)
    slope = pose.moved_jacobian(points, twist, centre) @ direction
    start = pose.moved(twist, centre).apply(points).ravel()
    steps = np.array([1e-2, 1e-3, 1e-4])
    ends = [pose.moved(twist + h * direction, centre).apply(points).ravel() for h in steps]
    errors = [np.linalg.norm(end - start - h * slope) for h, end in zip(steps, ends, strict=True)]
    # Taylor: the remainder falls with the square of the step.
    assert np.diff(np.log10(errors)) == pytest.approx([-2.0, -2.0], abs=0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m[:3], r"expected shape \(4, 4\), got \(3, 4\)"),
        (lambda m: m * np.array([1, 1, 1, np.nan]), "NaN"),
        (lambda m: m.T, "transposed"),
        (lambda m: np.diag([1e3, 1e3, 1e3, 1]) @ m, "stretches of 1000 1000 1000"),
        (lambda m: np.diag([-1, 1, 1, 1]) @ m, "mirrors"),
    ],
)
def test_what_is_no_rigid_motion_is_refused(rng: np.random.Generator, change, said: str) -> None:
    with pytest.raises(PoseError, match=said):
        Pose.from_matrix(change(_pose(rng).matrix))


def test_a_matrix_typed_with_four_digits_becomes_a_rotation(rng: np.random.Generator) -> None:
    pose = _pose(rng)
    typed = Pose.from_matrix(pose.matrix.round(4))
    assert np.allclose(typed.rotation @ typed.rotation.T, np.eye(3), rtol=0, atol=1e-14)
    assert pose.angle_to(typed) < 2e-4


@pytest.mark.parametrize(
    "wide",
    [
        {"rotation_deviation": 0.0},
        {"translation_deviation": 0.0},
        {"translation_deviation": -1.0},
        {"rotation_deviation": np.nan},
        {"rotation_deviation": np.inf},
    ],
)
def test_a_prior_of_no_width_is_refused(wide: dict[str, float]) -> None:
    (name,) = wide
    with pytest.raises(ValueError, match=rf"PosePrior\.{name}: expected a positive deviation, got"):
        PosePrior(Pose.identity(), np.zeros(3), **wide)


# --- Files.


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".npy", ".json"])
def test_a_matrix_is_read_in_its_unit(tmp_path: Path, rng: np.random.Generator, suffix: str) -> None:
    pose = _pose(rng)
    matrix, path = pose.matrix.copy(), tmp_path / f"start{suffix}"
    matrix[:3, 3] *= 1000
    if suffix == ".npy":
        np.save(path, matrix)
    elif suffix == ".json":
        path.write_text(json.dumps({"matrix": matrix.tolist()}))
    else:
        np.savetxt(path, matrix, delimiter="," if suffix == ".csv" else " ", header="body to camera")
    assert np.allclose(read_matrix(path, "mm").matrix, pose.matrix, rtol=0, atol=1e-12)


def test_the_transform_that_moves_the_model_in_slicer_is_the_pose(tmp_path: Path, rng: np.random.Generator) -> None:
    pose, centre = _pose(rng), np.array([10.0, -20.0, 5.0])
    back = pose.inverse()  # Slicer saves the transform from the parent, in LPS and millimetres
    offset = 1000 * back.translation - centre + back.rotation @ centre
    (tmp_path / "organ.tfm").write_text(
        "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
        f"Parameters: {' '.join(map(repr, [*back.rotation.ravel().tolist(), *offset.tolist()]))}\n"
        f"FixedParameters: {' '.join(map(repr, centre.tolist()))}\n"
    )
    assert np.allclose(read_matrix(tmp_path / "organ.tfm").matrix, pose.matrix, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("start.txt", "1 0 0\n0 1 0\n0 0 1\n", r"start.txt: expected a matrix of 4 x 4 numbers \(got shape \(3, 3\)\)"),
        ("start.txt", "1 0 0 a\n", "start.txt: expected a matrix of 4 x 4 numbers"),
        ("start.json", "[[1, 0", "start.json: expected a matrix"),
        ("start.json", '{"pose": []}', "start.json: expected a matrix"),
        ("start.xml", "1", "start.xml: expected a matrix as .*suffix '.xml'"),
        ("start.tfm", "Transform: BSplineTransform_double_3_3\n", "start.tfm: expected one linear .*BSpline"),
        ("start.csv", "-1,0,0,0\n0,1,0,0\n0,0,1,0\n0,0,0,1\n", "start.csv: rotation: .*mirrors"),
    ],
)
def test_a_file_that_is_no_matrix_is_named(tmp_path: Path, name: str, content: str, said: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(FileError, match=said):
        read_matrix(tmp_path / name)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for read in (read_matrix, read_landmarks):
        with pytest.raises(FileError, match=r"absent.txt: no such file"):
            read(tmp_path / "absent.txt")


FCSV = """# Markups fiducial file version = 4.11
# CoordinateSystem = {axes}
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
1,10,20,30,0,0,0,1,1,1,0,falciform,,
2,-10,5,0,0,0,0,1,1,1,0,gallbladder,,
"""


def _markups(axes: str) -> str:
    points = [("falciform", [10, 20, 30]), ("gallbladder", [-10, 5, 0])]
    control = [{"label": name, "position": place, "positionStatus": "defined"} for name, place in points]
    control.append({"label": "later", "position": [0, 0, 0], "positionStatus": "undefined"})
    return json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": axes, "controlPoints": control}]})


@pytest.mark.parametrize("axes", ["LPS", "RAS"])
@pytest.mark.parametrize("kind", ["marks.csv", "marks.txt", "marks.fcsv", "marks.mrk.json"])
def test_landmarks_are_read_as_the_file_says_or_in_the_axes_wanted(tmp_path: Path, kind: str, axes: str) -> None:
    path = tmp_path / kind
    text = "name,x,y,z\nfalciform,10,20,30\ngallbladder, -10, 5, 0\n"
    contents = {"marks.fcsv": FCSV.format(axes=axes), "marks.mrk.json": _markups(axes)}
    path.write_text(contents.get(kind, text))
    kept, turned = read_landmarks(path, "mm"), read_landmarks(path, "mm", axes="lps")
    assert list(kept) == ["falciform", "gallbladder"]
    assert np.allclose(kept["falciform"], [0.01, 0.02, 0.03], rtol=0, atol=1e-15)
    sign = -1 if axes == "RAS" and kind in contents else 1
    assert np.allclose(turned["falciform"], [sign * 0.01, sign * 0.02, 0.03], rtol=0, atol=1e-15)


def test_the_old_number_of_ras_is_understood(tmp_path: Path) -> None:
    (tmp_path / "marks.fcsv").write_text(FCSV.format(axes="0"))
    assert read_landmarks(tmp_path / "marks.fcsv", axes="lps")["gallbladder"][0] == pytest.approx(0.01, abs=1e-15)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("marks.csv", "a,1,2,3\na,4,5,6\n", "marks.csv: expected each landmark once, got a more"),
        ("marks.csv", "a,1,2\n", "marks.csv: expected points.*'a,1,2'"),
        ("marks.csv", "a,1,2,nan\n", "marks.csv: expected three finite coordinates, got others for a"),
        ("marks.csv", "name,x,y,z\n", "marks.csv: expected landmarks, got none"),
        ("marks.fcsv", FCSV.format(axes="IJK"), "marks.fcsv: expected points in LPS or RAS, got 'IJK'"),
        ("marks.mrk.json", "{}", "marks.mrk.json: expected points"),
        ("marks.stl", "solid", "marks.stl: expected landmarks as"),
    ],
)
def test_a_file_that_holds_no_landmarks_is_named(tmp_path: Path, name: str, content: str, said: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(FileError, match=said):
        read_landmarks(tmp_path / name)


# --- Landmarks.

MARKS = {"a": [0.0, 0.0, 0.0], "b": [0.1, 0.0, 0.0], "c": [0.0, 0.08, 0.0], "d": [0.02, 0.03, 0.06]}


@pytest.mark.parametrize("count", [3, 4])
def test_landmarks_give_the_pose_back(rng: np.random.Generator, count: int) -> None:
    pose = _pose(rng)
    body = dict(list(MARKS.items())[:count])
    fit = from_landmarks(body, {name: pose.apply(place) for name, place in reversed(body.items())})
    assert np.allclose(fit.pose.matrix, pose.matrix, rtol=0, atol=1e-12)
    assert fit.rms < 1e-12 and fit.unmatched == ()


def test_the_fit_is_of_least_squares_and_says_what_is_left(rng: np.random.Generator) -> None:
    pose = _pose(rng)
    seen = {name: pose.apply(place) + 2e-3 * rng.normal(size=3) for name, place in MARKS.items()}
    fit = from_landmarks(MARKS, seen)
    left = {name: np.linalg.norm(fit.pose.apply(place) - seen[name]) for name, place in MARKS.items()}
    assert fit.residuals == pytest.approx(left) and fit.rms == pytest.approx(
        np.sqrt(np.mean(np.square([*left.values()])))
    )
    centre = np.mean([*seen.values()], axis=0)
    rows = fit.pose.moved_jacobian(np.array([*MARKS.values()]), np.zeros(6), centre)
    residuals = np.concatenate([fit.pose.apply(place) - seen[name] for name, place in MARKS.items()])
    assert np.abs(rows.T @ residuals).max() < 1e-14  # square metres: stationary


def test_names_that_one_side_lacks_are_said() -> None:
    fit = from_landmarks(MARKS, {**MARKS, "e": [0, 0, 1]})
    assert fit.unmatched == ("e",)
    with pytest.raises(PoseError, match=r"got 2 \(a, b\); only one side has c, d, z"):
        from_landmarks(MARKS, {"a": MARKS["a"], "b": MARKS["b"], "z": MARKS["c"]})


def test_landmarks_in_a_line_are_refused() -> None:
    line = {name: np.array([1.0, 2.0, 3.0]) * i for i, name in enumerate("abc")}
    for pair in ((line, MARKS), (MARKS, line)):
        with pytest.raises(PoseError, match="in one line"):
            from_landmarks(*pair)


def test_a_mirror_is_never_fitted() -> None:
    mirrored = {name: np.array(place) * [-1, 1, 1] for name, place in MARKS.items()}
    fit = from_landmarks(MARKS, mirrored)
    assert np.linalg.det(fit.pose.rotation) == pytest.approx(1.0) and fit.rms > 0.01


def test_what_a_turn_of_the_camera_moves_is_told_on_the_bodys_axes(rng: np.random.Generator) -> None:
    """With the camera turned by any angle: as far as the camera sees points move, in the body's axes."""
    mean, points = _pose(rng), rng.standard_normal((40, 3))
    prior = PosePrior(mean, points.mean(axis=0), 0.1, 0.02)
    observed = SimpleNamespace(body=SimpleNamespace(points=points), nodes=np.arange(40))
    at = SimpleNamespace(observed=observed, rotation=mean.rotation)
    for change in 1e-6 * np.eye(6):
        seen = prior.pose(change).apply(points) - mean.apply(points)
        np.testing.assert_allclose(prior.moved(at, change, 1), seen @ mean.rotation, atol=1e-11)  # type: ignore[arg-type]
