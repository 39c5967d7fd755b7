"""Label maps as hospitals, TotalSegmentator and 3D Slicer write them: whole numbers in voxels, names, a place in space.

NIfTI stands in RAS in the unit that it names, NRRD in the space that it names; inside everything is LPS and metres.
TotalSegmentator writes names into an XML extension of NIfTI's header (its `--ml`), Slicer into fields of a `.seg.nrrd`.
"""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import nibabel
import nrrd
import numpy as np
from numpy.typing import NDArray

from ..body import Floats
from .common import SEGMENTATIONS, Axes, FileError, Unit, is_labelmap

_NRRD = ".nrrd"
_SLAB = 1 << 24  # voxels read at once: a file of doubles never stands whole in memory
_MOST_LABEL = 65535
_UNREADABLE: tuple[type[Exception], ...] = (
    nibabel.filebasedimages.ImageFileError, nrrd.NRRDError, EOFError, OSError, ValueError, zlib.error,
)  # fmt: skip
_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # from RAS to LPS
_NIFTI_UNITS: Mapping[str, tuple[float, Unit]] = {
    "mm": (1e-3, "mm"), "unknown": (1e-3, "mm"), "meter": (1.0, "m"), "micron": (1e-6, "mm"),
}  # fmt: skip
_NRRD_UNITS: Mapping[str, tuple[float, Unit]] = {
    "mm": (1e-3, "mm"), "": (1e-3, "mm"), "cm": (1e-2, "cm"), "m": (1.0, "m"), "um": (1e-6, "mm"),
}  # fmt: skip
_SPACES: Mapping[str, Axes] = {
    "left-posterior-superior": "lps", "lps": "lps", "right-anterior-superior": "ras", "ras": "ras",
}  # fmt: skip
_FORMS_AGREE = 1e-3  # metres between the places that the two forms of a NIfTI header give a voxel


@dataclass(frozen=True, eq=False)
class LabelMap:
    """The voxels of one file.

    Args:
        path: the file.
        labels: whole numbers, 0 for nothing, (layers, i, j, k); only a `.seg.nrrd` has more than one layer.
        to_lps: from voxel numbers to the voxel's middle, (4, 4), LPS, metres.
        unit: unit of length that the file is in.
        axes: axes that the file is in; None where it says none.
        names: layer and label by name; empty where the file has no names.
        notes: what may be a mistake of the file, one line each.
    """

    path: Path
    labels: NDArray[Any]
    to_lps: Floats
    unit: Unit
    axes: Axes | None
    names: Mapping[str, tuple[int, int]]
    notes: tuple[str, ...] = ()


def read_labelmap(path: str | Path, axes: Axes | None = None) -> LabelMap:
    """The voxels of a NIfTI or NRRD file.

    Args:
        path: `.nii`, `.nii.gz`, `.nrrd` or `.seg.nrrd` file.
        axes: what axes an NRRD file is in that does not say so; where it does, the file's own are taken.

    Raises:
        FileError: missing, damaged or unknown file, not three axes in space, no whole numbers, or no place in space.
    """
    with _reading(path := Path(path)):
        return _read_nrrd(path, axes) if path.suffix.lower() == _NRRD else _read_nifti(path)


