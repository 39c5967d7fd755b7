"""What is known where the search of a batch of clouds has ended: states, margins, what neighbours may share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.special import chdtri
from torch import Tensor

from ..loss import REJECTED
from ..policy import ACCURACY, POLICY
from .evidence import ERROR, NOISE, mixed_over_force_scale, scale_covariance
from .operations import Local, Operations, rms
from .pose import seen_slopes

_QUANTILES = 4001  # of a table
_TINY = 1e-300


class Concluded(NamedTuple):
    """See `frames.Frames`."""

    coefficients: Tensor
    moved: Tensor
    displacement: Tensor
    margin: Tensor
    forces: Tensor
    rotation: Tensor
    translation: Tensor
    rms_distance: Tensor
    outliers: Tensor
    may_share_noise: Tensor


class Conclusion:
    """What is told of a batch.

    Args:
        operations: of the search.
        confidence: of the margins, in (0, 1).
    """

    def __init__(self, operations: Operations, confidence: float) -> None:
        self._by, device = operations, operations.rest.device
        table = np.log(chdtri(np.linspace(1.0, 3.0, _QUANTILES), 1.0 - confidence))
        self._quantiles = torch.from_numpy(table).to(device)
        moving = [*range(operations.forces.stop), *range(operations.patterns.start, operations.patterns.stop)]
        if operations.is_said:
            moving += range(operations.pose.start, operations.pose.stop)
        self._moving = torch.tensor(moving, device=device)

    def concluded(self, local: Local, has_settled: Tensor, is_point: Tensor, moved: Tensor) -> Concluded:
        """After the last step, too, which is too short for new derivatives; where none was, that is not known.

        Args:
            local: where the search has ended.
            has_settled: whether the next step would be such a last one, (b,).
            is_point: of the clouds, (b, p).
            moved: largest displacement that the model's error was reckoned with, (b,), metres.
        """
        by, forces = self._by, self._by.forces
        c = local.at - has_settled[:, None] * (local.inverse @ local.gradient[..., None])[..., 0]
        values = by.network_at(c)[0]
        displacement = (by.columns(c, values, moved) @ by.whole.T + by.whole_offset).view(len(c), -1, 3)
        slopes = torch.cat(
            [
                by.whole[:, forces] + by.whole[:, by.decoded] @ local.tangents,
                moved[:, None, None] * by.whole[:, by.decoded.stop :],
            ],
            dim=2,
        )
        slopes = slopes.view(len(c), -1, 3, slopes.shape[2])
        unseen = by.unseen.expand(len(c), -1, -1, -1)
        poses = by.poses_at(c)
        rotation = torch.eye(3, dtype=c.dtype, device=c.device).expand(len(c), 3, 3)
        translation = torch.zeros_like(displacement[:, 0])
        if by.prior is not None and poses is not None:
            rotation, translation = poses.rotation, poses.translation
            if by.is_said:  # as if the camera stood where it was said to: what the pose is off by moves the body
                seen, axes = poses.apply(by.nodes + displacement), by.prior.rotation.mT
                displacement = (seen - by.prior.translation) @ by.prior.rotation - by.nodes
                by_pose = [seen_slopes(by.prior, poses, seen, axes[i].expand_as(seen)) for i in range(3)]
                turn = (axes @ rotation)[:, None]
                slopes = torch.cat([turn @ slopes, torch.stack(by_pose, dim=2)], dim=3)
                unseen = turn @ unseen @ turn.mT
        covariance, believed, force_square = self._posterior(local)
        nodes = slopes @ covariance[:, self._moving[:, None], self._moving][:, None] @ slopes.mT
        nodes = nodes + force_square[:, None, None, None] * unseen
        rest = ((believed * moved)[:, None] * by.whole_rest).square()
        nodes = nodes + rest[:, :, None, None] * torch.eye(3, dtype=c.dtype, device=c.device)
        is_rejected = (local.weights < REJECTED) & is_point
        return Concluded(
            c,
            by.movement(c, local, is_point, moved),
            displacement,
            self._margins(nodes),
            c[:, forces] @ by.force_patterns.T,
            rotation,
            translation,
            rms(local, is_point),
            is_rejected.sum(dim=1) / is_point.sum(dim=1),
            self._may_share_noise(local),
        )

    def _may_share_noise(self, local: Local) -> Tensor:
        """Whether the evidence promises to grow by it, (b,): see `score.gain_by_shared_noise`."""
        if not len(self._by.variances):
            return torch.zeros_like(local.is_graduated)
        solved = local.inverse @ local.shared_mixed
        # What the last step, which the score does not know of, would still change counts, too.
        pull = ((local.gradient[:, None] @ solved)[:, 0] - local.shared) / local.shrunk.sqrt()[:, None]
        told = local.shared_own - local.shared_mixed.mT @ solved
        variances = self._by.variances.repeat(1, 3)
        slopes = 0.5 * (pull.square() - told.diagonal(dim1=1, dim2=2)) @ variances.T
        bends = 0.5 * ((variances @ told.square()) * variances).sum(dim=2)
        return (0.5 * slopes.clamp_min(0.0).square() / bends).amax(dim=1) >= ACCURACY.worth

    def _posterior(self, local: Local) -> tuple[Tensor, Tensor, Tensor]:
        """See `laplace`.

        Covariance of the coefficients, (b, k, k), scale of the model's error in margins, (b,), mean square of that of
        forces, (b,), square newtons.
        """
        eta, priors = local.eta, self._by.priors
        believed = torch.where(eta[:, ERROR] >= 0.0, eta[:, ERROR], POLICY.discrepancy_in_margins * eta[:, ERROR])
        seen = torch.cat([eta[:, :ERROR], believed[:, None]], dim=1)
        held = torch.exp(priors.log_variances(seen) - 2.0 * priors.log_variances(eta))
        there, whole = (_variances(each, local.sums.error) for each in (eta, seen))
        told = ((whole / there.square())[:, None] @ local.sums.information.flatten(2)).view_as(local.inverse)
        covariance = local.inverse @ (torch.diag_embed(held) + told) @ local.inverse
        shift, spread = local.inverse @ local.by_scales, scale_covariance(local.sums, priors, eta)
        widened, square = mixed_over_force_scale(local.sums, priors, eta, spread)
        return covariance + shift @ spread @ shift.mT + widened, torch.exp(believed), square

    def _margins(self, covariances: Tensor) -> Tensor:
        """See `uncertainty.margins_of`; linear between the values of a table, which is good to 1e-8."""
        mean = covariances.diagonal(dim1=2, dim2=3).sum(dim=2)
        squares = covariances.square().sum(dim=(2, 3))
        known = squares > 0.0
        freedom = torch.where(known, mean.square() / squares.clamp_min(_TINY), 1.0).clamp(1.0, 3.0)
        factor = torch.where(known, squares / mean.clamp_min(_TINY), 0.0)
        place = (freedom - 1.0) * (0.5 * (_QUANTILES - 1))
        below = place.floor().clamp_max(_QUANTILES - 2)
        number, part, table = below.long(), place - below, self._quantiles
        return (factor * torch.exp((1.0 - part) * table[number] + part * table[number + 1])).sqrt()


def _variances(eta: Tensor, error: Tensor) -> Tensor:
    """Of the groups, (b, g)."""
    return torch.exp(2.0 * eta[:, NOISE])[:, None] + (torch.exp(eta[:, ERROR])[:, None] * error).square()
