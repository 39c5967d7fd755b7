"""The tensor functions of the materials' energies in torch: each law stands once, in `reference.materials`."""

from __future__ import annotations

import torch
from torch import Tensor


class TorchAlgebra:
    """The tensor functions that energies are written in (`materials.Algebra`), on the last two axes of a batch.

    Args:
        like: a tensor of the precision and on the device wanted.
        minimum: determinants below it are given as a^2 / (2 a - det) with a = least, which is positive and joins
            smoothly, so that energies of what is inside out are finite; 0 leaves them as they are.
    """

    def __init__(self, like: Tensor, minimum: float = 0.0) -> None:
        self.like, self.minimum = like, minimum

    def Identity(self, size: int) -> Tensor:  # noqa: N802 - UFL's name
        """The unit tensor."""
        return torch.eye(size, dtype=self.like.dtype, device=self.like.device)

    def transpose(self, A: Tensor) -> Tensor:
        """A^T."""
        return A.mT

    def dot(self, A: Tensor, B: Tensor) -> Tensor:
        """The product A B."""
        return A @ B

    def sym(self, A: Tensor) -> Tensor:
        """(A + A^T) / 2."""
        return 0.5 * (A + A.mT)

    def tr(self, A: Tensor) -> Tensor:
        """The trace."""
        return A.diagonal(dim1=-2, dim2=-1).sum(dim=-1)

    def det(self, A: Tensor) -> Tensor:
        """The determinant of 3 x 3."""
        found = (A[..., 0, :] * torch.linalg.cross(A[..., 1, :], A[..., 2, :])).sum(dim=-1)
        if not self.minimum:
            return found
        return torch.where(
            found < self.minimum, self.minimum**2 / (2 * self.minimum - found.clamp_max(self.minimum)), found
        )

    def inner(self, A: Tensor, B: Tensor) -> Tensor:
        """A : B."""
        return (A * B).sum(dim=(-2, -1))

    def ln(self, a: Tensor) -> Tensor:
        """The natural logarithm; NaN where a cell is inside out."""
        return a.log()
