"""Measures of error and of mesh quality: arrays in, numbers out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .body import HEXAHEDRON_FACES, TETRAHEDRON_FACES, Body, Floats, Ints, corner_jacobians
from .elements import linear_kind
from .quadrature import quadrature, quadrature_degree, shape_functions

# Local edges of a cell (VTK numbering), and the two faces that meet at each edge of a tetrahedron.
TETRAHEDRON_EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
HEXAHEDRON_EDGES = np.array(
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]]
)

_PLURALS = {
    "triangle": "triangles",
    "quadrilateral": "quadrilaterals",
    "tetrahedron": "tetrahedra",
    "hexahedron": "hexahedra",
}
# What makes the scaled Jacobian of a regular simplex 1, by dimension and corners.
_REGULAR = {(3, 4): float(np.sqrt(2)), (2, 3): float(2 / np.sqrt(3))}


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of distances, metres."""

    mean: float
    rms: float
    p95: float
    max: float

    def __str__(self) -> str:
        mean, rms, p95, largest = (f"{1e3 * x:.3g}" for x in (self.mean, self.rms, self.p95, self.max))
        return f"mean {mean} mm, rms {rms} mm, p95 {p95} mm, max {largest} mm"


def nodal_errors(displacement: ArrayLike, truth: ArrayLike) -> ErrorStatistics:
    """Mean, root mean square, 95th percentile and maximum of the nodal distances |u - u*|, metres.

    Args:
        displacement: found displacements, (..., n, 3), metres.
        truth: true displacements, same shape.

    Raises:
        ValueError: the shapes differ, are not (..., n, 3), or a value is not finite.
    """
    distances = nodal_distances(displacement, truth)
    return ErrorStatistics(
        mean=float(distances.mean()),
        rms=float(np.sqrt((distances**2).mean())),
        p95=float(np.percentile(distances, 95)),
        max=float(distances.max()),
    )


def target_errors(positions: ArrayLike, truth: ArrayLike) -> ErrorStatistics:
    """Target registration error: statistics of |x - x*| over target points (nodes, a tumour's vertices), metres.

    Args:
        positions: found positions (or displacements), (..., p, 3), metres.
        truth: true positions (or displacements), same shape.

    Raises:
        ValueError: as `nodal_errors`.
    """
    return nodal_errors(positions, truth)


def nodal_distances(displacement: ArrayLike, truth: ArrayLike) -> Floats:
    """Distances |u - u*| of every node, (..., n), metres.

    Args:
        displacement: found displacements, (..., n, 3), metres.
        truth: true displacements, same shape.

    Raises:
        ValueError: as `nodal_errors`.
    """
    found, true = _pair(displacement, truth)
    return np.linalg.norm(found - true, axis=-1)


def relative_error(displacement: ArrayLike, truth: ArrayLike) -> Floats:
    """Relative error |u - u*| / |u*| of each sample, (...); infinite where the truth is zero and u is not.

    Args:
        displacement: found displacements, (..., n, 3), metres.
        truth: true displacements, same shape.

    Raises:
        ValueError: as `nodal_errors`.
    """
    found, true = _pair(displacement, truth)
    error, norm = _norm(found - true), _norm(true)
    return np.divide(error, norm, out=np.where(error > 0, np.inf, 0.0), where=norm > 0)


def displacement_gradients(body: Body, displacement: ArrayLike) -> Floats:
    """Gradient of a displacement in the middle of each cell, (m, 3, 3), by the corners: du_i / dX_j.

    Args:
        body: the body.
        displacement: of its nodes, (n, 3), metres.

    Raises:
        ValueError: another shape.
    """
    moved = np.asarray(displacement, dtype=np.float64)
    if moved.shape != body.points.shape:
        raise ValueError(f"displacement: expected shape {body.points.shape}, got {moved.shape}.")
    kind = linear_kind(body.kind)
    middle = quadrature(kind, 1)[0].mean(axis=0, keepdims=True)
    slopes = shape_functions(kind, middle)[1][0]
    corners, vectors = body.points[body.corner_cells], moved[body.corner_cells]
    by_cell = np.linalg.inv(np.einsum("cki,kj->cij", corners, slopes))
    found: Floats = np.einsum("cki,kj,cjl->cil", vectors, slopes, by_cell)
    return found


