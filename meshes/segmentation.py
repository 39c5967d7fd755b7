"""Segmentations: one label map, or a folder with a file for each structure, asked for structures by name.

Names are understood as TotalSegmentator, 3D Slicer and people write them: upper and lower case, `tumour` for
`liver_tumor`, `liver` for the union of `liver_segment_1` to `_8`, a number for a label that has no name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, center_of_mass, distance_transform_edt, find_objects, label, minimum
from scipy.spatial import cKDTree

from .body import Floats, Surface
from .components import CAVITY_SHARE, CAVITY_VOLUME, Cavities, ComponentError, chosen_component, dropped_line
from .io import METRES, SEGMENTATIONS, Axes, FileError, Unit, structure_files
from .io.labels import LabelMap, read_labelmap, stated_frame
from .voxels import Voxels, boxed, inside_part, smooth_surface, thick_share, without_crumbs

# One meaning a line; a number behind a name (lesion_2, liver_segment_4) is one of several that are taken together.
_ALIASES: tuple[frozenset[str], ...] = tuple(
    map(
        frozenset,
        (
            ("liver", "hepar", "whole_liver", "liver_segment", "couinaud_segment", "segment"),
            ("tumour", "tumor", "tumours", "tumors", "liver_tumour", "liver_tumor", "liver_tumours", "liver_tumors",
             "lesion", "lesions", "liver_lesion", "liver_lesions", "hepatic_tumor", "metastasis", "metastases"),
            ("vessels", "vessel", "liver_vessels", "liver_vessel", "hepatic_vessels", "hepatic_vessel"),
            ("portal_vein", "portal_veins", "portal", "portal_vein_and_splenic_vein"),
            ("hepatic_vein", "hepatic_veins"),
            ("vena_cava", "inferior_vena_cava", "ivc", "postcava"),
            ("gallbladder", "gall_bladder"),
        ),
    )
)  # fmt: skip
_THIN = 0.5  # share of voxels in blocks of two by two by two below which a surface is doubtful
_ENCLOSED = 0.25  # share of a structure's voxels within the organ's outline: less, and it lies beside the organ
_SAME_PLACE = 1e-2  # of a voxel's edge
_LISTED = 40
_NEAREST = 12  # voxels whose boxes are looked at: the nearest middle need not be that of the nearest box


@dataclass(frozen=True)
class Structure:
    """Where the voxels of one structure are.

    Args:
        name: its name.
        path: the file.
        layer: layer of it.
        value: label in it; None for every voxel that is not 0.
    """

    name: str
    path: Path
    layer: int = 0
    value: int | None = None


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Structures by name.

    Args:
        path: file or folder.
        unit: unit of length of its files.
        axes: axes of its files.
        structures: what it has.
        volume: the voxels; None for a folder, whose files are read one by one.
        notes: what may be a mistake of the files, one line each.
        forced: unit that is taken in place of what its files say; None for theirs.
    """

    path: Path
    unit: Unit
    axes: Axes
    structures: tuple[Structure, ...]
    volume: LabelMap | None
    notes: tuple[str, ...]
    forced: Unit | None = None

    @property
    def listed(self) -> str:
        """The names that there are, for messages."""
        names = [structure.name for structure in self.structures]
        return ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")


def frame_of(path: str | Path) -> tuple[Unit, Axes | None, float]:
    """Unit of coordinates beside a segmentation, its axes, and metres in its own unit, from headers alone.

    Args:
        path: file or folder.

    Raises:
        FileError: it cannot be read, or has no label maps.
    """
    path = Path(path)
    return stated_frame(_files(path)[0] if path.is_dir() else path)


def read_segmentation(path: str | Path, axes: Axes | None = None, unit: Unit | None = None) -> Segmentation:
    """The structures of a file or a folder.

    Args:
        path: NIfTI, NRRD or MetaImage file, or a folder of such files, each with one structure that its name says.
        axes: of NRRD files that say none.
        unit: of length, in place of what the files say.

    Raises:
        FileError: see `read_labelmap`; nothing is segmented.
    """
    path = Path(path)
    if path.is_dir():
        files = _files(path)
        said, stated, scale = stated_frame(files[0])
        structures = tuple(Structure(_stem(file), file) for file in files)
        notes: tuple[str, ...] = ()
        if unit is not None and METRES[unit] != scale:
            notes = (f"warning: {path} says that a unit is {scale:g} m; {unit} was taken, as you say",)
        return Segmentation(path, unit or said, stated or axes or "lps", structures, None, notes, unit)
    volume = read_labelmap(path, axes, unit)
    structures = _structures(volume)
    if not structures:
        raise FileError(f"{path}: expected labelled voxels, got none: all are 0.")
    return Segmentation(path, volume.unit, volume.axes or "lps", structures, volume, volume.notes)


