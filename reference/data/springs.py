"""Supports that give way: springs spread over a part of the surface, as ligaments and neighbours hold an organ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softtwin.meshes.body import Body


@dataclass(frozen=True)
class Springs:
    """An elastic foundation: traction -(k_n n n^T + k_t (1 - n n^T)) u on the surface at rest, with its normal n.

    A Robin condition (Winkler's foundation). Springs do not turn with the surface. With no tangential part the surface
    slides; with a normal part far above Young's modulus over the body's size, on a track.

    Args:
        normal: stiffness per area across the surface, k_n, N/m^3.
        tangential: along it, k_t, N/m^3.

    Raises:
        ValueError: a stiffness that is negative or not finite, or none at all.
    """

    normal: float = 0.0
    tangential: float = 0.0

    def __post_init__(self) -> None:
        for name in ("normal", "tangential"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise ValueError(f"Springs.{name}: expected a stiffness of 0 N/m^3 or more, got {value}.")
        if self.normal == 0.0 and self.tangential == 0.0:
            raise ValueError("Springs: expected a stiffness above 0 N/m^3 across or along the surface, got none.")


def checked_springs(springs: Mapping[str, Springs], body: Body) -> dict[str, Springs]:
    """Springs by the surface that they hold.

    Raises:
        ValueError: a surface that the body does not have.
    """
    known = sorted({*body.surfaces, "boundary"})
    for name in springs:
        if name not in known:
            raise ValueError(f"Problem.springs: expected a surface among {known}, got {name!r}.")
    return dict(springs)
