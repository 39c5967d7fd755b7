"""Unknown poses of a batch: rigid motions about an expected one, with their derivatives; see `registration.pose`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_SMALL = 1e-2  # radians: below it a quotient is its series


class PosePriors(NamedTuple):
    """What is believed of the pose: see `parameters.pose.PosePrior`.

    Args:
        rotation: expected, (3, 3).
        translation: expected, (3,), metres.
        pivot: of the turn, in the camera's coordinates, (3,), metres.
        deviations: of turn and shift, (6,).
    """

    rotation: Tensor
    translation: Tensor
    pivot: Tensor
    deviations: Tensor


class Poses(NamedTuple):
    """Poses at coefficients: y = R x + t.

    Args:
        rotation: R, (b, 3, 3).
        translation: t, (b, 3), metres.
        pivot: where that of the turn is shifted to, (b, 3), metres.
        left: left Jacobian of the turn times its deviations, (b, 3, 3).
    """

    rotation: Tensor
    translation: Tensor
    pivot: Tensor
    left: Tensor

    def back(self, clouds: Tensor) -> Tensor:
        """Clouds, (b, p, 3), from the camera's coordinates to the body's."""
        return (clouds - self.translation[:, None]) @ self.rotation

    def apply(self, places: Tensor) -> Tensor:
        """Places, (b, p, 3), from the body's coordinates to the camera's."""
        return places @ self.rotation.mT + self.translation[:, None]


def poses_at(prior: PosePriors, coefficients: Tensor) -> Poses:
    """For coefficients of unit variance, (b, 6)."""
    turn, shift = (prior.deviations * coefficients).split(3, dim=1)
    angle = torch.linalg.vector_norm(turn, dim=1)[:, None, None]
    x, y, z = turn.unbind(dim=1)
    none = torch.zeros_like(x)
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=1).view(-1, 3, 3)
    square, one = cross @ cross, torch.eye(3, dtype=turn.dtype, device=turn.device)
    half = 0.5 * torch.sinc(angle / (2.0 * torch.pi)).square()
    rotation = one + torch.sinc(angle / torch.pi) * cross + half * square
    series = 1.0 / 6.0 - angle.square() / 120.0
    third = torch.where(angle > _SMALL, (angle - torch.sin(angle)) / angle.clamp_min(_SMALL) ** 3, series)
    left = (one + half * cross + third * square) * prior.deviations[:3]
    pivot = prior.pivot + shift
    translation = (rotation @ (prior.translation - prior.pivot)[:, None])[..., 0] + pivot
    return Poses(rotation @ prior.rotation, translation, pivot, left)


def seen_slopes(prior: PosePriors, poses: Poses, places: Tensor, along: Tensor) -> Tensor:
    """Derivative of where the camera sees places along vectors by the coefficients, (b, p, 6).

    Args:
        prior: what is believed.
        poses: where.
        places: in the camera's coordinates, (b, p, 3), metres.
        along: in its axes, (b, p, 3).
    """
    arms = places - poses.pivot[:, None]
    turned = torch.linalg.cross(arms, along) @ poses.left
    return torch.cat([turned, along * prior.deviations[3:]], dim=2)
