"""Nonlinear elimination: where Newton's step has to be cut, a few cells are balanced alone before the next one.

Under a tool a handful of cells is strained far more than the rest, and for their sake the step of the whole body is cut
to a tenth or a hundredth. Balanced on their own, all else at rest, they cost little; from there Newton goes on with
whole steps. Gong and Cai (SIAM J. Sci. Comput. 41, 2019) do so for hyperelastic arteries.

It must stay a nudge. Under rough loads a few cells have several states of balance of their own, and with many
eliminations the whole ends on another stable branch than the one that leaves rest: newton.py counts them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from ..fem.assembly import cell_unknowns
from ..fem.discretisation import Discretisation
from ..fem.fenicsx import CellMatrices, cell_dofs

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_SHARE, _MOST = 0.01, 1000  # nodes that are most out of balance, of all and in number


class CellElimination:
    """Newton's steps for the unknowns around the nodes that are most out of balance, the others fixed.

    Args:
        space: numbering of a displacement alone, on one rank.
        matrices: second derivatives of the strain energy.
    """

    def __init__(self, space: Discretisation, matrices: CellMatrices) -> None:
        self.space, self._matrices = space, matrices
        self._blocks, self._unknowns = cell_dofs(space.space), cell_unknowns(space)
        self._count = min(int(np.ceil(_SHARE * len(space.body.points))), _MOST)
        self._free = np.ones(space.owned, dtype=bool)
        self._free[space.fixed] = False

    def around(self, residual: Floats) -> Patch:
        """The cells that touch the nodes most out of balance, and the free unknowns of these cells."""
        forces = np.linalg.norm(residual.reshape(-1, self.space.body.dimension), axis=1)
        worst = np.zeros(len(forces), dtype=bool)
        worst[np.argpartition(forces, -self._count)[-self._count :]] = True
        near = np.zeros(len(forces), dtype=bool)
        near[self._blocks[worst[self._blocks].any(axis=1)]] = True
        return Patch(self, near)

    def matrices(self, unknowns: Floats, cells: Ints) -> Floats:
        """Tangents of some cells at a state."""
        self.space.set_state(unknowns)
        return self._matrices.some(cells)


class Patch:
    """The unknowns of some nodes and all cells that touch them."""

    def __init__(self, whole: CellElimination, nodes: NDArray[np.bool_]) -> None:
        dimension = whole.space.body.dimension
        self._whole = whole
        inside = np.repeat(nodes, dimension) & whole._free
        self.unknowns = np.flatnonzero(inside)
        self._cells = np.flatnonzero(nodes[whole._blocks].any(axis=1))
        place = np.full(len(inside), -1)
        place[self.unknowns] = np.arange(len(self.unknowns))
        mine = place[whole._unknowns[self._cells]]
        rows, columns = np.broadcast_arrays(mine[:, :, None], mine[:, None, :])
        self._entries = np.flatnonzero((rows >= 0) & (columns >= 0))
        self._rows, self._columns = rows.ravel()[self._entries], columns.ravel()[self._entries]

    def step(self, unknowns: Floats, residual: Floats) -> Floats:
        """Newton's direction, to be subtracted, zero outside; not finite where the tangent is singular."""
        values = self._whole.matrices(unknowns, self._cells).ravel()[self._entries]
        size = len(self.unknowns)
        tangent = coo_matrix((values, (self._rows, self._columns)), shape=(size, size)).tocsc()
        step = np.zeros_like(unknowns)
        try:
            factor = splu(tangent, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.1, options={"SymmetricMode": True})
        except RuntimeError:  # exactly singular
            step[self.unknowns] = np.nan
            return step
        step[self.unknowns] = factor.solve(residual[self.unknowns])
        return step
