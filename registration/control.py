"""The unknowns of a registration: nodal forces on the nodes that a tool may touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_SMALLEST_VARIANCE = 1e-5  # of a pattern of forces, relative to the largest: rougher ones are left out


@dataclass(frozen=True, eq=False)
class Control:
    """Forces as a linear function of coefficients that are independent and of unit variance beforehand.

    Args:
        nodes: nodes that may carry force, (a,).
        basis: nodal forces of each coefficient, (3n, k), newtons.
    """

    nodes: Ints
    basis: Floats

    def forces(self, coefficients: Floats) -> Floats:
        """Nodal forces, (n, 3), newtons."""
        return (self.basis @ coefficients).reshape(-1, 3)

    def net_force(self, coefficients: Floats) -> Floats:
        """Sum of the nodal forces, (3,), newtons."""
        return self.forces(coefficients).sum(axis=0)

    @property
    def net_basis(self) -> Floats:
        """Net force of each coefficient, (3, k), newtons."""
        return self.basis.reshape(-1, 3, self.basis.shape[1]).sum(axis=0)


def nodal_control(body: Body, nodes: ArrayLike, force_scale: float = 0.1, smoothness: float = 0.0) -> Control:
    """Three force components at every node of a zone.

    The prior is Gaussian with standard deviation `force_scale` at each node; with a smoothness length s, the forces of
    two nodes at distance d correlate by exp(-d^2 / 2 s^2), so that a smooth pull is cheaper than a scattered one.

    Args:
        body: the body.
        nodes: nodes that may carry force; fixed and inner ones are left out.
        force_scale: expected size of a nodal force component, newtons.
        smoothness: correlation length, metres; 0 for independent nodes (the L2 penalty of Odot 2023, eq. 6.5, squared).

    Raises:
        ValueError: no node is left, or a scale that is not positive.
    """
    if not force_scale > 0.0:
        raise ValueError(f"nodal_control.force_scale: expected a positive force in newtons, got {force_scale}.")
    chosen = np.setdiff1d(np.intersect1d(np.asarray(nodes, dtype=np.int64), body.boundary_nodes), body.fixed)
    if len(chosen) == 0:
        raise ValueError(
            f"nodal_control.nodes: expected nodes on the free boundary, none of the {np.size(nodes)} given is; "
            "give the zone that the tool may touch."
        )
    root = force_scale * _correlation_root(body.points[chosen], smoothness)
    basis = np.zeros((len(body.points), 3, 3 * root.shape[1]))
    for axis in range(3):
        basis[chosen, axis, axis::3] = root
    return Control(chosen, basis.reshape(-1, 3 * root.shape[1]))


def _correlation_root(positions: Floats, smoothness: float) -> Floats:
    """Independent patterns of nodal forces, (a, m), whose covariance is the correlation; few where it is smooth."""
    if smoothness <= 0.0:
        return np.eye(len(positions))
    squared = ((positions[:, None] - positions[None]) ** 2).sum(axis=2)
    correlation = np.exp(-squared / (2.0 * smoothness**2))
    variances, modes = np.linalg.eigh(correlation)
    kept = variances > _SMALLEST_VARIANCE * variances[-1]
    return modes[:, kept] * np.sqrt(variances[kept])