def thesis_error(displacement: ArrayLike, truth: ArrayLike) -> Floats:
    """The thesis's e = |u - u*|_2 / n of each sample, (...), metres (Odot 2023, chapter 4).

    It falls with the square root of the number of nodes, so it compares nothing across meshes; it is here to
    set figures beside the thesis's.

    Args:
        displacement: found displacements, (..., n, 3), metres.
        truth: true displacements, same shape.

    Raises:
        ValueError: as `nodal_errors`.
    """
    found, true = _pair(displacement, truth)
    return _norm(found - true) / true.shape[-2]


@dataclass(frozen=True)
class ForceError:
    """Error of a net force: absolute in newtons, relative to the true net force (infinite where that is zero)."""

    newtons: float
    relative: float


def net_force_error(forces: ArrayLike, truth: ArrayLike) -> ForceError:
    """Error of the sum of nodal forces.

    Args:
        forces: found nodal forces, (n, 3), newtons.
        truth: true nodal forces, (k, 3), or the true net force, (3,), newtons.

    Raises:
        ValueError: wrong shapes.
    """
    found, true = np.atleast_2d(np.asarray(forces, float)), np.atleast_2d(np.asarray(truth, float))
    if found.shape[-1] != 3 or true.shape[-1] != 3 or found.ndim != 2 or true.ndim != 2:
        raise ValueError(f"forces, truth: expected shapes (n, 3), got {found.shape} and {true.shape}.")
    net = true.sum(axis=0)
    newtons, norm = float(np.linalg.norm(found.sum(axis=0) - net)), float(np.linalg.norm(net))
    relative = newtons / norm if norm > 0 else (0.0 if newtons == 0 else np.inf)
    return ForceError(newtons, relative)


