"""Unknown nodal forces through few directions: which of them a cloud informs, and where forces are sought again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lstsq
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from softtwin.meshes.body import Body
from softtwin.meshes.embedding import outer, outer_nodes

from ..evaluation import Evaluation, Slopes
from ..forward import ReducedModel
from ..hyperparameters import FORCE as SCALE
from ..hyperparameters import LogNormalPrior
from ..policy import ACCURACY, POLICY
from ..surface_distance import SurfaceDistance
from .block import ParameterBlock

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_SMALLEST_VARIANCE = 1e-5  # of a pattern of forces, relative to the largest: rougher ones are left out
_MOST_PATTERNS = 300  # of one component: on a surface as large as a liver waves down to 1.4 smoothness lengths
_WHOLE = 100.0  # of its changes, that a pressure presses a body as a whole: so much that nothing is believed of it
_TANGENTIAL = 0.5  # weight of movements along the observed side: they become normal where it turns
FORCE = LogNormalPrior(0.01, 2.0, minimum=1e-5)


@dataclass(frozen=True, eq=False)
class NodalForces(ParameterBlock):
    """Nodal forces as a linear function of coefficients, independent and of one scale beforehand.

    Args:
        nodes: nodes that may carry force, (a,).
        patterns: forces at these nodes for each coefficient, (3a, k), dimensionless: coefficients are in newtons.
        count: number of nodes of the body, n.
        scale: what is believed of the coefficients' standard deviation, newtons.
        left_out: covariance of the net force of directions that were left out, for unit scale, (3, 3).
        every: the patterns before any direction was left out, (3a, m); None where none was.
        kept: orthonormal combinations of these that are left, (m, k); None as above.
    """

    has_own_figures: ClassVar[bool] = True

    nodes: Ints
    patterns: Floats
    count: int
    scale: LogNormalPrior = FORCE
    left_out: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    every: Floats | None = None
    kept: Floats | None = None

    @property
    def size(self) -> int:
        """Number of coefficients, k."""
        return self.patterns.shape[1]

    def hyperpriors(self, observed: SurfaceDistance) -> Mapping[int, LogNormalPrior]:
        """Of the coefficients' standard deviation."""
        return {SCALE: self.scale if self.size else replace(self.scale, spread=0.0)}

    def log_variances(self, eta: Floats) -> tuple[float, Mapping[int, float]]:
        """See `ParameterBlock.log_variances`."""
        return 2.0 * float(eta[SCALE]), {SCALE: 2.0}

    def jacobian(self, at: Evaluation, coefficients: Floats, slopes: Slopes) -> Floats:
        """See `ParameterBlock.jacobian`."""
        return at.state.jacobian(slopes.rows)

    def vjp(self, at: Evaluation, coefficients: Floats, slopes: Slopes, cotangent: Floats) -> Floats:
        """See `ParameterBlock.vjp`: by the adjoint state."""
        full = np.zeros_like(at.observed.body.points)
        full[at.observed.nodes] = (slopes.rows.T @ cotangent).reshape(-1, 3)
        found: Floats = at.stiffness_scaling * (at.state.full.vjp(full).ravel() @ self.basis)
        return found

    def moved(self, at: Evaluation, change: Floats, every: int) -> Floats:
        """See `ParameterBlock.moved`."""
        return at.state.moved(change, every)

    def full_columns(self, at: Evaluation, coefficients: Floats) -> Floats | None:
        """See `ParameterBlock.full_columns`."""
        return at.stiffness_scaling * at.state.full.jvp(self.basis) if self.size else None

    @cached_property
    def basis(self) -> Floats:
        """Forces at all nodes of the body for each coefficient, (3n, k)."""
        return self._at_all(self.patterns)

    def _at_all(self, patterns: Floats) -> Floats:
        count = patterns.shape[1]
        whole = np.zeros((self.count, 3, count))
        whole[self.nodes] = patterns.reshape(len(self.nodes), 3, count)
        return whole.reshape(3 * self.count, count)

    @property
    def unseen(self) -> Floats | None:
        """Forces at all nodes of the directions that were left out, (3n, m), dimensionless; None where none was."""
        if self.every is None or self.kept is None:
            return None
        return self._at_all(self.every - (self.every @ self.kept) @ self.kept.T)

    def forces(self, coefficients: Floats) -> Floats:
        """Nodal forces, (n, 3), newtons."""
        whole = np.zeros((self.count, 3))
        whole[self.nodes] = (self.patterns @ coefficients).reshape(len(self.nodes), 3)
        return whole

    def nearest(self, nodal: Floats) -> Floats:
        """Coefficients, (k,), of the forces of this kind that are nearest to nodal ones, (n, 3), newtons."""
        wanted, driver = nodal[self.nodes].ravel(), "gelsy"  # several times as fast as by singular values
        found: Floats = lstsq(self.patterns, wanted, check_finite=False, lapack_driver=driver)[0]
        return found

    def combined(self, kept: Floats) -> NodalForces:
        """The forces in orthonormal combinations of their directions; the net force of the others is left in doubt.

        Args:
            kept: combinations, (k, kept).
        """
        rest = self.net_basis - (self.net_basis @ kept) @ kept.T
        every = self.patterns if self.every is None else self.every
        left = self.left_out + rest @ rest.T
        both = kept if self.kept is None else self.kept @ kept
        return replace(self, patterns=self.patterns @ kept, left_out=left, every=every, kept=both)

    def leading(self, count: int) -> NodalForces:
        """The first directions alone: those that move the observed side most, where they were reduced."""
        kept = None if self.kept is None else self.kept[:, :count]
        return replace(self, patterns=self.patterns[:, :count], kept=kept)

    @cached_property
    def net_basis(self) -> Floats:
        """Net force of each coefficient, (3, k)."""
        return _net(self.patterns)