def stated_frame(path: str | Path) -> tuple[Unit, Axes | None]:
    """Unit and axes that a file says it is in, from its header alone; None for no axes.

    Args:
        path: as for `read_labelmap`.

    Raises:
        FileError: as `read_labelmap`.
    """
    with _reading(path := Path(path)):
        if path.suffix.lower() == _NRRD:
            header = nrrd.read_header(str(path))
            return _nrrd_unit(path, header)[1], _nrrd_axes(path, header)
        return _nifti_unit(path, nibabel.load(path).header)[1], "ras"


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Failures of the libraries as ours; both warn of fields that no one here reads."""
    if not path.is_file():
        raise FileError(f"{path}: no such file.")
    if not is_labelmap(path):
        raise FileError(f"{path}: expected a segmentation ({', '.join(SEGMENTATIONS)}), got suffix {path.suffix!r}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except FileError:
        raise
    except _UNREADABLE as error:
        raise FileError(f"{path}: could not be read; the file may be truncated or damaged ({error}).") from error


def _read_nifti(path: Path) -> LabelMap:
    image: Any = nibabel.load(path, keep_file_open=True)  # else each slab is unpacked from the file's beginning
    shape = image.shape
    if len(shape) < 3 or any(count != 1 for count in shape[3:]):
        raise FileError(f"{path}: expected one volume of voxels with three axes, got shape {shape}.")
    scale, unit = _nifti_unit(path, image.header)
    labels = _gathered(path, shape[:3], _slabs(image.dataobj, shape))
    to_lps = _checked_place(path, np.diag([scale, scale, scale, 1.0]) @ _TURN @ image.affine)
    return LabelMap(path, labels[None], to_lps, unit, "ras", _nifti_names(image.header), _nifti_notes(image, scale))


def _slabs(voxels: Any, shape: tuple[int, ...]) -> Iterator[NDArray[Any]]:
    step = max(1, _SLAB // (shape[0] * shape[1]))
    for start in range(0, shape[2], step):
        yield np.asanyarray(voxels[:, :, start : start + step]).reshape(*shape[:2], -1)


def _gathered(path: Path, shape: tuple[int, ...], slabs: Iterator[NDArray[Any]]) -> NDArray[Any]:
    """Slabs along the last axis as one array of small whole numbers."""
    labels, at = np.empty(shape, dtype=np.uint8, order="F"), 0
    for slab in slabs:
        values = _whole(path, slab)
        if values.dtype.itemsize > labels.dtype.itemsize:
            labels = labels.astype(values.dtype)
        labels[..., at : at + slab.shape[-1]] = values
        at += slab.shape[-1]
    return labels


def _whole(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    """Labels as the smallest whole numbers that hold them.

    Raises:
        FileError: they are no labels.
    """
    if values.dtype.kind not in "iufb":
        raise FileError(f"{path}: expected whole numbers in its voxels, got {values.dtype}.")
    if values.dtype.kind == "f" and not np.array_equal(values, np.rint(values)):
        strange = values[values != np.rint(values)]
        raise FileError(
            f"{path}: expected a label, a whole number, in each voxel, got {strange.ravel()[0]:.4g}; is it a map of "
            "probabilities, a resampled segmentation or the image itself?"
        )
    low, high = float(values.min(initial=0)), float(values.max(initial=0))
    if low < 0 or high > _MOST_LABEL:
        raise FileError(f"{path}: expected labels in 0..{_MOST_LABEL}, got {low:g}..{high:g}; is it the image itself?")
    return values.astype(np.uint8 if high < 256 else np.uint16)


def _nifti_unit(path: Path, header: Any) -> tuple[float, Unit]:
    named = header.get_xyzt_units()[0]
    if named not in _NIFTI_UNITS:
        raise FileError(f"{path}: expected a unit of length among {', '.join(_NIFTI_UNITS)}, got {named!r}.")
    return _NIFTI_UNITS[named]


def _nifti_notes(image: Any, scale: float) -> tuple[str, ...]:
    sform, qform = image.header.get_sform(coded=True), image.header.get_qform(coded=True)
    if not sform[1] and not qform[1]:
        return (
            f"warning: {image.get_filename()} does not say where it lies (sform and qform codes are 0): its left and "
            "right may be the other way round",
        )
    if sform[1] and qform[1]:
        corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * [*image.shape[:3], 1]
        apart = scale * np.abs(corners @ (sform[0] - qform[0]).T).max()
        if apart > _FORMS_AGREE:
            return (
                f"warning: {image.get_filename()} says twice where it lies, {1e3 * apart:.3g} mm apart; its sform is "
                "taken, other programs may take the qform",
            )
    return ()


def _nifti_names(header: Any) -> dict[str, tuple[int, int]]:
    """Names from TotalSegmentator's extension (Caret's XML: a Label with a Key holds its name)."""
    found: dict[str, tuple[int, int]] = {}
    for extension in header.extensions:
        content = extension.get_content()
        text = content if isinstance(content, bytes) else str(content).encode()
        begin = text.find(b"<CaretExtension")
        if begin < 0:
            continue
        try:
            tree = ElementTree.fromstring(text[begin:].rstrip(b"\0 \n\r\t"))
        except ElementTree.ParseError:
            continue
        for label in tree.iter("Label"):
            if label.get("Key", "").isdigit() and (label.text or "").strip():
                found[(label.text or "").strip()] = (0, int(label.get("Key", "0")))
    return {name: place for name, place in found.items() if place[1] > 0}


def _read_nrrd(path: Path, axes: Axes | None) -> LabelMap:
    voxels, header = nrrd.read(str(path))
    directions = _nrrd_directions(path, header)
    spatial = np.flatnonzero(np.isfinite(directions).all(axis=1))
    if len(spatial) != 3 or voxels.ndim not in (3, 4):
        raise FileError(
            f"{path}: expected voxels with three axes in space, and one of layers at most, got shape {voxels.shape} "
            f"with {len(spatial)} axes in space."
        )
    layered = np.moveaxis(voxels, spatial, (-3, -2, -1)).reshape(-1, *np.array(voxels.shape)[spatial])
    stated = _nrrd_axes(path, header) or axes
    if stated is None:
        raise FileError(
            f"{path}: expected a space (left-posterior-superior or right-anterior-superior), the file says none; say "
            "it with --frame lps or --frame ras."
        )
    scale, unit = _nrrd_unit(path, header)
    place = np.eye(4)
    place[:3, :3] = scale * directions[spatial].T
    place[:3, 3] = scale * np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    to_lps = _checked_place(path, _TURN @ place if stated == "ras" else place)
    names = _segment_names(path, header, len(layered))
    return LabelMap(path, np.stack([_whole(path, layer) for layer in layered]), to_lps, unit, stated, names)


def _nrrd_directions(path: Path, header: Mapping[str, Any]) -> Floats:
    if "space directions" in header:
        rows = [np.full(3, np.nan) if row is None else row for row in header["space directions"]]
        return np.asarray(rows, dtype=np.float64).reshape(-1, 3)
    if "spacings" in header and header["dimension"] == 3:
        return np.diag(np.asarray(header["spacings"], dtype=np.float64))
    raise FileError(f"{path}: expected where its voxels lie (space directions), the file does not say it.")


def _nrrd_axes(path: Path, header: Mapping[str, Any]) -> Axes | None:
    named = header.get("space", "")
    if not named:
        return None
    if named.lower() not in _SPACES:
        raise FileError(
            f"{path}: expected the space left-posterior-superior or right-anterior-superior, got {named!r}."
        )
    return _SPACES[named.lower()]


def _nrrd_unit(path: Path, header: Mapping[str, Any]) -> tuple[float, Unit]:
    named = {str(word).strip('" ') for word in header.get("space units", [""])} or {""}
    if len(named) != 1 or not named <= set(_NRRD_UNITS):
        raise FileError(f"{path}: expected one of the units mm, cm, m and um for all axes, got {sorted(named)}.")
    return _NRRD_UNITS[named.pop()]


def _segment_names(path: Path, header: Mapping[str, Any], layers: int) -> dict[str, tuple[int, int]]:
    """Layer and label of Slicer's segments; older files have a layer for each, and no word on it."""
    found: dict[str, tuple[int, int]] = {}
    for field, name in header.items():
        number = re.fullmatch(r"Segment(\d+)_Name", field)
        if number is None:
            continue
        default = int(number.group(1)) if layers > 1 else 0
        layer = int(header.get(f"Segment{number.group(1)}_Layer", default))
        value = int(header.get(f"Segment{number.group(1)}_LabelValue", 1))
        if not 0 <= layer < layers:
            raise FileError(f"{path}: expected the layer of segment {name!r} in 0..{layers - 1}, got {layer}.")
        if name in found:
            raise FileError(f"{path}: expected each name once, got two segments {name!r}; rename one.")
        found[str(name)] = (layer, value)
    return found


def _checked_place(path: Path, to_lps: Floats) -> Floats:
    sizes = np.linalg.norm(to_lps[:3, :3], axis=0)
    if not np.isfinite(to_lps).all() or not abs(np.linalg.det(to_lps[:3, :3])) > 1e-3 * np.prod(sizes):
        raise FileError(f"{path}: expected axes of voxels that span space, got {to_lps[:3, :3].round(6).tolist()}.")
    return to_lps
