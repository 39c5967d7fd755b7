"""Label maps as hospitals, TotalSegmentator and 3D Slicer write them: whole numbers in voxels, names, a place.

NIfTI (by nibabel) stands in RAS in the unit that it names, NRRD (by pynrrd) in the space that it names, MetaImage in
LPS and millimetres; inside everything is LPS and metres. TotalSegmentator writes names into an XML extension of NIfTI's
header (its `--ml`), Slicer into fields of a `.seg.nrrd`. SimpleITK would read all three formats, for 270 MB more, and
knows neither TotalSegmentator's names nor the second place that a NIfTI header may give; MetaImage is read here.
"""

from __future__ import annotations

import gzip
import re
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import nibabel
import nrrd
import numpy as np
from numpy.typing import NDArray

from ..body import Floats
from .common import METRES, SEGMENTATIONS, Axes, FileError, Unit, is_labelmap, spelled_unit

_NRRD, _META = (".nrrd", ".nhdr"), (".mha", ".mhd")
_SLAB = 1 << 24  # voxels read at once: a file of doubles never stands whole in memory
_MOST_LABEL = 65535
_MOST_FIELDS = 1000  # of a header
_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # from RAS to LPS
# NRRD names a space by the ends of its axes; each is the first, second or third here.
_ENDS: Mapping[str, tuple[int, float]] = {
    "left": (0, 1.0), "right": (0, -1.0), "posterior": (1, 1.0), "anterior": (1, -1.0),
    "superior": (2, 1.0), "inferior": (2, -1.0),
}  # fmt: skip
_WHOLE = 1e-3  # how far a label may be from a whole number: slopes and resampling in single precision leave less
_META_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
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
        names: name by layer and label; empty where the file has no names.
        notes: what may be a mistake of the file, one line each.
        scale: metres in the unit that its numbers are in.
    """

    path: Path
    labels: NDArray[Any]
    to_lps: Floats
    unit: Unit
    axes: Axes | None
    names: Mapping[tuple[int, int], str]
    notes: tuple[str, ...] = ()
    scale: float = 1e-3


def read_labelmap(path: str | Path, axes: Axes | None = None, unit: Unit | None = None) -> LabelMap:
    """The voxels of a NIfTI, NRRD or MetaImage file.

    Args:
        path: `.nii`, `.nii.gz`, `.nrrd`, `.seg.nrrd`, `.nhdr`, `.mha` or `.mhd` file.
        axes: what axes an NRRD file is in that does not say so; where it does, the file's own are taken.
        unit: of length, in place of what the file says, which a note names.

    Raises:
        FileError: missing, damaged or unknown file, not three axes in space, no whole numbers, or no place in space.
    """
    with _reading(path := Path(path)):
        found = _reader(path)(path, axes)
    return found if unit is None or found.scale == METRES[unit] else _in_unit(found, unit)


def _in_unit(volume: LabelMap, unit: Unit) -> LabelMap:
    place = volume.to_lps.copy()
    place[:3] *= METRES[unit] / volume.scale
    said = next((name for name, metres in METRES.items() if metres == volume.scale), "micrometres")
    note = f"warning: {volume.path} says that it is in {said}; {unit} was taken, as you say"
    return replace(volume, to_lps=place, unit=unit, scale=METRES[unit], notes=(*volume.notes, note))


def _reader(path: Path) -> Callable[[Path, Axes | None], LabelMap]:
    suffix = path.suffix.lower()
    return _read_nrrd if suffix in _NRRD else _read_meta if suffix in _META else _read_nifti


def stated_frame(path: str | Path) -> tuple[Unit, Axes | None, float]:
    """What a file says it is in, from its header alone: unit of coordinates beside it, axes (None for none), its scale.

    The scale is metres in the unit of its own numbers, which are micrometres at times.

    Args:
        path: as for `read_labelmap`.

    Raises:
        FileError: as `read_labelmap`.
    """
    with _reading(path := Path(path)):
        if path.suffix.lower() in _NRRD:
            header = nrrd.read_header(str(path))
            space = _nrrd_space(path, header)
            scale, unit = _nrrd_unit(path, header)
            return unit, None if space is None else _axes_beside(space), scale
        if path.suffix.lower() in _META:
            _meta_header(path)
            return "mm", "lps", METRES["mm"]
        scale, unit = _nifti_unit(path, nibabel.load(path).header)
        return unit, "ras", scale


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
    except Exception as error:  # each library has its own, and none names them all
        raise FileError(f"{path}: could not be read; the file may be truncated or damaged ({error}).") from error


def _read_nifti(path: Path, axes: Axes | None) -> LabelMap:
    image: Any = nibabel.load(path, keep_file_open=True)  # else each slab is unpacked from the file's beginning
    shape = image.shape
    if len(shape) < 3 or any(count != 1 for count in shape[3:]):
        raise FileError(f"{path}: expected one volume of voxels with three axes, got shape {shape}.")
    scale, unit = _nifti_unit(path, image.header)
    labels = _gathered(path, shape[:3], _slabs(image.dataobj, shape))
    _check_end(path, image)
    to_lps = _checked_place(path, np.diag([scale, scale, scale, 1.0]) @ _TURN @ image.affine)
    names, notes = _nifti_names(image.header), _nifti_notes(image, scale)
    return LabelMap(path, labels[None], to_lps, unit, "ras", names, notes, scale)


def _check_end(path: Path, image: Any) -> None:
    """Refuse a file whose checksum is wrong, or that is longer than its voxels: something in it moved."""
    opened = gzip.open if path.suffix.lower() == ".gz" else open
    size = 0
    with opened(path, "rb") as file:
        while part := file.read(_SLAB):
            size += len(part)
    wanted = image.dataobj.offset + int(np.prod(image.shape)) * image.get_data_dtype().itemsize
    if size != wanted:
        raise FileError(f"{path}: expected {wanted} bytes for its voxels, got {size}; the file may be damaged.")


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
    if values.dtype.kind == "f":
        whole = np.rint(values)
        strange = ~(np.abs(values - whole) <= _WHOLE)  # NaN is strange, too
        if strange.any():
            raise FileError(
                f"{path}: expected a label, a whole number, in each voxel, got {values[strange].ravel()[0]:.4g}; is it "
                "a map of probabilities, a resampled segmentation or the image itself?"
            )
        values = whole
    low, high = float(values.min(initial=0)), float(values.max(initial=0))
    if low < 0 or high > _MOST_LABEL:
        raise FileError(f"{path}: expected labels in 0..{_MOST_LABEL}, got {low:g}..{high:g}; is it the image itself?")
    return values.astype(np.uint8 if high < 256 else np.uint16)


def _nifti_unit(path: Path, header: Any) -> tuple[float, Unit]:
    named = header.get_xyzt_units()[0]
    found = spelled_unit("mm" if named == "unknown" else named)
    if found is None:
        raise FileError(f"{path}: expected a unit of length (metre, mm, micron), got {named!r}.")
    return found


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


def _nifti_names(header: Any) -> dict[tuple[int, int], str]:
    """Names from TotalSegmentator's extension (Caret's XML: a Label with a Key holds its name)."""
    found: dict[tuple[int, int], str] = {}
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
                found[(0, int(label.get("Key", "0")))] = (label.text or "").strip()
    return {place: name for place, name in found.items() if place[1] > 0}


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
    space = _nrrd_space(path, header)
    if space is None and axes is None:
        raise FileError(
            f"{path}: expected a space (left-posterior-superior or right-anterior-superior), the file says none; say "
            "it with --frame lps or --frame ras."
        )
    if space is None:
        space = _TURN.diagonal()[:3] if axes == "ras" else np.ones(3)
    scale, unit = _nrrd_unit(path, header)
    place = np.eye(4)
    place[:3, :3] = scale * directions[spatial].T
    place[:3, 3] = scale * np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    to_lps = _checked_place(path, np.diag([*space, 1.0]) @ place)
    names = _segment_names(path, header, len(layered))
    labels = np.stack([_whole(path, layer) for layer in layered])
    return LabelMap(path, labels, to_lps, unit, _axes_beside(space), names, _space_notes(path, header), scale)


def _nrrd_directions(path: Path, header: Mapping[str, Any]) -> Floats:
    if "space directions" in header:
        rows = [np.full(3, np.nan) if row is None else row for row in header["space directions"]]
        return np.asarray(rows, dtype=np.float64).reshape(-1, 3)
    if "spacings" in header and header["dimension"] == 3:
        return np.diag(np.asarray(header["spacings"], dtype=np.float64))
    raise FileError(f"{path}: expected where its voxels lie (space directions), the file does not say it.")


def _nrrd_space(path: Path, header: Mapping[str, Any]) -> Floats | None:
    """Sign of each axis from the file's space to LPS, (3,); None where it says no space.

    Raises:
        FileError: a space without left and right, or with its axes in another order.
    """
    named = str(header.get("space", "")).lower()
    if not named:
        return None
    words = named.removesuffix("-time").split("-")
    if len(words) == 1 and len(named) in (3, 4):
        letters = named[:3] if named.endswith("t") or len(named) == 3 else "???"
        words = [next((word for word in _ENDS if word[0] == letter), "") for letter in letters]
    ends = [_ENDS.get(word) for word in words]
    if len(ends) != 3 or any(end is None or end[0] != axis for axis, end in enumerate(ends)):
        raise FileError(
            f"{path}: expected the space left-posterior-superior, right-anterior-superior or another sign of these "
            f"axes, got {named!r}."
        )
    return np.array([end[1] for end in ends if end is not None])


def _axes_beside(space: Floats) -> Axes:
    """Axes in which coordinates beside a file are taken: its own, or LPS where its own are neither RAS nor LPS."""
    return "ras" if np.array_equal(space, _TURN.diagonal()[:3]) else "lps"


def _space_notes(path: Path, header: Mapping[str, Any]) -> tuple[str, ...]:
    space = _nrrd_space(path, header)
    if space is None or np.array_equal(space, np.ones(3)) or _axes_beside(space) == "ras":
        return ()
    return (f"segmentation: {path} is in {header['space']}; coordinates beside it are taken in LPS",)


def _nrrd_unit(path: Path, header: Mapping[str, Any]) -> tuple[float, Unit]:
    named = {str(word).strip("\"' ") for word in header.get("space units", [""])} or {""}
    found = spelled_unit(min(named) or "mm") if len(named) == 1 else None
    if found is None:
        raise FileError(f"{path}: expected one of the units mm, cm, m and um for all axes, got {sorted(named)}.")
    return found


def _read_meta(path: Path, axes: Axes | None) -> LabelMap:
    """MetaImage, as ITK writes it: millimetres and LPS (itkMetaImageIO; AnatomicalOrientation only describes it)."""
    fields, data = _meta_header(path)
    shape = _meta_numbers(path, fields, "DimSize", 3).astype(int)
    kind = _META_TYPES.get(fields.get("ElementType", ""))
    if kind is None or int(fields.get("ElementNumberOfChannels", "1")) != 1 or (shape < 1).any():
        raise FileError(f"{path}: expected one number of a known type in each voxel, got "
                        f"{fields.get('ElementType')} x {fields.get('ElementNumberOfChannels', '1')}.")  # fmt: skip
    is_big = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "False")).lower() == "true"
    if fields.get("BinaryData", "True").lower() != "true":
        raise FileError(f"{path}: expected binary voxels, got text; save it with binary data.")
    if fields.get("CompressedData", "False").lower() == "true":
        data = zlib.decompress(data)
    wanted = int(shape.prod()) * np.dtype(kind).itemsize
    if len(data) < wanted:
        raise FileError(f"{path}: the file is truncated: expected {wanted} bytes of voxels, got {len(data)}.")
    voxels = np.frombuffer(data, (">" if is_big else "<") + kind, int(shape.prod())).reshape(shape, order="F")
    rotation = _meta_numbers(path, fields, "TransformMatrix", 9, np.eye(3).ravel(), ("Rotation", "Orientation"))
    place = np.eye(4)
    sizes = _meta_numbers(path, fields, "ElementSpacing", 3, np.ones(3), ("ElementSize",))
    place[:3, :3] = rotation.reshape(3, 3).T * sizes  # ITK writes the direction of each axis as a row
    place[:3, 3] = _meta_numbers(path, fields, "Offset", 3, np.zeros(3), ("Origin", "Position"))
    place[:3] *= METRES["mm"]
    return LabelMap(path, _whole(path, voxels)[None], _checked_place(path, place), "mm", "lps", {})


def _meta_numbers(
    path: Path,
    fields: Mapping[str, str],
    name: str,
    count: int,
    default: Floats | None = None,
    other: Sequence[str] = (),
) -> Floats:
    text = next((fields[known] for known in (name, *other) if known in fields), None)
    if text is None and default is not None:
        return default
    numbers = np.array((text or "").split(), dtype=np.float64)
    if numbers.shape != (count,):
        raise FileError(f"{path}: expected {count} numbers as {name}, got {text!r}.")
    return numbers


def _meta_header(path: Path) -> tuple[dict[str, str], bytes]:
    """Fields of a header, and the bytes behind it or in the file that it names."""
    content, at, fields = path.read_bytes(), 0, dict[str, str]()
    while "ElementDataFile" not in fields:
        end = content.find(b"\n", at)
        key, equals, value = content[at : end if end >= 0 else None].decode("latin-1").partition("=")
        if (end < 0 and not equals) or not equals or len(fields) > _MOST_FIELDS:
            raise FileError(f"{path}: expected a header of MetaImage that ends with ElementDataFile.")
        fields[key.strip()] = value.strip()
        at = end + 1 if end >= 0 else len(content)
    if fields.get("ObjectType", "Image") != "Image" or fields.get("NDims", "3") != "3":
        raise FileError(f"{path}: expected an image of three axes, got {fields.get('ObjectType')} of "
                        f"{fields.get('NDims')}.")  # fmt: skip
    name = fields["ElementDataFile"]
    if name.upper() == "LOCAL":
        return fields, content[at:]
    if name.upper() == "LIST" or "%" in name:
        raise FileError(f"{path}: expected its voxels in one file, got {name!r}; save it as .mha.")
    beside = path.parent / Path(name.replace("\\", "/")).name
    if not beside.is_file():
        raise FileError(f"{path}: expected its voxels in {beside}, which is not there.")
    return fields, beside.read_bytes()


def _segment_names(path: Path, header: Mapping[str, Any], layers: int) -> dict[tuple[int, int], str]:
    """Layer and label of Slicer's segments; older files have a layer for each, and no word on it."""
    found: dict[tuple[int, int], str] = {}
    for field, name in header.items():
        number = re.fullmatch(r"Segment(\d+)_Name", field)
        if number is None:
            continue
        default = int(number.group(1)) if layers > 1 else 0
        layer = int(header.get(f"Segment{number.group(1)}_Layer", default))
        value = int(header.get(f"Segment{number.group(1)}_LabelValue", 1))
        if not 0 <= layer < layers:
            raise FileError(f"{path}: expected the layer of segment {name!r} in 0..{layers - 1}, got {layer}.")
        found[(layer, value)] = str(name)
    return found


def _checked_place(path: Path, to_lps: Floats) -> Floats:
    sizes = np.linalg.norm(to_lps[:3, :3], axis=0)
    if not np.isfinite(to_lps).all() or not abs(np.linalg.det(to_lps[:3, :3])) > 1e-3 * np.prod(sizes):
        raise FileError(f"{path}: expected axes of voxels that span space, got {to_lps[:3, :3].round(6).tolist()}.")
    return to_lps