def _files(folder: Path) -> list[Path]:
    files = structure_files(folder)
    if not files:
        raise FileError(f"{folder}: expected segmentations ({', '.join(SEGMENTATIONS)}) in this folder, got none.")
    return files


def _structures(volume: LabelMap) -> tuple[Structure, ...]:
    """What a label map has voxels of, under the names that it gives; labels without a name under their number."""
    there = {(layer, value) for layer, labels in enumerate(volume.labels) for value in _values(labels)}
    named = volume.names
    every = sorted(there, key=lambda place: (place not in named, place))
    if len(there) == 1 and not named:
        (layer, value), name = every[0], _stem(volume.path)
        return (Structure(name, volume.path, layer, value),)
    return tuple(Structure(named.get(place, str(place[1])), volume.path, *place) for place in every)


def _values(labels: NDArray[Any]) -> list[int]:
    """Labels that some voxel has; slab by slab, since counting makes eight bytes of each voxel."""
    counts = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    for slab in labels.T:
        counts += np.bincount(slab.ravel(order="K"), minlength=len(counts))
    return [int(value) for value in np.flatnonzero(counts) if value]


def _stem(path: Path) -> str:
    return re.sub(r"(\.seg)?\.(nii|nii\.gz|nrrd|nhdr|mha|mhd)$", "", path.name, flags=re.IGNORECASE)


def find(segmentation: Segmentation, name: str) -> tuple[Structure, ...]:
    """The structures that a name means; several where they are parts of one.

    Args:
        segmentation: where to look.
        name: as a person writes it, or a label's number.

    Raises:
        FileError: none, with those that there are.
    """
    structures, wanted = segmentation.structures, _plain(name)
    if one := _numbered(segmentation, name):
        return (one,)
    if wanted.isdigit() and (numbered := [s for s in structures if s.value == int(wanted)]):
        return tuple(numbered[:1])
    exact = [s for s in structures if _plain(s.name) == wanted]
    if exact:
        return tuple(_distinct(segmentation, exact)[:1])
    meant = next((group for group in _ALIASES if _without_number(wanted) in group), frozenset({wanted}))
    close = _distinct(segmentation, [s for s in structures if _plain(s.name) in meant])
    if not wanted[-1:].isdigit():
        close = close[:1] or [s for s in structures if _without_number(_plain(s.name)) in meant | {wanted}]
    if close:
        return tuple(close)
    numbers = all(structure.name.isdigit() for structure in structures)
    raise FileError(
        f"{segmentation.path}: expected a label {name!r}, it has {segmentation.listed}."
        + (" These have no names: say which is which by number (--organ 1, --inner tumour=2)." if numbers else "")
    )


def _numbered(segmentation: Segmentation, name: str) -> Structure | None:
    """The K-th of several of one name, which is asked for as `name (K)`; None for other words."""
    asked = re.fullmatch(r"(.+?)\s*\((\d+)\)", name.strip())
    named = {} if segmentation.volume is None else segmentation.volume.names
    alike = [place for place, other in sorted(named.items()) if asked and _plain(other) == _plain(asked.group(1))]
    if asked is None or not 0 < int(asked.group(2)) <= len(alike):
        return None
    place = alike[int(asked.group(2)) - 1]
    return next((s for s in segmentation.structures if (s.layer, s.value) == place), None)


def _distinct(segmentation: Segmentation, found: list[Structure]) -> list[Structure]:
    """The same structures.

    Raises:
        FileError: two of them have one name.
    """
    named = {} if segmentation.volume is None else segmentation.volume.names
    sought = {_plain(structure.name) for structure in found}
    alike = [(name, place) for place, name in sorted(named.items()) if _plain(name) in sought]
    twice = [(name, place) for name, place in alike if [_plain(other) for other, _ in alike].count(_plain(name)) > 1]
    if not twice:
        return found
    words = [
        f"{name} ({number}): label {value} of layer {layer}, {_size(segmentation, layer, value)}"
        for number, (name, (layer, value)) in enumerate(twice, 1)
    ]
    raise FileError(
        f"{segmentation.path}: expected one segment called {twice[0][0]!r}, it has {len(twice)}: {'; '.join(words)}. "
        f'Say which: "{twice[0][0]} (1)", or rename one.'
    )