def _net(patterns: Floats) -> Floats:
    """Net force of each pattern, (3, k)."""
    return _parted_net(np.ones(len(patterns)), patterns)


def nodal_forces(body: Body, nodes: ArrayLike, scale: LogNormalPrior = FORCE, smoothness: float = 0.0) -> NodalForces:
    """Three force components at every node of a zone.

    With a smoothness length s, the forces of two nodes at distance d correlate by exp(-d / s), so that a pull on a
    patch is cheaper than a scattered one. What touches an organ does so on a patch with an edge: the power of a disc's
    indicator falls as the third power of the wave number, and so does that of this correlation (Matern's of order 1/2
    on a surface: Rasmussen and Williams 2006, 4.2). A smoother one takes the edge for impossible, and is too sure of
    what it finds. Near d = 0 it falls as the overlap of a disc of radius 2 s / pi with itself moved by d.

    Args:
        body: the body.
        nodes: nodes that may carry force; fixed and inner ones are left out.
        scale: expected size of a nodal force component, newtons, and how well it is known.
        smoothness: correlation length, metres; 0 for independent nodes (the L2 penalty of Odot 2023, eq. 6.5, squared).

    Raises:
        ValueError: no node is left, or a smoothness that is negative.
    """
    chosen = _free_boundary("nodal_forces", body, nodes, smoothness)
    root = _correlation_root(body.points[chosen], smoothness, lambda lengths: np.exp(-lengths), _MOST_PATTERNS)
    return NodalForces(chosen, np.kron(root, np.eye(3)), len(body.points), scale)


