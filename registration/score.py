"""Whether a cloud asks for something that is no unknown of the registration: Rao's score test at the state found.

With distances y = J theta + c a + noise about the state, all unknowns theta are integrated out with what is believed of
them; of a the estimate is (c' V c)^-1 c' V y with V = (C + J P^-1 J')^-1, and its square in that metric is chi-square
where a is zero (Rao 1948). By Woodbury's formula V y are the weighted residuals that the registration has left. Robust
weights make the statistic smaller where the model is right, so that chances are upper bounds there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .gauss_newton import LocalModel

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Score:
    """What a cloud says of parameters that were left out.

    Args:
        estimate: of each to first order, (m,).
        statistic: its square over its covariance: chi-square with m degrees of freedom where all are zero.
    """

    estimate: Floats
    statistic: float

    @property
    def p_value(self) -> float:
        """Chance of so large a statistic where all are zero."""
        return float(chi2.sf(self.statistic, len(self.estimate)))


def score(local: LocalModel, columns: Floats) -> Score | None:
    """The test at the end of a registration; None where the cloud tells nothing of the parameters.

    Args:
        local: the objective's model there.
        columns: derivative of the distances by the parameters, (p, m).
    """
    weights = local.weights / local.deviations**2
    weighted = weights[:, None] * columns
    across = local.jacobian.T @ weighted
    solved = local.solved(across)
    information = columns.T @ weighted - across.T @ solved
    # What the last step, which was not taken, would still change of the residuals counts, too.
    pull = solved.T @ local.gradient - weighted.T @ local.problem.residuals(local.evaluation, local.own)
    values, vectors = np.linalg.eigh(information)
    scale = np.diag(columns.T @ weighted).max(initial=0.0)
    if not len(values) or not values[0] > np.finfo(float).eps * len(weights) * scale:
        return None
    estimate = vectors @ ((vectors.T @ pull) / values)
    return Score(estimate, float(pull @ estimate))


def by_scale(local: LocalModel) -> Floats:
    """Derivative of the distances by the logarithm of the cloud's scale about its middle, (p, 1), metres.

    Noise across a curved or coarse surface looks like a larger cloud: the score of a right one is not chi-square there.
    Its law has to be drawn at the state before a verdict can be based on it.
    """
    match, arms = local.evaluation.match, _arms(local)
    return -np.einsum("pi,pi->p", match.directions, arms)[:, None]


def by_rigid_motion(local: LocalModel) -> Floats:
    """Derivative of the distances by a turn, radians, and a shift, metres, of the cloud about its middle, (p, 6)."""
    normals = local.evaluation.match.directions
    return -np.hstack([np.cross(_arms(local), normals), normals])


def _arms(local: LocalModel) -> Floats:
    """From the middle of the points that count to each point, (p, 3), metres."""
    cloud, kept = local.evaluation.cloud, local.weights > 0.0
    return np.asarray(cloud - cloud[kept].mean(axis=0)) if kept.any() else cloud - cloud.mean(axis=0)