def _size(segmentation: Segmentation, layer: int, value: int) -> str:
    there = next((s for s in segmentation.structures if (s.layer, s.value) == (layer, value)), None)
    return "no voxels" if there is None else f"{1e6 * voxels_of(segmentation, [there]).volume:.3g} ml"


def the_organ(segmentation: Segmentation) -> str:
    """The name of the organ where nobody says it: the only structure, or the liver.

    Args:
        segmentation: where to look.

    Raises:
        FileError: there are several structures and no liver among them.
    """
    if len(segmentation.structures) == 1:
        return segmentation.structures[0].name
    try:
        find(segmentation, "liver")
    except FileError:
        raise FileError(
            f"{segmentation.path}: expected --organ with the label to build from, it has {segmentation.listed}."
        ) from None
    return "liver"


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _without_number(name: str) -> str:
    return re.sub(r"_?\d+$", "", name)


def voxels_of(segmentation: Segmentation, structures: Iterable[Structure]) -> Voxels:
    """The voxels of structures together, in the smallest box.

    Args:
        segmentation: that has them.
        structures: one or more.

    Raises:
        FileError: a file is empty, or lies elsewhere than another.
    """
    parts = [_part(segmentation, structure) for structure in structures]
    volume = parts[0][0]
    for other, _, _ in parts[1:]:
        if other.labels.shape[1:] != volume.labels.shape[1:] or not _at_one_place(volume, other):
            raise FileError(
                f"{other.path}: expected the same voxels as in {volume.path} ({_shape(volume)}), got {_shape(other)} "
                "or another place; resample them to one grid."
            )
    low = np.min([[side.start for side in box] for _, box, _ in parts], axis=0)
    high = np.max([[side.stop for side in box] for _, box, _ in parts], axis=0)
    filled = np.zeros(high - low, dtype=np.bool_)
    for _, box, part in parts:
        filled[tuple(slice(side.start - at, side.stop - at) for side, at in zip(box, low, strict=True))] |= part
    cut = bool((low == 0).any() or (high == volume.labels.shape[1:]).any())
    return boxed(filled, tuple(low.tolist()), volume.to_lps, cut)


def _part(segmentation: Segmentation, structure: Structure) -> tuple[LabelMap, tuple[slice, ...], NDArray[np.bool_]]:
    volume = segmentation.volume or read_labelmap(structure.path, segmentation.axes, segmentation.forced)
    labels = volume.labels[structure.layer]
    filled = labels != 0 if structure.value is None else labels == structure.value
    boxes = find_objects(filled.view(np.uint8))
    if not boxes:
        raise FileError(f"{structure.path}: expected voxels of {structure.name!r}, got none: all are 0.")
    return volume, boxes[0], filled[boxes[0]]


def _at_one_place(one: LabelMap, other: LabelMap) -> bool:
    return bool(np.abs(one.to_lps - other.to_lps).max() < _SAME_PLACE * np.linalg.norm(one.to_lps[:3, 0]))


def _shape(volume: LabelMap) -> str:
    sizes = 1e3 * np.linalg.norm(volume.to_lps[:3, :3], axis=0)
    return f"{' x '.join(map(str, volume.labels.shape[1:]))} of {' x '.join(f'{size:.3g}' for size in sizes)} mm"


