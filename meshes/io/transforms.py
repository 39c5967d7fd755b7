"""Rigid motions in files: 4 x 4 numbers in any layout that says itself, and linear transforms of ITK and 3D Slicer."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import Floats
from .common import FileError, Unit, existing, in_metres
from .formats.numbers import numbers

SUFFIXES = (".csv", ".json", ".npy", ".tfm", ".txt")
_ROUND = 1e-6  # of a last row or column of 0 0 0 1
_UNSCALED = 1e-3  # as far a similarity may be from a rigid motion, as in `Pose`
_LAST = np.array([0.0, 0.0, 0.0, 1.0])


def read_transform(path: str | Path, unit: Unit = "m") -> Floats:
    """The homogeneous matrix of a file, (4, 4), metres, with 0 0 0 1 as its last row.

    A matrix of numbers is taken as it is: rows, sixteen numbers in a line, three rows of four, or transposed, which its
    last column of 0 0 0 1 says (a rotation about the origin looks the same in both, and is taken as rows). A `.tfm` is
    in millimetres and LPS, and leads from the fixed image to the moving one.

    Args:
        path: TXT, CSV, NPY or JSON (rows, or an object with `matrix`), or ITK's `.tfm`.
        unit: of the translation in files other than `.tfm`.

    Raises:
        FileError: missing or damaged file, another suffix, another kind of transform, or a scale.
    """
    path = existing(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        advice = "; save it as .tfm" if suffix in (".h5", ".mat", ".hdf5", ".xfm") else ""
        raise FileError(f"{path}: expected a matrix as {', '.join(SUFFIXES)}, got suffix {path.suffix!r}{advice}.")
    try:
        if suffix == ".tfm":
            matrix, unit = _itk_matrix(path), "mm"
        else:
            matrix = _laid_out(_content(path, suffix))
    except FileError:
        raise
    except Exception as error:  # of the readers of JSON and NPY, too
        raise FileError(f"{path}: expected a matrix of 4 x 4 numbers ({error}).") from error
    matrix[:3, 3] = in_metres(matrix[:3, 3], unit)
    return matrix


def _content(path: Path, suffix: str) -> Any:
    if suffix == ".npy":
        return np.load(path, allow_pickle=False)
    text = path.read_text(encoding="utf-8-sig")
    if suffix == ".json":
        found = json.loads(text)
        return found["matrix"] if isinstance(found, dict) else found
    rows = [re.sub(r"[\[\]]", " ", line.partition("#")[0]) for line in text.splitlines()]
    words = [word for row in rows for word in row.split()]
    if ";" in text:
        split = [re.split(r"[;\s]+", row.strip("; \t")) for row in rows]
    elif len(words) in (12, 16) and all("," not in (word[0], word[-1]) for word in words):
        split = [row.split() for row in rows]  # commas in numbers are decimal commas
    else:
        split = [re.split(r"[,\s]+", row.strip(", \t")) for row in rows]
    split = [row for row in split if row != [""] and row]
    widths = {len(row) for row in split}
    if len(widths) != 1:
        raise ValueError(f"rows of {' and '.join(map(str, sorted(widths))) or 'no'} numbers")
    return numbers([word for row in split for word in row]).reshape(-1, *widths)


def _laid_out(content: Any) -> Floats:
    """The matrix of numbers in any layout that says itself."""
    array = np.array(content, dtype=np.float64)
    if array.size == 16 and array.shape != (4, 4):
        array = array.reshape(4, 4)
    elif array.size == 12 and array.shape in ((3, 4), (12,), (1, 12)):
        array = np.vstack([array.reshape(3, 4), _LAST])
    if array.shape != (4, 4):
        raise ValueError(f"got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("got NaN or infinity")
    if np.abs(array[3] - _LAST).max() > _ROUND and np.abs(array[:, 3] - _LAST).max() <= _ROUND:
        array = array.T.copy()
    return array


# --- ITK.


def _itk_matrix(path: Path) -> Floats:
    """The matrix of the linear transform of a file, millimetres; of a composite the product of its parts."""
    text = path.read_text(encoding="utf-8", errors="replace")
    parts, fields = list[dict[str, str]](), dict[str, str]()
    for line in text.splitlines():
        key, colon, value = line.partition(":")
        if not colon or line.startswith("#"):
            continue
        if key.strip() == "Transform":
            parts.append(fields := {})
        fields[key.strip()] = value.strip()
    kinds = [part.get("Transform", "") for part in parts]
    is_composite = bool(kinds) and kinds[0].startswith("CompositeTransform")
    linear = parts[1:] if is_composite else parts
    if not linear or (len(linear) > 1 and not is_composite):
        raise FileError(f"{path}: expected one linear transform in space, got {', '.join(kinds) or 'none'}; "
                        "save it as a linear transform, or give its 4 x 4 matrix as text.")  # fmt: skip
    whole = np.eye(4)
    for part in linear:  # ITK applies the last one first
        whole = whole @ _linear(path, part)
    return whole


def _linear(path: Path, part: dict[str, str]) -> Floats:
    kind = part.get("Transform", "")
    name = kind.split("_")[0]
    values = numbers(part.get("Parameters", "").split())
    centre = numbers(part.get("FixedParameters", "").split())
    known = _LINEAR.get(name)
    if known is None or not kind.endswith("_3_3"):
        raise FileError(f"{path}: expected one linear transform in space ({', '.join(sorted(_LINEAR))}), got {kind!r}; "
                        "save it as a linear transform, or give its 4 x 4 matrix as text.")  # fmt: skip
    if len(values) != known:
        raise ValueError(f"expected {known} parameters of {name}, got {len(values)}")
    scale = float(values[6]) if name == "Similarity3DTransform" else 1.0
    if abs(scale - 1) > _UNSCALED:
        raise FileError(f"{path}: expected a rigid motion, got {name} with a scale of {scale:g}; a pose has none.")
    matrix = np.eye(4)
    if name == "IdentityTransform":
        return matrix
    if name == "TranslationTransform":
        matrix[:3, 3] = values
        return matrix
    matrix[:3, :3], shift = scale * _rotation(name, values, centre), _shift(name, values)
    pivot = centre[:3] if len(centre) >= 3 else np.zeros(3)
    matrix[:3, 3] = shift + pivot - matrix[:3, :3] @ pivot
    return matrix


_LINEAR = {
    "AffineTransform": 12, "MatrixOffsetTransformBase": 12, "Rigid3DTransform": 12, "Euler3DTransform": 6,
    "VersorRigid3DTransform": 6, "VersorTransform": 3, "QuaternionRigidTransform": 7, "Similarity3DTransform": 7,
    "TranslationTransform": 3, "IdentityTransform": 0,
}  # fmt: skip


def _rotation(name: str, values: Floats, centre: Floats) -> Floats:
    if name == "Euler3DTransform":
        # R = Rz Rx Ry, or Rz Ry Rx where the fourth fixed parameter says so (itkEuler3DTransform.hxx, ComputeMatrix).
        is_zyx = len(centre) > 3 and centre[3] != 0
        angles = values[[2, 1, 0]] if is_zyx else values[[2, 0, 1]]
        return np.asarray(Rotation.from_euler("ZYX" if is_zyx else "ZXY", angles).as_matrix())
    if name in ("VersorRigid3DTransform", "VersorTransform", "Similarity3DTransform"):
        square = float(values[:3] @ values[:3])
        if square > 1 + _ROUND:
            raise ValueError(f"expected a versor of length 1 at most, got {np.sqrt(square):.6g}")
        return np.asarray(Rotation.from_quat([*values[:3], np.sqrt(max(0.0, 1 - square))]).as_matrix())
    if name == "QuaternionRigidTransform":
        return np.asarray(Rotation.from_quat(values[:4]).as_matrix())
    return values[:9].reshape(3, 3)


def _shift(name: str, values: Floats) -> Floats:
    if name == "VersorTransform":
        return np.zeros(3)
    return (
        values[3:6] if name in ("Euler3DTransform", "VersorRigid3DTransform", "Similarity3DTransform") else values[-3:]
    )