def _pair(displacement: ArrayLike, truth: ArrayLike) -> tuple[Floats, Floats]:
    found, true = np.asarray(displacement, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if found.shape != true.shape or found.ndim < 2 or found.shape[-1] != 3 or found.size == 0:
        raise ValueError(f"displacement, truth: expected one shape (..., n, 3), got {found.shape} and {true.shape}.")
    if not (np.isfinite(found).all() and np.isfinite(true).all()):
        raise ValueError("displacement, truth: expected finite numbers, got NaN or infinity.")
    return found, true


def _norm(field: Floats) -> Floats:
    return np.sqrt((field**2).sum(axis=(-2, -1)))


@dataclass(frozen=True)
class MeshQuality:
    """How good a mesh is; print it for a readable table.

    Args:
        nodes: number of nodes.
        cells: number of cells.
        kind: `tetrahedra` or `hexahedra`; in the plane `triangles` or `quadrilaterals`.
        volume: total volume, of a sparse grid's cells the filled part, cubic metres; area, square metres, in the plane.
        min_scaled_jacobian: worst cell, 1 is ideal, 0 flat.
        mean_scaled_jacobian: mean over the cells.
        min_radius_ratio: three times inradius over circumradius of the worst tetrahedron, 1 is ideal;
            NaN for other cells.
        min_dihedral: smallest angle between two faces of a cell, degrees; at a corner in the plane.
        max_dihedral: largest one, degrees.
        volume_ratio: largest over smallest cell volume.
        min_edge: shortest edge, metres.
        mean_edge: mean edge, metres.
        max_edge: longest edge, metres.
    """

    nodes: int
    cells: int
    kind: str
    volume: float
    min_scaled_jacobian: float
    mean_scaled_jacobian: float
    min_radius_ratio: float
    min_dihedral: float
    max_dihedral: float
    volume_ratio: float
    min_edge: float
    mean_edge: float
    max_edge: float

    def __str__(self) -> str:
        edges = "{:.2f} / {:.2f} / {:.2f}".format(*(1e3 * x for x in (self.min_edge, self.mean_edge, self.max_edge)))
        plane = self.kind in ("triangles", "quadrilaterals")
        rows = [
            ("nodes", f"{self.nodes}"),
            (self.kind, f"{self.cells}"),
            ("area", f"{self.volume * 1e4:.4g} cm^2") if plane else ("volume", f"{self.volume * 1e3:.4g} litres"),
            ("scaled Jacobian, min / mean", f"{self.min_scaled_jacobian:.3f} / {self.mean_scaled_jacobian:.3f}"),
            ("radius ratio, min", "-" if np.isnan(self.min_radius_ratio) else f"{self.min_radius_ratio:.3f}"),
            (
                "angle, min / max" if plane else "dihedral angle, min / max",
                f"{self.min_dihedral:.1f} / {self.max_dihedral:.1f} degrees",
            ),
            ("cell area, max / min" if plane else "cell volume, max / min", f"{self.volume_ratio:.3g}"),
            ("edge, min / mean / max", f"{edges} mm"),
        ]
        return "\n".join(f"{name:<28} {value}" for name, value in rows)


def mesh_quality(body: Body) -> MeshQuality:
    """Quality figures of a body's mesh.

    Args:
        body: the body.
    """
    jacobians, volumes = scaled_jacobians(body.points, body.corner_cells), cell_volumes(body.points, body.corner_cells)
    edges, angles = edge_lengths(body.points, body.corner_cells), dihedral_angles(body.points, body.corner_cells)
    ratio = tetrahedron_quality(body.points, body.corner_cells).min() if body.is_tetrahedral else np.nan
    return MeshQuality(
        nodes=len(body.points),
        cells=len(body.cells),
        kind=_PLURALS[body.kind.shape],
        volume=float(volumes.sum() if body.fractions is None else body.fractions @ volumes),
        min_scaled_jacobian=float(jacobians.min()),
        mean_scaled_jacobian=float(jacobians.mean()),
        min_radius_ratio=float(ratio),
        min_dihedral=float(angles.min()),
        max_dihedral=float(angles.max()),
        volume_ratio=float(volumes.max() / volumes.min()),
        min_edge=float(edges.min()),
        mean_edge=float(edges.mean()),
        max_edge=float(edges.max()),
    )


def tetrahedron_quality(points: Floats, cells: Ints) -> Floats:
    """Radius ratio 3 r / R (inradius over circumradius) of tetrahedra, (m,): 1 regular, 0 flat, negative inverted.

    Args:
        points: node positions, (n, 3).
        cells: node numbers, (m, 4).
    """
    a, b, c = (points[cells[:, i]] - points[cells[:, 0]] for i in (1, 2, 3))
    six_volumes = np.einsum("mi,mi->m", a, np.cross(b, c))
    faces = points[cells[:, TETRAHEDRON_FACES]]
    areas = 0.5 * np.linalg.norm(np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0]), axis=2)
    squares = [(v**2).sum(axis=1)[:, None] for v in (a, b, c)]
    # Circumcentre relative to the first corner, times 2 * 6V.
    centre = squares[0] * np.cross(b, c) + squares[1] * np.cross(c, a) + squares[2] * np.cross(a, b)
    product = np.linalg.norm(centre, axis=1) * areas.sum(axis=1)
    flat = product <= 0
    return np.where(flat, 0.0, 3 * six_volumes * np.abs(six_volumes) / np.where(flat, 1.0, product))


def cell_volumes(points: Floats, cells: Ints) -> Floats:
    """Volumes of cells, (m,), cubic metres; exact for tetrahedra and for trilinear hexahedra. Areas in the plane.

    Args:
        points: node positions, (n, 3), metres; (n, 2) in the plane.
        cells: node numbers of the corners, (m, 4) or (m, 8); (m, 3) or (m, 4) in the plane.
    """
    if points.shape[1] == 2:
        x, y = np.moveaxis(points[cells], 2, 0)
        return 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    if cells.shape[1] == 4:
        return corner_jacobians(points, cells)[:, 0] / 6
    # The divergence theorem over the six bilinear faces, each the mean of its two triangulations.
    corners = points[cells[:, HEXAHEDRON_FACES]] - points[cells[:, :1]][:, None]
    total = np.zeros(len(cells))
    for split in ([0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]):
        a, b, c = (corners[:, :, i] for i in split)
        total += np.einsum("mfi,mfi->m", a, np.cross(b, c))
    return total / 12


