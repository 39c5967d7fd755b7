"""How far each point may be from where it was found: what is known of the unknowns, carried through the derivatives.

The posterior of forces, pose and model error is normal (Laplace) and of low rank; so is that of the displacement (the
design is hIPPYlib's GaussianLRPosterior: Villa, Petra and Ghattas, ACM Trans. Math. Softw. 47 (2021)).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.special import chdtri

from softtwin.meshes.embedding import Embedding

from .evaluation import Evaluation
from .forward import ReducedModel
from .parameters.nodal_forces import NodalForces
from .policy import ACCURACY
from .posterior import Posterior
from .problem import Problem

Floats = NDArray[np.float64]
CoordinateFrame = Literal["body", "camera"]  # what is attached to the organ's support lies still, or what the camera is


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """A normal law of where the nodes are in one coordinate frame, about where they were found.

    The covariance is F F^T, and the square of a deviation of its own for each component of each node. A position that
    is given in another frame has another law: of what a cloud in the camera's coordinates shows, the place in these may
    be known well, and how much of it is the pose's and how much the displacement's may be known badly.

    Args:
        factor: F, (3n, r), metres.
        rest: of one component of each node, (n,), metres.
    """

    factor: Floats
    rest: Floats

    def covariances(self, points: Embedding | None = None) -> Floats:
        """Of the position of each point, (p, 3, 3), metres^2, on the axes of the frame.

        Args:
            points: carried by the body; the nodes if not given.
        """
        count = self.factor.shape[1]
        if points is None:
            factor, rest = self.factor.reshape(-1, 3, count), self.rest
        else:
            factor = (points.matrix @ self.factor.reshape(-1, 3 * count)).reshape(-1, 3, count)
            rest = points.matrix @ self.rest
        every = factor @ factor.transpose(0, 2, 1)
        every[:, range(3), range(3)] += np.square(rest)[:, None]
        return every

    def turned(self, rotation: Floats) -> Uncertainty:
        """The same on other axes.

        Args:
            rotation: from these axes to the others, (3, 3).
        """
        return Uncertainty(_turned(rotation, self.factor), self.rest)

    @cached_property
    def _of_nodes(self) -> Floats:
        return self.covariances()

    @cached_property
    def deviation(self) -> Floats:
        """Root mean square length of each node's error, (n,), metres."""
        return np.sqrt(np.trace(self._of_nodes, axis1=1, axis2=2))

    def margin(self, points: Embedding | None = None, confidence: float = 0.95) -> Floats:
        """Distance within which each point is of where it was found, with so much confidence, (p,), metres.

        The squared length of a normal error is taken as a multiple of chi-square with its mean and variance
        (Satterthwaite 1946).

        Args:
            points: carried by the body; the nodes if not given.
            confidence: in (0, 1).

        Raises:
            ValueError: another confidence.
        """
        return margins_of(self._of_nodes if points is None else self.covariances(points), confidence)


def margins_of(covariances: Floats, confidence: float = 0.95) -> Floats:
    """Distance within which a normal error of each covariance is, with so much confidence, (p,), metres.

    Args:
        covariances: (p, 3, 3), square metres.
        confidence: in (0, 1).

    Raises:
        ValueError: another confidence.
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"Uncertainty.margin.confidence: expected a number in (0, 1), got {confidence}.")
    mean = np.trace(covariances, axis1=1, axis2=2)
    if not np.isfinite(mean).all():
        return np.full(len(mean), np.inf)
    squares = np.einsum("pij,pij->p", covariances, covariances)
    known = squares > 0.0
    freedom = np.divide(mean**2, squares, out=np.ones_like(mean), where=known)
    factor = np.divide(squares, mean, out=np.zeros_like(mean), where=known)
    return np.sqrt(factor * np.exp(_log_quantile(confidence)(freedom)))


@lru_cache
def _log_quantile(confidence: float) -> CubicSpline:
    """Logarithm of chi-square's quantile by its degrees of freedom, 1 to 3 as a law of three components has."""
    freedom = np.linspace(0.99, 3.01, 203)
    return CubicSpline(freedom, np.log(chdtri(freedom, 1.0 - confidence)))


