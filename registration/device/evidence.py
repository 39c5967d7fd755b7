"""Laplace's evidence of many clouds at once: its gradient, and a step of Fisher's scoring towards its maximum.

The same as `registration.evidence`, with the scales of noise, forces and the model's error, and with the covariance of
scores in place of a search: for a block i of unknowns of prior variance v_i, and S their covariance over the roots of
the prior variances, that is 2 |1 - S|^2 over the blocks i and j for two such scales, and 2 tr_i (S - S S) for one of
them and the noise.
"""

from __future__ import annotations

from math import log
from typing import NamedTuple

import torch
from torch import Tensor

from ..hyperparameters import QUADRATURE

NOISE, FORCE, ERROR = range(3)  # order of the scales' logarithms here
_LONGEST = 1.0  # of a logarithm, that one step may take
_STEP = 1e-5  # of a logarithm, for a difference
_AT_BOUND = 0.02  # of a logarithm: so near to a bound it lies at it
_TINY = 1e-300


class Sums(NamedTuple):
    """What the points tell, in groups of like variance: see `registration.evidence.LinearProblem`.

    Args:
        information: B' W B, (b, g, k, k).
        projection: B' W y, (b, g, k).
        square: y' W y, (b, g).
        weight: sums of the weights, (b, g).
        tail: for the tails that robust weights have cut off, (b, g).
        error: standard deviation of a distance by what the model gets wrong from point to point, (b, g), metres.
    """

    information: Tensor
    projection: Tensor
    square: Tensor
    weight: Tensor
    tail: Tensor
    error: Tensor


class Law(NamedTuple):
    """The unknowns' normal law at given scales, over the roots of their prior variances.

    Args:
        root: of the prior variances, (b, k).
        inverse: covariance, (b, k, k).
        mean: (b, k).
        precision: one over the groups' variances, (b, g).
        by_noise: derivatives of the logarithms of these variances, (b, 3, g).
        log_determinant: of the precision, (b,).
    """

    root: Tensor
    inverse: Tensor
    mean: Tensor
    precision: Tensor
    by_noise: Tensor
    log_determinant: Tensor


