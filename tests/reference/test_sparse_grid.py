"""Equilibria on the sparse grid: the beam itself where it fits, near it where its sides cut cells."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("petsc4py", reason="FEniCSx is absent")

from softtwin.meshes.body import Body
from softtwin.meshes.checks import compacted
from softtwin.meshes.grid import SparseGrid, sparse_grid
from softtwin.meshes.shapes import beam
from softtwin.reference.data.materials import NeoHookean
from softtwin.reference.solve.problem import Problem

MATERIAL = NeoHookean(5000.0, 0.3)


@pytest.fixture(scope="module")
def conforming() -> Body:
    return beam((12, 4, 4), (0.6, 0.2, 0.2), "hexahedron")


def bent(grid: SparseGrid, newtons: float = 0.6) -> np.ndarray:
    """Displacement of the surface's vertices under a force on its end."""
    x = grid.surface.points[:, 0]
    end = np.isclose(x, x.max())
    forces = np.zeros_like(grid.surface.points)
    forces[end, 2] = newtons / end.sum()
    with Problem(grid.body, MATERIAL) as problem:
        state = problem.solve(grid.spread(forces))
        assert state.is_stable
    return grid.carry(state.displacement)[end].mean(axis=0)


def expected(body: Body, newtons: float = 0.6) -> np.ndarray:
    tip = body.node_sets["tip"]
    forces = np.zeros_like(body.points)
    forces[tip, 2] = newtons / len(tip)
    with Problem(body, MATERIAL) as problem:
        return problem.solve(forces).displacement[tip].mean(axis=0)


def test_a_grid_that_fits_is_the_beam(conforming: Body) -> None:
    surface = compacted(conforming.boundary_surface)
    left = np.flatnonzero(np.isclose(surface.points[:, 0], 0.0))
    grid = sparse_grid(surface, left, cells_per_axis=(12, 4, 4))
    assert (grid.fractions == 1.0).all()
    fixed = np.isclose(grid.body.points[:, 0], 0.0)
    clamped = SparseGrid(
        **{**vars(grid), "body": grid.body.with_sets(fixed=np.flatnonzero(fixed))}
    )  # the grid fixes whole cells, the beam its face alone
    np.testing.assert_allclose(bent(clamped), expected(conforming), rtol=0.02)  # forces sit on boundary nodes alone


@pytest.mark.parametrize("spacing", [0.044, 0.057])
def test_cut_cells_stand_for_their_part(conforming: Body, spacing: float) -> None:
    """Sides through the middle of cells: the deflection is that of the beam, not of the thicker grid.

    The grid is up to 1.6 times thicker than the beam, which would bend it up to 4 times less; whole cells are fixed, up
    to one tenth of its length. What is left is the discretisation error of three to five cells across.
    """
    surface = compacted(conforming.boundary_surface)
    left = np.flatnonzero(np.isclose(surface.points[:, 0], 0.0))
    grid = sparse_grid(surface, left, spacing=spacing)
    assert grid.fractions.min() < 0.9 and np.ptp(grid.body.points, axis=0)[2] > 1.09 * 0.2
    clear = 0.6 - grid.body.points[grid.body.fixed, 0].max()
    reference = expected(beam((12, 4, 4), (clear, 0.2, 0.2), "hexahedron"))[2]
    assert bent(grid)[2] == pytest.approx(reference, rel=0.15)
