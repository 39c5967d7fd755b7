"""Laplace's approximation where a solver ended: a normal law of the coefficients, with the hyperparameters' doubt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .hyperparameters import DISCREPANCY, FORCE, NOISE, QUADRATURE
from .local_model import LocalModel
from .posterior import Posterior

Floats = NDArray[np.float64]


def posterior(local: LocalModel) -> Posterior:
    """The normal law at a trial; the uncertainty of the hyperparameters moves its mean and widens its covariance.

    Args:
        local: the objective's model there.
    """
    informed = float(local.informed[local.problem.moving].sum())
    moved, spread = _by_hyperparameters(local)
    widened, force = _mixed_over_force_scale(local, spread)
    covariance = error_covariance(local) + moved @ spread @ moved.T + widened
    return Posterior(local.evaluation.coefficients, covariance, local.scales, informed, force)


def error_covariance(local: LocalModel) -> Floats:
    """Of this estimate, (k, k), where the model errs as much as it was seen to, though the cloud tells less.

    The estimate S (J' W D^-1 y) errs by S (P V P + J' W D^-1 D' D^-1 J) S with the larger variances V and D' of the
    model's error in place of those that it was made with, 1 / P and D: S itself where they are the same.

    Args:
        local: the objective's model at the end.
    """
    if local.problem.error is None or local.scales.discrepancy >= 1.0:
        return local.inverse
    whole = local.eta.copy()
    whole[DISCREPANCY] = np.log(local.scales.margin_discrepancy)
    held = local.precision**2 * np.exp(local.problem.prior_variances(whole)[0])
    believed, seen = (local.evidence.noise(each)[0] for each in (local.eta, whole))
    told = local.evidence.problem.weighted(np.exp(seen - 2.0 * believed))[0]
    return local.inverse @ (np.diag(held) + told) @ local.inverse


def _by_hyperparameters(local: LocalModel) -> tuple[Floats, Floats]:
    """Derivative of the mean by the logarithms of the hyperparameters, (k, h), and their covariance, (h, h)."""
    _, slopes = local.problem.prior_variances(local.eta)
    columns = (slopes * (local.precision * local.evaluation.coefficients)).T
    residuals = local.problem.residuals(local.evaluation, local.point_noise)
    share = (local.noise / local.deviations) ** 2  # of a distance's variance that is its own noise
    weighted = local.weights * residuals / local.deviations**2
    columns[:, NOISE] = 2.0 * (share * weighted) @ local.jacobian
    columns[:, DISCREPANCY] += 2.0 * ((1.0 - share) * weighted) @ local.jacobian
    return local.inverse @ columns, local.evidence.covariance(local.eta)


def _mixed_over_force_scale(local: LocalModel, spread: Floats) -> tuple[Floats | float, float]:
    """What the uncertainty of the forces' scale adds to the covariance, (k, k), and its root mean square, newtons.

    A force of which the cloud says nothing has the square of the scale as its variance, and a cloud that informs few
    directions leaves the scale uncertain. The covariance is therefore the mean of the conditional ones over the scale
    (integrated nested Laplace approximations: Rue, Martino and Chopin 2009, 3.2). Gauss-Hermite quadrature takes this
    mean with the evidence as density; the other hyperparameters follow the scale by linear regression.

    Args:
        local: the objective's model at the end.
        spread: covariance of the logarithms of the hyperparameters, (h, h).
    """
    deviation, evidence = np.sqrt(spread[FORCE, FORCE]), local.evidence
    law = evidence.conditional(local.eta)
    if deviation == 0.0 or law is None:
        return 0.0, local.scales.force
    line = spread[:, FORCE] / deviation
    nodes = [evidence.hyperprior.within(local.eta + place * line) for place, _ in QUADRATURE]
    density = np.array([np.log(weight) + 0.5 * place**2 for place, weight in QUADRATURE])
    density -= [evidence.value_alone(eta) for eta in nodes]
    parts = np.exp(density - density.max())
    parts /= parts.sum()
    widened = -law.root[:, None] * law.lower * law.root
    for part, there in zip(parts, map(evidence.conditional, nodes), strict=True):
        if there is not None:
            widened += (part * there.root)[:, None] * there.lower * there.root
    widened = np.tril(widened)
    return widened + np.tril(widened, -1).T, float(np.sqrt(parts @ np.exp(2.0 * np.array(nodes)[:, FORCE])))