def organ_surface(
    segmentation: Segmentation,
    name: str,
    inner: Iterable[str] = (),
    join: Iterable[str] = (),
    component: str = "largest",
    cavities: Cavities = "",
) -> tuple[Surface, list[str]]:
    """The closed surface of an organ, LPS, metres, and what was done to get it.

    Each voxel has one label, so the organ has a hole or a dent where a structure lies in it: what of the structure lies
    within the organ's outline belongs to the organ, unless it is a small part. Of several components one is kept. Of
    its holes those stay that are no noise (see `components.CAVITY_VOLUME`).

    Args:
        segmentation: that has it.
        name: the organ.
        inner: names of structures that may lie inside it.
        join: names of structures that are part of the organ, wherever they lie.
        component: which is kept (see `components.check_component`).
        cavities: keep all holes, or fill all; empty for the rule.

    Raises:
        FileError: no such label, or it is one voxel thick.
        ComponentError: no such component.
    """
    chosen = find(segmentation, name)
    voxels, notes = voxels_of(segmentation, chosen), list(segmentation.notes)
    notes.append(_described(segmentation, chosen, voxels))
    for other in join:
        both, own = _together(voxels, voxels_of(segmentation, find(segmentation, other)))
        added = own.filled & ~both.filled
        voxels = Voxels(both.filled | own.filled, both.to_lps, voxels.cut or own.cut)
        notes.append(f"segmentation: {other} is joined to {name}, {_millilitres(both, added)} more")
    for other in inner:
        both, own = _together(voxels, voxels_of(segmentation, find(segmentation, other)))
        within = inside_part(own.filled, both)
        share = within.sum() / own.filled.sum()
        if share <= _ENCLOSED:
            continue
        added = within & ~both.filled
        voxels = Voxels(both.filled | within, both.to_lps, voxels.cut)
        if added.any():
            part = "lies inside" if share == 1 else f"lies inside by {100 * share:.0f} %, which fills its place in"
            notes.append(f"segmentation: {other} {part} {name} and was counted to it, {_millilitres(both, added)} more")
    kept, dropped = _component(segmentation, voxels, component)
    if dropped > 0:
        notes.append(dropped_line(dropped, kept.volume, component))
    whole, said = _hollow(kept, cavities)
    notes += said
    if voxels.cut:
        notes.append(f"warning: {name} reaches the edge of the segmented volume, and ends flat where it may go on")
    notes += _check_thickness(segmentation, name, whole)
    return smooth_surface(whole), notes


def _millilitres(voxels: Voxels, flags: NDArray[np.bool_]) -> str:
    return f"{1e6 * Voxels(flags, voxels.to_lps).volume:.3g} ml"


def _component(segmentation: Segmentation, voxels: Voxels, component: str) -> tuple[Voxels, float]:
    """One component, and the volume of the others, cubic metres."""
    numbers, count = label(voxels.filled)
    counts = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    middles = np.array(center_of_mass(voxels.filled, numbers, range(1, count + 1))).reshape(-1, 3)
    middles = middles @ voxels.to_lps[:3, :3].T + voxels.to_lps[:3, 3]

    def away(structure: str) -> Floats:
        both, own = _together(voxels, voxels_of(segmentation, find(segmentation, structure)))
        distance = distance_transform_edt(~own.filled, sampling=both.spacing)
        return np.asarray(minimum(distance, label(both.filled)[0], range(1, count + 1)), dtype=np.float64)

    try:
        number = chosen_component(component, counts.astype(np.float64), middles, away)
    except ComponentError as error:
        raise ComponentError(f"{segmentation.path}: {error}") from None
    one = abs(float(np.linalg.det(voxels.to_lps[:3, :3])))
    return Voxels(numbers == number + 1, voxels.to_lps, voxels.cut), float(one * (counts.sum() - counts[number]))


def _hollow(voxels: Voxels, cavities: Cavities) -> tuple[Voxels, list[str]]:
    """The voxels with those holes filled that are none of the organ, and what to say of all of them."""
    holes, count = label(np.asarray(binary_fill_holes(voxels.filled), dtype=np.bool_) & ~voxels.filled)
    if count == 0:
        return voxels, []
    one = abs(float(np.linalg.det(voxels.to_lps[:3, :3])))
    volumes = one * np.bincount(holes.ravel(), minlength=count + 1)[1:]
    large = (volumes >= CAVITY_VOLUME) & (volumes >= CAVITY_SHARE * voxels.volume)
    stay = {"keep": np.ones(count, np.bool_), "fill": np.zeros(count, np.bool_)}.get(cavities, large)
    said = []
    if stay.any():
        said.append(
            f"segmentation: {stay.sum()} cavities of {1e6 * volumes[stay].sum():.4g} ml stay open; --cavities fill "
            "fills them; where another label lies in them, --inner or --join makes it part of the organ"
        )
    if not stay.all():
        said.append(
            f"segmentation: {(~stay).sum()} cavities of {1e6 * volumes[~stay].sum():.3g} ml filled"
            + ("" if cavities else "; --cavities keep keeps them")
        )
    filled = np.concatenate([[False], ~stay])[holes]
    return Voxels(voxels.filled | filled, voxels.to_lps, voxels.cut), said


