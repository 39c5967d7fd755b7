"""Parts of a body said in words: near an inner structure, in a ball, a box, a half-space, seen from somewhere, a file.

A region is a value; what of a body lies in it are nodes and triangles of the boundary. In text (lengths without a unit
are in a unit that the caller names, the place's unit stands behind its last number):

    near:hepatic_vein:5mm           within 5 mm of the inner surface of that name; without a distance: one cell
    ball:10,-20,35mm:15mm           centre and radius
    box:0,0,0:40,30,20mm            two opposite corners
    halfspace:0,0,12mm:0,0,-1       the side of the plane through the point to which the normal points
    seen-from:0,-400,100mm          what a camera at the place sees
    touching:vena_cava:5mm          where another label of the segmentation touches the organ; without a distance:
                                    a voxel's diagonal, or one cell where that reaches too few nodes
    veins.ply, veins.ply:mm:ras     near the points of a file, with its unit and axes where it has others
    "a + b.ply":mm                  the same in double quotes, where ` + ` or `:` belongs to the name
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .body import Body, Floats, Ints
from .closest import distances
from .clouds import triangles_seen_from
from .io import AXES, UNITS, Axes, Unit, in_metres
from .metrics import edge_lengths

Vector = tuple[float, float, float]
Flags = NDArray[np.bool_]
WORDS = ("near", "touching", "ball", "box", "halfspace", "seen-from")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_QUOTED = re.compile(r'"((?:[^"\\]|\\.)*)"((?::\w+)*)')
_JOINT = re.compile(r'"(?:[^"\\]|\\.)*"| \+ ')
_LENGTH = re.compile(rf"\s*({_NUMBER})\s*([a-z]*)\s*")


class RegionError(ValueError):
    """A region that cannot be read, or that holds nothing of a body: what was expected and what came."""


@dataclass(frozen=True)
class Near:
    """What lies within a distance of an inner structure.

    Args:
        structure: name of the inner surface.
        distance: metres; None for the median edge of the body.
    """

    structure: str
    distance: float | None = None


@dataclass(frozen=True)
class Touching:
    """What lies within a distance of another label of the segmentation that the body was made from.

    Args:
        label: its name.
        distance: metres; None for a voxel's diagonal, or the median edge of the body where that reaches too few nodes.
    """

    label: str
    distance: float | None = None


@dataclass(frozen=True)
class Ball:
    """What lies in a ball; centre and radius in metres."""

    centre: Vector
    radius: float


@dataclass(frozen=True)
class Box:
    """What lies in a box along the axes; two opposite corners, metres."""

    low: Vector
    high: Vector


@dataclass(frozen=True)
class HalfSpace:
    """What lies on the side of a plane to which its normal points; a point of the plane, metres."""

    point: Vector
    normal: Vector


@dataclass(frozen=True)
class SeenFrom:
    """What a camera sees; its place, metres."""

    position: Vector


@dataclass(frozen=True)
class File:
    """What a file says: points or triangles near the place, or node numbers.

    Args:
        path: the file.
        unit: its unit of length; None for the unit of the body's files.
        axes: its axes; None for what the file says itself, else those of the body's files.
    """

    path: Path
    unit: Unit | None = None
    axes: Axes | None = None

    def __str__(self) -> str:
        return ":".join(filter(None, (_quoted(self.path), self.unit, self.axes)))


Shape = Near | Ball | Box | HalfSpace | SeenFrom
Region = Shape | Touching | File


def parse_region(text: str, unit: Unit = "m") -> Region:
    """The region that a text describes (see the module).

    Args:
        text: the description.
        unit: of lengths without a unit of their own.

    Raises:
        RegionError: what was expected and what came.
    """
    word, *parts = text.split(":")
    if word not in WORDS or Path(text).exists():
        return parse_file(text)
    try:
        return _parse_shape(word, parts, unit)
    except ValueError as error:
        raise RegionError(f"{text!r}: {error}") from None


def parse_place(text: str, unit: Unit = "m") -> Vector:
    """A point that a text describes, metres: `X,Y,Z`, with a unit behind the last number where it has another.

    Args:
        text: the description.
        unit: of lengths without a unit of their own.

    Raises:
        RegionError: what was expected and what came.
    """
    try:
        shape = _parse_shape("seen-from", [text.strip()], unit)
    except RegionError:
        raise
    except ValueError as error:
        raise RegionError(f"{text!r}: {error}") from None
    assert isinstance(shape, SeenFrom)
    return shape.position


def parse_regions(text: str, unit: Unit = "m", root: Path = Path()) -> tuple[Region, ...]:
    """The regions of a text, whose union is meant: ` + ` stands between them.

    Args:
        text: the description.
        unit: of lengths without a unit of their own.
        root: folder that relative paths start from.

    Raises:
        RegionError: what was expected and what came.
    """
    return tuple(parse_region(part, unit) for part in parts_of(text, root))


def parts_of(text: str, root: Path = Path()) -> tuple[str, ...]:
    """The parts between which ` + ` stands, none of them empty.

    What is in double quotes is one part, and so is a text that names a file that is there.

    Args:
        text: the description.
        root: folder that relative paths start from.
    """
    if text.strip() and (root / _without_unit(text.strip())[0]).exists():
        return (text.strip(),)
    places = [found.start() for found in _JOINT.finditer(text) if found.group() == " + "]
    ends = [0, *(place + 3 for place in places)]
    parts = [text[low:high] for low, high in zip(ends, [*places, len(text)], strict=True)]
    return tuple(part.strip() for part in parts if part.strip())


def _without_unit(text: str) -> tuple[str, str | None, str | None]:
    """A path without quotes, and the unit and axes behind it."""
    quoted = _QUOTED.fullmatch(text)
    path, rest = (re.sub(r"\\(.)", r"\1", quoted.group(1)), quoted.group(2)) if quoted else (text, None)
    unit = axes = None
    words = path if rest is None else rest
    while (rest is not None or not Path(words).exists()) and ":" in words:
        first, _, last = words.rpartition(":")
        if last in UNITS and unit is None:
            words, unit = first, last
        elif last.lower() in AXES and axes is None:
            words, axes = first, last.lower()
        else:
            break
    return (words if rest is None else path + words), unit, axes


def _quoted(path: Path) -> str:
    """A path as text that `parse_regions` reads as this path."""
    plain = str(path)
    if not any(mark in plain for mark in (" + ", ":", '"', "\\")) and plain == plain.strip():
        return plain
    return '"' + re.sub(r'(["\\])', r"\\\1", plain) + '"'


def turned(region: Region) -> Region:
    """The same region where RAS is LPS or the other way round: x and y of the other sign; a file stays.

    Args:
        region: the region.
    """
    if isinstance(region, Ball):
        return Ball(_turned(region.centre), region.radius)
    if isinstance(region, Box):
        low, high = np.sort([_turned(region.low), _turned(region.high)], axis=0).tolist()
        return Box(tuple(low), tuple(high))
    if isinstance(region, HalfSpace):
        return HalfSpace(_turned(region.point), _turned(region.normal))
    return SeenFrom(_turned(region.position)) if isinstance(region, SeenFrom) else region


def _turned(vector: Vector) -> Vector:
    return (0.0 - vector[0], 0.0 - vector[1], vector[2])


def parse_file(text: str) -> File:
    """The file that a text names: a path, with `:mm`, `:lps` or both behind it where its unit or axes differ.

    A path may stand in double quotes; one that is there as it is written is taken so.

    Args:
        text: the description.

    Raises:
        RegionError: unit or axes are given twice, or there is no path.
    """
    path, unit, axes = _without_unit(text.strip())
    if not path:
        raise RegionError(f"{text!r}: expected a file, with :m, :cm, :mm, :lps or :ras behind it where it has another "
                          "unit or axes.")  # fmt: skip
    return File(Path(path), unit, axes)  # type: ignore[arg-type]


def boundary_nodes(region: Shape, body: Body) -> Ints:
    """Nodes of the body's boundary that lie in a region, sorted.

    Args:
        region: the region.
        body: the body at rest.

    Raises:
        RegionError: there are none, or the body has no inner structure of that name.
    """
    if isinstance(region, SeenFrom):
        return np.unique(boundary_triangles(region, body))
    nodes = body.boundary_nodes
    return nodes[_checked(region, body, body.points[nodes], "node")]


def boundary_triangles(region: Shape, body: Body) -> Ints:
    """Triangles of the body's boundary whose middle lies in a region, or that a camera sees, (t, 3), wound outward.

    Args:
        region: the region.
        body: the body at rest.

    Raises:
        RegionError: there are none, or the body has no inner structure of that name.
    """
    if not isinstance(region, SeenFrom):
        return body.boundary[_checked(region, body, body.points[body.boundary].mean(axis=1), "triangle")]
    seen = triangles_seen_from(body.boundary_surface, region.position)
    if not seen.any():
        raise RegionError(f"{_plain(region)}: no triangle of the boundary is seen from there; is the camera inside?")
    return body.boundary[seen]


def median_edge(body: Body) -> float:
    """Median length of a body's edges, metres: how near is near where nothing else is said.

    Args:
        body: the body.
    """
    return float(np.median(edge_lengths(body.points, body.corner_cells)))


def check_structure(region: Region, structures: tuple[str, ...]) -> None:
    """Refuse a region near a structure that there is not.

    Args:
        region: the region.
        structures: names of the inner surfaces.

    Raises:
        RegionError: with the names that there are.
    """
    if isinstance(region, Near) and region.structure not in structures:
        raise RegionError(
            f"near: expected the name of an inner structure, one of {sorted(structures)}, got {region.structure!r}."
        )


def _checked(region: Near | Ball | Box | HalfSpace, body: Body, points: Floats, what: str) -> Flags:
    check_structure(region, tuple(body.inner))
    depths = _depths(region, body, points)
    if not (depths >= 0).any():
        raise RegionError(
            f"{_plain(region)}: holds no {what} of the body's boundary; the nearest is {-1e3 * depths.max():.1f} mm "
            "away from it. Same unit and axes? Else make it larger."
        )
    return depths >= 0


def _depths(region: Near | Ball | Box | HalfSpace, body: Body, points: Floats) -> Floats:
    """How deep the points lie inside a region, metres; negative outside, (p,)."""
    if isinstance(region, Near):
        distance = median_edge(body) if region.distance is None else region.distance
        return distance - distances(body.inner[region.structure], points)
    if isinstance(region, Ball):
        return region.radius - np.linalg.norm(points - region.centre, axis=1)
    if isinstance(region, Box):
        return np.minimum(points - region.low, np.array(region.high) - points).min(axis=1)
    return (points - region.point) @ (np.array(region.normal) / np.linalg.norm(region.normal))


def _plain(region: Shape) -> str:
    """The region in words and millimetres, for messages."""
    if isinstance(region, Near):
        return f"near {region.structure}" + (f" ({1e3 * region.distance:g} mm)" if region.distance else "")
    if isinstance(region, Ball):
        return f"ball about {_triple(region.centre)} of radius {1e3 * region.radius:g} mm"
    if isinstance(region, Box):
        return f"box from {_triple(region.low)} to {_triple(region.high)}"
    if isinstance(region, HalfSpace):
        return f"half-space from {_triple(region.point)} on"
    return f"seen from {_triple(region.position)}"


def _triple(vector: Vector) -> str:
    return f"({', '.join(f'{1e3 * x:g}' for x in vector)}) mm"


def _parse_shape(word: str, parts: list[str], unit: Unit) -> Shape | Touching:
    if word in ("near", "touching"):
        if len(parts) not in (1, 2) or not parts[0]:
            raise ValueError(f"expected {word}:NAME or {word}:NAME:DISTANCE.")
        distance = _positive("distance", parts[1], unit) if len(parts) == 2 else None
        return Near(parts[0], distance) if word == "near" else Touching(parts[0], distance)
    if word == "ball":
        _check_parts(parts, 2, "ball:X,Y,Z:RADIUS")
        return Ball(_place("centre", parts[0], unit), _positive("radius", parts[1], unit))
    if word == "box":
        _check_parts(parts, 2, "box:X,Y,Z:X,Y,Z")
        return _box(parts[0], parts[1], unit)
    if word == "halfspace":
        _check_parts(parts, 2, "halfspace:X,Y,Z:NX,NY,NZ")
        normal = _place("normal", parts[1], "m")
        if not any(normal):
            raise ValueError(f"expected a normal that is not zero, got {parts[1]!r}.")
        return HalfSpace(_place("point", parts[0], unit), normal)
    _check_parts(parts, 1, "seen-from:X,Y,Z")
    return SeenFrom(_place("place", parts[0], unit))


def _box(first: str, second: str, unit: Unit) -> Box:
    # A unit that stands behind the second corner alone goes for both.
    stated = _LENGTH.fullmatch(second.split(",")[-1])
    behind = stated.group(2) if stated and stated.group(2) in UNITS else unit
    corners = np.sort([_place("corner", first, behind), _place("corner", second, unit)], axis=0)  # type: ignore[arg-type]
    return Box(tuple(corners[0].tolist()), tuple(corners[1].tolist()))  # type: ignore[arg-type]


def _check_parts(parts: list[str], count: int, form: str) -> None:
    if len(parts) != count:
        raise ValueError(f"expected {form}.")


def _place(name: str, text: str, unit: Unit) -> Vector:
    numbers = text.split(",")
    if len(numbers) != 3:
        raise ValueError(f"expected three numbers for its {name}, got {text!r}.")
    *first, last = numbers
    value, stated = _number(name, last, unit)
    return (_number(name, first[0], stated)[0], _number(name, first[1], stated)[0], value)


def _positive(name: str, text: str, unit: Unit) -> float:
    value, _ = _number(name, text, unit)
    if not value > 0:
        raise ValueError(f"expected a positive {name}, got {text!r}.")
    return value


def _number(name: str, text: str, unit: Unit) -> tuple[float, Unit]:
    """A length in metres, and the unit that it was given in."""
    found = _LENGTH.fullmatch(text)
    if not found or (found.group(2) and found.group(2) not in UNITS):
        raise ValueError(f"expected a number with m, cm, mm or nothing behind it for its {name}, got {text!r}.")
    stated: Unit = found.group(2) or unit  # type: ignore[assignment]
    return float(in_metres(float(found.group(1)), stated)), stated
