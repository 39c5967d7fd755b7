"""Bodies made from nothing: the beam, the propeller, the liver phantom."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

from .body import Body, Floats, Ints, Surface
from .filling import fill, filled, gmsh_model

# Six tetrahedra around the diagonal 0-6 of a hexahedron (Kuhn): copies side by side share their faces.
_KUHN = np.array([[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]])


def beam(
    divisions: tuple[int, int, int] = (19, 4, 4),
    size: tuple[float, float, float] = (1.0, 0.25, 0.25),
    kind: Literal["hexahedron", "tetrahedron"] = "hexahedron",
) -> Body:
    """A straight beam along x, clamped at x = 0, with the node set `tip` at its other end.

    The default is the thesis's beam: 304 hexahedra, 1 x 0.25 x 0.25 m.

    Args:
        divisions: hexahedra along x, y and z.
        size: length, width and height, metres.
        kind: `hexahedron`, or `tetrahedron` for six tetrahedra in each hexahedron.

    Raises:
        ValueError: a division below 1, a size that is not positive, or another kind.
    """
    if min(divisions) < 1 or not min(size) > 0:
        raise ValueError(f"divisions, size: expected three positive numbers each, got {divisions} and {size}.")
    if kind not in ("hexahedron", "tetrahedron"):
        raise ValueError(f"kind: expected 'hexahedron' or 'tetrahedron', got {kind!r}.")
    nx, ny, nz = (n + 1 for n in divisions)
    axes = [np.linspace(0.0, length, n + 1) for length, n in zip(size, divisions, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    numbers = np.arange(nx * ny * nz).reshape(nx, ny, nz)
    cells = _grid_cells(numbers)
    if kind == "tetrahedron":
        cells = cells[:, _KUHN].reshape(-1, 4)
    return Body(points, cells, {"fixed": numbers[0].ravel(), "tip": numbers[-1].ravel()})


def _grid_cells(numbers: Ints) -> Ints:
    low, high = slice(None, -1), slice(1, None)
    base = [(low, low), (high, low), (high, high), (low, high)]
    corners = [numbers[x, y, z] for z in (low, high) for x, y in base]
    return np.stack(corners, axis=-1).reshape(-1, 8)


def propeller(cell_size: float = 0.03, twist: float = 40.0) -> Body:
    """Three twisted blades on a hub about the z axis, 1 m across, held at the hub's bore; node set `tips`.

    Args:
        cell_size: edge length of the tetrahedra, metres.
        twist: turn of a blade's section from root to tip, degrees.

    Raises:
        ValueError: `cell_size` is not positive.
    """
    if not cell_size > 0:
        raise ValueError(f"cell_size: expected a positive length in metres, got {cell_size}.")
    bore, hub, height, tip = 0.05, 0.1, 0.16, 0.5
    with gmsh_model("propeller") as gmsh:
        occ = gmsh.model.occ
        blade = _blade(occ, root=0.8 * hub, tip=tip, twist=np.radians(twist))
        blades = [blade]
        for turn in (1, 2):
            copy = occ.copy([blade])[0]
            occ.rotate([copy], 0, 0, 0, 0, 0, 1, turn * 2 * np.pi / 3)
            blades.append(copy)
        core = (3, occ.addCylinder(0, 0, -height / 2, 0, 0, height, hub))
        solid, _ = occ.fuse([core], blades)
        hole = (3, occ.addCylinder(0, 0, -height, 0, 0, 2 * height, bore))
        occ.cut(solid, [hole])
        occ.synchronize()
        points, cells = fill(gmsh, cell_size)
    radius = np.hypot(points[:, 0], points[:, 1])
    # Nodes of a curved face lie on it, up to OpenCASCADE's tolerance.
    fixed = np.flatnonzero(radius < bore * (1 + 1e-6))
    return Body(points, cells, {"fixed": fixed, "tips": np.flatnonzero(radius > 0.97 * tip)})


def _blade(occ: object, root: float, tip: float, twist: float) -> tuple[int, int]:
    wires = []
    for s in np.linspace(0.0, 1.0, 4):
        radius, chord, thickness = root + s * (tip - root), 0.15 - 0.05 * s, 0.036 - 0.012 * s
        angle = np.radians(55.0) - twist * s
        wires.append(_section(occ, radius, chord, thickness, angle))
    return occ.addThruSections(wires, makeSolid=True)[0]  # type: ignore[attr-defined]


def _section(occ: object, radius: float, chord: float, thickness: float, angle: float) -> int:
    along = np.array([0.0, np.cos(angle), np.sin(angle)]) * chord / 2
    across = np.array([0.0, -np.sin(angle), np.cos(angle)]) * thickness / 2
    centre = np.array([radius, 0.0, 0.0])
    corners = [centre + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    tags = [occ.addPoint(*corner) for corner in corners]  # type: ignore[attr-defined]
    lines = [occ.addLine(tags[i], tags[(i + 1) % 4]) for i in range(4)]  # type: ignore[attr-defined]
    return occ.addWire(lines)  # type: ignore[attr-defined]


# --- The liver phantom. Axes: x to the patient's left, y to the back, z up; metres. Everything is an implicit
# function (negative inside), so that every part is smooth and can be tested for lying inside another.

_HILUM = np.array([0.008, 0.018, -0.020])
_HILUM_RADIUS = 0.024
_TUMOUR = np.array([-0.062, -0.012, 0.006])
# Branches of a vessel: start, end, radius at the start, radius at the end.
_Branch = tuple[tuple[float, float, float], tuple[float, float, float], float, float]
_PORTAL: Sequence[_Branch] = (
    ((0.000, 0.010, -0.008), (-0.015, 0.004, 0.002), 0.0055, 0.0050),
    ((-0.015, 0.004, 0.002), (-0.040, 0.012, -0.018), 0.0045, 0.0028),
    ((-0.015, 0.004, 0.002), (-0.035, -0.018, 0.020), 0.0045, 0.0028),
    ((-0.015, 0.004, 0.002), (0.020, -0.014, 0.012), 0.0045, 0.0034),
    ((0.020, -0.014, 0.012), (0.060, -0.016, 0.018), 0.0034, 0.0024),
)
_HEPATIC: Sequence[_Branch] = (
    ((-0.010, 0.030, 0.030), (-0.018, 0.018, 0.034), 0.0060, 0.0055),
    ((-0.018, 0.018, 0.034), (-0.058, 0.020, 0.012), 0.0048, 0.0028),
    ((-0.018, 0.018, 0.034), (-0.022, -0.030, 0.028), 0.0045, 0.0028),
    ((-0.018, 0.018, 0.034), (0.040, -0.010, 0.030), 0.0045, 0.0026),
)


def liver_phantom(cell_size: float = 0.0095) -> Body:
    """A smooth two-lobed organ the size of a liver, held at its hilum, with two vessel trees and a tumour inside.

    Inner surfaces: `vessel_portal`, `vessel_hepatic`, `tumour`. Surface `observed`: the boundary triangles that
    face the front. Axes: x to the patient's left, y to the back, z up.

    Args:
        cell_size: edge length of the tetrahedra, metres.

    Raises:
        ValueError: `cell_size` outside 2 to 20 mm, where the shape would be lost or the mesh huge.
    """
    if not 0.002 <= cell_size <= 0.02:
        raise ValueError(f"cell_size: expected 0.002 to 0.02 m for the liver phantom, got {cell_size}.")
    outline = isosurface(_liver, (-0.115, -0.085, -0.095), (0.12, 0.085, 0.085), spacing=0.004)
    points, cells = filled(outline, cell_size)
    inner = {
        "vessel_portal": _vessel(_PORTAL),
        "vessel_hepatic": _vessel(_HEPATIC),
        "tumour": isosurface(_tumour, _TUMOUR - 0.018, _TUMOUR + 0.018, spacing=0.002),
    }
    return _held_at_hilum(points, cells, inner)


def _held_at_hilum(points: Floats, cells: Ints, inner: dict[str, Surface]) -> Body:
    every = Body(points, cells, {"fixed": np.arange(len(points) - 1)})
    boundary = every.boundary
    near = np.linalg.norm(points - _HILUM, axis=1) < _HILUM_RADIUS
    nodes = every.boundary_nodes
    a, b, c = (points[boundary[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Body(points, cells, {"fixed": nodes[near[nodes]]}, {"observed": boundary[normals[:, 1] < -0.2]}, inner)


def _liver(x: Floats) -> Floats:
    right = _ellipsoid(x, (-0.034, 0.0, -0.009), (0.065, 0.066, 0.063))
    left = _ellipsoid(x, (0.042, -0.015, 0.017), (0.065, 0.042, 0.033))
    lobes = _smooth_union(right, left, 0.055)
    # The visceral face: a large sphere pressed in from below, behind and the left.
    normal = np.array([0.42, 0.42, -0.80]) / np.linalg.norm([0.42, 0.42, -0.80])
    visceral = _ball(x, np.array([0.016, 0.014, -0.024]) + 0.2 * normal, 0.2)
    ligament = _ellipsoid(x, (0.028, -0.068, -0.020), (0.010, 0.036, 0.028))
    return _smooth_cut(_smooth_cut(lobes, visceral, 0.020), ligament, 0.024)


def _tumour(x: Floats) -> Floats:
    return _ellipsoid(x, _TUMOUR, (0.013, 0.011, 0.012))


def _vessel(branches: Sequence[_Branch]) -> Surface:
    ends = np.array([[start, end] for start, end, *_ in branches]).reshape(-1, 3)
    return isosurface(lambda x: _tree(x, branches), ends.min(axis=0) - 0.01, ends.max(axis=0) + 0.01, spacing=0.0015)


def _tree(x: Floats, branches: Sequence[_Branch]) -> Floats:
    distance = _round_cone(x, *branches[0])
    for branch in branches[1:]:
        distance = _smooth_union(distance, _round_cone(x, *branch), 0.003)
    return distance


def _ball(x: Floats, centre: Floats, radius: float) -> Floats:
    return np.linalg.norm(x - centre, axis=-1) - radius


def _ellipsoid(x: Floats, centre: Sequence[float] | Floats, radii: Sequence[float]) -> Floats:
    # Level |q| = 1 of q = (x - c) / r, scaled by its gradient so that it measures distance near the surface.
    scaled = (x - np.asarray(centre)) / np.asarray(radii)
    level = np.linalg.norm(scaled, axis=-1)
    gradient = np.linalg.norm(scaled / np.asarray(radii), axis=-1)
    return level * (level - 1) / np.maximum(gradient, 1e-9)


def _round_cone(x: Floats, start: Sequence[float], end: Sequence[float], first: float, last: float) -> Floats:
    a, axis = np.asarray(start), np.asarray(end) - np.asarray(start)
    s = np.clip((x - a) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(x - a - s[..., None] * axis, axis=-1) - (first + s * (last - first))


def _smooth_union(a: Floats, b: Floats, width: float) -> Floats:
    blend = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - blend**2 * width / 4


def _smooth_cut(a: Floats, b: Floats, width: float) -> Floats:
    return -_smooth_union(-a, b, width)


def isosurface(
    function: Callable[[Floats], Floats], low: Sequence[float] | Floats, high: Sequence[float] | Floats, spacing: float
) -> Surface:
    """The surface on which a function of places is zero, wound outward from where it is negative.

    Args:
        function: of places (..., 3), metres: (...,).
        low: corner of the grid, (3,), metres.
        high: the opposite one.
        spacing: of the grid, metres.
    """
    # Off round numbers, since where the function is zero at a grid point, triangles shrink to nothing.
    low, high = np.asarray(low, float) - 0.317 * spacing, np.asarray(high, float)
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [low[i] + spacing * np.arange(counts[i]) for i in range(3)]
    values = function(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    image = vtkImageData()
    image.SetDimensions(*counts.tolist())
    image.SetOrigin(*low.tolist())
    image.SetSpacing(spacing, spacing, spacing)
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(order="F"), deep=True))
    edges = vtkFlyingEdges3D()
    edges.SetInputData(image)
    edges.SetValue(0, 0.0)
    edges.ComputeNormalsOff()
    edges.ComputeScalarsOff()
    edges.Update()
    mesh = edges.GetOutput()
    points = vtk_to_numpy(mesh.GetPoints().GetData()).astype(np.float64)
    triangles = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    surface = Surface(points, triangles)
    return surface if surface.volume > 0 else Surface(points, triangles[:, ::-1])