def normal_forces(body: Body, nodes: ArrayLike, scale: LogNormalPrior = FORCE, smoothness: float = 0.0) -> NodalForces:
    """Forces along the normal of the surface at rest alone: an unknown pressure, under which neighbours slide.

    So what surrounds an organ acts that is not grown together with it, as ribs and diaphragm on a lung. The pressure is
    a part that is the same all over, one that depends on where the surface faces, n' S n for a unit normal n and a
    symmetric S without trace, and smooth changes: what surrounds an organ has no edge, and those of two nodes at
    distance d correlate by exp(-d^2 / 2 s^2). Of the first two nothing is believed: they press and stretch the organ as
    a whole, and go on where no point is seen, as changes, which are local, do not.

    Args:
        body: the body.
        nodes: nodes that may carry force; fixed and inner ones are left out.
        scale: expected size of the changes' force at a node of average area, newtons, and how well it is known.
        smoothness: correlation length of the changes, metres; 0 for independent nodes.

    Raises:
        ValueError: as for `nodal_forces`.
    """
    chosen = _free_boundary("normal_forces", body, nodes, smoothness)
    surface = outer(body)
    normals = surface.along_normals(np.ones(len(surface.rest.points)))[chosen]
    normals /= np.linalg.norm(normals, axis=1).mean()
    pressures = _correlation_root(body.points[chosen], smoothness, lambda lengths: np.exp(-0.5 * lengths**2))
    pressures = np.hstack([np.full((len(chosen), 1), _WHOLE), _WHOLE * _by_facing(normals), pressures])
    patterns = normals[:, :, None] * pressures[:, None, :]
    return NodalForces(chosen, patterns.reshape(3 * len(chosen), -1), len(body.points), scale)


def _by_facing(normals: Floats) -> Floats:
    """Pressures n' S n at unit normals n, (a, 5), for five independent S: together of unit variance for each n.

    Args:
        normals: of any length, (a, 3); one of none carries no pressure.
    """
    x, y, z = (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)).T
    across = np.sqrt(3.0) * np.column_stack([x * y, x * z, y * z])
    found: Floats = np.column_stack([across, np.sqrt(0.75) * (x * x - y * y), 1.5 * z * z - 0.5])
    return found


def _free_boundary(name: str, body: Body, nodes: ArrayLike, smoothness: float) -> Ints:
    """Those of the nodes that may carry force."""
    if not 0.0 <= smoothness < np.inf:
        raise ValueError(f"{name}.smoothness: expected a length of 0 m or more, got {smoothness}.")
    chosen = np.setdiff1d(np.intersect1d(np.asarray(nodes, dtype=np.int64), outer_nodes(body)), body.fixed)
    if len(chosen) == 0:
        raise ValueError(
            f"{name}.nodes: expected nodes on the free boundary, none of the {np.size(nodes)} given is; "
            "give the zone that the tool may touch."
        )
    return chosen


def known_forces(body: Body, scale: LogNormalPrior = FORCE) -> NodalForces:
    """No unknown force: all that acts is the model's own loading.

    Args:
        body: the body.
        scale: without effect.
    """
    return NodalForces(np.zeros(0, dtype=np.int64), np.zeros((0, 0)), len(body.points), scale)


def _correlation_root(
    positions: Floats, smoothness: float, correlation: Callable[[Floats], Floats], most: int | None = None
) -> Floats:
    """Independent patterns of nodal forces, (a, m), whose covariance is the correlation; few where it is smooth.

    Args:
        positions: of the nodes, (a, 3), metres.
        smoothness: correlation length, metres; 0 for independent nodes.
        correlation: of two nodes by their distance in correlation lengths.
        most: patterns, the smoothest ones; None for all. Of a law with edges too many are not small.
    """
    if smoothness <= 0.0:
        return np.eye(len(positions))
    lengths = cdist(positions, positions) / smoothness
    variances, modes = np.linalg.eigh(correlation(lengths))
    kept = variances > _SMALLEST_VARIANCE * variances[-1]
    if most is not None:
        kept[:-most] = False
    return modes[:, kept] * np.sqrt(variances[kept])


@dataclass(frozen=True)
class LikelihoodInformed:
    """Which directions of force a cloud can tell: those that move the observed side by more than the noise.

    Args:
        noise: least noise of a point expected, metres.
        points: number of points of a cloud expected.
        size: largest size of the forces reckoned with, times the one expected.
        information: directions whose expected information, in units of the prior's, is below this are left out.
        maximum: most directions kept.
    """

    noise: float = field(default_factory=lambda: POLICY.noise_minimum)
    points: int = 500
    size: float = field(default_factory=lambda: ACCURACY.force_size_maximum)
    information: float = 0.5
    maximum: int = 96