def unseen_response(model: ReducedModel, forces: NodalForces) -> Floats:
    """Displacements at rest by the directions left out, for unit scale, (3n, r): a factor of their covariance.

    Where they are many, random combinations stand for them: a variance is known to a fifth.

    Args:
        model: between the coefficients and the observed nodes.
        forces: the forces.
    """
    directions = forces.unseen
    if directions is None:
        return np.zeros((3 * forces.count, 0))
    if directions.shape[1] > ACCURACY.drawn:
        chance = np.random.default_rng(0).standard_normal((directions.shape[1], ACCURACY.drawn))
        directions = directions @ (chance / np.sqrt(ACCURACY.drawn))
    return np.asarray(model.solve(np.zeros(model.count)).full.jvp(directions))


def uncertainty(
    problem: Problem,
    evaluation: Evaluation,
    posterior: Posterior,
    unseen: Floats,
    frame: CoordinateFrame = "body",
    law_error: float = 0.0,
) -> Uncertainty:
    """What is known of where the nodes are, where a solver ended, in one coordinate frame.

    All unknowns have one posterior, with the correlations of pose and displacement. In the body's frame the position is
    x + u, which no pose moves: what the cloud does not tell of the pose is in it by the forces that would make up for
    it. In the camera's it is y = R (x + u) + t, with the derivatives of all.

    Args:
        problem: what was registered.
        evaluation: where.
        posterior: there.
        unseen: response to the directions of force that were left out, as from `unseen_response`.
        frame: of the positions: `body`, in which what holds the organ lies still, or `camera`, that of the cloud. They
            are one where no pose is unknown.
        law_error: standard deviation of a component of each node by what the material's law leaves out, metres.
    """
    rest = np.full(len(problem.observed.body.points), law_error)
    if problem.error is not None:
        left_out = problem.error.amplitude * problem.error.discrepancy.rest
        rest = np.hypot(rest, posterior.scales.margin_discrepancy * left_out)
    if not np.isfinite(posterior.covariance).all():  # of a cloud that tells nothing that could be believed
        return Uncertainty(np.zeros((3 * len(rest), 1)), np.full(len(rest), np.inf))
    slopes, moving = _by_unknowns(problem, evaluation), np.ones(problem.size, dtype=bool)
    moving[problem.moving.stop :] = False
    if frame == "camera" and problem.pose is not None and evaluation.pose is not None:
        places = problem.observed.body.points + evaluation.state.full.displacement + problem.correction(evaluation)
        slopes, unseen = _turned(evaluation.pose.rotation, slopes), _turned(evaluation.pose.rotation, unseen)
        by_pose = problem.pose.seen_jacobian(evaluation.coefficients[problem.pose_part], places)
        slopes[:, problem.pose_part] = by_pose.reshape(-1, by_pose.shape[2])
    else:
        moving[problem.pose_part] = False
    values, vectors = np.linalg.eigh(posterior.covariance[np.ix_(moving, moving)])  # the others are integrated out
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return Uncertainty(np.hstack([slopes[:, moving] @ root, posterior.force * unseen]), rest)


def _by_unknowns(problem: Problem, evaluation: Evaluation) -> Floats:
    """Derivative of the displacement of all nodes by the coefficients, (3n, k), metres, on the body's axes.

    Those of pose and correlated noise move no node.
    """
    slopes = np.zeros((problem.observed.body.points.size, problem.size))
    for block, part in problem.parts:
        columns = block.full_columns(evaluation, evaluation.coefficients[part])
        if columns is not None:
            slopes[:, part] = columns
    return slopes


def _turned(rotation: Floats, columns: Floats) -> Floats:
    """Nodal vectors, (3n, k), on other axes."""
    turned = np.einsum("ij,njk->nik", rotation, columns.reshape(len(columns) // 3, 3, columns.shape[1]))
    return turned.reshape(columns.shape)
