"""Closest points of a moved surface, exact: every triangle is looked at, which a GPU does in one pass."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_CHUNK = 2_000_000  # pairs of point and triangle at a time, where they are not fused
_TINY = 1e-300


class Match(NamedTuple):
    """Clouds on moved surfaces: see `surface_distance.Correspondence`.

    Args:
        distances: signed along the directions, (b, p), metres: positive where the surface is beyond the point.
        directions: unit vectors in which each distance grows, (b, p, 3).
        triangles: that hold the closest points, (b, p).
        weights: barycentric weights of these, (b, p, 3).
    """

    distances: Tensor
    directions: Tensor
    triangles: Tensor
    weights: Tensor


class ClosestPoints:
    """Points on the surfaces of a batch.

    Args:
        triangles: corners, (t, 3).
        touching: as near as that, a point is on the surface, metres.
        device: where.
        is_fused: what calls it is compiled, and no distance of a pair is written down; else some points at a time.
    """

    def __init__(self, triangles: Tensor, touching: float, device: str, is_fused: bool = False) -> None:
        self.triangles, self.touching = triangles.to(device), touching
        self._is_fused = device == "cuda" and is_fused

    def match(self, positions: Tensor, clouds: Tensor) -> Match:
        """Clouds, (b, p, 3), on surfaces with vertices at positions, (b, v, 3), metres."""
        corners = positions[:, self.triangles]  # (b, t, corner, axis)
        chosen = _nearest(corners, clouds) if self._is_fused else _in_chunks(corners, clouds)
        own = torch.take_along_dim(corners, chosen[:, :, None, None], dim=1)
        weights = _weights(own, clouds)
        offsets = (weights[..., None] * own).sum(dim=2) - clouds
        lengths = torch.linalg.vector_norm(offsets, dim=2)
        normals = torch.linalg.cross(own[:, :, 1] - own[:, :, 0], own[:, :, 2] - own[:, :, 0])
        is_on_it = lengths < self.touching
        normals = normals / torch.linalg.vector_norm(normals, dim=2, keepdim=True).clamp_min(_TINY)
        away = offsets / torch.where(is_on_it, 1.0, lengths)[..., None]
        directions = torch.where(is_on_it[..., None], normals, away)
        side = torch.where((directions * normals).sum(dim=2) < 0.0, -1.0, 1.0)
        return Match(side * lengths, side[..., None] * directions, chosen, weights)


def _in_chunks(corners: Tensor, clouds: Tensor) -> Tensor:
    """`_nearest`, some points at a time."""
    parts = clouds.split(max(1, _CHUNK // (corners.shape[0] * corners.shape[1])), dim=1)
    return torch.cat([_nearest(corners, part) for part in parts], dim=1)


def _nearest(corners: Tensor, clouds: Tensor) -> Tensor:
    """The triangle, (b, p), that is nearest to each point, (b, p, 3), of those with corners (b, t, 3, 3)."""
    a, b, c = corners.unbind(dim=2)
    first, second, third = b - a, c - a, c - b
    normal = torch.linalg.cross(first, second)
    square = normal.square().sum(dim=2)
    whole = 1.0 / square.clamp_min(_TINY)
    from_a = _from(clouds, a)
    # Of the foot on the plane, the barycentric weights of the second and the third corner.
    v = _dot(from_a, torch.linalg.cross(second, normal)) * whole[:, None]
    w = _dot(from_a, torch.linalg.cross(normal, first)) * whole[:, None]
    height = _dot(from_a, normal)
    is_inside = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (square > 0.0)[:, None]
    edges = torch.minimum(
        torch.minimum(_to_edge(from_a, first), _to_edge(from_a, second)), _to_edge(_from(clouds, b), third)
    )
    return torch.where(is_inside, height * height * whole[:, None], edges).argmin(dim=2)


def _from(clouds: Tensor, corner: Tensor) -> list[Tensor]:
    """From a corner of each triangle, (b, t, 3), to each point: its components, (b, p, t)."""
    return [clouds[:, :, None, i] - corner[:, None, :, i] for i in range(3)]


def _dot(arms: list[Tensor], vector: Tensor) -> Tensor:
    """Of arms with a vector of each triangle, (b, t, 3)."""
    return arms[0] * vector[:, None, :, 0] + arms[1] * vector[:, None, :, 1] + arms[2] * vector[:, None, :, 2]


def _to_edge(arms: list[Tensor], edge: Tensor) -> Tensor:
    """Squared distance to the edge that begins where the arms do, (b, p, t)."""
    share = (_dot(arms, edge) / edge.square().sum(dim=2).clamp_min(_TINY)[:, None]).clamp(0.0, 1.0)
    off = [arms[i] - share * edge[:, None, :, i] for i in range(3)]
    return off[0] * off[0] + off[1] * off[1] + off[2] * off[2]


def _weights(corners: Tensor, clouds: Tensor) -> Tensor:
    """Barycentric weights of the point of a triangle, (b, p, 3, 3), that is closest to each point, (b, p, 3)."""
    a, b, c = corners.unbind(dim=2)
    first, second, third, arm = b - a, c - a, c - b, clouds - a
    normal = torch.linalg.cross(first, second)
    square = normal.square().sum(dim=2)
    whole = 1.0 / square.clamp_min(_TINY)
    v = (arm * torch.linalg.cross(second, normal)).sum(dim=2) * whole
    w = (arm * torch.linalg.cross(normal, first)).sum(dim=2) * whole
    is_inside = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (square > 0.0)
    shares = [_share(arm, first), _share(arm, second), _share(clouds - b, third)]
    none = torch.zeros_like(v)
    feet = torch.stack(
        [
            torch.stack([1.0 - shares[0], shares[0], none], dim=2),
            torch.stack([1.0 - shares[1], none, shares[1]], dim=2),
            torch.stack([none, 1.0 - shares[2], shares[2]], dim=2),
        ],
        dim=2,
    )  # (b, p, edge, corner)
    off = (feet[..., None] * corners[:, :, None]).sum(dim=3) - clouds[:, :, None]
    best = off.square().sum(dim=3).argmin(dim=2)
    on_edge = torch.take_along_dim(feet, best[:, :, None, None], dim=2)[:, :, 0]
    return torch.where(is_inside[..., None], torch.stack([1.0 - v - w, v, w], dim=2), on_edge)


def _share(arm: Tensor, edge: Tensor) -> Tensor:
    return ((arm * edge).sum(dim=2) / edge.square().sum(dim=2).clamp_min(_TINY)).clamp(0.0, 1.0)