def inner_surface(segmentation: Segmentation, name: str) -> tuple[Surface, list[str]]:
    """The closed surface of a structure, all its components but crumbs, LPS, metres, and what there is to say of it.

    Args:
        segmentation: that has it.
        name: the structure.

    Raises:
        FileError: no such label, or it is one voxel thick.
    """
    chosen = find(segmentation, name)
    voxels = without_crumbs(voxels_of(segmentation, chosen))
    notes = [_described(segmentation, chosen, voxels), *_check_thickness(segmentation, name, voxels)]
    return smooth_surface(voxels), notes


def _described(segmentation: Segmentation, chosen: tuple[Structure, ...], voxels: Voxels) -> str:
    names = " + ".join(structure.name for structure in chosen)
    sizes = " x ".join(f"{1e3 * size:.3g}" for size in voxels.spacing)
    return f"segmentation: {names}, {1e6 * voxels.volume:.4g} ml in voxels of {sizes} mm"


def _check_thickness(segmentation: Segmentation, name: str, voxels: Voxels) -> list[str]:
    share = thick_share(voxels)
    if share == 0:
        raise FileError(
            f"{segmentation.path}: expected {name!r} to be more than one voxel thick, got "
            f"{' x '.join(map(str, voxels.filled.shape))} voxels without a block of 2 x 2 x 2; no closed surface "
            "follows it. Segment it on finer slices, or leave it out (for what holds the organ, touching: takes it)."
        )
    if share < _THIN:
        return [f"warning: {name}: {100 * (1 - share):.0f} % of it is one voxel thick, its surface is doubtful there"]
    return []


def _together(one: Voxels, other: Voxels) -> tuple[Voxels, Voxels]:
    """Two sets of voxels of one grid in one box."""
    shift = np.rint(np.linalg.solve(one.to_lps[:3, :3], other.to_lps[:3, 3] - one.to_lps[:3, 3])).astype(int)
    low = np.minimum(0, shift)
    high = np.maximum(one.filled.shape, shift + other.filled.shape)
    first = np.pad(one.filled, [(int(-a), int(b - n)) for a, b, n in zip(low, high, one.filled.shape, strict=True)])
    ends = [(int(s - a), int(b - s - n)) for a, b, s, n in zip(low, high, shift, other.filled.shape, strict=True)]
    both = boxed(first, tuple(low.tolist()), one.to_lps, one.cut)
    return both, Voxels(np.pad(other.filled, ends), both.to_lps, other.cut)


def distances_to(segmentation: Segmentation, name: str, points: Floats) -> Floats:
    """Distances of points to the voxels of a structure, (p,), metres; 0 in them.

    Args:
        segmentation: that has it.
        name: the structure, of any thickness.
        points: (p, 3), LPS, metres.

    Raises:
        FileError: no such label.
    """
    voxels = voxels_of(segmentation, find(segmentation, name))
    axes = voxels.to_lps[:3, :3]
    middles = np.argwhere(_skin(voxels.filled)) @ axes.T + voxels.to_lps[:3, 3]
    count = min(_NEAREST, len(middles))
    _, nearest = cKDTree(middles).query(points, k=[*range(1, count + 1)])
    offsets = np.abs(np.linalg.solve(axes, (points[:, None] - middles[nearest]).reshape(-1, 3).T)).T
    beyond = np.maximum(offsets - 0.5, 0.0) * voxels.spacing
    away = np.linalg.norm(beyond, axis=1).reshape(len(points), count).min(axis=1)
    numbers = np.rint(np.linalg.solve(axes, (points - voxels.to_lps[:3, 3]).T).T).astype(int)
    inside = ((numbers >= 0) & (numbers < voxels.filled.shape)).all(axis=1)
    inside[inside] = voxels.filled[tuple(numbers[inside].T)]
    return np.where(inside, 0.0, away)


def _skin(filled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The filled voxels with a face that is bare."""
    padded = np.pad(filled, 1)
    enclosed = padded.copy()
    for axis in range(3):
        enclosed &= np.roll(padded, 1, axis) & np.roll(padded, -1, axis)
    return (padded & ~enclosed)[1:-1, 1:-1, 1:-1]


def voxel_diagonal(segmentation: Segmentation, name: str) -> float:
    """The diagonal of a voxel, metres.

    Args:
        segmentation: that has them.
        name: a structure.

    Raises:
        FileError: no such label.
    """
    structure = find(segmentation, name)[0]
    volume = segmentation.volume or read_labelmap(structure.path, segmentation.axes, segmentation.forced)
    return float(np.linalg.norm(np.linalg.norm(volume.to_lps[:3, :3], axis=0)))
