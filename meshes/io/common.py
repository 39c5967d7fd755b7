"""What all readers share: units and axes, the errors, which files are passed over, what a file states about itself."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..body import Floats

Unit = Literal["m", "cm", "mm"]
Axes = Literal["lps", "ras"]
UNITS: tuple[str, ...] = get_args(Unit)
AXES: tuple[str, ...] = get_args(Axes)
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
LARGEST, SMALLEST = 1.0, 5e-3  # metres: an organ outside these was read in the wrong unit
_USUAL = 0.15  # metres: where two units fit, the one in which the organ is nearer to this
SEGMENTATIONS = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])  # from RAS to LPS and back
HEAD = 2048  # bytes in which a file says what it is
_SPELLINGS: Mapping[str, tuple[float, Unit]] = {
    **dict.fromkeys(("m", "meter", "metre"), (1.0, "m")),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), (1e-2, "cm")),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), (1e-3, "mm")),
    # Micro sign, Greek mu, and what is typed for them; coordinates beside such a file are in millimetres.
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "micron", "micrometer", "micrometre"), (1e-6, "mm")),
}


class FileError(ValueError):
    """A file that cannot be used: the message names it, what was expected and what came."""


class ContentError(FileError):
    """A file that is there and was read, but holds no points, or numbers that are not finite."""


class UnitWarning(UserWarning):
    """A file whose size fits no organ: it was probably read in the wrong unit."""


def in_metres(lengths: ArrayLike, unit: Unit) -> Floats:
    """Lengths in metres.

    Args:
        lengths: numbers of any shape.
        unit: theirs.
    """
    # Dividing by a whole number rounds once; multiplying by 0.001 would round twice.
    return np.asarray(lengths, dtype=np.float64) / round(1 / METRES[unit])


def spelled_unit(word: str) -> tuple[float, Unit] | None:
    """Metres in a unit of length as programs spell it, and the unit of coordinates beside it; None for another word.

    Args:
        word: in any case, singular or plural, with blanks or quotes around it.
    """
    plain = word.strip("\"' ").lower()
    return _SPELLINGS.get(plain) or _SPELLINGS.get(plain.removesuffix("s"))


def is_labelmap(path: str | Path) -> bool:
    """Whether a file is one of segmented voxels, by its name (`labelmap.py` reads it).

    Args:
        path: the file.
    """
    return Path(path).name.lower().endswith(SEGMENTATIONS)


def is_segmentation(path: str | Path) -> bool:
    """Whether something may be a segmentation: a label map by its name, or a folder that holds some.

    Args:
        path: file or folder.
    """
    return bool(structure_files(path)) if Path(path).is_dir() else is_labelmap(path)


def is_companion(path: str | Path) -> bool:
    """Whether a file is what a system or an editor left beside another, and no data: hidden, a lock, of `__MACOSX`.

    Args:
        path: a file that was found in a folder.
    """
    path = Path(path)
    return path.name.startswith((".", "~$")) or "__MACOSX" in path.parts


def structure_files(folder: str | Path) -> list[Path]:
    """The label maps in a folder, in order.

    Args:
        folder: as TotalSegmentator writes it, with a file for each structure.
    """
    files = (path for path in Path(folder).iterdir() if path.is_file() and not is_companion(path))
    return sorted(path for path in files if is_labelmap(path))


def discard(partial: Path) -> None:
    """Remove what was written of a file that could not be finished.

    Args:
        partial: it; it may not be there, nor its folder.
    """
    with contextlib.suppress(OSError):
        partial.unlink()


def existing(path: str | Path) -> Path:
    """The path of a file that is there and not empty.

    Args:
        path: the file.

    Raises:
        FileError: it is missing, empty, or a folder.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError(f"{path}: no such file." if not path.exists() else f"{path}: expected a file, got a folder.")
    if path.stat().st_size == 0:
        raise ContentError(f"{path}: the file is empty.")
    return path


def placed(
    path: Path, points: Floats, unit: Unit, axes: Axes, smallest: float = SMALLEST, largest: float = LARGEST
) -> Floats:
    """Points of a file in metres and LPS; warns of a size that fits no organ.

    Args:
        path: the file, for the warning.
        points: (p, 3), in the file's unit and axes.
        unit: the file's unit of length.
        axes: the file's axes.
        smallest: below this size it warns, metres.
        largest: above this size it warns, metres.
    """
    if unit not in METRES:
        raise ValueError(f"unit: expected 'm', 'cm' or 'mm', got {unit!r}.")
    if axes not in ("lps", "ras"):
        raise ValueError(f"axes: expected 'lps' or 'ras', got {axes!r}.")
    points = in_metres(points, unit)
    if axes == "ras":
        points = points * RAS_TO_LPS
    size = float(np.ptp(points, axis=0).max())
    if np.isfinite(size) and not smallest <= size <= largest:
        _warn_size(path, size, unit)
    return points


def _warn_size(path: Path, size: float, unit: Unit) -> None:
    warnings.warn(
        f"{path} is {size:.3g} m across when read in {unit}, outside the {SMALLEST * 1e3:g} mm to {LARGEST:g} m of "
        f"an organ; {unit_advice(size, unit)}.",
        UnitWarning,
        stacklevel=4,
    )


def unit_advice(size: float, unit: Unit) -> str:
    """Which unit a file of a size that no organ has is probably in.

    Args:
        size: what it was read as, metres.
        unit: in which it was read.
    """
    sizes = {other: size / METRES[unit] * metres for other, metres in METRES.items() if other != unit}
    fits = [other for other, metres in sizes.items() if SMALLEST <= metres <= LARGEST]
    if not fits:
        return "it fits in no unit (--unit m, cm or mm): is it an organ?"
    likely = min(fits, key=lambda other: abs(np.log(sizes[other] / _USUAL)))
    return f"say --unit {likely}, in which it is {1e3 * sizes[likely]:.3g} mm"
