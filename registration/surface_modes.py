"""Smooth fields over a surface: eigenmodes of its Laplacian, and how a Gaussian process spreads over them.

What neighbouring points err alike is a field over the side that is seen, of Matérn's covariance; a vector field, whose
component along the normal the distances see. In the eigenmodes of the Laplacian its coefficients are independent, and
only their variances, the spectral density at the eigenvalues, depend on its size and length (Solin and Särkkä 2020; on
surfaces Borovitskiy et al. 2020): both can be sought without looking at the points again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import eigsh

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SurfaceModes:
    """The smoothest functions on a surface, of mean square 1 over its area.

    Args:
        values: eigenvalues of minus the Laplacian, ascending, (q,), 1/m^2.
        modes: at the vertices, (v, q).
        area: of the surface, square metres.
    """

    values: Floats
    modes: Floats
    area: float

    def at(self, triangles: Ints, weights: Floats) -> Floats:
        """The modes at points of the surface, (p, q).

        Args:
            triangles: corners of the triangles that hold them, (p, 3).
            weights: barycentric, (p, 3).
        """
        found: Floats = np.einsum("pk,pkq->pq", weights, self.modes[triangles])
        return found

    def leading(self, count: int) -> SurfaceModes:
        """The smoothest so many."""
        return SurfaceModes(self.values[:count], self.modes[:, :count], self.area)

    def log_variances(self, length: float, smoothness: float = 1.5) -> tuple[Floats, Floats]:
        """Logarithms of the modes' variances in a field of unit variance, and their derivatives by that of the length.

        Those of a smaller length than the modes show add up to less than 1: the rest is in the modes that are left out.

        Args:
            length: over which the field changes, metres.
            smoothness: of Matérn's covariance.

        Returns:
            (q,) and (q,).

        Raises:
            ValueError: a length or a smoothness that is not positive.
        """
        if not (0.0 < length < np.inf and 0.0 < smoothness < np.inf):
            raise ValueError(f"SurfaceModes.log_variances: expected positive numbers, got {length} and {smoothness}.")
        base = 2.0 * smoothness / length**2
        falling = -(smoothness + 1.0) * np.log(base + self.values)
        sloped = 2.0 * (smoothness + 1.0) * base / (base + self.values)
        # By Weyl's law the modes that are left out lie as densely as those of a plane.
        beyond = self.area / (4.0 * np.pi * smoothness) * (base + self.values[-1]) ** -smoothness
        beyond_sloped = 2.0 * smoothness * base / (base + self.values[-1])
        kept = np.exp(falling)
        total = float(kept.sum() + beyond)
        return falling - np.log(total), sloped - float(kept @ sloped + beyond * beyond_sloped) / total


def surface_modes(points: Floats, triangles: Ints, count: int) -> SurfaceModes:
    """Modes of linear elements with lumped mass; nothing flows across the edges of an open surface.

    Args:
        points: vertices, (v, 3), metres.
        triangles: (t, 3).
        count: largest number of modes; there are at most two fewer than vertices.

    Raises:
        ValueError: fewer than three vertices, no mode wanted, points that are not finite, or a surface without area.
    """
    if len(points) < 3 or count < 1:
        raise ValueError(f"surface_modes: expected 3 vertices and 1 mode at least, got {len(points)} and {count}.")
    if not np.isfinite(points).all() or not np.ptp(points, axis=0).any():
        raise ValueError("surface_modes.points: expected finite places that are apart, got NaN, or one place alone.")
    stiffness, mass = _laplacian(points, triangles)
    count = min(count, len(points) - 2)
    root = 1.0 / np.sqrt(mass)
    scaled = csc_array(diags_array(root) @ stiffness @ diags_array(root))
    size = float(mass.sum())
    rng = np.random.default_rng(0)
    values, vectors = eigsh(scaled, count, sigma=-1.0 / size, v0=rng.standard_normal(len(points)))
    order = np.argsort(values)
    modes = root[:, None] * vectors[:, order] * np.sqrt(size)
    return SurfaceModes(np.maximum(values[order], 0.0), np.ascontiguousarray(modes), size)


def _laplacian(points: Floats, triangles: Ints) -> tuple[csc_array, Floats]:
    """Stiffness, (v, v), and lumped mass, (v,), square metres, of linear elements on triangles."""
    corners = points[triangles]
    edges = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)  # the one that faces each corner
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    doubled = np.maximum(doubled, 1e-12 * doubled.max(initial=1e-300))
    blocks = np.einsum("tai,tbi->tab", edges, edges) / (2.0 * doubled)[:, None, None]
    rows, columns = np.repeat(triangles, 3, axis=1).ravel(), np.tile(triangles, (1, 3)).ravel()
    stiffness = csc_array(coo_array((blocks.ravel(), (rows, columns)), shape=(len(points), len(points))))
    mass = np.bincount(triangles.ravel(), np.repeat(doubled / 6.0, 3), minlength=len(points))
    return stiffness, np.maximum(mass, 1e-12 * mass.max())
