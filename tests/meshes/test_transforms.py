"""Rigid motions of ITK and in layouts that say themselves. Matrices of ITK's are those that SimpleITK 2.5.7 gives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtwin.meshes.io import FileError
from softtwin.meshes.io.transforms import read_transform

MATRIX = np.eye(4)
MATRIX[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
MATRIX[:3, 3] = [10.0, -20.0, 30.0]
VERSOR = "0.0916432938695913 0.1832865877391826 0.2749298816087739"


def tfm(*parts: tuple[str, str, str]) -> str:
    return "#Insight Transform File V1.0\n" + "".join(
        f"#Transform {k}\nTransform: {kind}_double_3_3\n"
        + (f"Parameters: {values}\nFixedParameters: {fixed}\n" if kind != "CompositeTransform" else "")
        for k, (kind, values, fixed) in enumerate(parts)
    )


EULER = ("Euler3DTransform", "0.3 -0.5 0.9 1 2 3", "10 -20 30 0")
RIGID = ("VersorRigid3DTransform", f"{VERSOR} 4 5 6", "10 -20 30")
SHIFT = ("TranslationTransform", "1 2 3", "")


def about(rotation: np.ndarray, centre: list[float], shift: list[float]) -> np.ndarray:
    """The motion R (x - c) + c + t, metres."""
    matrix = np.eye(4)
    matrix[:3, :3], pivot = rotation, np.array(centre)
    matrix[:3, 3] = 1e-3 * (np.array(shift) + pivot - rotation @ pivot)
    return matrix


TURN = Rotation.from_rotvec(0.7 * np.array([1.0, 2.0, 3.0]) / np.sqrt(14)).as_matrix()
EULER_ZXY = Rotation.from_euler("ZXY", [0.9, 0.3, -0.5]).as_matrix()
EULER_ZYX = Rotation.from_euler("ZYX", [0.9, -0.5, 0.3]).as_matrix()
PIVOT = [10.0, -20.0, 30.0]
THREE = about(EULER_ZXY, PIVOT, [1, 2, 3]) @ about(TURN, PIVOT, [4, 5, 6]) @ about(np.eye(3), PIVOT, [1, 2, 3])
KNOWN = {
    "euler": (tfm(EULER), about(EULER_ZXY, PIVOT, [1, 2, 3])),
    "euler zyx": (tfm((EULER[0], EULER[1], "10 -20 30 1")), about(EULER_ZYX, PIVOT, [1, 2, 3])),
    "versor rigid": (tfm(RIGID), about(TURN, PIVOT, [4, 5, 6])),
    "versor": (tfm(("VersorTransform", VERSOR, "10 -20 30")), about(TURN, PIVOT, [0, 0, 0])),
    "similarity": (tfm(("Similarity3DTransform", f"{VERSOR} 4 5 6 1", "10 -20 30")), about(TURN, PIVOT, [4, 5, 6])),
    "quaternion": (tfm(("QuaternionRigidTransform", f"{VERSOR} {np.cos(0.35):.17g} 4 5 6", "10 -20 30")),
                   about(TURN, PIVOT, [4, 5, 6])),
    "translation": (tfm(SHIFT), about(np.eye(3), [0, 0, 0], [1, 2, 3])),
    "identity": (tfm(("IdentityTransform", "", "")), np.eye(4)),
    "composite": (tfm(("CompositeTransform", "", ""), EULER, RIGID, SHIFT), THREE),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_linear_transforms_of_itk(name: str, tmp_path: Path) -> None:
    content, wanted = KNOWN[name]
    (tmp_path / "pose.tfm").write_text(content)
    assert read_transform(tmp_path / "pose.tfm", "m") == pytest.approx(wanted, abs=1e-12)


def test_the_matrices_that_simpleitk_gives(tmp_path: Path) -> None:
    # TransformPoint of the origin and of the unit vectors, millimetres.
    euler = [
        [0.656495773502, -0.748340779681, -0.0948650454112, -7.6858219663],
        [0.599364376717, 0.593846684693, -0.536757355797, 3.9860106006],
        [0.458012710847, 0.295520206661, 0.838386643594, 9.17867771693],
    ]
    composite = [
        [0.129353984219, -0.965577128498, 0.225673116894, -19.1849679179],
        [0.952956023479, 0.0581364043659, -0.297481051166, -15.1194681382],
        [0.274121075589, 0.253536915279, 0.927672716268, 19.4035308549],
    ]
    for content, matrix in ((tfm(EULER), euler), (KNOWN["composite"][0], composite)):
        (tmp_path / "pose.tfm").write_text(content)
        found = read_transform(tmp_path / "pose.tfm")
        found[:3, 3] *= 1e3
        assert found[:3] == pytest.approx(np.array(matrix), abs=1e-9)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (tfm(("Similarity3DTransform", f"{VERSOR} 4 5 6 1.05", "0 0 0")), "Similarity3DTransform with a scale of 1.05"),
        (tfm(("ScaleTransform", "1 1 2", "0 0 0")), "expected one linear transform in space"),
        (tfm(("BSplineTransform", "0", "0")), "got 'BSplineTransform_double_3_3'"),
        (tfm(EULER, RIGID), "expected one linear transform in space, got Euler3DTransform"),
        (tfm(("Euler3DTransform", "1 2 3", "0 0 0")), "expected 6 parameters of Euler3DTransform, got 3"),
        (tfm(("VersorRigid3DTransform", "1 1 1 0 0 0", "0 0 0")), "expected a versor of length 1 at most"),
        (tfm(EULER).replace("_3_3", "_2_2"), "got 'Euler3DTransform_double_2_2'"),
        ("nothing\n", "got none"),
    ],
)
def test_other_transforms_are_refused_by_their_names(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "pose.tfm").write_text(content)
    with pytest.raises(FileError, match=said):
        read_transform(tmp_path / "pose.tfm")


def rows(matrix: np.ndarray, separator: str = " ") -> str:
    return "\n".join(separator.join(f"{value:.12f}" for value in row) for row in matrix) + "\n"


LAYOUTS = {
    "rows.txt": rows(MATRIX),
    "commas.csv": rows(MATRIX, ","),
    "semicolons.csv": rows(MATRIX, ";"),
    "decimal.txt": rows(MATRIX).replace(".", ","),
    "both.csv": rows(MATRIX, ";").replace(".", ","),
    "line.txt": rows(MATRIX.reshape(1, 16)),
    "comma-line.txt": rows(MATRIX.reshape(1, 16), ", "),
    "three.txt": rows(MATRIX[:3]),
    "turned.txt": rows(MATRIX.T),
    "comment.txt": "# from a tracker\n" + rows(MATRIX),
    "brackets.txt": str(MATRIX.tolist()).replace("], [", "],\n["),
    "rows.json": json.dumps(MATRIX.tolist()),
    "flat.json": json.dumps({"matrix": MATRIX.T.ravel().tolist()}),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_matrix_in_a_layout_that_says_itself(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(LAYOUTS[name])
    wanted = MATRIX.copy()
    wanted[:3, 3] /= 1000
    assert read_transform(tmp_path / name, "mm") == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("content", ["1 0 0\n0 1 0\n", "1 2 3 4\n1 2 3\n", "", "1 nan 0 0 " * 4, "a b c d"])
def test_numbers_that_are_no_matrix_are_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "pose.txt").write_text(content or "\n")
    with pytest.raises(FileError, match=r"pose\.txt: expected a matrix of 4 x 4 numbers"):
        read_transform(tmp_path / "pose.txt")


def test_files_of_itk_that_are_no_text_are_refused_with_advice(tmp_path: Path) -> None:
    (tmp_path / "pose.h5").write_bytes(b"\x89HDF\r\n")
    with pytest.raises(FileError, match=r"got suffix '\.h5'; save it as \.tfm"):
        read_transform(tmp_path / "pose.h5")