def nodal_volumes(body: Body) -> Floats:
    """Integral of each node's shape function over the body, (n,), cubic metres: they add up to its volume.

    Of a sparse grid the filled part of each cell, as for its energy and its weight.

    Args:
        body: the body.
    """
    points, weights = quadrature(body.kind, quadrature_degree(body))
    values, slopes = shape_functions(body.kind, points)
    jacobians = np.linalg.det(np.einsum("cki,qkj->cqij", body.points[body.cells], slopes))
    filled = np.ones(len(body.cells)) if body.fractions is None else body.fractions
    shares = np.einsum("c,cq,q,qk->ck", filled, jacobians, weights, values)
    found: Floats = np.bincount(body.cells.ravel(), shares.ravel(), minlength=len(body.points)).astype(np.float64)
    return found


def scaled_jacobians(points: Floats, cells: Ints) -> Floats:
    """Smallest scaled Jacobian of each cell, (m,): 1 for regular simplices, cubes and squares, 0 flat.

    Args:
        points: node positions, (n, 3), metres; (n, 2) in the plane.
        cells: node numbers of the corners, (m, 4) or (m, 8); (m, 3) or (m, 4) in the plane.
    """
    local = _local_edges(points, cells)
    edges = points[cells[:, local[:, 1]]] - points[cells[:, local[:, 0]]]
    lengths = np.linalg.norm(edges, axis=2)
    meeting = np.array([np.flatnonzero((local == corner).any(axis=1)) for corner in range(cells.shape[1])])
    scaled = corner_jacobians(points, cells) / lengths[:, meeting].prod(axis=2)
    return scaled.min(axis=1) * _REGULAR.get((points.shape[1], cells.shape[1]), 1.0)


def edge_lengths(points: Floats, cells: Ints) -> Floats:
    """Lengths of the edges of a mesh, each edge once, metres.

    Args:
        points: node positions, (n, 3), metres; (n, 2) in the plane.
        cells: node numbers of the corners, (m, 4) or (m, 8); (m, 3) or (m, 4) in the plane.
    """
    edges = np.unique(np.sort(cells[:, _local_edges(points, cells)].reshape(-1, 2), axis=1), axis=0)
    return np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)


def dihedral_angles(points: Floats, cells: Ints) -> Floats:
    """Angles between the faces that meet at the edges of each cell, (m, 6) or (m, 12); corner angles in the plane.

    All in degrees.

    Args:
        points: node positions, (n, 3), metres; (n, 2) in the plane.
        cells: node numbers of the corners, (m, 4) or (m, 8); (m, 3) or (m, 4) in the plane.
    """
    if points.shape[1] == 2:
        ahead = np.roll(points[cells], -1, axis=1) - points[cells]
        back = -np.roll(ahead, 1, axis=1)
        cross = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
        return np.degrees(np.arctan2(cross, (ahead * back).sum(axis=2))) % 360.0
    local = TETRAHEDRON_FACES if cells.shape[1] == 4 else HEXAHEDRON_FACES
    corners = points[cells[:, local]]
    # The diagonals' product is the mean normal of a quadrilateral, and twice the area vector of a triangle.
    normals = (
        np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        if cells.shape[1] == 4
        else np.cross(corners[:, :, 2] - corners[:, :, 0], corners[:, :, 3] - corners[:, :, 1])
    )
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    first, second = _face_pairs(local)
    cosines = np.einsum("mei,mei->me", normals[:, first], normals[:, second])
    return 180.0 - np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def _local_edges(points: Floats, cells: Ints) -> Ints:
    if points.shape[1] == 2:
        corners = np.arange(cells.shape[1])
        return np.column_stack([corners, np.roll(corners, -1)])
    return TETRAHEDRON_EDGES if cells.shape[1] == 4 else HEXAHEDRON_EDGES


def _face_pairs(faces: Ints) -> tuple[Ints, Ints]:
    pairs = [
        (i, j) for i in range(len(faces)) for j in range(i) if len(set(faces[i].tolist()) & set(faces[j].tolist())) == 2
    ]
    first, second = np.array(pairs).T
    return first, second
