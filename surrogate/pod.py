"""Proper orthogonal decomposition of what the linear response misses, and the coordinates that it gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, Samples
from softtwin.reference.data.springs import ligaments_of

from .symmetry import Symmetry, identity, symmetries

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_FLOOR = 0.01  # keeps the semi-relative error finite for loads near zero
_DENSE = 3000  # largest eigenproblem of the POD solved directly


def correction_modes(corrections: Floats, fixed: Ints, group: Sequence[Symmetry], count: int) -> Floats:
    """Orthonormal POD modes of nodal fields and of their symmetric images, (3n, r), exactly zero at fixed nodes.

    With several symmetries no cluster of equal singular values is cut, so that the modes span an invariant space.

    Args:
        corrections: snapshots, (s, n, 3).
        fixed: numbers of the fixed nodes.
        group: symmetries of the body, the identity alone for none.
        count: most modes wanted; fewer come where the snapshots hold fewer.

    Raises:
        ValueError: the snapshots are all zero.
    """
    energies, modes = _leading(corrections, group, count + 1)
    if not energies[0] > 0.0:
        raise ValueError("corrections: expected displacements that differ from the linear response, got none that do.")
    kept = min(count, int((energies > 1e-12 * energies[0]).sum()))
    if len(group) > 1:
        while 1 < kept < len(energies) and energies[kept - 1] - energies[kept] < 1e-6 * energies[kept - 1]:
            kept -= 1
    modes = np.ascontiguousarray(modes[:, :kept])
    modes.reshape(len(corrections[0]), 3, kept)[fixed] = 0.0
    return modes


def _leading(fields: Floats, group: Sequence[Symmetry], count: int) -> tuple[Floats, Floats]:
    """Largest eigenvalues and eigenvectors of the covariance of the fields and their images, largest first."""
    rows = np.concatenate([motion.apply(fields).reshape(len(fields), -1) for motion in group])
    samples, size = rows.shape
    count = min(count, samples, size)
    if min(samples, size) > _DENSE:
        return _leading_iterated(rows, count)
    small = rows.T @ rows if size <= samples else rows @ rows.T
    energies, vectors = eigh(small, subset_by_index=(len(small) - count, len(small) - 1))
    energies, vectors = np.maximum(energies[::-1], 0.0), vectors[:, ::-1]
    if size > samples:
        vectors = np.linalg.qr(rows.T @ vectors / np.sqrt(np.maximum(energies, 1e-300)))[0]
    return energies, vectors


def _leading_iterated(rows: Floats, count: int) -> tuple[Floats, Floats]:
    """The same by subspace iteration (Halko, Martinsson, Tropp 2011), for many samples of many unknowns."""
    basis = np.random.default_rng(0).standard_normal((rows.shape[1], count + 32))
    for _ in range(6):
        basis = np.linalg.qr(rows.T @ (rows @ basis))[0]
    _, values, turn = np.linalg.svd(rows @ basis, full_matrices=False)
    return np.square(values[:count]), basis @ turn[:count].T


@dataclass(frozen=True, eq=False)
class ReducedBasis:
    """The coordinates that the reduced network works in.

    Args:
        modes: V, orthonormal, (3n, r), zero at fixed nodes.
        loaded: numbers of the loaded nodes, (l,).
        turns: what each symmetry does to reduced coordinates, (g, r, r).
    """

    modes: Floats
    loaded: Ints
    turns: Floats

    @property
    def count(self) -> int:
        """Number of modes."""
        return self.modes.shape[1]

    @property
    def restricted(self) -> Floats:
        """Modes at the loaded nodes, (3l, r)."""
        return self.modes.reshape(-1, 3, self.count)[self.loaded].reshape(-1, self.count)

    def images(self, coordinates: Floats) -> Floats:
        """Reduced coordinates (s, r) of all symmetric images, (g s, r), symmetry by symmetry."""
        return np.concatenate([coordinates @ turn.T for turn in self.turns])


def sizes_of(fields: Floats) -> Floats:
    """Euclidean norm of each field, (s,), for fields (s, n, 3)."""
    return np.linalg.norm(fields.reshape(len(fields), -1), axis=1)


def semi_relative(displacements: Floats, rms: float) -> Floats:
    """What squared errors of samples are divided by, (s,): |u| rms + 0.01 rms^2, finite for loads near zero.

    Args:
        displacements: (s, n, 3), metres.
        rms: root mean square of |u| over the training samples, metres.
    """
    return sizes_of(displacements) * rms + _FLOOR * rms**2


def learned_basis(data: DataSet, train: Samples, count: int, symmetric: bool) -> ReducedBasis:
    """The basis of what the linear response misses of training samples, the larger ones not all that counts.

    Args:
        data: for its body and linear response.
        train: the samples.
        count: most modes wanted.
        symmetric: whether the body's symmetries are used.

    Raises:
        ValueError: no samples that differ from the linear response.
    """
    rms = float(np.sqrt(np.mean(sizes_of(train.displacements) ** 2)))
    weights = 1.0 / np.sqrt(semi_relative(train.displacements, rms))
    corrections = train.displacements - data.response.apply(train.forces)
    weighted = corrections * weights[:, None, None]
    return build_basis(weighted, data.body, data.response.loaded, group_of(data, symmetric), count)


def basis_of(data: DataSet, modes: Floats, symmetric: bool) -> ReducedBasis:
    """The basis of modes that are known, which span an invariant space where symmetries are used.

    Args:
        data: for its body and loaded nodes.
        modes: V, orthonormal, (3n, r).
        symmetric: whether the body's symmetries are used.
    """
    return ReducedBasis(modes, data.response.loaded, _turns(modes, data.body, group_of(data, symmetric)))


def group_of(data: DataSet, symmetric: bool) -> tuple[Symmetry, ...]:
    """The symmetries of a data set's body, or the identity alone."""
    if not symmetric:
        return (identity(data.body),)
    if ligaments_of(data.springs):  # which pull at one place, and seldom at its images
        return (identity(data.body),)
    return symmetries(data.body, data.response.loaded, springs=data.springs)


def _turns(modes: Floats, body: Body, group: Sequence[Symmetry]) -> Floats:
    fields = modes.T.reshape(-1, *body.points.shape)
    return np.stack([modes.T @ motion.apply(fields).reshape(len(fields), -1).T for motion in group])


def build_basis(corrections: Floats, body: Body, loaded: Ints, group: Sequence[Symmetry], count: int) -> ReducedBasis:
    """The reduced basis of weighted corrections (s, n, 3): see `correction_modes`."""
    modes = correction_modes(corrections, body.fixed, group, count)
    return ReducedBasis(modes, loaded, _turns(modes, body, group))