def likelihood_informed(
    model: ReducedModel, observed: SurfaceDistance, rule: LikelihoodInformed, scale: float
) -> Floats:
    """Orthonormal combinations of a force basis that a cloud can tell at rest, (k, kept), those told best first.

    They are the leading eigenvectors of the prior-whitened Gauss-Newton matrix at rest: the likelihood-informed
    subspace (Spantini et al. 2015).

    Args:
        model: between the coefficients of the basis and the observed nodes.
        observed: the observed side.
        rule: what is told from what.
        scale: size of a force that is expected, newtons.
    """
    moved = model.solve(np.zeros(model.count)).jacobian(_observing_rows(observed))
    squares, vectors = np.linalg.eigh(moved.T @ moved)
    information = squares[::-1] * (rule.size * scale / rule.noise) ** 2 * rule.points
    count = min(rule.maximum, max(int((information > rule.information).sum()), 1))
    return np.ascontiguousarray(vectors[:, ::-1][:, :count])


def localised(forces: NodalForces, where: Floats) -> NodalForces:
    """The forces where they may act: each node's share of the basis times its part.

    The net force of directions that were left out before stays in doubt. Their displacements do not: of a size that was
    found from the same cloud they hold too much of the error (robustness, no zone: with them 95 to 99.9 % of the nodes
    are in margins of 90, without 92 to 96).

    Args:
        forces: forces of which nothing is known of their place.
        where: part of its expected size that a force at each node may have, (n,).
    """
    parts = np.repeat(where[forces.nodes], 3)
    patterns = parts[:, None] * forces.patterns
    every = forces.patterns if forces.every is None else forces.every
    whole, kept = _parted_net(parts, every), _net(patterns)
    return replace(forces, patterns=patterns, left_out=whole @ whole.T - kept @ kept.T, every=None, kept=None)


def _parted_net(parts: Floats, patterns: Floats) -> Floats:
    """Net force of each pattern times its nodes' parts, (3, k), with no copy of the patterns."""
    axes = np.zeros((3, len(parts)))
    for axis in range(3):
        axes[axis, axis::3] = parts[axis::3]
    return axes @ patterns


def reweighting(
    forces: NodalForces, nodal: Floats, positions: Floats, reach: float, minimum: float | None = None
) -> Floats:
    """Where forces were found, as parts of the largest, (n,): the next prior of forces whose place is unknown.

    Repeated, forces gather where the cloud asks for them (re-weighted least squares: Gorodnitsky and Rao 1997).

    Args:
        forces: the unknown forces.
        nodal: forces found, (n, 3), newtons.
        positions: of the nodes at rest, (n, 3), metres.
        reach: forces within this distance count together, metres.
        minimum: no part is smaller: a force elsewhere stays possible; that of the policy if not given.
    """
    least = ACCURACY.force_elsewhere if minimum is None else minimum
    place = positions[forces.nodes]
    size = np.linalg.norm(nodal[forces.nodes], axis=1)
    near = cKDTree(place).sparse_distance_matrix(cKDTree(place), 3.0 * reach, output_type="coo_matrix")
    smooth = coo_array((np.exp(-0.5 * (near.data / reach) ** 2), (near.row, near.col)), shape=near.shape) @ size
    where = np.zeros(len(positions))
    where[forces.nodes] = np.maximum(smooth / max(smooth.max(), 1e-300), least)
    return where


def _observing_rows(observed: SurfaceDistance) -> csr_array:
    """Root mean square movement of the observed side as rows, (3v, 3m): along the normal, and less across it."""
    normals, share = observed.normals
    count = len(normals)
    blocks = _TANGENTIAL * np.eye(3) + (1.0 - _TANGENTIAL) * normals[:, :, None] * normals[:, None, :]
    blocks *= np.sqrt(share)[:, None, None]
    columns = np.repeat((3 * np.arange(count)[:, None] + np.arange(3))[:, None, :], 3, axis=1)
    indptr = np.arange(0, 9 * count + 1, 3)
    return observed.by_nodes(csr_array((blocks.ravel(), columns.ravel(), indptr), shape=(3 * count, 3 * count)))
