"""Motions that map a body onto itself."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtwin.meshes.body import Body

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_AS_FULL = 1e-6  # fractions of cells that differ by less


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A motion that maps a body onto itself.

    Args:
        nodes: the node that each node lands on, (n,).
        rotation: orthogonal matrix, (3, 3), that vectors turn by; of determinant -1 for a mirror.
    """

    nodes: Ints
    rotation: Floats

    def apply(self, fields: Floats) -> Floats:
        """The nodal vector fields (s, n, 3), moved and turned with the body."""
        moved = np.empty_like(fields)
        moved[:, self.nodes] = fields @ self.rotation.T
        return moved


def identity(body: Body) -> Symmetry:
    """The symmetry that every body has."""
    return Symmetry(np.arange(len(body.points)), np.eye(3))


def symmetries(body: Body, loaded: Ints, tolerance: float = 1e-6, springs: Iterable[str] = ()) -> tuple[Symmetry, ...]:
    """The symmetries of a discrete body of isotropic material among axis swaps and mirrors; the identity comes first.

    Axes are those of the coordinates or, where these show none, the principal axes of the nodes. Nodes must land on
    nodes, cells on cells that are as full, fixed on fixed and loaded on loaded nodes.

    Args:
        body: the body.
        loaded: numbers of the nodes that may carry force, (l,).
        tolerance: largest distance between a moved node and its partner, relative to the body's size.
        springs: names of surfaces that springs hold: each must land on itself.
    """
    centred = body.points - body.points.mean(axis=0)
    tree = cKDTree(centred)
    held = [body.boundary if name == "boundary" else body.surfaces[name] for name in springs]
    for axes in (np.eye(3), np.linalg.eigh(centred.T @ centred)[1]):
        found = [identity(body)]
        for order, indicators in itertools.product(
            itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)
        ):
            rotation = axes @ (np.array(indicators)[:, None] * np.eye(3)[list(order)]) @ axes.T
            distance, nodes = tree.query(centred @ rotation.T)
            moved = not np.allclose(rotation, np.eye(3))
            if moved and distance.max() < tolerance * body.size and _maps(body, loaded, held, nodes):
                found.append(Symmetry(nodes, rotation))
        if len(found) > 1:
            return tuple(found)
    return (identity(body),)


def _maps(body: Body, loaded: Ints, held: Sequence[Ints], nodes: Ints) -> bool:
    cells = np.sort(body.cells, axis=1)
    images = np.sort(nodes[body.cells], axis=1)
    filled = np.ones(len(cells)) if body.fractions is None else body.fractions
    return (
        len(np.unique(nodes)) == len(nodes)
        and np.array_equal(np.sort(nodes[body.fixed]), body.fixed)
        and np.array_equal(np.sort(nodes[loaded]), np.sort(loaded))
        and all(np.array_equal(np.unique(part), np.unique(nodes[part])) for part in held)
        and np.array_equal(np.unique(cells, axis=0), np.unique(images, axis=0))
        and np.allclose(filled[np.lexsort(cells.T)], filled[np.lexsort(images.T)], rtol=0.0, atol=_AS_FULL)
    )