class Hyperpriors(NamedTuple):
    """What is believed of the scales' logarithms and of the unknowns: see `registration.evidence.Hyperprior`.

    Args:
        median: (3,).
        spread: (3,), 0 of one that is known.
        below: the same below the median, (3,).
        lowest: (3,).
        highest: (3,).
        slopes: derivatives of the logarithms of the unknowns' variances, (3, k).
        logs: these logarithms where the scales are 1, (k,).
    """

    median: Tensor
    spread: Tensor
    below: Tensor
    lowest: Tensor
    highest: Tensor
    slopes: Tensor
    logs: Tensor

    def within(self, eta: Tensor) -> Tensor:
        """Values within the bounds, those that are known as they are."""
        known = torch.where(self.spread > 0.0, eta, self.median)
        return torch.minimum(torch.maximum(known, self.lowest), self.highest)

    def log_variances(self, eta: Tensor) -> Tensor:
        """Of the unknowns, (b, k)."""
        return eta @ self.slopes + self.logs

    def spread_at(self, eta: Tensor) -> Tensor:
        """Standard deviations on the side of the medians where the logarithms are, (b, 3); 1 of what is known."""
        return torch.where(self.spread > 0.0, torch.where(eta < self.median, self.below, self.spread), 1.0)

    def cost(self, eta: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and bend of minus the logarithm of what is believed, (b, 3) each."""
        spread = self.spread_at(eta)
        off = torch.where(self.spread > 0.0, eta - self.median, 0.0)
        return off / spread.square(), spread.square().reciprocal()


def law_of(sums: Sums, priors: Hyperpriors, eta: Tensor) -> Law:
    """The unknowns' law at logarithms of the scales, (b, 3)."""
    own = torch.exp(2.0 * eta[:, NOISE])[:, None]
    beside = (torch.exp(eta[:, ERROR])[:, None] * sums.error).square()
    precision = 1.0 / (own + beside)
    none = torch.zeros_like(precision)
    by_noise = torch.stack([2.0 * own * precision, none, 2.0 * beside * precision], dim=1)
    root = torch.exp(0.5 * priors.log_variances(eta))
    matrix = (precision[:, None] @ sums.information.flatten(2)).view(*root.shape, root.shape[1])
    matrix = matrix * root[:, :, None] * root[:, None]
    diagonal = matrix.diagonal(dim1=1, dim2=2)
    unit = 1.0 + torch.finfo(matrix.dtype).eps * diagonal.sum(dim=1, keepdim=True)
    matrix = matrix + torch.diag_embed(unit.expand_as(diagonal))
    factor = torch.linalg.cholesky_ex(matrix)[0]
    identity = torch.eye(root.shape[1], dtype=root.dtype, device=root.device).expand_as(matrix)
    inverse_factor = torch.linalg.solve_triangular(factor, identity, upper=False)
    inverse = inverse_factor.mT @ inverse_factor
    projection = root * (precision[:, None] @ sums.projection)[:, 0]
    mean = (inverse @ projection[..., None])[..., 0]
    determinant = 2.0 * factor.diagonal(dim1=1, dim2=2).log().sum(dim=1)
    return Law(root, inverse, mean, precision, by_noise, determinant)


def value_of(sums: Sums, priors: Hyperpriors, eta: Tensor, law: Law) -> Tensor:
    """Minus the logarithm of the evidence times what is believed, (b,)."""
    projection = (law.precision[:, None] @ sums.projection)[:, 0]
    square = (law.precision * (sums.square + sums.tail)).sum(dim=1) - (law.root * law.mean * projection).sum(dim=1)
    slope, bend = priors.cost(eta)
    believed = (slope.square() / bend).sum(dim=1)
    return 0.5 * (square - (sums.weight * law.precision.log()).sum(dim=1) + law.log_determinant + believed)


def slope_of(sums: Sums, priors: Hyperpriors, eta: Tensor, law: Law) -> Tensor:
    """Gradient of minus the logarithm of the evidence times what is believed, (b, 3)."""
    moved = law.root * law.mean
    second = law.root[:, :, None] * law.inverse * law.root[:, None] + moved[:, :, None] * moved[:, None]
    data = sums.square + sums.tail - 2.0 * (sums.projection @ moved[..., None])[..., 0]
    data = data + (sums.information.flatten(2) @ second.flatten(1)[..., None])[..., 0]
    told = 1.0 - law.inverse.diagonal(dim1=1, dim2=2) - law.mean.square()
    fit = sums.weight - law.precision * data
    return priors.cost(eta)[0] + 0.5 * told @ priors.slopes.T + 0.5 * (law.by_noise @ fit[..., None])[..., 0]


def scored(sums: Sums, priors: Hyperpriors, eta: Tensor, law: Law) -> tuple[Tensor, Tensor]:
    """The scales' logarithms after a step towards the maximum, (b, 3), within their bounds, and how long it was, (b,).

    Its length is that in standard deviations of the logarithms after the data.

    Args:
        sums: what the points tell.
        priors: of scales and unknowns.
        eta: the scales' logarithms, (b, 3).
        law: of the unknowns there.
    """
    slope = slope_of(sums, priors, eta, law)
    told = torch.eye(law.mean.shape[1], dtype=eta.dtype, device=eta.device) - law.inverse
    squares = (priors.slopes @ told.square()) @ priors.slopes.T
    rest = told.diagonal(dim1=1, dim2=2)
    left = (rest - told.square().sum(dim=2)) @ priors.slopes.T  # of each scale, tr (S - S S)
    count = sums.weight.sum(dim=1).clamp_min(1.0)
    share = (1.0 - (2.0 * rest.sum(dim=1) - told.square().sum(dim=(1, 2))) / count).clamp_min(0.1)
    noise = (law.by_noise * sums.weight[:, None]) @ law.by_noise.mT * share[:, None, None]
    mean = (law.by_noise * sums.weight[:, None]).sum(dim=2) / count[:, None]
    across = mean[:, :, None] * left[:, None]
    matrix = 0.5 * (squares + noise + across + across.mT) + torch.diag_embed(priors.cost(eta)[1])
    is_held = (priors.spread <= 0.0) | ((eta <= priors.lowest) & (slope > 0.0))
    is_held = is_held | ((eta >= priors.highest) & (slope < 0.0))
    free = ~is_held
    matrix = torch.where(free[:, :, None] & free[:, None], matrix, torch.diag_embed(torch.ones_like(eta)))
    step = -solved(matrix, torch.where(free, slope, 0.0))
    after = priors.within(eta + step * (_LONGEST / step.abs().amax(dim=1, keepdim=True).clamp_min(_LONGEST)))
    change = torch.where(free, after - eta, 0.0)
    return after, (change[:, None] @ matrix @ change[..., None])[:, 0, 0].clamp_min(0.0).sqrt()


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solution, (b, 3), for matrices (b, 3, 3), by Cramer's rule: libraries stop a GPU for what they call errors."""
    a, b, c = matrix.unbind(dim=2)
    first, second, third = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    whole = (a * first).sum(dim=1, keepdim=True)
    return torch.stack([(each * right).sum(dim=1) for each in (first, second, third)], dim=1) / whole


def scale_covariance(sums: Sums, priors: Hyperpriors, eta: Tensor) -> Tensor:
    """Covariance of the scales' logarithms by the curvature at the maximum, (b, 3, 3); of one at a bound 0."""
    count = len(priors.median)
    bends = []
    for place in range(count):
        ends = []
        for sign in (1.0, -1.0):
            at = eta.clone()
            at[:, place] += sign * _STEP
            ends.append(slope_of(sums, priors, at, law_of(sums, priors, at)))
        bends.append((ends[0] - ends[1]) / (2.0 * _STEP))
    curvature = torch.stack(bends, dim=2)
    is_inside = (eta > priors.lowest + _AT_BOUND) & (eta < priors.highest - _AT_BOUND) & (priors.spread > 0.0)
    spread = torch.where(is_inside, priors.spread_at(eta), 0.0)
    scaled = 0.5 * (curvature + curvature.mT) * spread[:, :, None] * spread[:, None]
    unit = torch.diag_embed(torch.where(is_inside, 0.0, 1.0).to(eta))
    values, vectors = eigen(scaled + unit)
    root = spread[:, :, None] * vectors * values.clamp_min(1.0).rsqrt()[:, None]  # in no direction wider than believed
    return root @ root.mT


def mixed_over_force_scale(sums: Sums, priors: Hyperpriors, eta: Tensor, spread: Tensor) -> tuple[Tensor, Tensor]:
    """What the scale's uncertainty adds to the covariance, (b, k, k), and its mean square, (b,): see `laplace`.

    Args:
        sums: what the points tell.
        priors: of scales and unknowns.
        eta: logarithms of the scales, (b, 3).
        spread: their covariance, (b, 3, 3).
    """
    line = spread[:, FORCE] / spread[:, FORCE, FORCE].sqrt().clamp_min(_TINY)[:, None]
    nodes = [priors.within(eta + place * line) for place, _ in QUADRATURE]
    laws = [law_of(sums, priors, each) for each in nodes]
    density = [
        log(weight) + 0.5 * place**2 - value_of(sums, priors, node, law)
        for (place, weight), node, law in zip(QUADRATURE, nodes, laws, strict=True)
    ]
    weights = torch.softmax(torch.stack(density, dim=1), dim=1)
    every = torch.stack([law.root[:, :, None] * law.inverse * law.root[:, None] for law in laws], dim=1)
    mean = (weights[:, None] @ every.flatten(2)).view_as(laws[0].inverse)
    square = (weights * torch.stack([(2.0 * each[:, FORCE]).exp() for each in nodes], dim=1)).sum(dim=1)
    return mean - every[:, len(nodes) // 2], square


def eigen(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues, (b, 3), and eigenvectors in columns, (b, 3, 3), by Jacobi's rotations: see `solved`."""
    turned = torch.eye(3, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
    for _ in range(5):  # sweeps: quadratic convergence
        for i, j in ((0, 1), (0, 2), (1, 2)):
            angle = 0.5 * torch.atan2(2.0 * matrix[:, i, j], matrix[:, j, j] - matrix[:, i, i])
            cosine, sine = torch.cos(angle), torch.sin(angle)
            rotation = torch.diag_embed(torch.ones_like(matrix[:, 0]))
            rotation[:, i, i] = rotation[:, j, j] = cosine
            rotation[:, i, j], rotation[:, j, i] = sine, -sine
            matrix, turned = rotation.mT @ matrix @ rotation, turned @ rotation
    return matrix.diagonal(dim1=1, dim2=2), turned
